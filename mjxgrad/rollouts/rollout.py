"""Rollouts of a scene, and linear models of its steps: arguments are checked here, and its engine steps it."""

import dataclasses
import warnings
from collections.abc import Iterator, Mapping
from typing import Any, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from mjxgrad._arrays import function, instance, known, real, traceable, whole
from mjxgrad._programs import compiled
from mjxgrad._text import format_number, format_range
from mjxgrad.batched.device import copies, fits
from mjxgrad.engines import Motion, Observe, PolicyFunction, Rows, Sees, State, Trajectory, engine_of
from mjxgrad.engines.layout import INPUTS
from mjxgrad.engines.state import check_scene, direction
from mjxgrad.scene import Scene, SceneWarning
from mjxgrad.stepping import Contact, Discrete, Slope, Smoothing, smoothing_warnings

_ROUNDING = 1e-6  # of the ends of a range, by which single precision may pass them


def rollout(
    scene: Scene,
    state: State,
    controls: Float[ArrayLike, "_ _"] | PolicyFunction | None = None,
    params: PyTree = None,
    noise: Float[ArrayLike, "_ _"] | None = None,
    *,
    horizon: int | None = None,
    observe: Observe | None = None,
    policy_sees: Sees = "state",
    contact: Contact = Discrete(),
    inputs: Mapping[str, Float[ArrayLike, "..."]] | None = None,
    checkpoint: bool = True,
    measure_growth: bool = False,
) -> Trajectory:
    """Step a scene many times; return the trajectory, with `horizon + 1` states.

    Batches are `jax.vmap` over any argument. Differentiable in forward and reverse mode. A diverged rollout has no meaningful
    derivative; its flag `diverged` is set.

    Args:
        scene: from `load_scene`.
        state: the initial state, from `initial_state` or the end of another rollout.
        controls: one row per step; or a policy, called as `policy(params, state)`; or None for the scene's resting ones.
            MuJoCo clips a control at `ctrlrange`; beyond it the derivative is zero.
        params: parameters of the policy.
        noise: noise on the controls, one row per step.
        horizon: number of steps; needed only where neither controls nor noise determine it.
        observe: called as `observe(model, data)` with the complete data of every state, including contacts and forces; its
            results are stacked, and only these are kept. `mg.sensor`, `mg.site_position` and `mg.contact_force` read
            things by name. C MuJoCo gives `sensordata` and the places of bodies, geoms and sites; else there is NaN.
        policy_sees: "state", or "observations": the policy then receives the result of `observe` in place of the state.
            Forces and accelerations are those under the previous control, in the first step under the scene's resting one.
            Observing them takes a second solve per step.
        contact: how contact is stepped: `mg.Discrete()`, `mg.Slope()`, `mg.Onset()` or `mg.Smoothing(...)`, see
            `stepping.contact`. The default is MuJoCo's step, motion and derivative. A `SceneWarning` names the parts of the
            scene that a smoothing does not affect.
        inputs: further inputs of each step, one row per step, by MuJoCo's names: `qfrc_applied`, `xfrc_applied`, `mocap_pos`,
            `mocap_quat`, `eq_active`. Differentiable, except the last. Others stay as in `scene.data`.
        checkpoint: whether to recompute each step in reverse mode from its state and the solutions of its solves. Memory then
            grows by a few numbers per step. False keeps everything: somewhat faster, and hundreds of times larger.
        measure_growth: whether to propagate one tangent, for `growth` and `explodes`: they tell whether the derivatives can
            be trusted. Chattering contacts may multiply derivatives at every switch. It costs a derivative in forward mode.

    Raises:
        ValueError: if contact is none of the four records, shapes do not fit the scene, the horizon is missing or contradicted,
            or known controls or noise are not finite (inside `jax.jit` the rollout is flagged as diverged at this step).
    """
    state = started(scene, state)
    engine = engine_of(scene, contact)
    for message in smoothing_warnings(scene.model) if isinstance(contact, Smoothing) else ():
        warnings.warn(f"{scene.name}: {message}", SceneWarning, stacklevel=2)
    if policy_sees not in get_args(Sees) or (policy_sees == "observations" and observe is None):
        raise ValueError(f'policy_sees must be "state", or "observations" with observe=, got {policy_sees!r}')
    function("observe", observe, "model", "data")
    instance("checkpoint", checkpoint, bool, "True or False")
    instance("measure_growth", measure_growth, bool, "True or False")
    policy = controls if callable(controls) else None
    function("policy", policy, "params", "state")
    if policy is None and params is not None:
        raise ValueError("params must belong to a policy, got them beside a sequence of controls: give noise as noise=")
    sequence, horizon = sequence_of(controls, noise, horizon, scene.model.nu)
    many = max(map(copies, jax.tree.leaves((state, controls, params, noise, inputs))))
    row = scene.model.nq + scene.model.nv + scene.model.na + scene.model.nu
    size = many * horizon * row * state.qpos.dtype.itemsize
    worlds = f"{horizon} steps" if many == 1 else f"{many} rollouts of {horizon} steps"
    fits(worlds, size, "fewer at a time, such as jax.lax.map(function, starts, batch_size=256), or shorter ones")
    forces = applied(scene, inputs, horizon)
    base = jnp.broadcast_to(scene.data.ctrl, (horizon, scene.model.nu)) if sequence is None else sequence
    rows = Rows(base, jnp.zeros_like(base) if noise is None else jnp.asarray(noise), forces)
    motion = Motion(scene, policy, params if policy is not None else None, observe, policy_sees, checkpoint, contact)
    for message in () if sequence is None else clamped(scene, sequence):
        warnings.warn(f"{scene.name}: {message}", SceneWarning, stacklevel=2)
    with traceable("the policy, or observe,"):
        found = engine.roll_out(motion, state, rows)
    if not measure_growth:
        return found
    alone = Motion(scene, None, None, None, "state", checkpoint, contact)
    given = Rows(found.ctrl, jnp.zeros_like(found.ctrl), forces)
    return dataclasses.replace(found, growth=_growth(alone, state, given))


