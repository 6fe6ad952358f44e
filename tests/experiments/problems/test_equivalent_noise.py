"""What noise a contact's profile stands for."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from experiments.problems.equivalent_noise import contact_profile, probe
from tests.solver.test_kernels import DISTRIBUTIONS

SCENE = """<mujoco><worldbody><geom type="plane" size="5 5 .1" solimp="{0}" margin="{1}"/>
  <body pos="0 0 1"><freejoint/><geom size=".1" solimp="{0}"/></body></worldbody></mujoco>"""
LENGTH, REACH = 2e-3, 0.05
CONSTANT, RISING = ".9 .9 .001", ".9 .95 .001"


@functools.cache
def _scene(solimp, margin):
    return mg.load_scene(SCENE.format(solimp, margin))


def _probe(solimp=CONSTANT, margin=0.0, **settings):
    return probe(contact_profile(_scene(solimp, margin), **settings), reach=REACH)


@pytest.mark.parametrize("name", list(DISTRIBUTIONS))
def test_a_kernel_is_read_off_its_force(name):
    """Density, mean and standard deviation; second differences over 1/40 of a length are good to its square, 1e-3 of the peak."""
    found = _probe(smoothing=mg.Smoothing(LENGTH, name))
    assert found.is_noise
    exact = DISTRIBUTIONS[name].pdf(found.noise / LENGTH) / LENGTH
    np.testing.assert_allclose(found.density, exact, atol=1e-3 * exact.max())
    assert found.mean == pytest.approx(0, abs=1e-6)
    assert found.stddev == pytest.approx(LENGTH * DISTRIBUTIONS[name].std(), rel=1e-3)


def test_constant_impedance_is_noise_of_no_width_and_a_margin_shifts_it():
    """With d = 0.9 the slope is d / (1 - d) K d = 9 · 0.9 / (0.9 · 0.02)²."""
    found = _probe(margin=0.003)
    assert found.is_noise
    assert (found.mean, found.stddev) == (pytest.approx(-0.003), 0)
    assert found.slope == pytest.approx(9 * 0.9 / 0.018**2, rel=1e-9)


def test_rising_impedance_is_no_noise():
    """The force is zero at the surface and on a line through it deep inside, and cannot be convex between."""
    found = _probe(RISING)
    assert not found.is_noise
    assert "not convex" in found.reason
    assert np.isnan(found.stddev)


def test_a_force_that_jumps_is_no_noise_until_it_is_smoothed_without_gate():
    """Bodies that accelerate towards each other; a row without gate shifts by a / c instead, c = K d."""
    assert "jumps by 45" in _probe(acceleration=-5.0).reason  # D a = 9 · 5
    found = _probe(acceleration=-5.0, smoothing=mg.Smoothing(LENGTH, gated=False))
    assert found.is_noise
    assert found.mean == pytest.approx(-5.0 * 0.018**2 / 0.9, rel=1e-6)


def test_profiles_of_any_kind_are_told_apart():
    """A smooth step has no slope inside; a force that stays at a distance is none of a ramp."""
    assert "does not grow" in probe(lambda r: jnp.where(r < 0, 1.0, 0.0), reach=1.0).reason
    assert "does not vanish" in probe(lambda r: jnp.maximum(-r, 0) + 0.5, reach=1.0).reason


@pytest.mark.parametrize(
    ("profile", "settings", "message"),
    [
        (lambda r: -r, {"reach": 0.0}, "reach must be positive, got 0"),
        (lambda r: jnp.sqrt(-r), {"reach": 1.0}, "profile must be finite, got nan"),
    ],
)
def test_what_cannot_be_probed_is_refused(profile, settings, message):
    """With name and value."""
    with pytest.raises(ValueError, match=message):
        probe(profile, **settings)
