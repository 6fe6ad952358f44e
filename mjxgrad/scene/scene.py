"""The scene that `load_scene` returns, its description, and its sensors and sites by name."""

import dataclasses
import difflib
import functools
import importlib.util
import logging
import textwrap
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Float, PyTree

from mjxgrad._arrays import function, instance, is_known, one_of, real
from mjxgrad._mjx import mjx
from mjxgrad._text import aligned, format_number, format_range, name_pairs
from mjxgrad.bodies import constants, tree
from mjxgrad.contact import Softness, softness_warnings
from mjxgrad.contact.collision import candidates
from mjxgrad.contact.parameters import ContactParameters, Pairs, contact_parameters
from mjxgrad.contact.warnings import contact_warnings
from mjxgrad.scene.conversions import Conversion, Omission
from mjxgrad.scene.numbers import PARAMETERS, with_numbers
from mjxgrad.scene.refusals import PARALLEL, UNDECIDED, UNLIKE, has_medium, refusal_messages
from mjxgrad.stepping import EngineName
from mjxgrad.stepping.rows import index_of

MOST_PAIRS = 20_000
"""Largest number of geom pairs that MJX loads, since more take minutes, and that a scene lists."""
_WIDTH = 118  # characters in a laptop's terminal
_OPTIONS = ("timestep", "gravity", "wind")
# MuJoCo's compiler refuses a few of these below zero, or at it. Its steps take the others and gain energy, or are NaN. Springs,
# gravity compensation, margins and gaps may be negative: they have a meaning.
_POSITIVE = {"timestep", "impratio"}
_NOT_NEGATIVE = _POSITIVE | {
    "body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "geom_size", "geom_rbound", "geom_friction",
    "pair_friction", "geom_solmix", "dof_armature", "dof_damping", "dof_frictionloss", "dof_M0", "dof_invweight0",
    "tendon_armature", "tendon_damping", "tendon_frictionloss", "tendon_invweight0", "actuator_armature", "actuator_damping",
    "actuator_delay", "actuator_cranklength", "density", "viscosity",
}  # fmt: skip
_ORDERED = ("range", "_lengthspring")
_DIRECTIONS = ("_quat", "_axis", "_dir")
_ROUNDING = 1e-5  # of the largest moment of inertia: that of a plate is the sum of the others
_EULERDAMP = mujoco.mjtDisableBit.mjDSBL_EULERDAMP.value


OF_FILES: dict[EngineName, str] = {"mujoco": "C MuJoCo", "warp": "MuJoCo Warp"}
"""Engines that step a file as it is."""


class SceneError(ValueError):
    """A scene cannot be loaded or stepped; the message has the element, the requirement and the remedy."""


class SceneWarning(UserWarning):
    """A scene moves differently from its file, or has a contact that its time step cannot resolve."""


class Parametrisation(eqx.Module):
    """Numbers from which those of a model come, see `Scene.with_parameters`."""

    values: Float[Array, " parameters"]
    fields: dict[str, Array]  # that come from them
    rates: dict[str, Float[Array, "*shape parameters"]]  # derivatives of these fields


