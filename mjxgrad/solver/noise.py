r"""Gaussian noise on the distance of a contact: its mean force, in closed form.

The force of a contact is the ramp $\max(-r, 0)$ of its distance $r$. Under standard normal noise $w$ on the distance it becomes

$$S(r) = \mathbb{E} \max(-r - w, 0) = \varphi(r) - r\,\Phi(-r), \qquad S'(r) = -P(w < -r), \qquad S''(r) = \varphi(r).$$

Distances are in units of the *length*, the standard deviation. At the surface $S(0) = \mathbb{E}|w| / 2 = 1 / \sqrt{2\pi}$.

References:
    Pang, Suh, Yang, Tedrake. Global Planning for Contact-Rich Manipulation via Local Smoothing of Quasi-dynamic
    Contact Models. IEEE Transactions on Robotics 2023, arXiv:2206.10787 (randomised smoothing of contact).
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import special

_Shape = Float[Array, "*shape"]
REACH = 6.0
"""Distance beyond which `share` is below 1e-8, and `depth` is held."""
# Fit of the normal tail: degree by the size of a number in bytes, with relative errors of 9e-8 and 1e-14.
_TAIL_SCALE = 3.0
_TAIL_DEGREE = {4: 10, 8: 24}


@functools.cache
def _tail_coefficients(degree: int) -> tuple[float, ...]:
    """Return the polynomial in s = 2t - 1 of log(Φ(-r) / t) + r²/2, t = 1 / (1 + r/3), highest power first."""

    def rest(t: np.ndarray) -> np.ndarray:
        return np.log(0.5 * special.erfcx(_TAIL_SCALE * math.sqrt(0.5) * (1 / t - 1)) / t)

    fit = np.polynomial.Chebyshev.interpolate(rest, degree, domain=[0.0, 1.0])
    return tuple(np.polynomial.chebyshev.cheb2poly(fit.coef)[::-1].tolist())


@jax.custom_jvp
def share(r: _Shape) -> _Shape:
    """Return Φ(-r), the probability of contact at a distance, to relative rounding for either sign of r.

    Not by `jax.lax.erfc`, which ends in polynomials: XLA considers them cheap and evaluates them again for every entry of
    the Hessian. An exponential is computed once and stored.
    """
    size = jnp.abs(r)
    t = 1 / (1 + size / _TAIL_SCALE)
    s = 2 * t - 1
    exponent = functools.reduce(lambda sum_, c: sum_ * s + c, _tail_coefficients(_TAIL_DEGREE[r.dtype.itemsize]))
    tail = t * jnp.exp(exponent - 0.5 * size * size)
    return jnp.where(r > 0, tail, 1 - tail)


@share.defjvp
def _share_jvp(primals, tangents):
    return share(*primals), -density(*primals) * tangents[0]


@jax.custom_jvp
def ramp(r: _Shape) -> _Shape:
    """Return the mean force φ(r) - r Φ(-r) at a distance, to a few units of relative rounding times r²."""
    return density(r) - r * share(r)


@ramp.defjvp
def _ramp_jvp(primals, tangents):
    return ramp(*primals), -share(*primals) * tangents[0]


def density(w: _Shape) -> _Shape:
    """Return φ(w)."""
    return jnp.exp(-0.5 * w**2) * (1 / math.sqrt(2 * math.pi))


def depth(distance: _Shape) -> _Shape:
    """Return the mean penetration given contact; constant beyond `REACH`, where contact is improbable."""
    near = jnp.minimum(distance, REACH)
    return ramp(near) / share(near)
