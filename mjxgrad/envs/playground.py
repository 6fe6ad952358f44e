"""Environments of MuJoCo Playground and brax, stepped by `mg.step`.

Both call `mjx.step`. It is replaced by `mg.step` while their `reset` and `step` run, and restored after. So is Playground's
`tolerance`, whose derivative is no number within bounds that are infinite, by the same with the derivative 0 there. Nothing else
changes. `environment` makes tasks of Playground's dm_control suite environments of ours, for `mg.learning`.
"""

import contextlib
import copy
import functools
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco.mjx
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from mjxgrad._arrays import whole
from mjxgrad._mjx import mjx
from mjxgrad.envs.environment import Environment, Rewards
from mjxgrad.rollouts import State, initial_state
from mjxgrad.scene import load_scene
from mjxgrad.stepping import Contact, Discrete, check_contact, step

Foreign = TypeVar("Foreign")
_LOCK = threading.RLock()


def load(
    name: str,
    config_overrides: Mapping[str, Any] | None = None,
    *,
    contact: Contact = Discrete(),
    iterations: int = 100,
) -> Any:
    """Load an environment of MuJoCo Playground, to be stepped by `mg.step`.

    The object is Playground's own and works with its wrappers and randomisers. Its motion is Playground's with a converged
    solver, unless `contact` changes it. The name, such as "CartpoleSwingup", is that of `registry.load`. The overrides are
    values by flattened name; `impl` is always "jax", which has derivatives. All else is as in `stepped_right`.

    Raises:
        ImportError: if playground is not installed.
        ValueError: if there is no such environment, or as in `stepped_right`.
    """
    # Imported here: brax's environments need no playground.
    try:
        from mujoco_playground import registry  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError(f"{name} is MuJoCo Playground's, not installed: pip install 'mjxgrad[playground]'") from error
    overrides = {**(config_overrides or {}), "impl": "jax"}
    return stepped_right(registry.load(name, None, overrides), contact=contact, iterations=iterations)


def stepped_right(environment: Foreign, *, contact: Contact = Discrete(), iterations: int = 100) -> Foreign:
    """Replace `mjx.step` by `mg.step` in an object's `reset` and `step`, and return the object.

    Args:
        environment: an object with these methods on MJX's JAX implementation: from Playground, from brax's backend "mjx", or
            your own. Only this object changes.
        contact: how contact is stepped, see `mg.step`.
        iterations: least limit on the solver's iterations; it stops at the model's tolerance. Many of their models stop after
            1 to 4, where the solve's derivative is not yet that of the motion.

    Raises:
        ValueError: if contact does not suit `mg.step`.
    """
    check_contact(contact)

    def own_step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
        most = max(iterations, model.opt.iterations)
        return step(model.replace(opt=model.opt.replace(iterations=most)), data, contact=contact)

    # On the object, not in a wrapper: randomisers of models call the step of the innermost environment.
    for name in ("reset", "step"):
        setattr(environment, name, _within(getattr(environment, name), own_step))
    return environment


class SuiteTask(Environment):
    """A task of Playground's dm_control suite; see `environment`.

    Attributes:
        task: Playground's object, whose observations and rewards these are.
        starts: positions and velocities that its `reset` drew, of which each episode takes one.
    """

    task: Any = eqx.field(static=True, kw_only=True)
    starts: tuple[Float[Array, "starts nq"], Float[Array, "starts nv"]] = eqx.field(repr=False, kw_only=True)

    def control(self, action: Float[Array, " nu"]) -> Float[Array, " nu"]:
        return action

    def start(self, key: PRNGKeyArray) -> State:
        index = jax.random.randint(key, (), 0, len(self.starts[0]))
        return initial_state(self.scene, *(x[index] for x in self.starts))

    def observe(self, state: State, memory: PyTree) -> Float[Array, " obs"]:
        return self.look(state, lambda model, data: _asked(self.task._get_obs, data, {}))

    def rewards(self, before: State, action: Float[Array, " nu"], after: State, memory: PyTree) -> Rewards:
        told = lambda model, data: _asked(self.task._get_reward, data, action, {}, {})  # noqa: E731
        return {"task": self.look(after, told, action)}