@compiled
def _growth(motion: Motion, state: State, rows: Rows) -> Float[Array, ""]:
    """Return the largest growth of a tangent of the start under known controls; it has no derivative."""
    fixed = lambda x: jax.lax.stop_gradient(x) if eqx.is_inexact_array(x) else x  # noqa: E731
    motion, state, rows = jax.tree.map(fixed, (motion, state, rows))

    def course(qpos: Array, qvel: Array) -> tuple[tuple[Array, Array], Array]:
        start = dataclasses.replace(state, qpos=qpos, qvel=qvel)
        found = engine_of(motion.scene, motion.contact).roll_out(motion, start, rows)
        return (found.qpos, found.qvel), found.diverged

    _, change, diverged = jax.jvp(course, (state.qpos, state.qvel), direction(state), has_aux=True)
    size = jnp.linalg.norm(jnp.concatenate(change, axis=1), axis=1).max()
    return jnp.where(jnp.isfinite(size) & ~diverged, jnp.maximum(size, 1.0), jnp.inf)


class Linearisation(eqx.Module):
    """Derivatives of the next state and the sensors; a change of state is (positions, velocities, activations).

    Positions change in tangent space, a quaternion by three numbers (m, rad).

    Attributes:
        A: derivative of the next state by the present one.
        B: derivative of the next state by the controls.
        C: derivative of the sensors by the present state.
        D: derivative of the sensors by the controls.
    """

    A: Float[Array, "changes changes"]
    B: Float[Array, "changes nu"]
    C: Float[Array, "nsensordata changes"]
    D: Float[Array, "nsensordata nu"]


def linearise(
    scene: Scene, state: State, ctrl: Float[ArrayLike, " nu"] | None = None, *, contact: Contact = Slope()
) -> Linearisation:
    """Return the linear model of one step from a state; use `jax.vmap` for a batch of states.

    The controls are the scene's resting ones by default. Contact is stepped as in `rollout`: the default is the model of the
    outcome, and `mg.Discrete()` corresponds to `mjd_transitionFD`, whose D by MuJoCo 3.17 has the wrong sign if centred.

    Raises:
        ValueError: as `rollout`.
    """
    state = started(scene, state)
    ctrl = scene.data.ctrl if ctrl is None else real("ctrl", ctrl, scene.data.ctrl.dtype)
    if ctrl.shape != (scene.model.nu,):
        raise ValueError(f"ctrl must have shape ({scene.model.nu},), one number per actuator, got {ctrl.shape}")
    sequence_of(ctrl[None], None, 1, scene.model.nu)
    return Linearisation(*engine_of(scene, contact).linearise(scene, state, ctrl, contact))


def clamped(scene: Scene, controls: Float[Array | np.ndarray, "horizon nu"]) -> Iterator[str]:
    """Yield that controls leave their actuator's range, if they are known and do."""
    model, numbers, ends = scene.mj_model, known(controls), known(scene.model.actuator_ctrlrange)
    if numbers is None or ends is None or model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
        return
    low, high = (ends + _ROUNDING * np.abs(ends) * np.array([-1.0, 1.0])).T
    beyond = ((numbers < low) | (numbers > high)) & (model.actuator_ctrllimited == 1)
    if beyond.any():
        row, column = np.argwhere(beyond)[0].tolist()
        name = actuator_of(model, column)
        reach, ends = format_number(float(numbers[row, column])), format_range(ends[column], " to ")
        told = f"{reach} in step {row}, and its ctrlrange is {ends}"
        yield f"a control of actuator {name} is {told}: MuJoCo clamps it, and it has no derivative there"


