"""What a step leaves out, and how each part of it is put back: by the file, by an argument, or by a patch where there is none."""

import contextlib
import functools
import importlib
import time
import tracemalloc
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal
from unittest import mock

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import mjxgrad as mg
from experiments.problems import ASSETS
from mjxgrad._mjx import mjx
from mjxgrad.batched.cholesky import SOLUTION
from mjxgrad.engines import inverse
from mjxgrad.engines.pool import pool_of
from mjxgrad.engines.state import data_of
from mjxgrad.scene.refusals import has_constraints
from mjxgrad.stepping import EngineName, rows
from mjxgrad.tasks import scene_path

SceneName = Literal["cartpole", "ball_wall", "push", "falling_arm", "sensing_arm", "hopper", "ant", "quadruped"]
PartName = Literal[
    "damping", "storage", "rows", "forces", "pairs", "room", "cold", "columns", "record", "carry", "values", "numbers",
    "solution", "stages", "geoms",
]  # fmt: skip
_MOST_PAIRS = 6
_LITTLE = 1e-25  # of what must act, so that no step can know that it does next to nothing
_SCALAR = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
_FORWARD = importlib.import_module("mjxgrad.stepping.forward")  # whose name in `stepping` is a function's
_DIFFERENCES, _BEGIN = mujoco.mjd_inverseFD, inverse.Inverse.__init__


@dataclass(frozen=True)
class Part:
    """Something that is left out."""

    what: str  # in a few words
    why: str  # likewise
    engines: tuple[EngineName, ...] = ("mjx", "mujoco")  # who leave it out
    # Puts it back into a file, and returns whether there is anything to put back.
    edit: Callable[[mujoco.MjSpec], bool] = lambda _: True
    load: dict[str, Any] = field(default_factory=dict)  # arguments of `load_scene` that put it back
    rollout: dict[str, Any] = field(default_factory=dict)  # those of `rollout`
    patch: Callable[[], contextlib.AbstractContextManager] = contextlib.nullcontext  # puts it back into the library
    step: Callable | None = None  # of a loop that carries the whole data
    is_argument: bool = False  # whether the scene is an argument, whose numbers the compiler does not know
    off: str = ""  # why results differ beyond rounding, if they do


@contextlib.contextmanager
def patched(parts: Sequence[Part]) -> Iterator[None]:
    """Run with what is put back into the library."""
    with contextlib.ExitStack() as stack:
        for part in parts:
            stack.enter_context(part.patch())
        yield


def file_of(name: str) -> mujoco.MjSpec:
    """Return a scene's file; the sensing arm is the falling one with sensors and sparse matrices."""
    theirs = ASSETS / f"{name}.xml"
    own = theirs if theirs.exists() else scene_path("falling_arm" if name == "sensing_arm" else name)
    spec = mujoco.MjSpec.from_file(str(own))
    if name == "sensing_arm":
        spec.option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
        for kind in ("FRAMEPOS", "FRAMELINVEL", "FRAMELINACC", "FRAMEANGACC"):
            sensor = getattr(mujoco.mjtSensor, f"mjSENS_{kind}")
            spec.add_sensor(name=kind, type=sensor, objtype=mujoco.mjtObj.mjOBJ_BODY, objname="lower")
    return spec


def _with_rows(spec: mujoco.MjSpec) -> bool:
    """Give joints limits out of reach and next to no friction loss, and add an equality that is switched off."""
    limited, joints = spec.compile().jnt_limited, [joint for joint in spec.joints if joint.type in _SCALAR]
    for joint in joints:
        if not limited[joint.id]:
            joint.limited, joint.range = mujoco.mjtLimited.mjLIMITED_TRUE, [-1e5, 1e5]
        joint.frictionloss = joint.frictionloss or _LITTLE
    kind, of = mujoco.mjtEq.mjEQ_JOINT, mujoco.mjtObj.mjOBJ_JOINT
    spec.add_equality(type=kind, objtype=of, name1=joints[0].name, active=False)
    return True


def _with_forces(spec: mujoco.MjSpec) -> bool:
    """Add next to no medium and gravity compensation, and a tendon and a motor that pull at nothing."""
    joint, option = next(j for j in spec.joints if j.type in _SCALAR), spec.option
    option.density, option.viscosity = option.density or _LITTLE, option.viscosity or _LITTLE
    spec.bodies[-1].gravcomp = spec.bodies[-1].gravcomp or _LITTLE
    spec.add_tendon(name="loose").wrap_joint(joint.name, 1.0)
    # A file's defaults may make a servo of it.
    idle = {"gainprm": np.zeros(10), "biasprm": np.zeros(10), "biastype": mujoco.mjtBias.mjBIAS_NONE}
    spec.add_actuator(name="idle", target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT, **idle)
    return True