def environment(
    name: str, config_overrides: Mapping[str, Any] | None = None, *, num_starts: int = 1024, iterations: int = 100
) -> SuiteTask:
    """Return a task of Playground's dm_control suite as an environment, such as "CheetahRun", "WalkerWalk", "HumanoidWalk".

    Observations and rewards are by Playground's functions, at the state after an action. Its own step calls them one time step
    late: with the new positions and velocities, but places and sensors of the state before its last time step, so that of a
    cheetah, whose actions have one, the reward is that of the state before. Starts are drawn by its `reset` here and now, with
    one key, since a cheetah's takes 200 steps. Episodes end by time alone.

    Args:
        name: as in `load`, of a task without targets that move.
        config_overrides: as in `load`.
        num_starts: number of starts.
        iterations: as in `stepped_right`.

    Raises:
        ImportError: if playground is not installed.
        ValueError: if there is no such task, or `num_starts` is below 1.
    """
    num_starts, task = whole("num_starts", num_starts), load(name, config_overrides, iterations=iterations)
    from mujoco_playground import dm_control_suite  # pyright: ignore[reportMissingImports]

    if name not in dm_control_suite.ALL_ENVS or task.mj_model.nmocap:
        raise ValueError(f"name must be of a task of the dm_control suite without targets that move, got {name!r}")
    drawn = jax.jit(jax.vmap(lambda key: task.reset(key).data))(jax.random.split(jax.random.key(0), num_starts))
    model = copy.deepcopy(task.mj_model)
    model.opt.iterations = max(iterations, model.opt.iterations)
    # A solve would be taken for sensors of forces and accelerations that nobody reads.
    needs_solve = model.sensor_needstage == mujoco.mjtStage.mjSTAGE_ACC
    is_late = jnp.asarray(np.repeat(needs_solve, model.sensor_dim))
    first = jax.tree.map(lambda x: x[0], drawn)
    blind = first.replace(sensordata=jnp.where(is_late, jnp.nan, first.sensordata))
    told = task._get_obs(blind, {}), task._get_reward(blind, jnp.zeros(model.nu), {}, {})
    if all(np.isfinite(x).all() for x in told):
        model.sensor_needstage[needs_solve] = mujoco.mjtStage.mjSTAGE_NONE
        model.sensor_type[needs_solve] = mujoco.mjtSensor.mjSENS_CLOCK
    how = {"frame_skip": task.n_substeps, "episode_length": int(task._config.episode_length)}
    return SuiteTask(load_scene(model), task=task, starts=(drawn.qpos, drawn.qvel), **how)


def _asked(method: Callable, *args: Any) -> Any:
    """Return what a method of Playground's tells, with our `tolerance`."""
    with _replaced({}):
        return method(*args)


def _within(method: Callable, own_step: Callable[[mjx.Model, mjx.Data], mjx.Data]) -> Callable:
    """Return a method during which `mjx.step` is replaced, in its thread."""

    @functools.wraps(method)
    def call(*args: Any, **kwargs: Any) -> Any:
        with _replaced({(mujoco.mjx, "step"): own_step}):
            return method(*args, **kwargs)

    return call


@contextlib.contextmanager
def _replaced(functions: dict[tuple[Any, str], Callable]) -> Iterator[None]:
    """Replace functions of modules, and Playground's `tolerance` where it is loaded, in this thread."""
    # One thread at a time: two interleaved threads would restore each other's substitute.
    with _LOCK:
        if reward := sys.modules.get("mujoco_playground._src.reward"):
            functions = functions | {(reward, "tolerance"): functools.partial(_tolerance, reward.tolerance)}
        thread, originals = threading.get_ident(), {key: getattr(*key) for key in functions}

        def chosen(key: tuple[Any, str]) -> Callable:
            def call(*args: Any, **kwargs: Any) -> Any:
                return (functions if threading.get_ident() == thread else originals)[key](*args, **kwargs)

            return call

        try:
            for key in functions:
                setattr(*key, chosen(key))
            yield
        finally:
            for key, original in originals.items():
                setattr(*key, original)


def _tolerance(original: Callable, x: Any, bounds: Any = (0.0, 0.0), *args: Any, **kwargs: Any) -> Any:
    """Return Playground's `tolerance`, with the derivative 0 within the bounds.

    There it multiplies 0 by the derivative at the distance from the bound beyond, which may be infinite.
    """
    is_within = (bounds[0] <= x) & (x <= bounds[1])
    return original(jnp.where(is_within, jax.lax.stop_gradient(x), x), bounds, *args, **kwargs)
