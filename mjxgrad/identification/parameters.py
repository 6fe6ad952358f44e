"""Parameters to identify: named numbers between bounds, and the model fields that each of them changes."""

import dataclasses
import difflib
import itertools
import math
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import scipy.spatial
from jax.scipy.spatial.transform import Rotation
from jaxtyping import Array, ArrayLike, Bool, Float

from mjxgrad._arrays import function, instance, real, traceable
from mjxgrad._mjx import mjx
from mjxgrad._text import name_pairs
from mjxgrad.contact import Softness
from mjxgrad.contact.parameters import ContactParameters, contact_parameters, deciding_geoms
from mjxgrad.engines.state import check_scene
from mjxgrad.scene import Scene, SceneWarning
from mjxgrad.stepping.rows import index_of

Write = Callable[[mjx.Model, Array], dict[str, Array]]
"""Function from a model and the parameter's value to the changed fields of the model."""
Bounds = tuple[float, float] | None
_Object = mujoco.mjtObj
_OBJECTS = {
    "body": _Object.mjOBJ_BODY, "jnt": _Object.mjOBJ_JOINT, "dof": _Object.mjOBJ_JOINT, "geom": _Object.mjOBJ_GEOM,
    "site": _Object.mjOBJ_SITE, "actuator": _Object.mjOBJ_ACTUATOR, "tendon": _Object.mjOBJ_TENDON,
}  # fmt: skip
_POSITIVE = ("dof_damping", "dof_armature", "dof_frictionloss", "body_mass", "geom_size", "jnt_stiffness")
_UNITS = {  # of slides, and of hinges
    "dof_damping": ("N s/m", "N m s/rad"), "dof_armature": ("kg", "kg m²"), "dof_frictionloss": ("N", "N m"),
    "jnt_stiffness": ("N/m", "N m/rad"),
}  # fmt: skip
_FACTOR = 10.0  # positive numbers are bounded by a tenth and ten times the model's value
_AT_BOUND = 1e-6  # share of the range
_NEAR = 1e-3  # of a number's scale, by which it is changed to see what follows
# The bounds of `mujoco.sysid` for inertia: the mass by a factor of 10, stretches by 2, shears by 0.5, the centre by 0.5 m.
_REACH = np.array([np.log(10) / 2, *[np.log(2) / 2] * 3, *[0.5] * 3, *[0.5] * 3])


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A number, or an array of numbers, to identify.

    Attributes:
        nominal: the value at which the search begins, in the parameter's unit.
        lower: least value; minus infinity for none.
        upper: greatest value; infinity for none.
        write: function from a model and a value to the changed fields, `{"dof_damping": ...}`. Derived fields follow, as in
            `scene.with_model`. None for a parameter that only `delay` of `identify` reads.
        unit: the unit in reports.
    """

    nominal: Any
    lower: Any = -np.inf
    upper: Any = np.inf
    write: Write | None = None
    unit: str = ""

    def __post_init__(self):
        function("write", self.write, "model", "value")
        nominal = np.asarray(real("nominal", self.nominal), float)
        for name in ("nominal", "lower", "upper"):
            value = np.asarray(real(name, getattr(self, name)), float)
            if value.ndim and value.shape != nominal.shape:
                raise ValueError(f"{name} must be one number or of shape {nominal.shape}, got shape {value.shape}")
            object.__setattr__(self, name, np.broadcast_to(value, nominal.shape))
        if not np.isfinite(self.nominal).all():
            raise ValueError(f"nominal must be finite, got {self.nominal.tolist()}")
        if not ((self.lower < self.upper) & (self.lower <= self.nominal) & (self.nominal <= self.upper)).all():
            given = f"{self.lower.tolist()}, {self.nominal.tolist()}, {self.upper.tolist()}"
            raise ValueError(f"lower, nominal and upper must increase, nominal within them, got {given}")

    def __repr__(self) -> str:
        shown = (("nominal", self.nominal), ("lower", self.lower), ("upper", self.upper))
        text = lambda x: np.array2string(x, formatter={"float_kind": "{:.4g}".format}, max_line_width=300)  # noqa: E731
        numbers = [f"{name}={text(value)}" for name, value in shown]
        return f"Parameter({', '.join(numbers)}, unit={self.unit!r})"


@dataclasses.dataclass(frozen=True)
class Coordinates:
    """All parameters as one vector, and the coordinates of the search, which begins at zero.

    A coordinate is the logarithm of a number whose bounds have one sign, relative to the nominal one; otherwise the distance
    from that over the range, else over the distance to the only bound, else over its size. There is one of `names` per number,
    `mass` or `gains[1]`, and one of `shapes` per parameter, with its name.
    """

    nominal: Float[np.ndarray, " dim"]
    lower: Float[np.ndarray, " dim"]
    upper: Float[np.ndarray, " dim"]
    names: tuple[str, ...]
    shapes: tuple[tuple[str, tuple[int, ...]], ...]

    @classmethod
    def of(cls, parameters: Mapping[str, Parameter]) -> "Coordinates":
        """Return the coordinates of named parameters, at least one."""
        if not parameters or not all(isinstance(name, str) for name in parameters):
            raise ValueError(f"parameters must name at least one parameter, by text, got {list(parameters) or 'none'}")
        joined = lambda part: np.concatenate([getattr(p, part).ravel() for p in parameters.values()])  # noqa: E731
        names = [
            name + "".join(f"[{i}]" for i in place if p.nominal.size > 1)
            for name, p in parameters.items()
            for place in np.ndindex(p.nominal.shape)
        ]
        shapes = tuple((name, p.nominal.shape) for name, p in parameters.items())
        return cls(joined("nominal"), joined("lower"), joined("upper"), tuple(names), shapes)

    def unravel(self, vector: Float[ArrayLike, " dim"]) -> dict[str, Any]:
        """Return the parameters by name."""
        sizes = [math.prod(shape) for _, shape in self.shapes]
        parts = zip(self.shapes, sizes, itertools.accumulate(sizes), strict=True)
        return {name: vector[end - size : end].reshape(shape) for (name, shape), size, end in parts}  # pyright: ignore[reportIndexIssue]

    @property
    def _is_logarithm(self) -> np.ndarray:
        return (self.lower * self.upper > 0) & np.isfinite(self.lower) & np.isfinite(self.upper)

    @property
    def scale(self) -> Float[np.ndarray, " dim"]:
        """The scale of each number: its range, else the distance to its only bound, else its size."""
        above, below, size = self.nominal - self.lower, self.upper - self.nominal, np.abs(self.nominal)
        reach = np.where(np.isfinite(above), above, np.where(np.isfinite(below), below, size))
        width = np.where(np.isfinite(self.upper - self.lower), self.upper - self.lower, reach)
        return np.where(width > 0, width, 1.0)

    def values(self, point: Float[np.ndarray, "*points dim"]) -> Float[np.ndarray, "*points dim"]:
        """Return the numbers at a point of the search; points beyond a bound are clipped."""
        with np.errstate(over="ignore"):
            grown = self.nominal * np.exp(np.where(self._is_logarithm, point, 0.0))
        return np.clip(np.where(self._is_logarithm, grown, self.nominal + self.scale * point), self.lower, self.upper)

    def rates(self, values: Float[np.ndarray, " dim"]) -> Float[np.ndarray, " dim"]:
        """Return the derivative of each number by its coordinate."""
        return np.where(self._is_logarithm, values, self.scale)

    def box(self) -> tuple[Float[np.ndarray, " dim"], Float[np.ndarray, " dim"]]:
        """Return the bounds of the coordinates."""
        safe = np.where(self._is_logarithm, self.nominal, 1.0)
        ends = []
        for bound in (self.lower, self.upper):
            ratio = np.where(self._is_logarithm, bound, 1.0) / safe
            ends.append(np.where(self._is_logarithm, np.log(ratio), (bound - self.nominal) / self.scale))
        return np.minimum(*ends), np.maximum(*ends)

    def is_at_bound(self, values: Float[np.ndarray, " dim"]) -> Bool[np.ndarray, " dim"]:
        """Return whether each number is at a bound, up to rounding."""
        return np.minimum(values - self.lower, self.upper - values) < _AT_BOUND * self.scale


def write_all(scene: Scene, parameters: Mapping[str, Parameter], values: Mapping[str, Array]) -> Scene:
    """Return the scene after each parameter, in order, has written its value; traceable."""
    model, changed = scene.model, {}
    for name, parameter in parameters.items():
        if parameter.write is not None:
            fields = _written(model, name, parameter, values[name])
            model, changed = model.replace(**fields), changed | fields
    return scene.with_model(**changed) if changed else scene


def check_entries(scene: Scene, parameters: Mapping[str, Parameter]) -> None:
    """Refuse a parameter of whose numbers a later one writes some anew, so that they would not follow it."""
    earlier: dict[str, list[dict[str, Array]]] = {}
    for name, parameter in parameters.items():
        if parameter.write is None:
            continue
        nominal, step = (
            parameter.nominal,
            _NEAR * Coordinates.of({name: parameter}).scale.reshape(parameter.nominal.shape),
        )
        values = nominal, nominal + np.where(nominal + step <= parameter.upper, step, -step)
        first, near = (jnp.asarray(value, scene.data.qpos.dtype) for value in values)
        for other, pair in earlier.items():
            after = [_written(scene.model.replace(**fields), name, parameter, first) for fields in pair]
            for field in after[0].keys() & pair[0].keys():
                is_lost = (pair[0][field] != pair[1][field]) & (after[0][field] == after[1][field])
                if is_lost.any():
                    raise ValueError(f"parameters must be of different numbers, got {field} of {other!r} and {name!r}")
        earlier[name] = [_written(scene.model, name, parameter, value) for value in (first, near)]


def _written(model: mjx.Model, name: str, parameter: Parameter, value: Array) -> dict[str, Array]:
    with traceable(f"write of {name}"):
        fields = parameter.write(model, value)  # pyright: ignore[reportOptionalCall]
    instance(f"what write of {name} returns", fields, dict, 'a dict of fields, such as {"dof_damping": ...}')
    return fields


def _indices(scene: Scene, kind: mujoco.mjtObj, *names: str) -> np.ndarray:
    """Return the numbers of named elements, at least one."""
    check_scene(scene)
    if not names:
        raise ValueError("a parameter must have at least one name, got none")
    return np.array([index_of(scene.model, kind, name) for name in names])


def mass(scene: Scene, *bodies: str, bounds: Bounds = None) -> Parameter:
    """Return the mass of a body, or the common mass of several (kg); inertias scale with it, as with the density.

    The bounds are a tenth and ten times the scene's value by default.

    Raises:
        ValueError: if there is no such body.
    """

    def write(model: mjx.Model, value: Array) -> dict[str, Array]:
        index = np.array([index_of(model, _Object.mjOBJ_BODY, body) for body in bodies])
        factor = (value / model.body_mass[index])[:, None]
        inertia = model.body_inertia.at[index].set(factor * model.body_inertia[index])
        return {"body_mass": model.body_mass.at[index].set(value), "body_inertia": inertia}

    first = _indices(scene, _Object.mjOBJ_BODY, *bodies)[0]
    nominal = float(scene.model.body_mass[first])
    return _positive(nominal, bounds, write, "kg", "mass")


def friction(scene: Scene, *contacts: str, bounds: tuple[float, float] = (0.0, 2.0), **subset: Any) -> Parameter:
    """Return the common sliding friction of the selected contacts; all geoms that determine it receive the value.

    The contacts are named by geoms, or by pairs such as "floor/foot"; or selected by `pairs` or `geoms`, as in `Softness`. They
    are all by default.

    Warns:
        SceneWarning: if the contacts differ in the scene, and become alike.

    Raises:
        ValueError: if a name is unknown or can touch nothing.
    """
    named = Softness(**_selected(contacts, subset))
    present = np.asarray(_touching(scene, named).friction)[:, 0]
    if np.ptp(present) > 0:
        listed = name_pairs(named.selected(scene.model))
        told = f"friction of {listed} is from {present.min():g} to {present.max():g}, and becomes one number"
        warnings.warn(f"{scene.name}: {told}: name the pairs that share one, as table/cup", SceneWarning, stacklevel=2)

    def write(model: mjx.Model, value: Array) -> dict[str, Array]:
        chosen = named.selected(model)
        explicit = np.array([p.explicit for p in chosen if p.explicit >= 0], int)
        geoms = np.array(sorted({g for p in chosen if p.explicit < 0 for g in deciding_geoms(model, p)}), int)
        found = {}
        if explicit.size:
            found["pair_friction"] = model.pair_friction.at[explicit, :2].set(value)
        if geoms.size:
            found["geom_friction"] = model.geom_friction.at[geoms, 0].set(value)
        return found

    return _positive(float(present[0]), bounds, write, "", "friction")


def _selected(contacts: tuple[str, ...], subset: dict[str, Any]) -> dict[str, Any]:
    """Return names of geoms, or of pairs, as arguments of `Softness`."""
    if not contacts:
        return subset
    pairs = tuple(tuple(str(name).split("/")) for name in contacts if "/" in str(name))
    if subset or (pairs and (len(pairs) < len(contacts) or any(len(pair) != 2 for pair in pairs))):
        raise ValueError(f"contacts must be named by geoms, or by pairs geom/geom, got {', '.join(map(str, contacts))}")
    return {"pairs": pairs} if pairs else {"geoms": contacts}


def softness(scene: Scene, part: str, *contacts: str, bounds: Bounds = None, **subset: Any) -> Parameter:
    """Return one part of the softness of the selected contacts; contacts as in `friction`, bounds as in `mass`.

    The parts are "stiffness" (1/s²), "damping_ratio", which determines the restitution, and "width" (m).

    Raises:
        ValueError: if there is no such part, or as `Softness`.
    """
    units = {"stiffness": "1/s²", "damping_ratio": "", "width": "m"}
    if part not in units:
        raise ValueError(f"part must be one of {', '.join(units)}, got {part!r}")
    subset = _selected(contacts, subset)

    def write(model: mjx.Model, value: Array) -> dict[str, Array]:
        after = Softness(**{part: value}, **subset).apply(model)
        fields = ("geom_solref", "geom_solimp", "pair_solref", "pair_solimp")
        return {name: new for name in fields if (new := getattr(after, name)) is not getattr(model, name)}

    present = getattr(_touching(scene, Softness(**subset)), part)
    return _positive(float(present[0]), bounds, write, units[part], part)


def _touching(scene: Scene, named: Softness) -> ContactParameters:
    check_scene(scene)
    if found := named.selected(scene.model):
        return contact_parameters(scene.model, found)
    raise ValueError(f"friction and softness need geoms that can touch, got none in {scene.name}")


def damping(scene: Scene, *joints: str, bounds: Bounds = None) -> Parameter:
    """Return the damping of a joint, or the common damping of several (N s/m or N m s/rad); otherwise as `mass`."""
    return number(scene, "dof_damping", *joints, bounds=bounds)


def armature(scene: Scene, *joints: str, bounds: Bounds = None) -> Parameter:
    """Return the armature of a joint, or the common armature of several (kg or kg m²); otherwise as `mass`."""
    return number(scene, "dof_armature", *joints, bounds=bounds)


def friction_loss(scene: Scene, *joints: str, bounds: Bounds = None) -> Parameter:
    """Return the dry friction of a joint, or the common friction of several (N or N m); otherwise as `mass`."""
    return number(scene, "dof_frictionloss", *joints, bounds=bounds)


def gear(scene: Scene, *actuators: str, bounds: Bounds = None) -> Parameter:
    """Return the first gear number of an actuator, or the common one of several; otherwise as `mass`."""
    return number(scene, "actuator_gear", *actuators, column=0, bounds=bounds)


def number(scene: Scene, field: str, *names: str, column: int | None = None, bounds: Bounds = None) -> Parameter:
    """Return a number of a field of the model, or the common number of several elements; otherwise as `mass`.

    A link of an arm is as long as `number(scene, "body_pos", "forearm", column=2)` says where the next body begins.

    Args:
        scene: the scene with nominal values.
        field: MuJoCo's name, such as "jnt_stiffness"; of joints' velocities "dof_damping".
        names: bodies, joints, geoms, actuators or others, as the field's name begins.
        column: which of an element's numbers; None for a field that has one.
        bounds: least and greatest value; needed where the number is not positive.

    Raises:
        ValueError: if there is no such field, element or column.
    """
    check_scene(scene)
    start = str(field).partition("_")[0]
    if start not in _OBJECTS or not isinstance(value := getattr(scene.model, field, None), jax.Array):
        near = difflib.get_close_matches(str(field), list(vars(scene.model)), 1)
        told = f"got {field!r}" + "".join(f"; did you mean {one}?" for one in near)
        raise ValueError(f"field must be one of the model's that begins with {', '.join(_OBJECTS)}, {told}")
    if value.ndim != 1 + (column is not None) or (column is not None and not 0 <= column < value.shape[1]):
        wanted = f"from 0 to {value.shape[1] - 1}" if value.ndim == 2 else "None, for it has one number each"
        raise ValueError(f"column of {field} must be {wanted}, got {column}")
    index = _indices(scene, _OBJECTS[start], *names)
    if start == "dof":
        index = np.flatnonzero(np.isin(scene.model.dof_jntid, index))
    place: Any = index if column is None else (index, column)

    def write(model: mjx.Model, value: Array) -> dict[str, Array]:
        return {field: getattr(model, field).at[place].set(value)}

    unit = _unit(scene.mj_model, field, index)
    return _positive(float(value[place][0]), bounds, write, unit, field.removeprefix("dof_"), field in _POSITIVE)


def _unit(model: mujoco.MjModel, field: str, index: np.ndarray) -> str:
    """Return the unit of a number of slides or of hinges; of others nothing."""
    if field not in _UNITS:
        return ""
    kinds = set(model.jnt_type[model.dof_jntid[index] if field.startswith("dof") else index].tolist())
    of_slides, of_hinges = _UNITS[field]
    known = {mujoco.mjtJoint.mjJNT_SLIDE.value: of_slides, mujoco.mjtJoint.mjJNT_HINGE.value: of_hinges}
    return known.get(kinds.pop(), "") if len(kinds) == 1 else ""


def gains(scene: Scene, *actuators: str, bounds: tuple[Any, Any] | None = None) -> Parameter:
    """Return the gains of an actuator, or the common ones of several of one kind.

    They are `kp` and `kv` of a position servo, `kv` of a velocity servo, the gain of a motor. Bounds are as in `mass`, each a
    number or one per gain.

    Raises:
        ValueError: if there is no such actuator, it is of another kind, or a gain is zero and no bounds are given.
    """
    indices = _indices(scene, _Object.mjOBJ_ACTUATOR, *actuators).tolist()
    kinds = [_gains(scene, index, name) for index, name in zip(indices, actuators, strict=True)]
    nominal, places = kinds[0]
    for (_, other), name in zip(kinds, actuators, strict=True):
        if other != places:
            raise ValueError(f"gains must be of actuators of one kind, got {actuators[0]} and {name}")

    def write(model: mjx.Model, value: Array) -> dict[str, Array]:
        index = np.array([index_of(model, _Object.mjOBJ_ACTUATOR, name) for name in actuators])
        value = jnp.atleast_1d(value)
        found = {"actuator_gainprm": model.actuator_gainprm.at[index, 0].set(value[0])}
        return found | ({"actuator_biasprm": model.actuator_biasprm.at[index, places].set(-value)} if places else {})

    return _positive(nominal, bounds, write, "", "gains")


def _gains(scene: Scene, index: int, name: str) -> tuple[Float[np.ndarray, "..."], slice | None]:
    """Return the gains of an actuator, and where its bias has them once more."""
    gain, bias = (np.asarray(getattr(scene.model, f"actuator_{part}"))[index] for part in ("gainprm", "biasprm"))
    if scene.mj_model.actuator_biastype[index] != mujoco.mjtBias.mjBIAS_AFFINE:
        return np.asarray(gain[0], float), None
    is_position, is_velocity = gain[0] == -bias[1] != 0, gain[0] == -bias[2] and bias[1] == 0
    if not (is_position or is_velocity):
        raise ValueError(f"gains must be of a position or velocity servo or a motor, got {name} with bias {bias[:3]}")
    places = slice(1, 3) if is_position else slice(2, 3)
    return -bias[places], places


def _positive(
    nominal: Any, bounds: tuple[Any, Any] | None, write: Write, unit: str, name: str, is_positive: bool = True
) -> Parameter:
    nominal = np.asarray(nominal, float)
    if bounds is None:
        if not (nominal > 0).all():
            raise ValueError(f"bounds of {name} must be given where it is not positive, got {nominal.tolist()}")
        bounds = (nominal / _FACTOR, nominal * _FACTOR)
    if np.shape(bounds)[:1] != (2,) or not np.all(np.asarray(bounds[0]) < np.asarray(bounds[1])):
        raise ValueError(f"bounds of {name} must be two numbers that increase, got {bounds}")
    if is_positive and np.any(np.asarray(bounds[0]) < 0):
        raise ValueError(f"bounds of {name} must not be negative, got {bounds[0]}")
    begin = np.clip(nominal, *bounds)  # bounds may be those of a rounded number
    if not np.allclose(begin, nominal, rtol=1e-5, atol=1e-12):
        raise ValueError(f"{name} of the scene must be within its bounds, {bounds}, got {nominal.tolist()}")
    return Parameter(begin, *bounds, write=write, unit=unit)


def inertia(scene: Scene, body: str) -> Parameter:
    r"""Return mass, centre of mass and inertia tensor of a named body as ten unconstrained numbers.

    The mass $m$, first moment $h$ and second moments $\Sigma = \int x x^T \mathrm{d}m$ form the pseudo-inertia. It is positive
    definite for every physically possible body,

    $$J = \begin{pmatrix} \Sigma & h \\ h^T & m \end{pmatrix} = U U^T, \qquad U = e^{\alpha} \begin{pmatrix} e^{d_1} & s_{12} &
    s_{13} & t_1 \\ & e^{d_2} & s_{23} & t_2 \\ & & e^{d_3} & t_3 \\ & & & 1 \end{pmatrix}.$$

    The ten numbers are $(\alpha, d_1, d_2, d_3, s_{12}, s_{23}, s_{13}, t_1, t_2, t_3)$, as in `mujoco.sysid`. The mass is
    $e^{2 \alpha}$, and $t$ the centre of mass.

    Raises:
        ValueError: if there is no such body, a flat body makes a logarithm infinite, or its inertia was compiled as diagonal.

    References:
        Rucker, Wensing. Smooth parameterization of rigid-body inertia. IEEE Robotics and Automation Letters 7(2), 2022.
    """

    def write(model: mjx.Model, value: Array) -> dict[str, Array]:
        index, parts = index_of(model, _Object.mjOBJ_BODY, body), body_fields(pseudo_inertia(value))
        return {name: getattr(model, name).at[index].set(part) for name, part in parts.items()}

    index = _indices(scene, _Object.mjOBJ_BODY, body)[0]
    if scene.mj_model.body_simple[index] and scene.mj_model.body_dofnum[index] > 1:
        told = f"inertia of {body}, which was compiled as diagonal, cannot change"
        raise ValueError(f"{told}: move its centre of mass in the file, as by <inertial pos='1e-6 0 0' .../>")
    names = ("body_mass", "body_ipos", "body_inertia", "body_iquat")
    fields = [np.asarray(getattr(scene.model, name), float)[index] for name in names]
    nominal = logarithms(second_moments(*fields))
    if not np.isfinite(nominal).all():
        raise ValueError(f"inertia needs a body with mass and extent in all directions, got {body!r}")
    return Parameter(nominal, nominal - _REACH, nominal + _REACH, write=write)


def pseudo_inertia(numbers: Float[Array, "10"]) -> Float[Array, "4 4"]:
    """Return the pseudo-inertia of ten numbers (kg, kg m, kg m²)."""
    alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3 = numbers
    rows = [[jnp.exp(d1), s12, s13, t1], [0, jnp.exp(d2), s23, t2], [0, 0, jnp.exp(d3), t3], [0, 0, 0, 1]]
    root = jnp.exp(alpha) * jnp.array(rows)
    return root @ root.T


def logarithms(pseudo: np.ndarray) -> np.ndarray:
    """Return the ten numbers of a pseudo-inertia; NaN where it is not positive definite."""
    try:
        root = np.linalg.cholesky(pseudo[::-1, ::-1])[::-1, ::-1]
    except np.linalg.LinAlgError:
        return np.full(10, np.nan)
    unit = root / root[3, 3]
    shears = (unit[0, 1], unit[1, 2], unit[0, 2])
    return np.array([np.log(root[3, 3]), *np.log(np.diag(unit)[:3]), *shears, *unit[:3, 3]])


def second_moments(mass: float | np.ndarray, centre: np.ndarray, moments: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return the pseudo-inertia from MuJoCo's fields of a body: mass, ipos, inertia and iquat."""
    rotation = scipy.spatial.transform.Rotation.from_quat(axes, scalar_first=True).as_matrix()
    about_centre = rotation @ np.diag(moments.sum() / 2 - moments) @ rotation.T
    offset = np.append(centre, 1.0)
    return mass * np.outer(offset, offset) + np.pad(about_centre, (0, 1))


def body_fields(pseudo: Float[Array, "4 4"]) -> dict[str, Float[Array, "..."]]:
    """Return MuJoCo's fields of the body with this pseudo-inertia.

    For equal principal moments the axes have no derivative, though the tensor has one. The moments are therefore separated by
    a share of √ε, too little to affect the motion.
    """
    mass, centre = pseudo[3, 3], pseudo[:3, 3] / pseudo[3, 3]
    spread = pseudo[:3, :3] - mass * jnp.outer(centre, centre)
    separation = jnp.sqrt(jnp.finfo(spread.dtype).eps) * jnp.trace(spread)
    along, axes = jnp.linalg.eigh(spread + separation * jnp.diag(jnp.arange(3.0)))
    axes = axes * jnp.sign(jnp.linalg.det(axes))
    moments, turn = jnp.sum(along) - along, Rotation.from_matrix(axes).as_quat(scalar_first=True)
    return {"body_mass": mass, "body_ipos": centre, "body_inertia": moments, "body_iquat": turn}
