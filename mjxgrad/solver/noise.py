r"""Noise on the distance of a contact: its mean force in closed form, for several distributions.

The force of a contact is the ramp $\max(-r, 0)$ of its distance $r$. Under noise $w$ of density $\rho$ on the distance it becomes

$$S(r) = \mathbb{E} \max(-r - w, 0), \qquad S'(r) = -P(w < -r), \qquad S''(r) = \rho(-r).$$

Read backwards, a force at a distance $F$ that deep inside runs along $-s\,r$ is the mean under the density $F''(-w) / s$: exactly
if $F$ is convex and asymptotic to that ramp. An impedance that rises with depth is not convex; a margin shifts a ramp.

All densities are even. Distances are in units of the *length*, the standard deviation of the Gaussian. The others are scaled to
its mean $|w|$, and so to the same force at the surface, $S(0) = 1 / \sqrt{2\pi}$.

| kernel | softened ramp | density | standard deviation | far away |
|---|---|---|---|---|
| `gaussian` | $\varphi(r) - r\,\Phi(-r)$ | normal | 1 | $e^{-r^2/2} / r^2$ |
| `logistic` | $\beta\,\mathrm{softplus}(-r/\beta)$, $\beta = 0.576$ | logistic | $\pi \beta / \sqrt 3 = 1.044$ | $e^{-r/\beta}$ |
| `log_barrier` | $(-r + \sqrt{r^2 + 4/\kappa}) / 2$, $\kappa = 2\pi$ | Student's t, 2 degrees of freedom | infinite | $1 / r$ |

The ramp is the $f \ge 0$ that minimises $f^2/2 + f r$; with the barrier $-\log(f)/\kappa$ in place of the bound, the minimiser is
the log barrier's $S(r)$.

References:
    Pang, Suh, Yang, Tedrake. Global Planning for Contact-Rich Manipulation via Local Smoothing of Quasi-dynamic
    Contact Models. IEEE Transactions on Robotics 2023, arXiv:2206.10787 (randomised smoothing, and the log barrier).
"""

import dataclasses
import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import special

_Shape = Float[Array, "*shape"]
# Mean of |w| under every kernel, β of the logistic, and 4/κ of the log barrier.
_MEAN_SIZE = math.sqrt(2 / math.pi)
_BETA = _MEAN_SIZE / (2 * math.log(2))
_SQUARE = _MEAN_SIZE**2
# Fit of the normal tail: degree by the size of a number in bytes, with relative errors of 9e-8 and 1e-14.
_TAIL_SCALE = 3.0
_TAIL_DEGREE = {4: 10, 8: 24}


@dataclasses.dataclass(frozen=True)
class Kernel:
    """A distribution of noise, and the mean force of a contact under it; static, since it shapes the compiled program."""

    reach: float  # distance beyond which `share` is below 1e-8, and `depth` is held
    ramp: Callable[[_Shape], _Shape]  # mean force at a distance
    share: Callable[[_Shape], _Shape]  # probability of contact at a distance, minus the slope of `ramp`
    density: Callable[[_Shape], _Shape]  # density of the noise, minus the slope of `share`

    def depth(self, distance: _Shape) -> _Shape:
        """Return the mean penetration given contact; constant beyond `reach`, where contact is improbable."""
        near = jnp.minimum(distance, self.reach)
        return self.ramp(near) / self.share(near)


@functools.cache
def _tail_coefficients(degree: int) -> tuple[float, ...]:
    """Return the polynomial in s = 2t - 1 of log(Φ(-r) / t) + r²/2, t = 1 / (1 + r/3), highest power first."""

    def rest(t: np.ndarray) -> np.ndarray:
        return np.log(0.5 * special.erfcx(_TAIL_SCALE * math.sqrt(0.5) * (1 / t - 1)) / t)

    fit = np.polynomial.Chebyshev.interpolate(rest, degree, domain=[0.0, 1.0])
    return tuple(np.polynomial.chebyshev.cheb2poly(fit.coef)[::-1].tolist())


@jax.custom_jvp
def _normal_share(r: _Shape) -> _Shape:
    """Return Φ(-r) to relative rounding for either sign of r."""
    # Not by `jax.lax.erfc`, which ends in polynomials: XLA considers them cheap and evaluates them again for every
    # entry of the Hessian. An exponential is computed once and stored.
    size = jnp.abs(r)
    t = 1 / (1 + size / _TAIL_SCALE)
    s = 2 * t - 1
    exponent = functools.reduce(lambda sum_, c: sum_ * s + c, _tail_coefficients(_TAIL_DEGREE[r.dtype.itemsize]))
    tail = t * jnp.exp(exponent - 0.5 * size * size)
    return jnp.where(r > 0, tail, 1 - tail)


@_normal_share.defjvp
def _share_jvp(primals, tangents):
    return _normal_share(*primals), -_normal_density(*primals) * tangents[0]


@jax.custom_jvp
def _normal_ramp(r: _Shape) -> _Shape:
    """Return φ(r) - r Φ(-r) to a few units of relative rounding times r²."""
    return _normal_density(r) - r * _normal_share(r)


@_normal_ramp.defjvp
def _ramp_jvp(primals, tangents):
    return _normal_ramp(*primals), -_normal_share(*primals) * tangents[0]


def _normal_density(w: _Shape) -> _Shape:
    return jnp.exp(-0.5 * w**2) * (1 / math.sqrt(2 * math.pi))


def _barrier_ramp(r: _Shape) -> _Shape:
    # Two forms of the same number: each cancels on the other side.
    root = jnp.sqrt(r**2 + _SQUARE)
    return jnp.where(r > 0, 0.5 * _SQUARE / (root + jnp.abs(r)), 0.5 * (root - r))


KERNELS: dict[str, Kernel] = {
    "gaussian": Kernel(6.0, _normal_ramp, _normal_share, _normal_density),
    "logistic": Kernel(
        reach=11.0,
        ramp=lambda r: _BETA * jax.nn.softplus(-r / _BETA),
        share=lambda r: jax.nn.sigmoid(-r / _BETA),
        density=lambda w: jax.nn.sigmoid(-w / _BETA) * jax.nn.sigmoid(w / _BETA) / _BETA,
    ),
    "log_barrier": Kernel(
        reach=1e4,
        ramp=_barrier_ramp,
        share=lambda r: _barrier_ramp(r) / jnp.sqrt(r**2 + _SQUARE),
        density=lambda w: 0.5 * _SQUARE * (w**2 + _SQUARE) ** -1.5,
    ),
}