def actuator_of(model: mujoco.MjModel, control: int) -> str | int:
    """Return the name of a control's actuator, which may have several, or the number of one without a name."""
    actuator = int(np.searchsorted(model.actuator_ctrladr, control, side="right")) - 1
    return model.actuator(actuator).name or actuator


def sequence_of(
    controls: ArrayLike | PolicyFunction | None, noise: ArrayLike | None, horizon: int | None, num_controls: int
) -> tuple[Array | None, int]:
    """Return the controls if they are a sequence, and the number of steps; refuse contradicting arguments."""
    given = {"controls": None if callable(controls) else controls, "noise": noise}
    given = {name: real(name, value) for name, value in given.items() if value is not None}
    for name, value in given.items():
        if value.ndim != 2 or value.shape[1] != num_controls:
            raise ValueError(_unlike_rows(name, value.shape, num_controls, horizon))
    lengths = {name: len(value) for name, value in given.items()}
    if horizon is not None:
        lengths["horizon"] = whole("horizon", horizon)
    if not lengths:
        raise ValueError("horizon must be given where neither controls nor noise give it, got None")
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise ValueError(f"controls, noise and horizon must agree on the number of steps, got {told}")
    horizon = next(iter(lengths.values()))
    if horizon < 1:
        raise ValueError(f"horizon must be at least 1, got {horizon}")
    for name, value in given.items():
        numbers = known(value)  # not jnp, whose operations are traced inside jit even on known values
        if numbers is not None and not np.isfinite(numbers).all():
            row, column = np.argwhere(~np.isfinite(numbers))[0]
            raise ValueError(f"{name} must be finite, got {numbers[row, column]} in step {row} for actuator {column}")
    return given.get("controls"), horizon


def _unlike_rows(name: str, shape: tuple[int, ...], num_controls: int, horizon: int | None) -> str:
    columns = {0: "no column, for there are no actuators", 1: "1 column, that of the actuator"}
    wanted = f"one row per step and {columns.get(num_controls, f'{num_controls} columns, one per actuator')}"
    remedy = ""
    if shape == (num_controls,):
        remedy = f": to hold them for a horizon take jnp.tile({name}, (horizon, 1))"
    elif len(shape) == 1 and num_controls == 1:
        remedy = f": take {name}[:, None]"
    elif len(shape) == 2 and shape[0] == num_controls > 1 and horizon in (None, shape[1]):
        remedy = ": if its rows are those of actuators, transpose it"
    length = "horizon" if horizon is None else horizon
    return f"{name} must have {wanted}, shape ({length}, {num_controls}), got shape {shape}{remedy}"


def started(scene: Any, state: Any) -> State:
    """Return a state in the scene's precision; refuse what is no scene or no state, a state of another, or several at once."""
    check_scene(scene)
    instance("state", state, State, "of mg.initial_state, or the end of a rollout")
    parts, dtype = {}, scene.data.qpos.dtype
    for name, size in (("qpos", scene.model.nq), ("qvel", scene.model.nv), ("act", scene.model.na), ("time", None)):
        parts[name] = part = real(f"state.{name}", getattr(state, name), dtype)
        if part.shape != (wanted := () if size is None else (size,)):
            remedy = "map over batches with jax.vmap"
            raise ValueError(f"state.{name} must have shape {wanted} in this scene, got {part.shape}: {remedy}")
    state = dataclasses.replace(state, **parts)
    return jax.tree.map(lambda x: x.astype(dtype) if eqx.is_inexact_array(x) and x.dtype != dtype else x, state)


def applied(scene: Scene, inputs: Mapping[str, ArrayLike] | None, horizon: int) -> dict[str, Array]:
    """Return the further inputs of each step; refuse unknown ones."""
    found = {}
    instance("inputs", inputs, Mapping | None, "a dict of arrays by name")
    for name, value in ({} if inputs is None else inputs).items():
        if name not in INPUTS[1:]:
            raise ValueError(f"inputs must be among {', '.join(INPUTS[1:])}, got {name!r}")
        shape = (horizon, *getattr(scene.data, name).shape)
        if np.shape(value) != shape:
            raise ValueError(f"inputs[{name!r}] must have shape {shape}, one row per step, got {np.shape(value)}")
        numbers = known(value)
        if numbers is not None and not np.isfinite(numbers).all():
            raise ValueError(f"inputs[{name!r}] must be finite, got {numbers[~np.isfinite(numbers)][0]}")
        found[name] = jnp.asarray(value, getattr(scene.data, name).dtype)
    return found
