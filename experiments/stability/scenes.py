"""The scenes of an experiment on stability, and how a point of its grid becomes a model and a state."""

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
DEFAULTS = {
    "timestep": 2e-3,
    "time_constant": 0.02,
    "damping_ratio": 1.0,
    "stiffness": 0.0,
    "impedance_first": 0.9,
    "impedance_last": 0.95,
    "width": 1e-3,
    "mass_ratio": 1.0,
    "speed": 1.0,
    "friction": 1.0,
    "depth": 0.0,
    "margin": 0.0,
}
"""MuJoCo's own contact at its own time step. Stiffness, if any, stands for the direct format; depth is in radii."""

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
    bounces: bool = False  # whether it is a single bounce, with a restitution in closed form
    has_refsafe: bool = True  # whether MuJoCo may replace time constants
    has_limits: bool = False  # whether the point's parameters are those of joint limits

    def model(self) -> mujoco.MjModel:
        """Compile it."""
        return mujoco.MjModel.from_xml_string(self.mjcf)


def configure(scene: StabilityScene, model: mujoco.MjModel, data: mujoco.MjData, point: Point) -> None:
    """Set a scene's model to a point of the grid, in place, with all that MuJoCo derives from masses."""
    model.opt.timestep = point["timestep"]
    if point["stiffness"] > 0:
        frequency = np.sqrt(point["stiffness"])
        solref = (-point["stiffness"], -2 * point["damping_ratio"] * frequency)
    else:
        solref = (point["time_constant"], point["damping_ratio"])
    solimp = (point["impedance_first"], point["impedance_last"], point["width"])
    kinds = ((model.jnt_solref, model.jnt_solimp),) if scene.has_limits else ()
    for references, impedances in (*kinds, (model.geom_solref, model.geom_solimp)):
        references[:] = solref
        impedances[:, :3] = solimp
    model.geom_friction[:] = point["friction"] * np.array([1.0, 0.1 * RADIUS, 0.01 * RADIUS])
    # Margins of two geoms add.
    model.geom_margin[:] = point["margin"] / 2
    masses = np.array(scene.masses(point["mass_ratio"]))
    model.body_inertia[1:] *= (masses / model.body_mass[1:])[:, None]
    model.body_mass[1:] = masses
    mujoco.mj_setConst(model, data)


def effective(scene: StabilityScene, point: Point) -> tuple[float, float]:
    """Give stiffness (1/s²) and damping (1/s) in effect."""
    if point["stiffness"] > 0:
        return point["stiffness"], 2 * point["damping_ratio"] * np.sqrt(point["stiffness"])
    constant = point["time_constant"]
    if scene.has_refsafe:
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

    found = []
    for name, refsafe in (("ball", "disable"), ("ball, refsafe", "enable")):
        mjcf, has_refsafe = _mjcf("ball", body, flags=f'refsafe="{refsafe}"'), refsafe == "enable"
        found.append(StabilityScene(name, mjcf, "ball", start, _alone, (1.0,), bounces=True, has_refsafe=has_refsafe))
    return found


def _spheres() -> list[StabilityScene]:
    body = f"""{_PLANE}<body pos="0 0 {RADIUS}"><freejoint/>{_BALL.format("ball")}</body>"""

    def start(point: Point) -> State:
        speed = point["speed"]
        qpos = np.array([0.0, 0.0, RADIUS + _above(point), 1.0, 0.0, 0.0, 0.0])
        return qpos, np.array([0.5 * speed, 0.2 * speed, -speed, 0.0, 0.3 * speed / RADIUS, 0.1 * speed / RADIUS])

    variants = [(1, "pyramidal"), *((dim, cone) for cone in _CONES for dim in (3, 4, 6))]
    found = []
    for dim, cone in variants:
        mjcf = _mjcf("sphere", body, gravity=GRAVITY, cone=cone, condim=dim)
        name = f"sphere, condim {dim}" + (f", {cone}" if dim > 1 else "")
        found.append(StabilityScene(name, mjcf, "sphere", start, _alone, _FREE_BODY))
    return found


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

    found = []
    for cone in _CONES:
        mjcf = _mjcf("pair", body, cone=cone, condim=3)
        found.append(
            StabilityScene(f"two balls, {cone}", mjcf, "two balls", start, masses, weights, crossing=((0, 7),))
        )
    return found


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

    found = []
    for cone in _CONES:
        mjcf = _mjcf("box", body, gravity=GRAVITY, cone=cone, condim=3)
        found.append(StabilityScene(f"box, {cone}", mjcf, "box", start, _alone, _FREE_BODY))
    return found


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
