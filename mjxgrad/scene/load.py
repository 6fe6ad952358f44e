"""Loading of scenes from a file, a string or a C model."""

import copy
import itertools
import math
import os
import warnings
from pathlib import Path
from typing import Any, cast, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjxgrad._arrays import instance, one_of, real, whole
from mjxgrad._mjx import MJX_VERSION, counts, geom_pairs, make_efc_address, make_efc_type, mjx
from mjxgrad._warnings import collected
from mjxgrad.batched.device import is_gpu, own_device
from mjxgrad.contact import Softness, softness_warnings
from mjxgrad.contact.collision import slot_dims
from mjxgrad.contact.parameters import contact_pairs
from mjxgrad.scene import conversions as rules
from mjxgrad.scene.refusals import REFUSALS, UNDECIDED, UNLIKE, refusal_messages
from mjxgrad.scene.scene import (
    MOST_PAIRS,
    OF_FILES,
    Scene,
    SceneError,
    SceneWarning,
    check_engine,
    numbers_of,
    takes_warp,
)
from mjxgrad.stepping import EngineName

_FLOAT32_TOLERANCE = 1e-6
_SHORT = 1e-6  # s
_SPARSE_FROM = 60  # degrees of freedom; MJX's own threshold


def load_scene(
    source: str | os.PathLike[str] | mujoco.MjSpec | mujoco.MjModel,
    *,
    softness: Softness | None = None,
    keep_everything: bool = False,
    timestep: float | None = None,
    max_contacts: int | None = None,
    engine: EngineName | None = None,
) -> Scene:
    """Load a scene, convert what MJX lacks and leave out what the scene does not need.

    C MuJoCo steps a scene that MJX cannot, with derivatives, too, or on a GPU MuJoCo Warp, where it is installed: see
    `scene.engine`, and `scene.unsupported` for the reason.

    Arrays are float64 if `jax_enable_x64` is set. Float32 otherwise raises a solver tolerance below 1e-6, which the solver
    would never reach.

    Args:
        source: path of an MJCF file, MJCF as a string, a `MjSpec` or a C model; neither is changed.
        softness: contact softness, instead of the file's.
        keep_everything: leave out nothing, and keep the solver tolerance and the storage of
            matrices as in the file. The motion is the same to rounding.
        timestep: time step in s, instead of the file's.
        max_contacts: number of contact slots per friction dimension (`condim`), for the nearest contacts; only these cost
            anything in the solve. None has room for all possible contacts. `Trajectory.crowded` counts the steps that filled
            all slots.
        engine: "mjx" refuses scenes that MJX cannot step, "mujoco" has C MuJoCo step the file as it is, "warp" MuJoCo Warp. None
            prefers MJX, but not for contacts of meshes and height fields, which MJX finds by rules of its own.

    Returns:
        The scene. `print(scene.summary())` describes it.

    Raises:
        FileNotFoundError: if there is no such file.
        IsADirectoryError: if the path is a folder.
        TypeError: if the source is none of these.
        ValueError: if `timestep` or `max_contacts` is not positive, or as `Softness.apply`.
        SceneError: if MuJoCo cannot read the MJCF, or nothing in it can move. Where MJX is asked for, also if MJX cannot
            simulate it, with all unsupported features, or loading would take minutes by the number of geom pairs.
    """
    instance("softness", softness, Softness | None, "mg.Softness, such as mg.Softness(stiffness=1e4)")
    one_of("engine", engine, (*get_args(EngineName), None))
    instance("keep_everything", keep_everything, bool, "True or False")
    if max_contacts is not None and whole("max_contacts", max_contacts, None) < 1:
        raise ValueError(f"max_contacts must be at least 1, got {max_contacts}; None has room for all")
    with collected() as told:
        mj_model, name = _compile(source)
    _set_timestep(mj_model, name, timestep)
    _check_model(mj_model, name)
    check_engine(engine, mj_model)
    mj_model, stepped, conversions, unsupported = _converted(mj_model, name, engine)
    omissions = ()
    if not keep_everything and not unsupported:
        omissions = rules.switch_off(stepped)
        conversions += _fit_solver(stepped)
    pairs = contact_pairs(mj_model if unsupported else stepped, MOST_PAIRS)
    with jax.ensure_compile_time_eval():  # also within a traced function that loads its own scene
        model, data = _put(stepped, name, max_contacts)
    if unsupported:
        touching = {name: getattr(mj_model, name) for name in ("geom_contype", "geom_conaffinity", "geom_type")}
        model = model.tree_replace({"opt.solver": mujoco.mjtSolver.mjSOL_PGS, **touching})
    if nothing := [field for field, value in numbers_of(model).items() if np.isnan(value).any()]:  # pyright: ignore[reportArgumentType]
        raise SceneError(f"{name} must hold numbers, got NaN in {', '.join(nothing)}")
    # What MJX lacks, a GPU steps by Warp, in single precision alone.
    is_for_warp = engine is None and bool(unsupported) and is_gpu() and jnp.result_type(float) == jnp.float32
    chosen = "warp" if engine == "warp" or (is_for_warp and takes_warp(mj_model)) else None
    scene = Scene(
        model, data, mj_model, omissions, tuple(conversions), pairs, name, unsupported, chosen, max_contacts  # pyright: ignore[reportArgumentType]
    )  # fmt: skip
    messages = [f"MuJoCo says: {text}" for text in told]
    if timestep and timestep > 0.1:
        messages.append(f"a time step of {timestep:g} s is long: give seconds")
    if (step := mj_model.opt.timestep) < _SHORT:
        messages.append(f"a time step of {step:g} s is short: a second of motion takes {1 / step:.0e} steps")
    head, *more = unsupported.splitlines() or [""]
    alone = head.removeprefix(f"{name} cannot be stepped by MJX: ")
    reasons = "; ".join(one.strip(" -").partition(", got")[0] for one in more or [alone])
    messages += (
        [f"{OF_FILES[scene.engine]} steps it: {reasons}; see scene.unsupported"]
        if unsupported and engine is None
        else []
    )
    if not unsupported:
        messages += [text.partition("; load")[0] for text in refusal_messages(mj_model, [UNLIKE, UNDECIDED])]
    messages += [f"{c.what}: {c.used} instead of {c.given}: {c.reason}" for c in conversions if not c.exact]
    if softness is not None:
        scene = eqx.tree_at(lambda s: s.model, scene, softness.apply(scene.model))
        messages += softness_warnings(softness, scene.model)
    for message in messages + scene.warnings():
        warnings.warn(f"{name}: {message}", SceneWarning, stacklevel=2)
    return scene


