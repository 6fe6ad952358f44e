"""The scenes of an experiment on stability, the points of its grid, and how a point becomes a model and a state."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

RADIUS = 0.05  # m, of every ball, half the side of the box
MASS = 1.0  # kg, of the lightest body
GRAVITY = 9.81  # m/s²
FLIGHT = 2.3  # steps before the first touch: no whole number, so that it falls inside a step
FIELDS = (
    "geom_solref", "geom_solimp", "geom_friction", "geom_margin", "jnt_solref", "jnt_solimp", "jnt_margin",
    "body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "dof_invweight0",
)  # fmt: skip
Point = Mapping[str, float]
State = tuple[Float[np.ndarray, " nq"], Float[np.ndarray, " nv"]]

_HEAD = """
<mujoco model="{name}">
  <compiler angle="radian"/>
  <option gravity="0 0 {gravity}" cone="{cone}" tolerance="1e-12" iterations="100"><flag {flags}/></option>
  <default><geom condim="{condim}" mass="1"/></default>
  <worldbody>
"""
_TAIL = "\n</worldbody></mujoco>"
_PLANE = '<geom name="floor" type="plane" size="1 1 .1" mass="0"/>'
_CONES = ("pyramidal", "elliptic")
_FREE_BODY = (0.7, 0.4, 1.0, 0.0, 0.0, 0.0, 0.0)  # weights of its positions in the outcome
_BALL = f'<geom name="{{0}}" size="{RADIUS}"/>'


@dataclass(frozen=True)
class StabilityScene:
    """A scene with its own program; all that is not static is a point of the grid."""

    name: str  # of the scene
    mjcf: str  # of it
    family: str  # what it shares with scenes that differ in cone or dimension
    start: Callable[[Point], State]  # from a point to positions and velocities
    masses: Callable[[float], list[float]]  # of all bodies but the world, from the mass ratio (kg)
    outcome: tuple[float, ...]  # weights of the positions in the number whose derivative is judged
    # Indices of two positions of which the first stays below the second unless the bodies tunnel.
    crossing: tuple[tuple[int, int], ...] = ()
    spacing: float = 0.0  # of these two where their positions are equal (m)
    depth_unit: float = RADIUS  # what a depth of one is (m, or rad)
    has_refsafe: bool = True  # whether MuJoCo may replace time constants
    has_limits: bool = False  # whether the point's parameters are those of joint limits

    def model(self) -> mujoco.MjModel:
        """Compile it."""
        return mujoco.MjModel.from_xml_string(self.mjcf)

    def configure(self, model: mujoco.MjModel, data: mujoco.MjData, point: Point) -> None:
        """Set the model to a point of the grid, in place, with all that MuJoCo derives from masses."""
        model.opt.timestep = point["timestep"]
        solref = (point["time_constant"], point["damping_ratio"])
        if point["stiffness"] > 0:
            solref = tuple(-x for x in self.effective(point))
        solimp = (point["impedance_first"], point["impedance_last"], point["width"])
        kinds = ((model.jnt_solref, model.jnt_solimp),) if self.has_limits else ()
        for references, impedances in (*kinds, (model.geom_solref, model.geom_solimp)):
            references[:] = solref
            impedances[:, :3] = solimp
        model.geom_friction[:] = point["friction"] * np.array([1.0, 0.1 * RADIUS, 0.01 * RADIUS])
        # Margins of two geoms add.
        model.geom_margin[:], model.body_margin[:] = point["margin"] / 2, point["margin"] / 2
        masses = np.array(self.masses(point["mass_ratio"]))
        model.body_inertia[1:] *= (masses / model.body_mass[1:])[:, None]
        model.body_mass[1:] = masses
        mujoco.mj_setConst(model, data)

    def effective(self, point: Point) -> tuple[float, float]:
        """Give stiffness (1/s²) and damping (1/s) in effect."""
        if point["stiffness"] > 0:
            return point["stiffness"], 2 * point["damping_ratio"] * np.sqrt(point["stiffness"])
        constant = point["time_constant"]
        if self.has_refsafe:
            constant = max(constant, 2 * point["timestep"])
        return (constant * point["damping_ratio"]) ** -2, 2 / constant


def catalogue() -> tuple[StabilityScene, ...]:
    """List all scenes, those of one family one after another."""
    return (*_balls(), *_spheres(), *_pairs(), _stack(), *_boxes(), _chain())


def _mjcf(
    name: str, body: str, *, gravity: float = 0.0, cone: str = "pyramidal", condim: int = 1, flags: str = ""
) -> str:
    flags = f'autoreset="disable" energy="enable" {flags}'
    return _HEAD.format(name=name, gravity=-gravity, cone=cone, condim=condim, flags=flags) + body + _TAIL


def _alone(_: float) -> list[float]:
    return [MASS]


def _graded(count: int) -> Callable[[float], list[float]]:
    """Masses of bodies in a row, each heavier than the one before by the same factor, the lightest of `MASS`."""
    places = np.arange(count) / (count - 1)
    return lambda ratio: list(MASS * ratio**places / (ratio**places).min())


def _above(point: Point) -> float:
    """Distance from touching at the start (m)."""
    if point["depth"] > 0:
        return -point["depth"] * RADIUS
    return point["margin"] + FLIGHT * point["speed"] * point["timestep"]


def _balls() -> list[StabilityScene]:
    body = f"""{_PLANE}<body pos="0 0 {RADIUS}"><joint type="slide" axis="0 0 1"/>{_BALL.format("ball")}</body>"""

    def start(point: Point) -> State:
        return np.array([_above(point)]), np.array([-point["speed"]])

    plain, safe = (_mjcf("ball", body, flags=f'refsafe="{refsafe}"') for refsafe in ("disable", "enable"))
    return [
        StabilityScene("ball", plain, "ball", start, _alone, (1.0,), has_refsafe=False),
        StabilityScene("ball, refsafe", safe, "ball", start, _alone, (1.0,)),
    ]


def _spheres() -> list[StabilityScene]:
    body = f"""{_PLANE}<body pos="0 0 {RADIUS}"><freejoint/>{_BALL.format("ball")}</body>"""

    def start(point: Point) -> State:
        speed = point["speed"]
        qpos = np.array([0.0, 0.0, RADIUS + _above(point), 1.0, 0.0, 0.0, 0.0])
        return qpos, np.array([0.5 * speed, 0.2 * speed, -speed, 0.0, 0.3 * speed / RADIUS, 0.1 * speed / RADIUS])

    def scene(name: str, dim: int, cone: str) -> StabilityScene:
        mjcf = _mjcf("sphere", body, gravity=GRAVITY, cone=cone, condim=dim)
        return StabilityScene(name, mjcf, "sphere", start, _alone, _FREE_BODY)

    others = [scene(f"sphere, condim {dim}, {cone}", dim, cone) for cone in _CONES for dim in (3, 4, 6)]
    return [scene("sphere, condim 1", 1, "pyramidal"), *others]


def _pairs() -> list[StabilityScene]:
    body = f"""
      <body pos="0 0 0"><freejoint/>{_BALL.format("first")}</body>
      <body pos="1 0 0"><freejoint/>{_BALL.format("second")}</body>"""

    def start(point: Point) -> State:
        distance = 2 * RADIUS + _above(point)
        # Off centre by a tenth of the radius, but where the centres are to coincide.
        aside = 0.1 * RADIUS if distance > 0 else 0.0
        first = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
        second = [distance, aside, 0.0, 1.0, 0.0, 0.0, 0.0]
        return np.array(first + second), np.array([point["speed"]] + 11 * [0.0])

    weights = (0.0, 0.3, 0.0) + 4 * (0.0,) + (1.0, 0.4, 0.1) + 4 * (0.0,)

    def masses(ratio: float) -> list[float]:
        return [MASS * max(1.0, 1 / ratio), MASS * max(1.0, ratio)]

    given = ("two balls", start, masses, weights, ((0, 7),))
    return [StabilityScene(f"two balls, {cone}", _mjcf("pair", body, cone=cone, condim=3), *given) for cone in _CONES]


def _stack() -> StabilityScene:
    count = 4
    balls = "".join(
        f'<body pos="0 0 {(2 * i + 1) * RADIUS}"><joint type="slide" axis="0 0 1"/>{_BALL.format(f"ball{i}")}</body>'
        for i in range(count)
    )

    def start(point: Point) -> State:
        above = _above(point)
        # Each ball rests on the one below; only the lowest is apart from the floor, or all are inside each other.
        heights = above * np.arange(1, count + 1) if above < 0 else np.full(count, above)
        return heights, np.full(count, -point["speed"])

    mjcf, weights = _mjcf("stack", _PLANE + balls, gravity=GRAVITY), (0.2, 0.3, 0.5, 1.0)
    crossing = tuple((i, i + 1) for i in range(count - 1))
    masses, spacing = _graded(count), 2 * RADIUS
    return StabilityScene("stack", mjcf, "stack", start, masses, weights, crossing=crossing, spacing=spacing)


def _boxes() -> list[StabilityScene]:
    body = f"""{_PLANE}<body pos="0 0 {RADIUS}"><freejoint/>
      <geom name="box" type="box" size="{RADIUS} {RADIUS} {RADIUS}"/></body>"""

    def start(point: Point) -> State:
        # Leaning by 0.02 rad, so that corners land one after another.
        lean = 0.02
        corner = RADIUS * (np.cos(lean) + np.sin(lean))
        speed = point["speed"]
        qpos = np.array([0.0, 0.0, corner + _above(point), np.cos(lean / 2), 0.0, np.sin(lean / 2), 0.0])
        return qpos, np.array([0.3 * speed, 0.1 * speed, -speed, 0.0, 0.0, 0.0])

    texts = {cone: _mjcf("box", body, gravity=GRAVITY, cone=cone, condim=3) for cone in _CONES}
    return [StabilityScene(f"box, {cone}", text, "box", start, _alone, _FREE_BODY) for cone, text in texts.items()]


def _chain() -> StabilityScene:
    count, length = 3, 0.3
    inner = ""
    for i in reversed(range(count)):
        inner = f"""<body pos="{0 if i == 0 else length} 0 0">
          <joint type="hinge" axis="0 1 0" limited="true" range="-0.5 0.5"/>
          <geom type="capsule" fromto="0 0 0 {length} 0 0" size="0.02" contype="0" conaffinity="0"/>{inner}</body>"""

    def start(point: Point) -> State:
        rate = point["speed"] / length
        last = 0.5 + point["depth"] * 0.1 if point["depth"] > 0 else 0.5 - FLIGHT * rate * point["timestep"]
        return np.array([0.1, 0.1, last]), np.array([0.0, 0.0, rate])

    mjcf = _mjcf("chain", inner, gravity=GRAVITY)
    weights = (0.3, 0.5, 1.0)
    return StabilityScene("chain", mjcf, "chain", start, _graded(count), weights, depth_unit=0.1, has_limits=True)


Axis = Callable[[Float[np.ndarray, " n"]], Float[np.ndarray, " n"]]  # from places in [0, 1] to values

# In the planes of a single bounce the impedance is constant.
CONSTANT = {"impedance_first": 0.9, "impedance_last": 0.9}
PLANES: dict[str, tuple[tuple[str, str, dict[str, float]], ...]] = {
    "ball": (
        ("timestep", "time_constant", CONSTANT),
        ("time_constant", "damping_ratio", CONSTANT),
        ("timestep", "stiffness", CONSTANT),
        ("width", "impedance_first", {}),
        ("timestep", "speed", CONSTANT),
    ),
    "ball, refsafe": (("timestep", "time_constant", CONSTANT),),
    "sphere": (("speed", "friction", {}), ("time_constant", "depth", {})),
    "two balls": (
        ("speed", "mass_ratio", {}),
        ("timestep", "speed", {}),
        ("time_constant", "depth", {}),
        ("width", "margin", {}),
    ),
    "stack": (("time_constant", "mass_ratio", {}), ("timestep", "depth", {})),
    "box": (("time_constant", "depth", {}), ("speed", "friction", {})),
    "chain": (("time_constant", "mass_ratio", {}), ("timestep", "stiffness", {})),
}
"""By scene, or by its family: the parameter across, the one up, and what else differs from the default."""
_CONTACT = (
    "timestep", "time_constant", "damping_ratio", "stiffness", "impedance_first", "impedance_last", "width", "speed"
)  # fmt: skip
_RANDOM = {
    "ball": (*_CONTACT, "margin"),
    "sphere": (*_CONTACT, "margin", "friction", "depth"),
    "two balls": (*_CONTACT, "margin", "friction", "depth", "mass_ratio"),
    "stack": (*_CONTACT, "margin", "depth", "mass_ratio"),
    "box": (*_CONTACT, "margin", "friction", "depth"),
    "chain": (*_CONTACT, "depth", "mass_ratio"),
}


@dataclass(frozen=True)
class Points:
    """Points of the grid of one scene."""

    values: dict[str, Float[np.ndarray, " points"]]  # of every parameter, by name
    family: np.ndarray  # index of the plane that each belongs to, −1 for random ones
    planes: tuple[tuple[str, str], ...]  # names of the two parameters of each plane

    def __len__(self) -> int:
        return len(self.family)

    def __getitem__(self, index: int) -> dict[str, float]:
        return {name: float(value[index]) for name, value in self.values.items()}

    @property
    def flown(self) -> Float[np.ndarray, " points"]:
        """What a body flies in one step (m)."""
        return self.values["speed"] * self.values["timestep"]

    def plane(self, index: int, values: np.ndarray) -> np.ndarray:
        """Arrange what belongs to one plane, of one value per point, as an image, the parameter across along columns."""
        chosen = values[self.family == index]
        return chosen.reshape(round(np.sqrt(len(chosen))), -1)


def points(scene: StabilityScene, resolution: int, num_random: int, seed: int) -> Points:
    """List the points of a scene: plane by plane, the parameter across changing fastest, then the random ones."""
    planes = PLANES.get(scene.name, PLANES[scene.family])
    places = np.linspace(0, 1, resolution)
    blocks = []
    for across, up, others in planes:
        x, y = np.meshgrid(PARAMETERS[across][1](places), PARAMETERS[up][1](places))
        blocks.append(_block(x.size, others | {across: x.ravel(), up: y.ravel()}))
    names = _RANDOM[scene.family]
    # A plane alone decides whether the format is direct; here every other point is.
    rng = np.random.default_rng(seed)
    strata = rng.permuted(np.tile(np.arange(num_random), (len(names), 1)), axis=1).T
    sample = (strata + rng.random(strata.shape)) / num_random
    drawn = {name: PARAMETERS[name][1](sample[:, i]) for i, name in enumerate(names)}
    drawn["stiffness"] = np.where(np.arange(num_random) % 2, drawn["stiffness"], 0.0)
    if "depth" in drawn:
        drawn["depth"] = np.where(np.arange(num_random) % 4 < 3, 0.0, drawn["depth"])
    blocks.append(_block(num_random, drawn))
    family = np.repeat([*range(len(planes)), -1], [len(block["timestep"]) for block in blocks])
    values = {name: np.concatenate([block[name] for block in blocks]) for name in DEFAULTS}
    return Points(values, family, tuple((across, up) for across, up, _ in planes))


def _block(count: int, given: Mapping[str, np.ndarray | float]) -> dict[str, Float[np.ndarray, " n"]]:
    return {name: np.broadcast_to(given.get(name, value), count).astype(float) for name, value in DEFAULTS.items()}


def _powers(low: float, high: float) -> Axis:
    return lambda place: low * (high / low) ** place


def _zero_and_powers(low: float, high: float) -> Axis:
    """The lowest twelfth is zero."""
    share = 1 / 12
    return lambda place: np.where(place <= share, 0.0, low * (high / low) ** ((place - share) / (1 - share)))


def _impedance(place: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    knots = (0.0, 0.3, 0.6, 0.9, 0.99, 0.999, 0.9999)
    return np.interp(place, np.linspace(0, 1, len(knots)), knots)


def _depth(place: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Up to four radii; around two, where two balls have one centre, exactly that."""
    depth = np.maximum(4 * place, 0.1)
    return np.where(np.abs(depth - 2) < 0.3, 2.0, depth)


