"""The mean force under noise against quadrature and scipy's distributions."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, optimize, stats

import mjxgrad as mg
from mjxgrad.solver.noise import KERNELS

kernels = pytest.mark.parametrize("name", list(KERNELS))
POINTS = np.array([-6.0, -1.3, -0.2, 0.0, 0.7, 2.1, 5.0])
_SIZE = np.sqrt(2 / np.pi)
# Each has the mean size √(2/π) of a standard normal: that of a logistic is 2 ln 2 of its scale, that of Student's t with two
# degrees of freedom √2 of its.
DISTRIBUTIONS = {
    "gaussian": stats.norm(),
    "logistic": stats.logistic(scale=_SIZE / (2 * np.log(2))),
    "log_barrier": stats.t(2, scale=_SIZE / np.sqrt(2)),
}


@functools.cache
def _program(name):
    """Return values, slopes and curvatures of all that a kernel has, compiled together."""
    kernel = KERNELS[name]

    def with_derivatives(function, r):
        slope = jax.grad(function)
        return function(r), slope(r), jax.grad(slope)(r)

    functions = {f: getattr(kernel, f) for f in ("ramp", "share", "density", "depth")}
    return jax.jit(jax.vmap(lambda r: {f: with_derivatives(function, r) for f, function in functions.items()}))


@functools.cache
def _at_points(name):
    return _program(name)(jnp.asarray(POINTS))


@kernels
def test_density_and_share_are_those_of_the_named_distribution(name):
    """To a few units of rounding."""
    found, distribution = _at_points(name), DISTRIBUTIONS[name]
    np.testing.assert_allclose(found["density"][0], distribution.pdf(POINTS), rtol=1e-13)
    np.testing.assert_allclose(found["share"][0], distribution.cdf(-POINTS), rtol=1e-13)
    assert distribution.cdf(-KERNELS[name].reach) < 1e-8


@kernels
def test_ramp_is_the_mean_push(name):
    """E max(-r - w, 0), by quadrature to 1e-10 on a half line; in single precision to some units of rounding times r²."""
    distribution = DISTRIBUTIONS[name]
    single = _program(name)(jnp.asarray(POINTS, jnp.float32))["ramp"][0]
    for r, found, narrow in zip(POINTS, _at_points(name)["ramp"][0], single, strict=True):
        exact, _ = integrate.quad(lambda w, r=r: (-r - w) * distribution.pdf(w), -np.inf, -r, epsabs=1e-12, limit=200)
        assert float(found) == pytest.approx(exact, rel=1e-9, abs=1e-10)
        assert float(narrow) == pytest.approx(exact, rel=2e-6, abs=1e-7)


@kernels
def test_all_push_alike_at_the_surface(name):
    """Half the mean size of the noise."""
    assert float(_at_points(name)["ramp"][0][POINTS == 0][0]) == pytest.approx(_SIZE / 2, rel=1e-14)


def test_log_barrier_is_the_barrier():
    """Its ramp minimises f²/2 + f r - log(f)/κ with κ = 2π; the root of the derivative, f + r - 1/(κ f), by bisection."""
    for r, found in zip(POINTS, _at_points("log_barrier")["ramp"][0], strict=True):
        exact = optimize.brentq(lambda f, r=r: f + r - 1 / (2 * np.pi * f), 1e-9, 1e3, xtol=1e-14)
        assert float(found) == pytest.approx(exact, rel=1e-9)


@kernels
def test_nothing_breaks_at_any_distance_in_single_precision(name):
    """Values and two derivatives stay finite from the surface to slots without contact, whose distance may be 1e10 m.

    Where there is a share left, it is right to some units of rounding times the exponent r²/2, 5 up to r = 3.
    """
    distance = jnp.array([-1e13, -1e4, -40, -2, 0, 0.1, 0.3, 0.6, 1, 1.5, 2, 3, 8, 40, 1e4, 1e13], jnp.float32)
    found = _program(name)(distance)
    for function, values in found.items():
        assert np.isfinite(values).all(), function
        assert values[0].dtype == jnp.float32
    ramp, share = found["ramp"][0], found["share"][0]
    assert ramp[-1] <= 1e-13
    np.testing.assert_allclose(ramp[:2], -distance[:2], rtol=1e-6)
    exact = DISTRIBUTIONS[name].cdf(-np.asarray(distance, float))
    np.testing.assert_allclose(share[3:12], exact[3:12], rtol=1e-6)
    np.testing.assert_allclose(share[12], exact[12], rtol=5e-6)


@kernels
def test_a_smoothing_tells_the_density_in_metres(name):
    """At a length of 4 mm; the log barrier's as the formula of its weight κ = 2π / length², 2 √κ / (4 + κ w²)^(3/2)."""
    length, kappa = 4e-3, 2 * np.pi / 4e-3**2
    found = mg.Smoothing(length, kernel=name).density(jnp.asarray(length * POINTS))
    np.testing.assert_allclose(found, DISTRIBUTIONS[name].pdf(POINTS) / length, rtol=1e-12)
    if name == "log_barrier":
        np.testing.assert_allclose(found, 2 * np.sqrt(kappa) / (4 + kappa * (length * POINTS) ** 2) ** 1.5, rtol=1e-12)


@kernels
def test_slopes_agree(name):
    """S' = -share and share' = -density, by automatic differentiation: a few units of rounding."""
    found = _at_points(name)
    np.testing.assert_allclose(found["ramp"][1], -found["share"][0], rtol=1e-10, atol=1e-15)
    np.testing.assert_allclose(found["ramp"][2], found["density"][0], rtol=1e-10, atol=1e-15)
    np.testing.assert_allclose(found["share"][1], -found["density"][0], rtol=1e-10)
