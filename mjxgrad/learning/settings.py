"""Settings for learning from short windows, and bundled contact gradients among them."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from mjxgrad._arrays import fraction, instance, positive, real, sizes, whole
from mjxgrad.bodies.kinematics import integrate_position
from mjxgrad.envs import Environment, EnvState
from mjxgrad.stepping.rows import has_pyramids


@dataclasses.dataclass(frozen=True)
class Bundle:
    """Branches over which the derivative of a control step is averaged, at the cost of a step each; the motion is as it is.

    Where contact pushes hard, the derivative of a step is the mean of those at nearby states.

    Attributes:
        num_branches: number of branches.
        position_stddev: standard deviation of the change of each position (m or rad).
        velocity_stddev: standard deviation of the change of each velocity (m/s or rad/s).
        force: total normal force of all contacts, before or after the step, above which derivatives are averaged (N).

    References:
        Bundled Contact Gradients. arXiv:2609.30951: ten branches of 1 cm and 2 cm/s over two control steps, where a foot of a
        humanoid carries 400 N. Here each control step has its own branches.
    """

    num_branches: int = 10
    position_stddev: float = 0.01
    velocity_stddev: float = 0.02
    force: float = 400.0

    def __post_init__(self):
        whole("num_branches", self.num_branches)
        if np.asarray(real("spreads and force", dataclasses.astuple(self)[1:])).min() < 0:
            raise ValueError(f"spreads and force must not be negative, got {self}")

    def step_on(self, environment: Environment, state: EnvState, action: Float[Array, " nu"]):
        """Return what `environment.step_on` returns, with the derivative of the mean where contact pushes hard."""

        def branch(key: PRNGKeyArray) -> tuple[EnvState, EnvState]:
            start, (turn, push) = state.physics, jax.random.normal(key, (2, *state.physics.qvel.shape))
            qpos = integrate_position(environment.scene.model, start.qpos, self.position_stddev * turn, 1.0)
            near = dataclasses.replace(start, qpos=qpos, qvel=start.qvel + self.velocity_stddev * push)
            return environment.step_on(dataclasses.replace(state, physics=near), action)

        plain = environment.step_on(state, action)
        # The third of three keys: a step consumes the first two.
        branches = jax.vmap(branch)(jax.random.split(jax.random.split(state.key, 3)[2], self.num_branches))
        forces = [environment.look(one.physics, _total_force, action) for one in (state, plain[0])]
        is_hard = jnp.maximum(*jax.lax.stop_gradient(forces)) > self.force

        def averaged(x: Array, each: Array) -> Array:
            if not eqx.is_inexact_array(x):
                return x
            # Infinity less infinity is no number, and a memory may hold infinities.
            change = jnp.where(jnp.isfinite(each), each - jax.lax.stop_gradient(each), 0).mean(axis=0)
            return jnp.where(is_hard, jax.lax.stop_gradient(x) + change, x)

        return jax.tree.map(averaged, plain, branches)


def _total_force(model, data) -> Float[Array, ""]:
    """Return the normal force of all contacts; pyramids share it among their edges."""
    contact, force = data._impl.contact, data._impl.efc_force
    first = zip(contact.efc_address.tolist(), contact.dim.tolist(), strict=True)
    rows = [a + k for a, dim in first for k in range(2 * (dim - 1) if has_pyramids(model, dim) else 1)]
    return force[jnp.array(rows, int)].sum()


# What teaches DiffRL's robots per action, of which they have 60 a second; at 8 ms it taught gymnasium's hopper less than half.
_RATE, _WINDOW, _DISCOUNT, _TRACE = 60.0, 16, 0.99, 0.9
_LONGEST = 0.05  # s; slower decisions are those of a slower task, and count as such actions
_OPTIONAL = ("window", "discount", "trace", "alpha", "actor_decay")  # which may be None


@dataclasses.dataclass(frozen=True)
class Settings:
    """The settings of a learner; the defaults taught ants and hoppers, with 64 environments as with 1024.

    A robot's motion lasts seconds, however long its actions are. So window, discount and trace are by default those of 16
    actions of 1/60 s, with 0.99 and 0.9 per action, over the same time; actions of more than 50 ms count as 50. See `counted`.

    Attributes:
        num_environments: number of environments side by side; a GPU takes little longer for 1024, see `for_gpu`.
        window: steps of each environment per update; None takes 0.27 s.
        discount: discount per step; None takes 0.55 per second.
        trace: λ of the returns that the policy climbs, see `window`: 1 differentiates through the whole window (SHAC), 0 through
            one step and the value function after it. None lets it fall to a third within 0.17 s.
        alpha: weight of first order, from 0 to 1: 1 is SHAC, 0 has no derivatives. None takes that of the least error in each
            update, see `mixing`: α-order.
        stddev: standard deviations of the noise on actions before squashing, in the first and in the last update.
        actor_layers: hidden sizes of the policy.
        actor_scale: factor of the initial gains of the policy's hidden layers.
        critic_layers: hidden sizes of the value function.
        actor_rate: learning rate of the policy, which decreases linearly to zero.
        actor_decay: factor of the policy's rate per update, in place of the linear decrease; None for the latter.
        critic_rate: learning rate of the value function, which decreases linearly to zero.
        critic_iterations: passes over a window's states per update.
        critic_batches: number of batches in a pass.
        largest_sample: largest norm of the first-order gradient of one environment's step; longer ones are shortened. The
            unit is the root mean square of the zeroth-order gradient over environments: 0.1 limits the first-order variance
            to a hundredth of the zeroth-order one. Infinity shortens none.
        largest_change: largest change of the noisy policy in an update, the relative entropy of its actions in nats, in the
            mean over what was observed; longer steps are shortened. Infinity shortens none.
        has_critic: whether a value function estimates the rewards after a window; otherwise they are left out, and `trace`
            must be 1.
        bundle: branches over which derivatives are averaged where contact pushes hard; None takes them as they are.
    """

    num_environments: int = 64
    window: int | None = None
    discount: float | None = None
    trace: float | None = None
    alpha: float | None = None
    stddev: tuple[float, float] = (0.4, 0.25)
    actor_layers: tuple[int, ...] = (128, 64, 32)
    actor_scale: float = 1.0
    critic_layers: tuple[int, ...] = (64, 64)
    actor_rate: float = 1e-3
    actor_decay: float | None = None
    critic_rate: float = 5e-4
    critic_iterations: int = 16
    critic_batches: int = 4
    largest_sample: float = 0.1
    largest_change: float = 0.05
    has_critic: bool = True
    bundle: Bundle | None = None

    def __post_init__(self):
        def given(*names: str) -> list[str]:
            return [name for name in names if name not in _OPTIONAL or getattr(self, name) is not None]

        for name in given("num_environments", "window", "critic_iterations", "critic_batches"):
            whole(name, getattr(self, name))
        for name in given("actor_scale", "actor_rate", "critic_rate", "actor_decay"):
            positive(name, getattr(self, name))
        for name in ("largest_sample", "largest_change"):
            if getattr(self, name) != np.inf:  # which shortens none
                positive(name, getattr(self, name))
        instance("bundle", self.bundle, Bundle | None, "of mg.learning.Bundle")
        instance("has_critic", self.has_critic, bool, "True or False")
        for name in ("actor_layers", "critic_layers"):  # a list has no hash
            object.__setattr__(self, name, sizes(name, getattr(self, name), "(64, 64)"))
        if real("stddev", self.stddev).shape != (2,) or not min(self.stddev) > 0:
            raise ValueError(f"stddev must be positive at the beginning and at the end, two numbers, got {self.stddev}")
        for name in given("discount", "trace", "alpha"):
            fraction(name, getattr(self, name))
        if not self.has_critic and self.trace is not None and self.trace < 1:
            raise ValueError(
                f"trace must be 1 without a value function, got {self.trace}: there is nothing to blend with"
            )
        if self.window is not None and (self.num_environments * self.window) % self.critic_batches:
            raise ValueError(
                f"critic_batches must divide the {self.num_environments * self.window} states of an update, "
                f"got {self.critic_batches}"
            )

    def counted(self, interval: float) -> "Counted":
        """Return these settings with window, discount and trace in actions of `interval` seconds, where they are None."""
        actions = _RATE * min(interval, _LONGEST)
        # As many as the batches of the value function divide.
        multiple = self.critic_batches // math.gcd(self.critic_batches, self.num_environments)
        window = multiple * math.ceil(_WINDOW / actions / multiple - 0.5)
        trace = _TRACE**actions if self.has_critic else 1.0
        own = {"window": max(window, multiple), "discount": _DISCOUNT**actions, "trace": trace}
        return Counted(**(own | {name: value for name, value in vars(self).items() if value is not None}))

    @classmethod
    def for_gpu(cls, **changes: Any) -> "Settings":
        """Return settings with 1024 environments and networks twice as wide, by which hoppers fall less, and other changes."""
        given = {"num_environments": 1024, "actor_layers": (256, 128, 64), "critic_layers": (128, 128)}
        return cls(**given | changes)


@dataclasses.dataclass(frozen=True)
class Counted(Settings):
    """Settings whose window, discount and trace are numbers, by `Settings.counted`; the defaults are those of 1/60 s."""

    window: int = _WINDOW
    discount: float = _DISCOUNT
    trace: float = _TRACE
