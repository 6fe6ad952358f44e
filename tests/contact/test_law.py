"""The law of a row: powers that are known to be squares, and time constants that refsafe clamps."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from mjxgrad.contact.law import impedance, is_square, stiffness_damping

PARABOLA = np.array([[0.9, 0.95, 0.001, 0.3, 2.0], [0.1, 0.99, 0.02, 0.5, 2.0]])


@pytest.mark.parametrize("row", [0, 1])
def test_a_parabola_is_a_power_law_of_two(row):
    """On both sides of the midpoint and beyond the width, value and derivative, to rounding."""
    solimp = jnp.asarray(PARABOLA[row])
    depths = -jnp.array([0.0, 0.1, 0.29, 0.6, 0.99, 1.5]) * PARABOLA[row, 2]
    pairs = [
        jax.jit(jax.vmap(jax.value_and_grad(lambda r, s=is_known: impedance(solimp, r, is_square=s).present)))(depths)
        for is_known in (False, True)
    ]
    np.testing.assert_allclose(pairs[1], pairs[0], rtol=1e-13)


def test_only_what_is_known_is_a_square():
    other = PARABOLA.copy()
    other[1, 4] = 3.0
    assert is_square(PARABOLA, np.zeros((0, 5)))
    assert not is_square(PARABOLA, other)
    seen = []
    jax.jit(lambda solimp: seen.append(is_square(solimp)))(jnp.asarray(PARABOLA))
    assert seen == [False]


@pytest.mark.parametrize(("steps", "slope"), [(1.5, 0.0), (2.0, -2.0), (4.0, -2.0)])
def test_at_refsafes_clamp_the_derivative_is_that_of_the_unclamped_side(steps, slope):
    """B = 2 / t_c falls by 2 / t_c² from two time steps on, and below them not at all."""
    model = mjx.put_model(mujoco.MjModel.from_xml_string("<mujoco/>"))
    constant = steps * model.opt.timestep
    found = jax.grad(lambda t: stiffness_damping(model, jnp.stack([t, jnp.ones_like(t)]))[1])(constant)
    assert float(found) == pytest.approx(slope / float(constant) ** 2, rel=1e-6)