PARAMETERS: dict[str, tuple[float, Axis, str]] = {
    "timestep": (2e-3, _powers(1e-4, 5e-2), "time step, s"),
    "time_constant": (0.02, _powers(1e-5, 1.0), "time constant, s"),
    "damping_ratio": (1.0, _powers(1e-2, 10.0), "damping ratio"),
    "stiffness": (0.0, _powers(1.0, 1e8), "direct stiffness, 1/s²"),
    "impedance_first": (0.9, _impedance, "impedance at the surface"),
    "impedance_last": (0.95, _impedance, "impedance deep inside"),
    "width": (1e-3, _zero_and_powers(1e-6, 0.1), "width, m"),
    "mass_ratio": (1.0, _powers(1e-6, 1e6), "mass ratio"),
    "speed": (1.0, _powers(1e-2, 100.0), "speed, m/s"),
    "friction": (1.0, _zero_and_powers(1e-3, 10.0), "friction"),
    "depth": (0.0, _depth, "depth at the start, radii"),
    "margin": (0.0, _zero_and_powers(1e-6, 0.02), "margin, m"),
}
"""Default, values and label of each. The defaults are MuJoCo's own contact at its own time step; stiffness, if any, stands for
the direct format."""
DEFAULTS = {name: default for name, (default, _, _) in PARAMETERS.items()}