class Scene(eqx.Module):
    """A scene ready to be stepped.

    Indices of bodies, joints and geoms are those of the C model: `scene.model.geom_friction[i]` is as in MuJoCo.

    Attributes:
        model: model for MJX; its array leaves may be differentiated, replaced and batched.
        data: template at `qpos0`; no stage of the dynamics has run.
        mj_model: the C model of the same motion, for rendering and names, with the file's numbers; see `to_mujoco`. It is to be
            read only: engines keep copies.
        omissions: parts that a step leaves out, and why.
        conversions: settings replaced by others, and why.
        pairs: geom pairs that can touch, the first 20,000, in the order of `contact_parameters`; `summary` groups equal ones.
        name: source of the scene.
        unsupported: reason why MJX cannot step it, so that C MuJoCo does; empty if MJX can.
        chosen: the engine that `with_engine` chose; None for the default.
        max_contacts: as given to `load_scene`; MuJoCo Warp has room for so many contacts of a state.
        more: numbers of the C model that MJX lacks and `with_model` changed, by MuJoCo's names, such as "geom_surfacevel".
        parametrisation: numbers from which `with_parameters` made others; None without it.
    """

    # In what holds a scene it is shown by its name: equinox does not ask `__repr__` there.
    model: mjx.Model = eqx.field(repr=False)
    data: mjx.Data = eqx.field(repr=False)
    mj_model: mujoco.MjModel = eqx.field(static=True, repr=False)
    omissions: tuple[Omission, ...] = eqx.field(static=True, repr=False)
    conversions: tuple[Conversion, ...] = eqx.field(static=True, repr=False)
    pairs: Pairs = eqx.field(static=True, repr=False)
    name: str = eqx.field(static=True)
    unsupported: str = eqx.field(static=True, default="", repr=False)
    chosen: EngineName | None = eqx.field(static=True, default=None)
    max_contacts: int | None = eqx.field(static=True, default=None)
    more: dict[str, Array] = eqx.field(default_factory=dict, repr=False)
    parametrisation: Parametrisation | None = eqx.field(default=None, repr=False)

    @property
    def engine(self) -> EngineName:
        """Who steps it: as chosen, else "mjx", or "mujoco" where MJX lacks something."""
        return self.chosen or ("mujoco" if self.unsupported else "mjx")

    def with_engine(self, engine: EngineName) -> "Scene":
        """Return the scene stepped by MJX, by MuJoCo Warp, or by C MuJoCo: on all cores, uncompiled, differentiable once.

        Raises:
            ValueError: if there is no such engine.
            SceneError: if MJX cannot step the scene, NVIDIA Warp is not installed, or it would lose delays.
        """
        one_of("engine", engine, get_args(EngineName))
        if engine == "mjx" and self.unsupported:
            raise SceneError(self.unsupported)
        check_engine(engine, self.mj_model)
        kept = self.parametrisation if engine == "mujoco" else None
        return dataclasses.replace(self, chosen=engine, parametrisation=kept)

    def contact_parameters(self) -> ContactParameters:
        """Return the effective parameters of the pairs that can touch, one row each; traceable."""
        return contact_parameters(self.model, self.pairs)

    def with_softness(self, softness: Softness) -> "Scene":
        """Soften or stiffen the contacts; only array leaves of `model` change.

        Works under `jax.jit`, `jax.vmap` and `jax.grad`. If the values are known, it warns about
        parts without effect and about contacts that the time step cannot follow.

        Raises:
            ValueError: as `Softness.apply`.
        """
        instance("softness", softness, Softness, "mg.Softness, such as mg.Softness(stiffness=1e4)")
        scene = eqx.tree_at(lambda s: s.model, self, softness.apply(self.model))
        for message in softness_warnings(softness, scene.model) + scene.warnings():
            _warn(self, message)
        return scene

    def with_model(self, **fields: Float[ArrayLike, "..."]) -> "Scene":
        """Return the scene with other numbers of the model, such as `geom_friction`, `timestep`, `gravity` or `wind`.

        The fields are the model's floating-point arrays, and of the options the time step (s), gravity (m/s²) and wind (m/s),
        which acts only in a medium. Differentiable by the new values, and traceable. Shapes stay, so `jax.vmap` makes a batch of
        scenes. Constants that MuJoCo derives from masses, inertias, lengths and sizes are updated, unless they are given, too;
        see `mg.set_const`. Where C MuJoCo steps the scene, its other arrays and options have the same right, such as
        `geom_surfacevel`, `actuator_damping`, `density` or `impratio`; MJX then refuses the scene.

        Raises:
            ValueError: if there is no such field, it is not an array of numbers, or the shape differs. Known values are also
                refused where one is NaN, or what no scene can have: a negative mass, size, friction, damping, armature or
                density, moments of inertia of no body, a range from above to below, a time step of zero. Inside `jax.jit` a
                rollout with NaN is flagged as diverged.
        """
        every = numbers_of(self.model)
        options = {name: every[f"opt.{name}"] for name in _OPTIONS}
        arrays = {name: value for name, value in every.items() if "." not in name} | options
        native = {k: jnp.asarray(v, self.data.qpos.dtype) for k, v in _native(self.mj_model).items() if k not in arrays}
        chosen = [name for name in fields if name in native]
        if chosen and self.engine == "mjx":
            raise ValueError(f'MJX cannot change {" and ".join(chosen)}: take scene.with_engine("mujoco")')
        arrays |= native if self.engine == "mujoco" else {}
        fields = {name: real(name, value) for name, value in fields.items()}
        for name, value in fields.items():
            if name not in arrays:
                near = difflib.get_close_matches(name, arrays, n=3)
                remedy = f"did you mean {' or '.join(near)}?" if near else "see MuJoCo's documentation of mjModel"
                raise ValueError(f"with_model must name arrays of numbers of the model, got {name}; {remedy}")
            if np.shape(value) != arrays[name].shape:
                raise ValueError(f"{name} must have shape {arrays[name].shape} in this scene, got {np.shape(value)}")
        changed = {name: jnp.asarray(value, arrays[name].dtype) for name, value in fields.items()}
        changed |= {name: _of_length_one(x) for name, x in changed.items() if name.endswith("_quat")}
        # Not jnp, which jit would trace.
        known = {name: np.asarray(value) for name, value in changed.items() if is_known(value)}
        for name, numbers in known.items():
            _check_numbers(name, numbers)
        if "body_mass" in known and (empty := _without_mass(self.mj_model, known["body_mass"])):
            raise ValueError(f"body_mass must leave every moving body some mass, got none for {empty}")
        self._refuse_left_out(changed, known)
        if "wind" in fields and not has_medium(self.mj_model):
            _warn(self, "wind acts on nothing without a medium: set density or viscosity in <option>")
        is_explicit = self.model.opt.disableflags & ~self.mj_model.opt.disableflags & _EULERDAMP
        if "dof_damping" in fields and is_explicit:
            _warn(self, "loaded undamped, so dof_damping is integrated explicitly; load with keep_everything=True")
        scene = self
        if more := {name: changed.pop(name) for name in chosen}:
            named = {f"opt.{name}" if hasattr(self.mj_model.opt, name) else name: value for name, value in more.items()}
            reason = self.unsupported or f"with_model changed {' and '.join(chosen)}, which MJX does not have"
            scene = dataclasses.replace(self, more=self.more | named, unsupported=reason)
        options = {f"opt.{name}": changed.pop(name) for name in _OPTIONS if name in changed}
        if "body_gravcomp" in changed:  # without any in the file no step looks at it
            changed["flg_gravcomp"] = True  # pyright: ignore[reportArgumentType]
        model, derived = self.model.replace(**changed).tree_replace(options), {}  # pyright: ignore[reportArgumentType]
        if constants.CAUSES & fields.keys():
            # Only these, so that other fields stay known while the model is traced.
            derived = jax.jit(constants.constants_of)(model)
        elif "geom_size" in fields:
            derived = {"geom_rbound": constants.bounding_radii(model)}  # pyright: ignore[reportArgumentType]
        return eqx.tree_at(lambda s: s.model, scene, model.replace(**derived | changed))

    def _refuse_left_out(self, changed: Mapping[str, Array], known: Mapping[str, np.ndarray]) -> None:
        """Refuse numbers of what MuJoCo's compiler, or MJX, has left out of the model; warn where values are not known yet."""
        model = self.mj_model
        # Of such bodies MuJoCo keeps the diagonal of the inertia matrix alone.
        simple = np.flatnonzero((model.body_simple > 0) & (model.body_dofnum > 1))
        for name in changed.keys() & {"body_ipos", "body_iquat", "jnt_axis"}:
            owners = model.jnt_bodyid if name == "jnt_axis" else np.arange(model.nbody)
            is_of = np.isin(owners, simple)
            if name in known:
                is_of &= (np.abs(known[name] - getattr(model, name)) > _ROUNDING).any(axis=1)
            for body in owners[is_of][:1].tolist():
                told = f"{name} of {model.body(body).name or f'body {body}'}, whose inertia was compiled as diagonal"
                remedy = "move its centre of mass in the file, by as little as <inertial pos='1e-6 0 0' .../>"
                if name in known:
                    raise ValueError(f"{told}, cannot change: {remedy}")
                _warn(self, f"{told}, has no effect on it: {remedy}")
        if self.engine != "mjx":
            return
        for name, has in (
            ("dof_frictionloss", "dof_hasfrictionloss"),
            ("tendon_frictionloss", "tendon_hasfrictionloss"),
        ):
            is_left_out = ~np.asarray(getattr(self.model._impl, has), bool)
            if name in known and known[name][is_left_out].any():
                told = f"{name} that is zero in the file is left out by MJX, and cannot change"
                raise ValueError(f'{told}: give a small one there, or take scene.with_engine("mujoco")')

    def with_parameters(self, change: Callable[["Scene", PyTree], "Scene"], values: PyTree) -> "Scene":
        """Return `change(scene, values)`, with derivatives by C MuJoCo along `values` alone: they cost a few steps for each.

        A derivative by `with_model` alone takes every entry of each array that is replaced or follows from one, hundreds in a
        robot. Values and derivatives are the same; by other engines so is the price.

        Args:
            change: function of a scene and values to a scene, by `with_model` or `with_softness`.
            values: numbers, or a pytree of such.

        Raises:
            ValueError: if `values` are not floats, `change` is no function of two or returns no scene, and as `with_model`.
        """
        function("change", change, "scene", "values")
        values = jax.tree.map(functools.partial(real, "values"), values)
        instance("what change returns", scene := change(self, values), Scene, "a scene, by scene.with_model")
        if scene.engine != "mujoco":
            return scene
        flat, unravel = ravel_pytree(values)
        own, before = _arrays_of(self), self.parametrisation
        every = flat if before is None else jnp.concatenate([before.values, flat])
        count = len(every) - len(flat)

        def changed(vector: Float[Array, " parameters"]) -> dict[str, Array]:
            start = self
            if before is not None:  # what came from others comes from them still
                moved = vector[:count] - jax.lax.stop_gradient(before.values)
                start = _with_arrays(self, {k: x + before.rates[k] @ moved for k, x in before.fields.items()})
            found = _arrays_of(change(start, unravel(vector[count:])))
            # The time step decides when events are, for which whole steps are taken.
            return {k: x for k, x in found.items() if x is not own.get(k) and k != "opt.timestep"}

        with warnings.catch_warnings():  # which were given above
            warnings.simplefilter("ignore", SceneWarning)
            rates = jax.jacfwd(changed)(jax.lax.stop_gradient(every))
        fields = {k: x for k, x in _arrays_of(scene).items() if k in rates}
        return dataclasses.replace(scene, parametrisation=Parametrisation(every, fields, rates))  # pyright: ignore[reportCallIssue]

    @property
    def ctrlrange(self) -> Float[Array, "nu 2"]:
        """Least and largest control of each actuator, at which MuJoCo clips it; infinite where there is no limit."""
        limited = np.asarray(self.model.actuator_ctrllimited, bool)[:, None]
        return jnp.where(limited, self.model.actuator_ctrlrange, jnp.array([-jnp.inf, jnp.inf]))

    def warnings(self) -> list[str]:
        """Return warnings of contacts that `refsafe` alters or the time step cannot resolve; none while traced or batched."""
        is_batched = np.ndim(self.model.geom_solref) != 2 or np.ndim(self.model.opt.timestep) != 0
        if is_batched or any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(self.model)):
            return []
        return contact_warnings(self.model, self.pairs)

    def to_mujoco(self) -> mujoco.MjModel:
        """Return the C model with the present values of `model`, including softness; sizes and flags are those of `mj_model`.

        Raises:
            ValueError: if the scene is batched or traced.
        """
        if any(isinstance(value, jax.core.Tracer) for value in _arrays_of(self).values()):
            raise ValueError("to_mujoco needs known values, got a traced scene")
        return with_numbers(self.mj_model, _changed(self))

    def __repr__(self) -> str:
        # All its arrays would fill pages of messages.
        return f"Scene({self.name!r}, nq={self.mj_model.nq}, nu={self.mj_model.nu}, pairs={len(self.pairs)})"

    def __hash__(self) -> int:
        raise TypeError("a Scene is a pytree of arrays: make it an ordinary argument of jax.jit, not a static one")

    def summary(self) -> str:
        """Describe the scene in text for a terminal 120 characters wide: sizes, options, contacts, conversions, omissions.

        Raises:
            ValueError: if the scene is batched or traced.
        """
        solref = self.model.geom_solref
        if isinstance(solref, jax.core.Tracer) or np.ndim(solref) != 2:
            raise ValueError("summary needs one scene with known values, got a batched or traced one")
        differs = " (moves differently from C MuJoCo)"
        converted = [(c.what, f"{c.given} → {c.used}", c.reason + differs * (not c.exact)) for c in self.conversions]
        unlike = () if self.unsupported else refusal_messages(self.mj_model, [UNLIKE, UNDECIDED, PARALLEL])
        sections = [
            _heading(self),
            f"Stepped by {OF_FILES[self.engine]}: {self.unsupported}" if self.unsupported else "",
            _contacts(self),
            _table("Converted", converted),
            _table("Left out", [(o.what, o.reason) for o in self.omissions]),
            _table("Left out by rollouts", list(_left_out(self))),
            _table("Unlike C MuJoCo", [(text,) for text in unlike]),
            _table("Warnings", [(text,) for text in self.warnings()]),
        ]
        return "\n\n".join(section for section in sections if section)