def _compile(source: str | os.PathLike[str] | mujoco.MjSpec | mujoco.MjModel) -> tuple[mujoco.MjModel, str]:
    """Return a copy of the C model of a source, and its name in messages."""
    if isinstance(source, mujoco.MjModel):
        name = source.names.partition(b"\0")[0].decode(errors="replace")
        return copy.deepcopy(source), name if name not in ("", "MuJoCo Model") else "the model"
    if isinstance(source, mujoco.MjSpec):
        return _parse(lambda spec: spec.copy().compile(), source, "the MjSpec")
    accepted = "an MJCF file, MJCF as a string (starting with '<'), a mujoco.MjSpec or a mujoco.MjModel"
    if not isinstance(source, str | os.PathLike):
        raise TypeError(f"source must be {accepted}, got {type(source).__name__}")
    if isinstance(source, str) and source.lstrip("\ufeff \t\r\n").startswith("<"):
        return _parse(mujoco.MjModel.from_xml_string, source.strip("\ufeff \t\r\n"), "the MJCF")
    if source == "":
        raise FileNotFoundError(f"source must be {accepted}, got ''")
    path = Path(source)
    if path.is_dir():
        raise IsADirectoryError(f"source must be {accepted}, got the folder {str(path)!r}")
    if not path.is_file():
        reason = "which does not exist; relative paths start at the current folder"
        raise FileNotFoundError(f"source must be {accepted}, got {str(path)!r}, {reason}")
    return _parse(mujoco.MjModel.from_xml_path, str(path), path.name)


