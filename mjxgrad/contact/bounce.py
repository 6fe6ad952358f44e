r"""A single bounce of a ball on MuJoCo's contact, in closed form.

Without gravity and with a single sliding joint, contact at depth $-r$ is the oscillator
$\ddot r = d(r)\, a_\text{ref}$, $a_\text{ref} = -B \dot r - K d(r) r$, while the force is repulsive. For a constant impedance
$d$ this is $\ddot r = -2 \zeta \omega_0 \dot r - \omega_0^2 r$ with $\omega_0 = 1 / (t_c \zeta)$, for every $d$. The force acts
from $r = 0$ until $\ddot r = 0$. Before and after, the ball flies freely, so its start only shifts the motion in time, and
$dz/dz_0 = -e$ for the height at any later time: the restitution is the derivative.

References:
    MuJoCo documentation, "Solver parameters" (the oscillator and its impedance).
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from mjxgrad._arrays import as_float


class Bounce(eqx.Module):
    r"""One bounce under a constant impedance, in closed form; traceable, and shapes broadcast.

    Attributes:
        time_constant: $t_c$, the first number of `solref`, in s.
        damping_ratio: $\zeta$, the second number; any positive number.
        speed: speed of approach, in m/s.
    """

    time_constant: Float[Array, "..."] = eqx.field(converter=as_float)
    damping_ratio: Float[Array, "..."] = eqx.field(converter=as_float)
    speed: Float[Array, "..."] = eqx.field(converter=as_float, default=1.0)

    @property
    def frequency(self) -> Float[Array, "..."]:
        r"""Return $\omega_0 = 1 / (t_c \zeta)$, in rad/s."""
        return 1 / (self.time_constant * self.damping_ratio)

    @property
    def restitution(self) -> Float[Array, "..."]:
        r"""Return $e = \exp(-2 \zeta \arccos\zeta / \sqrt{1 - \zeta^2})$, continued beyond $\zeta = 1$, where it is $e^{-2}$."""
        return jnp.exp(-2 * self.damping_ratio * _angle(self.damping_ratio))

    @property
    def duration(self) -> Float[Array, "..."]:
        r"""Return the duration of the force, $2 \arccos\zeta / (\omega_0 \sqrt{1 - \zeta^2})$, in s."""
        return 2 * _angle(self.damping_ratio) / self.frequency

    def height(self, start: Float[ArrayLike, "..."], time: Float[ArrayLike, "..."]) -> Float[Array, "..."]:
        """Return the height (m) at a time (s) after the bounce, from a height (m) at time zero."""
        released = -2 * self.damping_ratio * self.speed * self.restitution / self.frequency
        flown = jnp.asarray(time) - start / self.speed - self.duration
        return released + self.restitution * self.speed * flown


def _angle(damping_ratio: Float[Array, "..."]) -> Float[Array, "..."]:
    r"""Return $\arccos\zeta / \sqrt{1 - \zeta^2}$, which is smooth at 1 though its parts are not."""
    gap = 1 - damping_ratio
    is_near = jnp.abs(gap) < 1e-4
    below = jnp.where(is_near | (gap < 0), 0.5, damping_ratio)
    above = jnp.where(is_near | (gap > 0), 2.0, damping_ratio)
    far = jnp.where(gap > 0, jnp.arccos(below) / jnp.sqrt(1 - below**2), jnp.arccosh(above) / jnp.sqrt(above**2 - 1))
    return jnp.where(is_near, 1 + gap / 3 + 2 * gap**2 / 15, far)
