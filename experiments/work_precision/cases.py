"""The scenes: where they start, which velocities are uncertain, and what is asked of the end."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from experiments.motion import own_task
from experiments.sawtooth import ball, filled
from experiments.sawtooth import case as landing_case
from experiments.work_precision.settings import Settings
from mjxgrad.tasks import scene_path


@dataclass(frozen=True)
class Case:
    """A motion from uncertain starts.

    Two velocities, `moved`, are uncertain: the parameters of the gradient, whose standard deviation is in m/s or rad/s. The
    outcome has weights of the final positions. Start positions differ from the model's, velocities from zero, by index. Controls
    are constant, zero unless given. The duration is in s.
    """

    title: str
    model: mujoco.MjModel
    duration: float
    moved: tuple[int, int]
    stddev: float
    outcome: Mapping[int, float]
    qpos: Mapping[int, float] = field(default_factory=dict)
    qvel: Mapping[int, float] = field(default_factory=dict)
    ctrl: tuple[float, ...] = ()

    @property
    def start(self) -> tuple[Float[np.ndarray, " nq"], Float[np.ndarray, " nv"]]:
        """Positions and velocities in the middle of the uncertainty."""
        return filled(self.model.qpos0, self.qpos), filled(np.zeros(self.model.nv), self.qvel)

    @property
    def controls(self) -> Float[np.ndarray, " nu"]:
        return np.array(self.ctrl) if self.ctrl else np.zeros(self.model.nu)

    @property
    def weights(self) -> Float[np.ndarray, " nq"]:
        return filled(np.zeros(self.model.nq), self.outcome)

    @property
    def directions(self) -> Float[np.ndarray, "2 nv"]:
        """Unit vectors of the uncertain velocities."""
        return np.eye(self.model.nv)[list(self.moved)]

    @property
    def timestep(self) -> float:
        return self.model.opt.timestep


def case(name: str) -> Case:
    """Build a motion by its name in the settings."""
    return _BUILDERS[name]()


def own_case(settings: Settings) -> Case:
    """Build the motion of a scene of one's own, its controls constant, its outcome a random mix of positions."""
    task = own_task(settings)
    model, state, rng = task.scene.mj_model, task.state, np.random.default_rng(settings.seed)
    qpos, qvel = (dict(enumerate(np.asarray(one, float).tolist())) for one in (state.qpos, state.qvel))
    mix = dict(enumerate(rng.normal(size=model.nq).tolist()))
    seconds, ctrl = task.horizon * model.opt.timestep, tuple(np.asarray(task.scene.data.ctrl, float).tolist())
    return Case(Path(str(settings.scene)).stem, model, seconds, (0, model.nv - 1), 0.1, mix, qpos, qvel, ctrl)


def _scene(name: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(scene_path(name)))


def _landing(name: str, title: str, moved: tuple[int, int], outcome: Mapping[int, float]) -> Case:
    """One of gymnasium's bodies landing, as in the experiment on the sawtooth, but thrown down so that it lands sooner."""
    given = landing_case(name)
    return Case(title, given.model, 0.24, moved, 0.1, outcome, given.qpos, {**given.qvel, given.moved: -1.0})


def _push() -> Case:
    """`mjcf/push.xml` with a contact a hundred times as stiff as the stiffest published: the balls knock."""
    model = _scene("push")
    model.pair_solref[:] = (-1e5, 0.0)
    return Case("Stiff pushing", model, 0.4, (0, 1), 0.1, {0: 0.3, 1: 1.0}, {0: -0.02}, {0: 0.5}, (0.3,))


def _bounce() -> Case:
    """Thrown down obliquely without spin: it bounces once, under the default contact."""
    model, qvel = ball(friction=0.5, height=0.15), {0: 1.0, 2: -1.5}
    return Case("Bouncing ball, one contact", model, 0.16, (0, 2), 0.1, {0: 1.0, 2: 1.0}, qvel=qvel)


def _slide() -> Case:
    """Slides without spin, askew to the axes of the friction pyramid, until it rolls."""
    model, qvel = ball(friction=0.3, height=0.0499), {0: 1.0, 1: 0.4}
    return Case("Sliding ball, friction", model, 0.2, (0, 1), 0.1, {0: 1.0, 1: 1.0}, qvel=qvel)


def _arm() -> Case:
    """Short, for later the servos hold the arm wherever it came from, and no gradient is left."""
    title, qpos = "Servo arm on the floor, articulated", {0: 0.1, 1: 0.5, 2: 0.2}
    return Case(title, _scene("servo_arm"), 0.16, (0, 1), 0.3, {0: 1.0, 1: 0.5}, qpos, ctrl=(0.7, 0.4, 0.0))


_FREE, _CUBE, _HEAP = "Double pendulum, no contact", "Tumbling cube", "Four falling balls, many bodies"
_BUILDERS: dict[str, Callable[[], Case]] = {
    "pendulum": lambda: Case(_FREE, _scene("free_pendulum"), 0.8, (0, 1), 0.3, {0: 1.0, 1: 0.5}, {0: 1.5, 1: 1.0}),
    "bounce": _bounce,
    "slide": _slide,
    # Edge first, thrown harder so that it soon lands.
    "cube": lambda: Case(_CUBE, _scene("cube_toss"), 0.3, (1, 2), 0.05, {1: 1.0, 2: 1.0}, {2: 0.12}, {1: 0.3, 2: -0.5}),
    "arm": _arm,
    "hopper": lambda: _landing("hopper", "Hopper landing", (0, 1), {0: 1.0, 1: 1.0}),
    "half_cheetah": lambda: _landing("half_cheetah", "Half cheetah landing", (0, 1), {0: 1.0, 1: 1.0, 2: 0.3}),
    "push": _push,
    "heap": lambda: Case(_HEAP, _scene("ball_heap"), 0.24, (6, 8), 0.1, {7: 1.0, 9: 1.0, 16: 0.5}),
    "walker2d": lambda: _landing("walker2d", "Walker2d landing", (0, 1), {0: 1.0, 1: 1.0}),
    "ant": lambda: _landing("ant", "Ant landing", (0, 2), {0: 1.0, 2: 1.0}),
}