def _parse(read, argument: str | mujoco.MjSpec, name: str) -> tuple[mujoco.MjModel, str]:
    try:
        return read(argument), name
    except ValueError as error:
        message = " ".join(str(error).split())
        raise SceneError(f"{name} must be MJCF that MuJoCo accepts, but it says: {message}") from (error)


def count_pairs(model: mujoco.MjModel) -> int:
    """Count the pairs of geoms that can touch, up to one more than `MOST_PAIRS`."""
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT:
        return 0
    return sum(1 for _ in itertools.islice(geom_pairs(model), MOST_PAIRS + 1))


def _set_timestep(model: mujoco.MjModel, name: str, timestep: float | None) -> None:
    if timestep is not None:
        if not (math.isfinite(real("timestep", timestep)) and timestep > 0):
            raise ValueError(f"timestep must be positive, in seconds, got {timestep!r}")
        model.opt.timestep = timestep
    elif not (math.isfinite(model.opt.timestep) and model.opt.timestep > 0):
        remedy = "set it in <option>, or give load_scene a timestep"
        raise SceneError(f"{name} must have a positive time step, got {model.opt.timestep:g} s: {remedy}")


def _check_model(model: mujoco.MjModel, name: str) -> None:
    try:
        model.names.decode()
    except UnicodeDecodeError as error:
        given = error.object[error.start :][:1]
        raise SceneError(f"{name} must have names in UTF-8, got {given!r}; save it so") from None
    if model.nv == 0:
        reason = "so that nothing can move; give a body a joint"
        raise SceneError(f"{name} must have at least one degree of freedom, got none (nv = 0), {reason}")


def _converted(
    model: mujoco.MjModel, name: str, engine: EngineName | None
) -> tuple[mujoco.MjModel, mujoco.MjModel, list[rules.Conversion], str]:
    """Return the C model, the model for MJX, the conversions, and the reason why MJX cannot step it, if any."""
    original = copy.deepcopy(model)
    try:
        if count_pairs(model) > MOST_PAIRS:
            raise SceneError(
                f"{name} must have at most {MOST_PAIRS} pairs of geoms that can touch, got more: give geoms that never "
                "touch contype and conaffinity that do not match; then max_contacts bounds those that do"
            )
        if mujoco.__version__.split(".")[:2] != MJX_VERSION.split(".")[:2]:
            raise SceneError(
                f"MJX has the maths of MuJoCo {MJX_VERSION}, and this is MuJoCo {mujoco.__version__}; "
                "pip install 'mjxgrad[mjx]' for MJX's step"
            )
        conversions = [c for rule in rules.BEFORE_REFUSALS for c in rule(model)]
        refused = refusal_messages(model, REFUSALS if engine == "mjx" else (*REFUSALS, UNLIKE))
        if len(refused) == 1:
            raise SceneError(f"{name} cannot be stepped by MJX: {refused[0]}")
        if refused:
            listed = "\n".join(f"  - {message}" for message in refused)
            raise SceneError(f"{name} cannot be stepped by MJX for {len(refused)} reasons:\n{listed}")
        if engine is not None and engine in OF_FILES:  # only now, so that the hint is of no file that MJX cannot step
            raise SceneError(
                f"{name} was loaded for {OF_FILES[engine]}, engine={engine!r}; without engine= MJX steps it"
            )
        conversions += [c for rule in rules.AFTER_REFUSALS for c in rule(model)]
        stepped = copy.deepcopy(model)
        conversions += list(rules.drop_sensors(stepped))
    except SceneError as error:
        if engine == "mjx":
            raise
        conversions = list(rules.waking(original))
        return original, rules.kinematics_alone(original), conversions, str(error)
    return model, stepped, conversions, ""


