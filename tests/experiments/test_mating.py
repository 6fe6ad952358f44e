"""Pressure on a peg and depths of it, from closed forms, energy, and convergence."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.mating import HALF, Settings, outcome_of, walls, wrench

STIFFNESS, THICKNESS = 4e7, 0.02
POINTS = (None, 16, 256)


def pushed(pose, clearance=0.001, chamfer=0.0, number=None):
    return np.asarray(wrench(jnp.array(pose), walls(clearance, chamfer), STIFFNESS, number))


@pytest.mark.parametrize("number", POINTS)
def test_a_flat_overlap_is_pushed_by_stiffness_times_depth_times_area(number):
    """Far from the rim, at 0.3 mm: the whole lower face is inside, and side faces push alike from both sides."""
    depth, area = 3e-4, 2 * HALF[0] * THICKNESS
    assert pushed([0.07, HALF[1] - depth, 0.0], number=number) == pytest.approx(
        [0, STIFFNESS * depth * area, 0], abs=0.2 if number == 16 else 0.05
    )


def test_over_the_rim_the_pressure_is_exact():
    """Of a face, w inside at depth d, the depth is the least of d and the way to the wall's side: d w − d²/2 in all."""
    depth, offset = 3e-4, 0.005
    width = offset + HALF[0] - (HALF[0] + 0.001)
    found = pushed([offset, HALF[1] - depth, 0.0])
    assert found[1] == pytest.approx(STIFFNESS * THICKNESS * (depth * width - depth**2 / 2), rel=1e-12)
    assert found[0] == pytest.approx(-STIFFNESS * THICKNESS * depth**2 / 2, rel=1e-12)


def test_a_peg_in_the_middle_of_its_hole_feels_nothing():
    assert pushed([0.0, 0.02, 0.0]) == pytest.approx([0, 0, 0], abs=1e-12)


def test_points_tend_to_the_pressure():
    """The rule's error falls as the number of points, for the depth ends within an edge with a kink: at least by a half."""
    pose = [0.004, 0.036, 0.05]
    exact = pushed(pose, chamfer=0.003)
    errors = [np.linalg.norm(pushed(pose, chamfer=0.003, number=n) - exact) for n in (64, 256, 4096)]
    assert (np.diff(np.log(errors)) < -np.log(2)).all()
    assert errors[-1] < 1e-2 * np.linalg.norm(exact)


def test_the_force_is_mirrored_with_the_peg():
    right, left = (pushed([s * 0.004, 0.036, s * 0.05], chamfer=0.003) for s in (1, -1))
    assert left == pytest.approx(right * [-1, 1, -1], rel=1e-12)


def test_the_pressure_has_no_jump_where_a_box_has_one():
    """Along an offset past the rim, 5 mm deep: the largest change between neighbours falls with their distance."""
    force = jax.jit(
        jax.vmap(lambda x: wrench(jnp.stack([x, HALF[1] - 0.005, 0.03]), walls(0.001, 0.0), STIFFNESS, None))
    )
    forces = np.asarray(force(jnp.linspace(0, 0.008, 2001)))
    finer, coarser = (np.abs(np.diff(forces[::step], axis=0)).max() for step in (1, 10))
    assert finer < 0.2 * coarser


def test_the_derivative_of_a_mating_is_its_difference_and_a_centred_peg_falls_in_by_either_contact():
    settings, rest, little, at = Settings(experiment="mating"), jnp.zeros((3, 2)), 1e-6, 0.003
    depth = outcome_of("pressure", settings, 0.001, 0.003)
    both = jax.jit(jax.vmap(lambda p: jax.jvp(lambda q: depth(q, rest), (p,), (jnp.ones_like(p),))))
    (below, _, above, centred), slopes = both(jnp.array([at - little, at, at + little, 0.0]))
    assert float(slopes[1]) == pytest.approx(float(above - below) / (2 * little), rel=1e-3)
    assert abs(float(slopes[1])) > 0.1
    assert centred > 0.02
    assert outcome_of("boxes", settings, 0.002)(jnp.asarray(0.0), rest) > 0.02
