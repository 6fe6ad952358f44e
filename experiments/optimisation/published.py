"""The published tasks with all that their paper says of how to optimise them, and what came out there."""

import dataclasses
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mjxgrad.objective import ActionNoise, closed_loop, open_loop
from mjxgrad.policy import linear_policy
from mjxgrad.tasks import published

Schedule = Callable[[Int[Array, ""] | int], Float[Array, ""] | float]


@dataclasses.dataclass(frozen=True)
class Published:
    """A task with its settings; those of the paper in `TASKS`, our own for a scene.

    The optimiser is plain gradient descent: params ← params − learning_rate · estimate.
    """

    name: str  # of the task
    objective: ActionNoise  # the cost under noise on the actions
    params: Float[Array, " dim"]  # where the optimisation starts
    num_samples: int  # rollouts per estimate
    learning_rate: float | Schedule  # a number, or an optax schedule from the number of steps made
    num_steps: int  # of the optimiser
    gamma: float  # the bias that the α-order rule may accept
    bound: float  # L, what the α-order rule takes as the largest norm of one sample's zeroth-order gradient
    # Mean and standard deviation over seeds of the noise-free cost, at the "start" and at the end of "first", "zeroth",
    # "alpha" and "ddcg"; NaN is a deviation that is not known.
    reference: Mapping[str, tuple[float, float]]
    num_starts: int = 1  # over how many starts `final_cost` averages where they are random

    def final_cost(self, params: Float[Array, " dim"]) -> Float[Array, ""]:
        """Give the cost without action noise: from the nominal start, or the mean over a fixed set of random ones."""
        free = self.objective.zero_noise()
        actions, start = self.objective.split(free)
        if start is None:
            return self.objective.value(params, free)
        keys = jax.random.split(jax.random.key(0), self.num_starts)
        starts = jax.vmap(self.objective.task.sample_start)(keys)
        return jax.vmap(lambda x: self.objective.value(params, (actions, x)))(starts).mean()


UNKNOWN = float("nan")

# The baseline of "zeroth" is the cost without noise from the same start: 41 to 43 come out in tennis so, but with that of
# the nominal start the spread of costs over starts drowns the gradient and the descent ends near 1800. Over 4 to 8 seeds
# that baseline gives 1175 ± 2 (push, soft), 818 ± 2 (stiff), 7092 ± 20 (friction), 742 ± 75 (LQR); the mean of the other
# samples gives 1144, 816, 7080 and 557.

PUSH_SOFT = {
    "start": (2375.0, UNKNOWN),
    "first": (1128.0, 0.02),
    "zeroth": (1170.0, 2.0),
    "alpha": (1128.0, UNKNOWN),
    "ddcg": (1134.0, 2.0),
}
PUSH_STIFF = {
    "start": (1821.0, UNKNOWN),
    "first": (959.0, 130.0),
    "zeroth": (818.3, 0.8),
    "alpha": (816.7, 0.6),
    "ddcg": (816.9, 0.6),
}
FRICTION = {
    "start": (16200.0, UNKNOWN),
    "first": (8792.0, 65.0),
    "zeroth": (7156.0, 89.0),
    "alpha": (7144.0, 65.0),
    "ddcg": (7131.0, 54.0),
}
TENNIS = {"start": (206.0, UNKNOWN), "first": (110.0, 8.0), "zeroth": (41.3, 1.5), "alpha": (39.5, 3.0)}
PLANNING = {"start": (3343.0, UNKNOWN), "first": (1572.0, UNKNOWN), "zeroth": (414.0, 140.0), "alpha": (330.0, 63.0)}
LQR = {"start": (2000.0, UNKNOWN), "first": (544.0, UNKNOWN), "zeroth": (694.0, 25.0), "alpha": (686.0, 32.0)}


def push(stiffness: float = 10.0) -> Published:
    """A body pushes another to a place through a spring.

    The published soft and stiff tasks differ in more than the stiffness: at 1000 N/m and above the velocity factor is
    0.99 and the horizon 200 steps, below 0.998 and 400. To sweep the stiffness (N/m) alone change `stiffness` in the task.
    Reference results are those at the published 10 and 1000.
    """
    is_stiff = stiffness >= 1000
    return _controls(
        published.push(stiffness, 0.99, 200) if is_stiff else published.push(stiffness),
        0.1,
        name="push_stiff" if is_stiff else "push_soft",
        stddev=0.1,
        num_samples=10,
        learning_rate=1e-3,
        num_steps=500,
        gamma=1e8,
        bound=100.0,
        reference={10.0: PUSH_SOFT, 1000.0: PUSH_STIFF}.get(float(stiffness), {}),
    )


def _tennis_rate(count: Int[Array, ""] | int) -> Float[Array, ""]:
    return 1e-6 / (jnp.asarray(count, float) + 1) ** 0.1


def _controls(task: published.DynamicsTask, control: float, *, stddev: float, **settings) -> Published:
    params = jnp.full((task.horizon * task.num_controls,), control)
    return Published(objective=open_loop(task, stddev), params=params, **settings)


def _gain(task: published.DynamicsTask, num_states: int, *, stddev: float, **settings) -> Published:
    policy, params = linear_policy(num_states, task.num_controls, bias=False)
    objective = closed_loop(task, policy, stddev, params=params)
    return Published(objective=objective, params=objective.ravel(params), **settings)


TASKS: Mapping[str, Callable[[], Published]] = {
    "push_soft": lambda: push(10.0),
    "push_stiff": lambda: push(1000.0),
    "friction": lambda: _controls(
        published.friction(),
        0.0,
        name="friction",
        stddev=0.1,
        num_samples=10,
        learning_rate=1e-4,
        num_steps=100,
        gamma=2e4,
        bound=100.0,
        reference=FRICTION,
    ),
    "tennis": lambda: _gain(
        published.tennis(),
        7,
        name="tennis",
        stddev=0.01,
        num_samples=1000,
        learning_rate=_tennis_rate,
        num_steps=200,
        gamma=1000.0,
        bound=1000.0,
        reference=TENNIS,
        num_starts=5000,
    ),
    "motion_planning": lambda: _controls(
        published.motion_planning(),
        0.01,
        name="motion_planning",
        stddev=0.05,
        num_samples=500,
        learning_rate=0.01,
        num_steps=500,
        gamma=150.0,
        bound=10.0,
        reference=PLANNING,
    ),
    "lqr": lambda: _gain(
        published.lqr(),
        100,
        name="lqr",
        stddev=0.1,
        num_samples=10,
        learning_rate=1e-7,
        num_steps=100,
        gamma=100.0,
        bound=100.0,
        reference=LQR,
        num_starts=100,
    ),
}