def _fit_solver(model: mujoco.MjModel) -> list[rules.Conversion]:
    """Store small matrices densely, and limit the tolerance to the resolution of float32."""
    conversions = []
    if model.nv < _SPARSE_FROM:
        if model.opt.jacobian == mujoco.mjtJacobian.mjJAC_SPARSE:
            reason = f"faster below {_SPARSE_FROM} degrees of freedom, the same numbers"
            conversions.append(rules.Conversion("jacobian", "sparse", "dense", reason))
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    if jnp.result_type(float) == jnp.float32 and model.opt.tolerance < _FLOAT32_TOLERANCE:
        given, model.opt.tolerance = f"{model.opt.tolerance:g}", _FLOAT32_TOLERANCE
        conversions.append(rules.Conversion("tolerance", given, f"{_FLOAT32_TOLERANCE:g}", "float32 resolves no more"))
    return conversions


class _Rigid:
    """A model without its flexible bodies: their vertices are bodies like others, and what else they do only C MuJoCo knows."""

    nflex = 0

    def __init__(self, model: mujoco.MjModel):
        self._model = model

    def __getattr__(self, name: str) -> Any:
        return getattr(self._model, name)


def _put(model: mujoco.MjModel, name: str, max_contacts: int | None) -> tuple[mjx.Model, mjx.Data]:
    if not contact_pairs(model):
        # MJX insists on a collision function even for pairs whose contact is disabled.
        model.geom_contype[:] = 0
        model.geom_conaffinity[:] = 0
        # Nor can it sum the forces of zero contacts for sensors, which then read zero.
        of_contact = np.isin(model.sensor_type, [mujoco.mjtSensor.mjSENS_TOUCH, mujoco.mjtSensor.mjSENS_CONTACT])
        model.sensor_needstage[of_contact] = mujoco.mjtStage.mjSTAGE_NONE
        model.sensor_type[of_contact] = mujoco.mjtSensor.mjSENS_CLOCK
    try:
        # The device of this process; MJX would take the first of all processes.
        with np.errstate(over="raise"):
            mjx_model = mjx.put_model(_Rigid(model) if model.nflex else model, impl="jax", device=own_device())  # pyright: ignore[reportArgumentType]
        return mjx_model, _make_data(model, mjx_model, max_contacts)
    except FloatingPointError:
        largest = f"{np.finfo(np.float32).max:.1g}"
        raise SceneError(
            f"{name} must hold numbers up to {largest} in single precision, got a larger one; set jax_enable_x64 for those"
        ) from None
    except NotImplementedError as error:
        raise SceneError(f"{name} cannot be stepped by MJX: MJX says: {error}") from error


def _make_data(model: mujoco.MjModel, mjx_model: mjx.Model, max_contacts: int | None) -> mjx.Data:
    """Return MJX's data with contact slots, including frictionless ones beside elliptic ones, which MJX refuses."""
    # A pair of boxes has more of them than in MJX.
    cone, model.opt.cone = model.opt.cone, mujoco.mjtCone.mjCONE_PYRAMIDAL
    data = mjx.make_data(model, impl="jax", device=own_device())
    model.opt.cone = cone
    dims = slot_dims(mjx_model) if data._impl.ncon else np.zeros(0, int)
    dims = np.concatenate([np.zeros(0, int), *(dims[dims == dim][:max_contacts] for dim in np.unique(dims))])
    if cone == mujoco.mjtCone.mjCONE_PYRAMIDAL and np.array_equal(dims, data._impl.contact.dim):
        return data
    # All slots of MJX's data are alike.
    contact = jax.tree.map(lambda x: x[np.zeros(len(dims), int)], data._impl.contact)
    efc_type = make_efc_type(mjx_model, dims)
    contact = contact.replace(dim=dims, efc_address=make_efc_address(mjx_model, dims, efc_type))
    every = {field.name: getattr(data._impl, field.name) for field in data._impl.fields()}
    rows = {k: x for k, x in every.items() if k.startswith("efc_") and isinstance(x, jax.Array)}
    numbers = counts(efc_type)  # of equalities, friction losses, limits and contacts
    found = {k: jnp.zeros((sum(numbers), *x.shape[1:]), x.dtype) for k, x in rows.items()}
    found |= dict(zip(("ne", "nf", "nl"), numbers, strict=False)) | {"nefc": sum(numbers), "ncon": len(dims)}
    found |= {"efc_type": efc_type, "contact": contact}
    return cast(mjx.Data, data.tree_replace({f"_impl.{k}": x for k, x in found.items()}))