def _warn(scene: Scene, message: str) -> None:
    """Warn the caller of a scene's method; Equinox wraps methods, so this is one stack level further up."""
    warnings.warn(f"{scene.name}: {message}", SceneWarning, stacklevel=4)


def _check_numbers(name: str, numbers: np.ndarray) -> None:
    """Refuse numbers of a field that no scene can have."""
    least, most = numbers.min(initial=np.inf), numbers.max(initial=0)
    if np.isnan(least) or (name in _NOT_NEGATIVE and most == np.inf):
        raise ValueError(f"{name} must hold numbers, got {'NaN' if np.isnan(least) else 'infinity'}")
    if (name in _NOT_NEGATIVE and least < 0) or (name in _POSITIVE and least == 0):
        raise ValueError(f"{name} must {'be positive' if name in _POSITIVE else 'not be negative'}, got {least:g}")
    if name.endswith(_ORDERED) and (crossed := numbers[..., 0] > numbers[..., 1]).any():
        raise ValueError(f"{name} must have its lower ends first, got {numbers[crossed][0].tolist()}")
    if name.endswith(_DIRECTIONS) and not np.linalg.norm(numbers, axis=-1).all():
        raise ValueError(f"{name} must have directions, got zeros")
    if name == "body_inertia":
        largest = numbers.max(axis=-1)
        if (is_none := 2 * largest > (1 + _ROUNDING) * numbers.sum(axis=-1)).any():
            told = "have no moment above the sum of the two others, which no body has"
            raise ValueError(f"{name} must {told}, got {numbers[is_none][0].tolist()}")


