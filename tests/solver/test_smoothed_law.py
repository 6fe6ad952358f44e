"""The laws of rows under noise against quadrature of the laws without."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from mjxgrad.solver import constraint
from mjxgrad.solver.constraint import ConeGroup, Noise, RowLayout, Rows
from mjxgrad.solver.noise import KERNELS
from tests.solver.test_noise import DISTRIBUTIONS, kernels

LENGTH, RATE = 2e-3, 900.0  # m, 1/s²


def _nodes(kinks, name="gaussian", num_nodes=40):
    """Return noise and its weights, Gauss and Legendre's between kinks, for means over a whole line with heavy tails.

    In s with w = s / (1 - s²) the mean of a push has no singularity at either end even under Student's t: dw grows like
    (1 - s²)⁻², and density times push falls off like w⁻², that is (1 - s²)².
    """
    w = np.asarray(kinks)
    inner = np.where(w == 0, 0.0, 2 * w / (1 + np.sqrt(1 + 4 * w**2)))
    fixed = np.broadcast_to([-1, -0.9, -0.8, -0.6, 0, 0.6, 0.8, 0.9, 1], (*w.shape[:-1], 9))
    ends = np.sort(np.concatenate([inner, fixed], axis=-1), axis=-1)
    x, weight = np.polynomial.legendre.leggauss(num_nodes)
    half = np.diff(ends, axis=-1)[..., None] / 2
    s = (ends[..., :-1, None] + half * (1 + x)).reshape(*w.shape[:-1], -1)
    noise = s / (1 - s**2)
    measure = (half * weight).reshape(s.shape) * (1 + s**2) / (1 - s**2) ** 2
    return noise, measure * DISTRIBUTIONS[name].pdf(noise)


@kernels
def test_force_of_a_row_is_the_mean_over_noise(name):
    """-D E[(x + c w) 1(x + c w < 0)], gated by r + w < 0, to 1e-8 of the largest; above, below and at the gate."""
    distance = np.array([-6e-3, -1e-3, 0.0, 1.5e-3, 4e-3, -2e-3, 2e-3])
    x = RATE * distance + np.array([1.0, -3.0, -2.0, 2.0, -9.0, 0.0, -2.5])
    weight = np.linspace(1.0, 3.0, len(x))
    layout = RowLayout(0, 0, len(x), (), 0, KERNELS[name])
    noise = Noise(jnp.full(len(x), RATE * LENGTH), jnp.asarray(RATE * distance))
    rows = Rows(jnp.zeros(len(x)), jnp.asarray(weight), jnp.zeros(len(x)), (), noise)
    last = np.minimum(-x / RATE, -distance)[:, None]
    w, share = _nodes(last / LENGTH, name)
    pushes = np.where(LENGTH * w < last, x[:, None] + RATE * LENGTH * w, 0.0)
    exact = -weight * np.sum(share * pushes, axis=1)
    np.testing.assert_allclose(constraint.force(layout, rows, jnp.asarray(x)), exact, rtol=1e-8, atol=1e-8)


def _cone(dim, contacts=6):
    """Return laws without noise of contacts with unlike friction, and x in all three zones, the apex and at rest included."""
    random = np.random.default_rng(4)
    friction = np.array([0.7, 0.7, 0.3, 0.2, 0.1])[: dim - 1] * np.linspace(0.5, 1.5, contacts)[:, None]
    mu = friction[:, :1] / np.sqrt(2.0)
    first = np.linspace(1.0, 2.0, contacts)[:, None]
    weight = np.concatenate([first, first * friction**2 / mu**2], axis=1)
    x = random.normal(size=(contacts, dim)) * 2
    x[:, 0] = [-6.0, -1.5, 0.1, 1.0, 2.0, -2.0]
    x[1, 1:] *= 1e-9  # all but at rest, where pulls along the tangent cancel
    x[5, 1:] = 0
    layout = RowLayout(0, 0, contacts * dim, (ConeGroup(0, contacts, dim),))
    scales = (jnp.asarray(np.concatenate([mu, friction], axis=1)),)
    rows = Rows(jnp.zeros(contacts * dim), jnp.asarray(weight.ravel()), jnp.zeros(contacts * dim), scales)
    return layout, rows, x


def _noisy_cone(layout, rows, distance, name="gaussian"):
    dim = layout.cones[0].dim
    gate = jnp.asarray(np.repeat(RATE * distance, dim))
    noise = Noise(jnp.full(gate.shape, RATE * LENGTH), gate)
    noisy = Rows(rows.reference, rows.weight, rows.bound, rows.scales, noise)
    return dataclasses.replace(layout, first_noisy=0, kernel=KERNELS[name]), noisy


DISTANCE = np.array([-2e-3, -1e-3, 0.0, 1e-3, 3e-3, -5e-4])


@kernels
def test_force_of_a_cone_is_the_mean_over_noise_on_the_normal_distance(name):
    """Of MuJoCo's three zones, with a kink wherever a zone begins along the noise: 1e-8 of forces of order one."""
    layout, rows, x = _cone(6)
    noisy_layout, noisy = _noisy_cone(layout, rows, DISTANCE, name)
    found = jax.jit(lambda y: constraint.force(noisy_layout, noisy, y))(jnp.asarray(x.ravel())).reshape(x.shape)
    scale = np.asarray(rows.scales[0])
    slip = np.linalg.norm(x[:, 1:] * scale[:, 1:], axis=1)
    kinks = [(slip - x[:, 0]) / RATE, (-slip / scale[:, 0] ** 2 - x[:, 0]) / RATE, -DISTANCE]
    w, share = _nodes(np.stack(kinks, axis=1) / LENGTH, name)
    share = np.where(LENGTH * w < -DISTANCE[:, None], share, 0.0)
    shifted = np.repeat(x[None], w.shape[1], axis=0)
    shifted[:, :, 0] += RATE * LENGTH * w.T
    hard = jax.jit(jax.vmap(lambda y: constraint.force(layout, rows, y.ravel()).reshape(y.shape)))(jnp.asarray(shifted))
    exact = np.einsum("in,nik->ik", share, np.asarray(hard))
    np.testing.assert_allclose(found, exact, rtol=1e-8, atol=1e-8)


@kernels
def test_curvature_of_a_cone_is_the_derivative_of_its_force_and_positive(name):
    """Also where it does not slip; 1e-7 leaves room for the trapezoidal rule there, see the law."""
    layout, rows, x = _cone(4)
    layout, rows = _noisy_cone(layout, rows, DISTANCE, name)
    point = jnp.asarray(x.ravel())
    product = jax.jit(lambda y: constraint.curvature_product(layout, rows, y, jnp.eye(len(point))))(point)
    slope = -jax.jit(jax.jacfwd(lambda y: constraint.force(layout, rows, y)))(point)
    np.testing.assert_allclose(product, slope, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(product, product.T, atol=1e-9)
    assert np.linalg.eigvalsh(product).min() > -1e-9


@kernels
def test_cone_in_single_precision_is_that_of_double(name):
    """Relative to the largest force, 1e-5: some tens of units of rounding."""
    layout, rows, x = _cone(3)
    layout, rows = _noisy_cone(layout, rows, DISTANCE, name)
    point = jnp.asarray(x.ravel())
    force = jax.jit(lambda r, y: constraint.force(layout, r, y))
    double = force(rows, point)
    narrow = jax.tree.map(lambda a: a.astype(jnp.float32), rows)
    single = force(narrow, point.astype(jnp.float32))
    np.testing.assert_allclose(single, double, atol=1e-5 * np.abs(double).max())
