"""The kernels against quadrature and scipy's distributions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, optimize, stats

from mjxgrad.smoothing import KERNELS

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


@kernels
def test_density_and_share_are_those_of_the_named_distribution(name):
    """To a few units of rounding."""
    kernel, distribution = KERNELS[name], DISTRIBUTIONS[name]
    np.testing.assert_allclose(kernel.density(jnp.asarray(POINTS)), distribution.pdf(POINTS), rtol=1e-13)
    np.testing.assert_allclose(kernel.share(jnp.asarray(POINTS)), distribution.cdf(-POINTS), rtol=1e-13)
    assert kernel.stddev == pytest.approx(distribution.std(), rel=1e-12)


@kernels
def test_ramp_is_the_mean_push(name):
    """E max(-r - w, 0), by quadrature to 1e-10 on a half line."""
    kernel, distribution = KERNELS[name], DISTRIBUTIONS[name]
    for r in POINTS:
        exact, _ = integrate.quad(lambda w, r=r: (-r - w) * distribution.pdf(w), -np.inf, -r, epsabs=1e-12, limit=200)
        assert float(kernel.ramp(jnp.asarray(r))) == pytest.approx(exact, rel=1e-9, abs=1e-10)


@kernels
def test_all_push_alike_at_the_surface(name):
    """Half the mean size of the noise."""
    assert float(KERNELS[name].ramp(jnp.array(0.0))) == pytest.approx(_SIZE / 2, rel=1e-14)


def test_log_barrier_is_the_barrier():
    """Its ramp minimises f²/2 + f r - log(f)/κ with κ = 2π; the root of the derivative, f + r - 1/(κ f), by bisection."""
    for r in POINTS:
        exact = optimize.brentq(lambda f, r=r: f + r - 1 / (2 * np.pi * f), 1e-9, 1e3, xtol=1e-14)
        assert float(KERNELS["log_barrier"].ramp(jnp.asarray(r))) == pytest.approx(exact, rel=1e-9)


@kernels
def test_nothing_breaks_at_any_distance_in_single_precision(name):
    """Values and two derivatives stay finite from the surface to slots without contact, whose distance may be 1e10 m."""
    kernel = KERNELS[name]
    distance = jnp.array([-1e13, -1e4, -40.0, 0.0, 12.0, 40.0, 1e4, 1e13], jnp.float32)
    for function in (kernel.ramp, kernel.share, kernel.density, kernel.depth):
        slope = jax.grad(function)
        every = jax.jit(jax.vmap(lambda r, f=function, s=slope: (f(r), s(r), jax.grad(s)(r))))
        for values in every(distance):
            assert np.isfinite(values).all(), function
            assert values.dtype == jnp.float32
    assert kernel.ramp(distance)[-1] <= 1e-13
    np.testing.assert_allclose(kernel.ramp(distance)[:2], -distance[:2], rtol=1e-6)


@kernels
def test_slopes_agree(name):
    """S' = -share and share' = -density, also where derivatives are taken automatically: a few units of rounding."""
    kernel, points = KERNELS[name], jnp.asarray(POINTS)
    np.testing.assert_allclose(jax.vmap(jax.grad(kernel.ramp))(points), -kernel.share(points), rtol=1e-10, atol=1e-15)
    np.testing.assert_allclose(jax.vmap(jax.grad(kernel.share))(points), -kernel.density(points), rtol=1e-10)