def _of_length_one(quaternions: Float[Array, "*rows 4"]) -> Float[Array, "*rows 4"]:
    """Return quaternions of length one, with the derivative of that; those of length one to rounding keep their numbers."""
    length = jnp.linalg.norm(quaternions, axis=-1, keepdims=True)
    unit = quaternions / jnp.where(length > 0, length, 1.0)
    is_one = jnp.abs(length - 1) < 8 * jnp.finfo(length.dtype).eps
    value = jnp.where(is_one, quaternions, unit)
    return unit + jax.lax.stop_gradient(value - unit)


def _without_mass(model: mujoco.MjModel, mass: np.ndarray) -> str:
    """Return the first body with joints that has no mass, nor has any that it carries, though the file's has; or nothing."""
    carried = mass.astype(float)
    for body in range(model.nbody - 1, 0, -1):
        carried[model.body_parentid[body]] += carried[body]
    empty = np.flatnonzero((model.body_jntnum > 0) & (carried == 0) & (model.body_subtreemass > 0))
    return (model.body(empty[0]).name or f"body {empty[0]}") if empty.size else ""


def numbers_of(model: mjx.Model) -> dict[str, Array]:
    """Return the floating-point arrays of a model by name, with options as `opt.timestep`."""
    parts = (("", model), ("opt.", model.opt))
    every = {prefix + f.name: getattr(part, f.name, None) for prefix, part in parts for f in part.fields()}
    return {k: v for k, v in every.items() if isinstance(v, jax.Array) and jnp.issubdtype(v.dtype, jnp.floating)}


