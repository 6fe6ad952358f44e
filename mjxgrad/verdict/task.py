"""A task of a scene of one's own, as a command line or a configuration names it, and the one number it is differentiated by."""

import importlib
import runpy
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, Float, PyTree

from mjxgrad._arrays import is_known
from mjxgrad._rollout import Trajectory, initial_state
from mjxgrad.contact import Softness
from mjxgrad.dynamics import Onset
from mjxgrad.dynamics.kinematics import kinematics
from mjxgrad.objective import ActionNoise, Objective, parameter_noise
from mjxgrad.scene import Scene, SceneWarning
from mjxgrad.task import Outcome, SceneTask
from mjxgrad.verdict.motions import half_range
from mjxgrad.verdict.programs import CONTACT_FIELDS

_BUILT_IN = {"height": 1, "speed": 1, "upright": 1, "reach": 2}  # and how many names each takes
_SECONDS, _MOST_STEPS, _FEWEST_STEPS = 0.5, 300, 50


def scene_task(
    scene: Scene,
    cost: str | Callable[[Trajectory], Any],
    *,
    start: str | None = None,
    horizon: int | None = None,
    gradient: str = "onset",
) -> SceneTask:
    """Make a task of a scene, by names alone.

    Args:
        scene: from `load_scene`. Its resting controls become those of the key frame.
        cost: of a trajectory: a function, or file.py:function, module:function, or at the end of bodies and sites by name
            height:torso (minus its height, m), speed:torso (minus its mean speed along x, m/s), upright:torso (1 − cosine of
            its tilt), reach:hand/ball (their distance, m).
        start: a key frame; None is the reference pose, at rest.
        horizon: steps; None is half a second, but 50 to 300 steps.
        gradient: "onset", for contacts that begin within the step, or one of `step`, with MuJoCo's motion.

    Raises:
        ValueError: if there is no such file, function, body or key frame, in one sentence.
    """
    model, state = scene.mj_model, initial_state(scene)
    if start is not None:
        key = _index(model, "KEY", start)
        if key < 0:
            raise ValueError(
                f"start: there is no key frame {start!r}; those there are: {_names(model, 'KEY', model.nkey)}"
            )
        state = initial_state(scene, qpos=model.key_qpos[key], qvel=model.key_qvel[key], act=model.key_act[key])
        scene = eqx.tree_at(lambda s: s.data.ctrl, scene, jnp.asarray(model.key_ctrl[key], state.qpos.dtype))
    steps = (
        int(np.clip(round(_SECONDS / model.opt.timestep), _FEWEST_STEPS, _MOST_STEPS)) if horizon is None else horizon
    )
    function = named_cost(scene, cost) if isinstance(cost, str) else cost
    task = SceneTask(scene, state, function, steps, onset=Onset())
    return task if gradient == "onset" else task.with_gradient(gradient)  # pyright: ignore[reportArgumentType]


def load_function(name: str) -> Callable[..., Any]:
    """Find a function by file.py:function or module:function, the module also in the current folder."""
    source, _, function = name.rpartition(":")
    if source.endswith(".py") and not Path(source).is_file():
        raise ValueError(f"cost: there is no file {source}")
    try:
        sys.path.insert(0, str(Path.cwd()))
        names = runpy.run_path(source) if source.endswith(".py") else vars(importlib.import_module(source))
    except Exception as error:  # whatever a file of one's own may do
        kinds = "file.py:function, module:function, or of a body as height:torso"
        raise ValueError(f"cost must be {kinds}, got {name!r}: {error}") from error
    if not callable(names.get(function)):
        there = ", ".join(key for key, one in names.items() if callable(one) and not key.startswith("_"))
        raise ValueError(f"cost: there is no function {function!r} in {source}; those there are: {there or 'none'}")
    return names[function]


def named_cost(scene: Scene, name: str) -> Callable[[Trajectory], Any]:
    """Find a cost by its name, see `scene_task`."""
    kind, _, what = name.partition(":")
    if kind not in _BUILT_IN:
        return load_function(name)
    if len(frames := [_frame(scene.mj_model, one) for one in what.split("/")]) != _BUILT_IN[kind]:
        raise ValueError(
            f"cost: {kind} takes {'two names, hand/ball' if kind == 'reach' else 'one name'}, got {what!r}"
        )
    data, seconds = scene.data, scene.mj_model.opt.timestep

    def cost(trajectory: Trajectory) -> Float[Array, ""]:
        ends = [kinematics(scene.model, data.replace(qpos=trajectory.qpos[i])) for i in (0, -1)]
        place, turn = frames[0](ends[1])
        if kind == "reach":
            return jnp.linalg.norm(place - frames[1](ends[1])[0])
        if kind == "speed":
            return (frames[0](ends[0])[0][0] - place[0]) / (seconds * len(trajectory.ctrl))
        return -place[2] if kind == "height" else 1 - turn[2, 2]

    return cost


def _frame(model: mujoco.MjModel, name: str) -> Callable[[Any], tuple[Array, Array]]:
    """Return how to read position and orientation of a body or site."""
    for kind, prefix in (("BODY", "x"), ("SITE", "site_x")):
        if (index := _index(model, kind, name)) >= 0:
            return lambda data: (getattr(data, f"{prefix}pos")[index], getattr(data, f"{prefix}mat")[index])
    there = f"{_names(model, 'BODY', model.nbody)}; sites {_names(model, 'SITE', model.nsite)}"
    raise ValueError(f"cost: there is no body or site {name!r}; bodies are {there}")


def _index(model: mujoco.MjModel, kind: str, name: str) -> int:
    return mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind}"), name)


def _names(model: mujoco.MjModel, kind: str, count: int) -> str:
    every = (mujoco.mj_id2name(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind}"), i) for i in range(count))
    return ", ".join(filter(None, every)) or "none"


class Push(ActionNoise):
    """The cost under noise on every control, by how far all of them are moved along one direction, at every step.

    By single controls the gradient is hundreds of small numbers; of a single one an interval says what is known of it.
    """

    task: SceneTask
    stddev: Float[Array, " nu"]
    direction: Float[Array, " nu"]
    dim: int | None = eqx.field(static=True, default=1)

    def outcome(self, params: Float[Array, " dim"], noise: PyTree) -> Outcome:
        actions, start = self.split(noise)
        moved = self.task.scene.data.ctrl + params[0] * self.direction
        return self.task.run(jnp.broadcast_to(moved, self.noise_shape), noise=actions.astype(params.dtype), start=start)

    def score(self, params: Float[Array, " dim"], noise: PyTree) -> Float[Array, " dim"]:
        return self.pull_back_at(params, None)(self._noise_score(params, noise))

    def pull_back_at(self, params: Float[Array, " dim"], states: PyTree) -> Partial:
        return Partial(_along, jnp.tile(self.direction, self.task.horizon))


def _along(direction: Float[Array, " m"], by_noise: Float[Array, " m"]) -> Float[Array, " 1"]:
    return (direction @ by_noise)[None]


def _thrown(task: SceneTask, along: Float[Array, " nv"], speed: Float[Array, " 1"]) -> Float[Array, ""]:
    start = eqx.tree_at(lambda state: state.qvel, task.state, task.state.qvel + speed[0] * along)
    return task.run(None, start=start).cost  # pyright: ignore[reportArgumentType]


def by_stiffness(task: SceneTask, noise: float, seed: int = 0) -> tuple[Callable[[Float[Array, ""]], Objective], str]:
    """Return the cost under noise as a function of contact stiffness (1/s², at critical damping), and what it is a cost by.

    NaN is the file's own contact. The parameter moves all controls along one direction, noise is on each of them at each step,
    both in halves of their ranges; without actuators both are on the velocities at the start. The direction is random.
    """
    scene, nu = task.scene, task.num_controls
    count = nu or scene.mj_model.nv
    drawn = np.random.default_rng(seed).normal(size=count)
    along = jnp.asarray(drawn / np.linalg.norm(drawn) if count > 1 else np.ones(1), task.state.qpos.dtype)
    half = jnp.asarray(half_range(scene), task.state.qpos.dtype)

    def objective(stiffness: Float[Array, ""]) -> Objective:
        is_own = jnp.isnan(stiffness)
        model = scene.model
        if is_known(stiffness) and np.isnan(stiffness):
            for text in scene.warnings():
                warnings.warn(f"{scene.name}: {text}", SceneWarning, stacklevel=2)
        elif scene.pairs:
            soft = scene.with_softness(Softness(jnp.where(is_own, 1.0, stiffness), 1.0)).model
            picked = {name: jnp.where(is_own, getattr(model, name), getattr(soft, name)) for name in CONTACT_FIELDS}
            model = model.replace(**picked)
        soft_task = eqx.tree_at(lambda one: one.scene.model, task, model)
        if nu:
            return Push(soft_task, noise * half, half * along)
        return parameter_noise(Partial(_thrown, soft_task, along), noise, dim=1)

    kind, what = ("ACTUATOR", "controls") if nu else ("JOINT", "velocities")
    which = _names(scene.mj_model, kind, 1) if count == 1 else f"all {count} {what} in one random mix"
    return (
        objective,
        f"a constant push of {which}, in halves of the range" if nu else f"the start's speed of {which}, m/s or rad/s",
    )
