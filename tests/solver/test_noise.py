"""The mean force under noise against quadrature and scipy's distribution."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from mjxgrad.solver import noise

POINTS = np.array([-6.0, -1.3, -0.2, 0.0, 0.7, 2.1, 5.0])
NORMAL = stats.norm()


@functools.cache
def _program():
    """Return values, slopes and curvatures of all functions, compiled together."""

    def with_derivatives(function, r):
        slope = jax.grad(function)
        return function(r), slope(r), jax.grad(slope)(r)

    functions = {f: getattr(noise, f) for f in ("ramp", "share", "density", "depth")}
    return jax.jit(jax.vmap(lambda r: {f: with_derivatives(function, r) for f, function in functions.items()}))


@functools.cache
def _at_points():
    return _program()(jnp.asarray(POINTS))


def test_density_and_share_are_those_of_the_normal_distribution():
    """To a few units of rounding."""
    found = _at_points()
    np.testing.assert_allclose(found["density"][0], NORMAL.pdf(POINTS), rtol=1e-13)
    np.testing.assert_allclose(found["share"][0], NORMAL.cdf(-POINTS), rtol=1e-13)
    assert NORMAL.cdf(-noise.REACH) < 1e-8


def test_ramp_is_the_mean_push():
    """E max(-r - w, 0), by quadrature to 1e-10 on a half line."""
    for r, found in zip(POINTS, _at_points()["ramp"][0], strict=True):
        exact, _ = integrate.quad(lambda w, r=r: (-r - w) * NORMAL.pdf(w), -np.inf, -r, epsabs=1e-12, limit=200)
        assert float(found) == pytest.approx(exact, rel=1e-9, abs=1e-10)


def test_nothing_breaks_at_any_distance_in_single_precision():
    """Values and two derivatives stay finite from the surface to slots without contact, whose distance may be 1e10 m.

    Where there is a share left, it is right to some units of rounding times the exponent r²/2, 5 up to r = 3.
    """
    distance = jnp.array([-1e13, -1e4, -40, -2, 0, 0.1, 0.3, 0.6, 1, 1.5, 2, 3, 8, 40, 1e4, 1e13], jnp.float32)
    found = _program()(distance)
    for function, values in found.items():
        assert np.isfinite(values).all(), function
        assert values[0].dtype == jnp.float32
    ramp, share = found["ramp"][0], found["share"][0]
    assert ramp[-1] <= 1e-13
    np.testing.assert_allclose(ramp[:2], -distance[:2], rtol=1e-6)
    exact = NORMAL.cdf(-np.asarray(distance, float))
    np.testing.assert_allclose(share[3:12], exact[3:12], rtol=1e-6)
    np.testing.assert_allclose(share[12], exact[12], rtol=5e-6)


def test_slopes_agree():
    """S' = -share and share' = -density, by automatic differentiation: a few units of rounding."""
    found = _at_points()
    np.testing.assert_allclose(found["ramp"][1], -found["share"][0], rtol=1e-10, atol=1e-15)
    np.testing.assert_allclose(found["ramp"][2], found["density"][0], rtol=1e-10, atol=1e-15)
    np.testing.assert_allclose(found["share"][1], -found["density"][0], rtol=1e-10)