def check_engine(engine: EngineName | None, mj_model: mujoco.MjModel) -> None:
    """Refuse MuJoCo Warp where NVIDIA Warp is missing, or what it does not step."""
    if engine != "warp":
        return
    if importlib.util.find_spec("warp") is None:
        raise SceneError("engine='warp' needs NVIDIA Warp: pip install 'mjxgrad[warp]'")
    if mj_model.nhistory:  # a rollout does not carry them from step to step
        raise SceneError("engine='warp' carries no delays of actuators or sensors: take engine='mujoco'")
    import warp  # pyright: ignore[reportMissingImports]
    from mujoco.mjx.third_party import mujoco_warp

    warp.config.log_level = max(warp.config.log_level, logging.WARNING)  # a library must not print
    try:
        with warp.ScopedDevice("cpu"):
            mujoco_warp.put_model(mj_model)
    except (NotImplementedError, RuntimeError, ValueError) as error:
        raise SceneError(f"engine='warp' cannot step it: {error}; take engine='mujoco'") from error


def takes_warp(mj_model: mujoco.MjModel) -> bool:
    """Return whether MuJoCo Warp is there, and steps a model."""
    try:
        check_engine("warp", mj_model)
    except SceneError:
        return False
    return True


def _changed(scene: "Scene") -> dict[str, Array]:
    """Return the numbers of a scene's model that its C model does not have, or that are not known yet."""

    def is_changed(name: str, value: Array) -> bool:
        holder = scene.mj_model.opt if name.startswith("opt.") else scene.mj_model
        given = np.asarray(getattr(holder, name.removeprefix("opt."), value))
        return not is_known(value) or not np.array_equal(np.ravel(value), np.ravel(given).astype(value.dtype))

    return {name: value for name, value in numbers_of(scene.model).items() if is_changed(name, value)} | scene.more


def changed_numbers(scene: "Scene") -> dict[str, Array]:
    """Return the same, those that come from parameters by these."""
    found = _changed(scene)
    if (by := scene.parametrisation) is None:
        return found
    # Those that were replaced since, or came through another transformation of JAX, have derivatives of their own.
    own = [name for name, value in by.fields.items() if found.get(name) is value]
    if not own:
        return found
    rates = {f"{PARAMETERS}:{name}": jax.lax.stop_gradient(by.rates[name]) for name in own}
    return found | {k: jax.lax.stop_gradient(found[k]) for k in own} | {PARAMETERS: by.values} | rates


def _arrays_of(scene: "Scene") -> dict[str, Array]:
    return numbers_of(scene.model) | scene.more


def _with_arrays(scene: "Scene", arrays: Mapping[str, Array]) -> "Scene":
    """Return a scene with other arrays in place of its own, by name, as they are."""
    more = {name: arrays[name] for name in scene.more if name in arrays}
    plain = {name: x for name, x in arrays.items() if name not in more and "." not in name}
    options = {name: x for name, x in arrays.items() if name not in more and "." in name}
    model = scene.model.replace(**plain).tree_replace(options)  # pyright: ignore[reportArgumentType]
    return dataclasses.replace(scene, model=model, more=scene.more | more)


def _native(model: mujoco.MjModel) -> dict[str, np.ndarray | float]:
    """Return the numbers of a C model by MuJoCo's names, its options among them."""
    every = {name: getattr(part, name) for part in (model, model.opt) for name in dir(part) if not name.startswith("_")}
    is_array = lambda value: isinstance(value, np.ndarray) and value.size and value.dtype == np.float64  # noqa: E731
    return {name: value for name, value in every.items() if isinstance(value, float) or is_array(value)}


_NEWTON = mujoco.mjtSolver.mjSOL_NEWTON


def _options(scene: Scene) -> Any:
    """Return the options that decide how a scene is stepped; where MJX cannot, its model has only places and numbers."""
    return scene.model.opt if scene.engine == "mjx" else scene.mj_model.opt