def _with_pairs(spec: mujoco.MjSpec) -> bool:
    """Add some pairs of geoms that masks keep apart; did they touch in the motion, its difference would tell."""
    for k, geom in enumerate(spec.geoms):
        geom.name = geom.name or f"geom {k}"
    model, others = spec.compile(), []
    known = {(pair.geom1, pair.geom2) for pair in mg.load_scene(model).pairs}
    body, parent = model.geom_bodyid, model.body_parentid
    for i, j in zip(*np.triu_indices(model.ngeom, 1), strict=True):
        a, b = body[i], body[j]
        is_kin = a == b or (a and b and bool({parent[a], a} & {parent[b], b} - {0}))
        if not is_kin and not {(i, j), (j, i)} & known:
            others.append((model.geom(i).name, model.geom(j).name))
    for first, second in others[:: max(1, len(others) // _MOST_PAIRS)][:_MOST_PAIRS]:
        spec.add_pair(geomname1=first, geomname2=second)
    return bool(others) and not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT


def _cold(spec: mujoco.MjSpec) -> bool:
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART
    return has_constraints(spec.compile())


def _anew(model: mujoco.MjModel, data: mujoco.MjData, width: float, skip: bool, *found: Any) -> None:
    """Write differences of inverse dynamics, of which all stages are computed for each column."""
    if found[0] is not None:
        return _DIFFERENCES(model, data, width, skip, *found)
    matrix, entries = (found[1], data.qvel) if found[1] is not None else (found[2], data.qacc)
    mujoco.mj_inverse(model, data)
    base = data.qfrc_inverse.copy()
    for dof, kept in enumerate(entries.tolist()):
        entries[dof] = kept + width
        mujoco.mj_inverse(model, data)
        matrix[dof], entries[dof] = (data.qfrc_inverse - base) / width, kept


class _Kept(np.ndarray):
    """An array that stays as it is."""

    def __setitem__(self, *_: Any) -> None:
        pass


def _with_all_geoms(self: inverse.Inverse, *arguments: Any) -> None:
    _BEGIN(self, *arguments)
    self.touching = [np.ones_like(one).view(_Kept) for one in self.touching]


def _unknown(model: mjx.Model, _: Any, contact: Any, __: int) -> jax.Array:
    return jnp.asarray(model.geom_bodyid)[contact.geom]


def _put(target: Any, name: str, other: Callable) -> Callable[[], contextlib.AbstractContextManager]:
    return lambda: mock.patch.object(target, name, other)


_X: tuple[EngineName, ...] = ("mjx",)
_C: tuple[EngineName, ...] = ("mujoco",)
_FULL = {"keep_everything": True}
_READ = {"observe": lambda _, data: jax.tree.leaves(data)}
PARTS: dict[str, Part] = {
    "damping": Part(
        "implicit damping", "no joint is damped", _X, load=_FULL, patch=_put(_FORWARD, "is_known_to_be", lambda *_: False)
    ),
    "storage": Part("sparse matrices", "small ones are faster dense", _X, load=_FULL),
    "rows": Part("limits, friction loss, equality", "the file has none", edit=_with_rows),
    "forces": Part("medium, tendon, motor", "the file has none", edit=_with_forces),
    "pairs": Part(f"{_MOST_PAIRS} pairs of geoms", "masks keep them apart", edit=_with_pairs),
    "room": Part("room beyond 8 contacts", "max_contacts=8", _X, load={"max_contacts": 8}),
    "cold": Part("cold start of solves", "the last solution is near", edit=_cold, off="the solver's tolerance"),
    "columns": Part("columns of contacts", "joints that move neither body", _X, patch=_put(rows, "_bodies", _unknown)),
    "record": Part("record of all data", "nobody reads it", _X, rollout=_READ),
    "carry": Part("all data between steps", "the state decides", _X, step=mg.step),
    "values": Part("values within steps", "a gradient computes them anew", _X, rollout={"checkpoint": False}),
    "numbers": Part("numbers as arguments", "they are known", is_argument=True),
    "solution": Part(
        "differences of steps", "the solution has the derivative", _C, off="wider differences",
        patch=_put(inverse, "has_inverse", lambda _: False),
    ),
    "stages": Part(
        "kinematics, collisions by velocity", "places stay", _C, patch=_put(mujoco, "mjd_inverseFD", _anew)
    ),
    "geoms": Part(
        "collisions of geoms apart", "they stay apart", _C, patch=_put(inverse.Inverse, "__init__", _with_all_geoms)
    ),
    "all": Part("all of these", "as above"),
    "mjx.step": Part("all (mjx.step)", "MJX's own step", _X, step=mjx.step, off="the solver's tolerance"),
}  # fmt: skip
ONLY_GRADIENT = {"values", "solution", "stages", "geoms"}


def is_left_out(key: str, name: str, engine: EngineName) -> bool:
    """Return whether an engine leaves a part out of a scene; C MuJoCo has no inverse dynamics of Runge and Kutta's steps."""
    file, has_inverse = file_of(name), inverse.has_inverse(file_of(name).compile())
    is_told = key not in ("all", "mjx.step") and engine in PARTS[key].engines and PARTS[key].edit(file)
    return is_told and (has_inverse or engine == "mjx" or key not in ONLY_GRADIENT)


def starts_of(model: mujoco.MjModel, count: int, horizon: int, seed: int) -> tuple[jax.Array, ...]:
    """Return states that have fallen for a while and are stirred a little, and controls within half of their range."""
    data, random = mujoco.MjData(model), np.random.default_rng(seed)
    mujoco.mj_step(model, data, round(0.3 / model.opt.timestep))
    low, high = np.where(model.actuator_ctrllimited.astype(bool), model.actuator_ctrlrange.T, [[-1.0], [1.0]])
    ctrl = (low + high) / 2 + 0.25 * (high - low) * random.uniform(-1, 1, (count, horizon, model.nu))
    qvel = data.qvel + 0.2 * random.normal(size=(count, model.nv))
    return jnp.asarray(np.tile(data.qpos, (count, 1))), jnp.asarray(qvel), jnp.asarray(ctrl)


def _function(parts: Sequence[Part], work: str) -> Callable[..., Any]:
    """Return a program of a scene and of batches of starts: where motions end, or gradients of a mix of that."""
    options = {key: value for part in parts for key, value in part.rollout.items()}
    step = next((part.step for part in parts if part.step), None)
    observe = options.get("observe", lambda *_: None)

    def looped(scene: mg.Scene, state: mg.State, ctrl: jax.Array) -> tuple[Any, Any]:
        def advance(data: mjx.Data, row: jax.Array) -> tuple[mjx.Data, Any]:
            moved = step(scene.model, data.replace(ctrl=row))  # pyright: ignore[reportOptionalCall]
            # MJX gives some integers of tendons 64 bits.
            return jax.tree.map(lambda new, old: new.astype(old.dtype), moved, data), observe(None, moved)

        if step is mg.step and options.get("checkpoint", True):  # as `rollout` does
            keep = jax.checkpoint_policies.save_only_these_names(SOLUTION)
            advance = jax.checkpoint(advance, policy=keep, prevent_cse=False)
        end, record = jax.lax.scan(advance, data_of(scene, state, ctrl[0]), ctrl)
        return end, (record, jax.tree.leaves(end))

    def cost(scene: mg.Scene, qpos: jax.Array, qvel: jax.Array, ctrl: jax.Array) -> tuple[jax.Array, Any]:
        ctrl, state = jnp.pad(ctrl, ((0, 0), (0, scene.model.nu - ctrl.shape[1]))), mg.initial_state(scene, qpos, qvel)
        if step is None:
            found = mg.rollout(scene, state, ctrl, **options)
            end, record = found.final, found.observations
        else:
            end, record = looped(scene, state, ctrl)
        # No symmetry, so that no error cancels.
        value = jnp.linspace(1.0, 2.0, end.qpos.size) @ end.qpos + jnp.linspace(-0.1, 0.1, end.qvel.size) @ end.qvel
        return value, ((end.qpos, end.qvel), record)

    def gradient(*given: Any) -> tuple[Any, Any]:
        found, (_, record) = jax.grad(cost, argnums=(1, 2, 3), has_aux=True)(*given)
        return found, record

    return jax.vmap(gradient if work == "gradient" else lambda *given: cost(*given)[1], (None, 0, 0, 0))


@dataclass(frozen=True)
class Program:
    """A program with parts put back, traced."""

    lowered: jax.stages.Lowered
    given: tuple[Any, ...]
    parts: Sequence[Part]
    seconds: float

    def compiled(self) -> tuple[Callable[..., Any], float, float]:
        """Compile it, and return a function that runs it, the seconds that both took, and the bytes that it needs."""
        began = time.perf_counter()
        program = self.lowered.compile()
        sizes, seconds = program.memory_analysis(), self.seconds + time.perf_counter() - began

        def run(*starts: jax.Array) -> Any:
            with patched(self.parts):
                return jax.block_until_ready(program(*self.given, *starts))

        return run, seconds, sizes.temp_size_in_bytes + sizes.output_size_in_bytes if sizes else float("nan")


def program(name: str, parts: Sequence[Part], engine: EngineName, work: str, starts: tuple) -> Program | None:
    """Trace the program of a scene with parts put back; None where `mjx.step` has no reverse mode."""
    file = file_of(name)
    with patched(parts), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for part in parts:
            part.edit(file)
        load = {key: value for part in parts for key, value in part.load.items()}
        scene = mg.load_scene(file, **load).with_engine(engine)
        if engine == "mujoco":
            pool_of(scene.mj_model).may_share = False  # with processes that know of no patch
        given = (scene,) if any(part.is_argument for part in parts) else ()
        function, began = _function(parts, work), time.perf_counter()
        try:
            lowered = jax.jit(function if given else functools.partial(function, scene)).lower(*given, *starts)
        except ValueError as error:
            if "Reverse-mode" not in str(error):
                raise
            return None
        return Program(lowered, given, parts, time.perf_counter() - began)


def peak(run: Callable, *starts: jax.Array) -> float:
    """Return the most bytes that arrays of numpy hold while a program runs."""
    tracemalloc.start()
    run(*starts)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak
