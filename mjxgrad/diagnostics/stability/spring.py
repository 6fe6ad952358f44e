r"""One constraint seen as a spring and damper, and what a time step makes of it.

Contacts, limits and equalities have one law: at full impedance $\ddot r = -k r - b \dot r$, $k$ and $b$ per unit of the
row's effective mass. Semi-implicit Euler follows it without gaining energy while $h^2 k + 2 h b < 4$, which in MuJoCo's
standard format is $h / t_c < 2 \zeta (\sqrt{1 + \zeta^2} - \zeta)$, $t_c = 2 / b$.

That is one row alone, at the impedance $d_w$; where the impedance falls with depth, stiffness and damping are largest at
first touch. The n contacts of a box that lands flat add up to the impedance
$n d / (1 + (n - 1) d)$, and pull with $n / (1 + (n - 1) d_w)$ times $k$ and $b$; contacts with other bodies add to it, up to
$1 / d_w$ times, where a row gets the whole of the acceleration that it asks for.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from mjxgrad.contact.bounce import Bounce
from mjxgrad.scene.contact_check import largest_stable_step, steepest


@dataclass(frozen=True)
class Spring:
    r"""A contact pair, joint limit, tendon limit or equality as a spring and damper.

    Attributes:
        kind: "contact", "joint limit", "tendon limit" or "equality".
        name: of the pair, joint, tendon or equality.
        stiffness: $k$ in effect, in 1/s².
        damping: $b$ in effect, in 1/s.
        impedance: $d_0$ and $d_w$.
        width: over which the impedance rises, in m (rad for hinges).
        given: the time constant that the file asks for, in s; None in the direct format.
        timestep: $h$, in s.
        integrator: of the model.
        size: by how much it may be passed in one step and still be found: what a ball may move through another body, or
            the range of a limit, in m (rad); infinite for planes and equalities.
        num_rows: contacts that the pair can make at once.
        pyramid: sliding friction μ of a pyramidal contact; None for all others.
    """

    kind: str
    name: str
    stiffness: float
    damping: float
    impedance: tuple[float, float]
    width: float
    given: float | None
    timestep: float
    integrator: mujoco.mjtIntegrator
    size: float
    num_rows: int = 1
    pyramid: float | None = None

    def __str__(self) -> str:
        """The name, as messages print it."""
        return self.name

    @property
    def damping_ratio(self) -> float:
        r"""$b / (2 \sqrt k)$; infinite without stiffness."""
        return self.damping / (2 * np.sqrt(self.stiffness)) if self.stiffness > 0 else np.inf

    @property
    def time_constant(self) -> float:
        """$2 / b$, in s; infinite without damping."""
        return 2 / self.damping if self.damping > 0 else np.inf

    @property
    def load(self) -> float:
        """The time step as a share of the largest stable one: unstable from 1 on."""
        return self._load(1.0)

    @property
    def coupled_load(self) -> float:
        """The same where all contacts of the pair hold the body at once; never below `load`."""
        return self._load(self.num_rows / (1 + (self.num_rows - 1) * max(self.impedance)))

    @property
    def steepest(self) -> tuple[float, float]:
        """Stiffness (1/s²) and damping (1/s) where the impedance is largest."""
        return steepest(self.stiffness, self.damping, self.impedance, self.width)

    def _load(self, factor: float) -> float:
        stiffness, damping = (factor * value for value in self.steepest)
        if stiffness <= 0:
            # A damper alone: h b < 2 for Euler, the real axis of RK4's region of stability.
            limit = 2.785 if self.integrator == mujoco.mjtIntegrator.mjINT_RK4 else 2.0
            return self.timestep * damping / limit
        frequency = np.sqrt(stiffness)
        return self.timestep * frequency / largest_stable_step(damping / (2 * frequency), self.integrator)

    @property
    def is_hidden(self) -> bool:
        """Whether `refsafe` replaces the time constant that was asked for."""
        # A relative margin, because float32 rounds a time constant of exactly two steps.
        return self.given is not None and self.time_constant > self.given * (1 + 1e-5)

    @property
    def num_steps(self) -> float:
        """Time steps that a single bounce off it lasts, at any speed; infinite without stiffness."""
        if self.stiffness <= 0 or self.damping <= 0:
            return np.pi / np.sqrt(self.stiffness) / self.timestep if self.stiffness > 0 else np.inf
        return float(self._bounce.duration) / self.timestep

    def depth(self, speed: float) -> float:
        r"""Give how deep a bounce at a speed goes, $v \sqrt e / \omega_0$, $e$ the restitution (m, or rad).

        Args:
            speed: of approach, in m/s (rad/s).
        """
        if self.stiffness <= 0:
            return np.inf
        restitution = 1.0 if self.damping <= 0 else float(self._bounce.restitution)
        return speed * np.sqrt(restitution / self.stiffness)

    def rise_steps(self, speed: float) -> float:
        """Give the time steps in which the impedance rises at a speed of approach; infinite if it does not rise.

        Args:
            speed: of approach, in m/s (rad/s).
        """
        first, last = self.impedance
        return self.width / (speed * self.timestep) if first != last and speed > 0 else np.inf

    @property
    def _bounce(self) -> Bounce:
        # Bounce writes ω₀ = 1 / (t_c ζ), which is √k by the definitions above.
        return Bounce(self.time_constant, self.damping_ratio)