def _heading(scene: Scene) -> str:
    model, opt = scene.mj_model, scene.model.opt
    sizes = (
        (model.nbody - 1, "body", "bodies"),
        (model.nv, "degree of freedom", "degrees of freedom"),
        (model.ngeom, "geom", "geoms"),
        (model.nu, "control", "controls"),
        (model.na, "activation", "activations"),
        (model.nmocap, "mocap body", "mocap bodies"),
        (model.neq, "equality", "equalities"),
        (model.ntendon, "tendon", "tendons"),
        (int(model.jnt_limited.sum()), "joint limit", "joint limits"),
        (model.nsensor, "sensor", "sensors"),
    )
    counted = [f"{n} {one if n == 1 else many}" for n, one, many in sizes if n]
    kept = _options(scene)
    integrator = mujoco.mjtIntegrator(kept.integrator).name.removeprefix("mjINT_")
    cone = mujoco.mjtCone(kept.cone).name.removeprefix("mjCONE_").lower()
    # MJX's own step is by Newton's method alone.
    solver = mujoco.mjtSolver(kept.solver if scene.engine != "mjx" else _NEWTON).name.removeprefix("mjSOL_")
    gravity = np.linalg.norm(np.asarray(opt.gravity))
    options = (
        f"time step {1e3 * float(opt.timestep):g} ms",
        integrator if integrator == "RK4" else integrator.capitalize(),
        f"{cone} cones" + (f", impratio {float(opt.impratio):g}" if opt.impratio != 1 else ""),
        f"{solver.replace('NEWTON', 'Newton')} to {format_number(float(opt.tolerance))} in {kept.iterations} iterations",
        f"gravity {gravity:.3g} m/s²",
        str(scene.data.qpos.dtype),
    )
    return "\n".join([scene.name, "  " + ", ".join(counted), "  " + ", ".join(options)])


def _contacts(scene: Scene) -> str:
    if not scene.pairs:
        return ""
    columns = list(_columns(scene))
    groups: dict[tuple[str, ...], list] = {}
    for pair, cells in zip(scene.pairs, zip(*(cells for _, _, cells in columns), strict=True), strict=True):
        groups.setdefault(cells, []).append(pair)
    rows = [(name_pairs(pairs), *cells) for cells, pairs in groups.items()]
    count = len(scene.pairs)
    title = f"Contact: {'at least ' * (count == MOST_PAIRS)}{count} pair{'s' * (count > 1)} of geoms can touch"
    if not scene.unsupported:
        slots, every = scene.data._impl.ncon, sum(map(len, candidates(scene.model).values()))
        title += f"; room for {slots} contacts of {every}" if slots < every else f", at {every} points"
    is_euler = _options(scene).integrator != mujoco.mjtIntegrator.mjINT_RK4
    legend = "effective k and b = 2ζ√k, per mass of the contact"
    legend += "; stable while h²k + 2hb < 4" if is_euler else ""
    if len(rows) < count:
        legend += "\n  all of them: scene.pairs"
    heads = [("pair", *(name for name, _, _ in columns)), ("", *(unit for _, unit, _ in columns))]
    return _table(title, heads + rows, is_numeric=True) + f"\n  {legend}"


def _left_out(scene: Scene) -> Iterator[tuple[str, str]]:
    """Yield what a rollout neither computes nor keeps, whatever was loaded, and why."""
    model = scene.mj_model
    if scene.engine == "mujoco":
        # As `engines.inverse.has_inverse`, which knows of scenes.
        is_staged = model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
        if not (is_staged or model.opt.noslip_iterations or model.nhistory or model.nplugin):
            yield "kinematics, collisions", "derivatives by velocities, accelerations and controls do not need them"
            yield "geoms that do not touch", "differences by positions do not bring them together"
            yield "the solver", "derivatives are those of the solution that a step has found"
        yield "numbers of the model", "a call passes those alone that differ from the file's"
        return
    size, every = model.nq + 2 * model.nv + model.na + 1, sum(np.size(x) for x in jax.tree.leaves(scene.data))
    yield "data between steps", f"a rollout carries {size} of {every} numbers; observe= keeps more"
    yield "values within steps", "a gradient computes them anew; checkpoint=False keeps them"
    yield "numbers of the model", "the compiler knows them, unless the scene is an argument of jax.jit"
    kinds = ((model.nsensor, "sensors"), (model.ncam, "cameras"), (model.nlight, "lights"))
    if unread := [name for count, name in kinds if count]:
        yield ", ".join(unread), "they move nothing; computed only where observe= reads them"
    if scene.data._impl.nefc and not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_WARMSTART:
        yield "unconstrained acceleration", "a solve starts at the last acceleration alone"
    geoms = np.array([(pair.geom1, pair.geom2) for pair in scene.pairs], int).reshape(-1, 2)
    moves = tree.moving_dofs(scene.model)[model.geom_bodyid[geoms]]
    zeros = int((moves[:, 0] == moves[:, 1]).sum())
    if zeros and scene.data._impl.ncon == sum(map(len, candidates(scene.model).values())):
        yield "columns of contacts", f"{zeros} of {len(geoms) * model.nv}: these joints do not move the geoms apart"


