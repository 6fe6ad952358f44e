"""Bodies of about the same extent, built of different geoms, and one-parameter paths of them over a fixed cube."""

import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

import mjxgrad as mg

HALF = 0.1  # m, of every body and of the cube
_BALL = 0.02  # m, radius of rounded parts: four times the depth
_POINT = 0.001  # m, radius of what stands for a point
# Of MuJoCo's default contact, 1 / (0.02 s)² and 2 / 0.02 s, which the points of a lattice share.
_STIFFNESS, _DAMPING = 2500.0, 100.0
# So little impedance over all points that each is a spring of its own, whatever the others carry; MuJoCo's least is 1e-4.
_LATTICE_IMPEDANCE, _LEAST_IMPEDANCE = 0.05, 1e-4

_CORNERS = HALF * np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
_SCENE = """<mujoco><option gravity="0 0 0" timestep="0.002" tolerance="1e-10"/><default><geom condim="1" mass="0"/></default>
{asset}<worldbody><geom name="cube" type="box" size=".1 .1 .1"/>
<body name="body"><freejoint/><inertial pos="0 0 0" mass="1" diaginertia=".00667 .00667 .00667"/>
{geoms}</body></worldbody></mujoco>"""


@dataclass(frozen=True)
class Shape:
    """A body over the cube, the convex hull of balls whose centres are in its frame (m); all have the same mass and inertia."""

    label: str
    scene: mg.Scene
    hull: Float[np.ndarray, "points 3"]
    radius: float
    is_lattice: bool = False


def shape(name: str | int) -> Shape:
    """Build a body of 0.2 m by its name in the settings; a number stands for a lattice of so many points along an edge.

    A lattice stands for a pressure field: the force is the sum of what its points carry, each in proportion to its depth and
    with its share of the stiffness.
    """
    inner = _CORNERS * (HALF - _BALL) / HALF
    if isinstance(name, int):
        count, points = name**2, _grid(name, _POINT)
        impedance = max(_LATTICE_IMPEDANCE / count, _LEAST_IMPEDANCE)
        contact = (
            f'solref="{-_STIFFNESS / count} {-_DAMPING / count}" solimp="{impedance} {impedance} .001" priority="1"'
        )
        return Shape(f"{name} × {name} points", _balls(points, _POINT, contact), points, _POINT, is_lattice=True)
    if name == "box":
        return Shape("box", _scene('<geom type="box" size=".1 .1 .1"/>'), _CORNERS, 0.0)
    if name == "mesh":
        vertices = " ".join(f"{x:g}" for x in _CORNERS.ravel())
        asset = f'<asset><mesh name="cube" vertex="{vertices}"/></asset>'
        return Shape("box as a mesh", _scene('<geom type="mesh" mesh="cube"/>', asset), _CORNERS, 0.0)
    if name == "edges":
        low = inner[inner[:, 2] < 0][[0, 1, 3, 2]]
        ends = [(*a, *b) for a, b in zip(low, np.roll(low, -1, axis=0), strict=True)]
        geoms = [f'<geom type="capsule" size="{_BALL}" fromto="{" ".join(f"{x:g}" for x in one)}"/>' for one in ends]
        return Shape("4 capsules", _scene("".join(geoms)), inner, _BALL)
    if name == "ball":
        return Shape("one ball", _balls(np.zeros((1, 3)), HALF), np.zeros((1, 3)), HALF)
    label, at = ("8 balls at corners", inner) if name == "balls" else ("4 × 4 balls", _grid(4, _BALL))
    return Shape(label, _balls(at, _BALL), at, _BALL)


def _grid(num_along_edge: int, radius: float) -> Float[np.ndarray, "points 3"]:
    """Return balls in the middles of equal squares of the lower face, flush with it."""
    middles = HALF * (2 * (np.arange(num_along_edge) + 0.5) / num_along_edge - 1)
    return np.array([(x, y, radius - HALF) for x in middles for y in middles])


def _balls(places: np.ndarray, radius: float, contact: str = "") -> mg.Scene:
    return _scene("".join(f'<geom size="{radius}" pos="{x:.10g} {y:.10g} {z:.10g}" {contact}/>' for x, y, z in places))


def _scene(geoms: str, asset: str = "") -> mg.Scene:
    return mg.load_scene(_SCENE.format(geoms=geoms, asset=asset))


# Off the planes of symmetry, where several things would happen at once.
_ASIDE = 0.013  # m
# One corner down: turned about the diagonal's horizontal normal until the diagonal is vertical.
_ON_CORNER = Rotation.align_vectors([[0.0, 0.0, -1.0]], [[-1.0, -1.0, -1.0] / np.sqrt(3.0)])[0]


@dataclass(frozen=True)
class Path:
    """How a body is moved: along x, or turned about an axis at some x, from an orientation at parameter zero (m or rad)."""

    title: str
    interval: tuple[float, float]
    axis: tuple[float, float, float] | None = None
    x: float = 0.0
    start: Rotation = Rotation.identity()  # noqa: RUF009

    @property
    def unit(self) -> str:
        return "rad" if self.axis else "m"

    @property
    def length(self) -> float:
        return self.interval[1] - self.interval[0]

    def poses(
        self, shape: Shape, depth: float, parameters: Float[np.ndarray, " points"]
    ) -> Float[np.ndarray, "points 7"]:
        """Give positions and quaternions; the centre's height is that at which the lowest point is as deep at parameter zero."""
        still = np.zeros_like(parameters)
        turns = np.multiply.outer(parameters if self.axis else still, self.axis or (0.0, 0.0, 1.0))
        reach = shape.radius - self.start.apply(shape.hull)[:, 2].min()
        x = still + self.x if self.axis else parameters
        places = np.stack([x, still + _ASIDE, still + HALF + reach - depth], axis=1)
        return np.concatenate([places, (Rotation.from_rotvec(turns) * self.start).as_quat(scalar_first=True)], axis=1)


PATHS = {
    "slide": Path("slide past the edge", (0.0, 0.21)),
    "askew": Path("slide askew", (0.0, 0.25), start=Rotation.from_euler("z", 0.4)),
    "roll": Path("roll", (-0.12, 0.12), (0.0, 1.0, 0.0), 0.03),
    "yaw": Path("yaw", (0.0, np.pi / 2), (0.0, 0.0, 1.0), 0.05),
    "corner": Path("corner past the edge", (0.0, 0.11), start=_ON_CORNER),
}