def _columns(scene: Scene) -> Iterator[tuple[str, str, list[str]]]:
    parameters = scene.contact_parameters()
    yield "condim", "", [str(pair.condim) for pair in scene.pairs]
    yield "solref", "", [" ".join(format_number(x) for x in row) for row in np.asarray(parameters.solref).tolist()]
    yield "k", "1/s²", _numbers(parameters.stiffness)
    yield "b", "1/s", _numbers(parameters.damping)
    yield "ζ", "", _numbers(parameters.damping_ratio)
    yield "impedance", "", [format_range(row) for row in np.asarray(parameters.impedance).tolist()]
    yield "width", "mm", _numbers(1e3 * parameters.width)
    yield "h²k+2hb", "", _numbers(parameters.stability)
    frictions = np.asarray(parameters.friction).tolist()
    yield "friction", "", [_friction(pair.condim, row) for pair, row in zip(scene.pairs, frictions, strict=True)]
    yield "margin", "mm", _numbers(1e3 * parameters.margin)


def _numbers(values) -> list[str]:
    return [format_number(x) for x in np.asarray(values).tolist()]


def _friction(condim: int, friction: Sequence[float]) -> str:
    """Return the sliding, torsional and rolling coefficients that the contact has."""
    kinds = {1: [], 3: [friction[:2]], 4: [friction[:2], friction[2:3]], 6: [friction[:2], friction[2:3], friction[3:]]}
    cells = [x for kind in kinds[condim] for x in dict.fromkeys(map(format_number, kind))]  # equal ones once
    return " ".join(cells) or "none"


def _table(title: str, rows: Sequence[tuple[str, ...]], *, is_numeric: bool = False) -> str:
    """Return a title and aligned columns, the first left-aligned; nothing without rows."""
    if not rows:
        return ""
    # Only sentences wrap: a broken row of numbers is unreadable.
    width, align = (10**6, str.rjust) if is_numeric else (_WIDTH, str.ljust)
    wrap = textwrap.TextWrapper(width, initial_indent="  ", subsequent_indent="      ").fill
    return "\n".join([title, *map(wrap, aligned(rows, align))])


def sensor(model: mjx.Model, data: mjx.Data, name: str) -> Float[Array, " dim"]:
    """Return the reading of a sensor after `forward`, a step or a rollout, in MuJoCo's units for this sensor.

    Raises:
        ValueError: if there is no such sensor, or MJX cannot compute it.
    """
    index = index_of(model, mujoco.mjtObj.mjOBJ_SENSOR, name)
    if model.sensor_needstage[index] == mujoco.mjtStage.mjSTAGE_NONE:
        raise ValueError(f"sensor {name!r} would read 0: MJX cannot compute it, as the scene's summary says")
    start = int(model.sensor_adr[index])
    return data.sensordata[start : start + int(model.sensor_dim[index])]


def site_position(model: mjx.Model, data: mjx.Data, name: str) -> Float[Array, "3"]:
    """Return the position of a site in world coordinates (m), after `forward`, a step or a rollout.

    Raises:
        ValueError: if there is no such site.
    """
    return data.site_xpos[index_of(model, mujoco.mjtObj.mjOBJ_SITE, name)]
