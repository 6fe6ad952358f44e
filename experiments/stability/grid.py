"""The points that are looked at: planes through the grid, two parameters each, and a Latin hypercube over all of them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from experiments.stability.scenes import DEFAULTS, StabilityScene

Axis = Callable[[Float[np.ndarray, " n"]], Float[np.ndarray, " n"]]
"""From places in [0, 1] to values."""

# In the planes of a single bounce the impedance is constant, for a restitution in closed form.
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
        x, y = np.meshgrid(AXES[across](places), AXES[up](places))
        blocks.append(_block(x.size, others | {across: x.ravel(), up: y.ravel()}))
    names = _RANDOM[scene.family]
    # A plane alone decides whether the format is direct; here every other point is.
    rng = np.random.default_rng(seed)
    strata = rng.permuted(np.tile(np.arange(num_random), (len(names), 1)), axis=1).T
    sample = (strata + rng.random(strata.shape)) / num_random
    drawn = {name: AXES[name](sample[:, i]) for i, name in enumerate(names)}
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


AXES: dict[str, Axis] = {
    "timestep": _powers(1e-4, 5e-2),
    "time_constant": _powers(1e-5, 1.0),
    "damping_ratio": _powers(1e-2, 10.0),
    "stiffness": _powers(1.0, 1e8),
    "impedance_first": _impedance,
    "impedance_last": _impedance,
    "width": _zero_and_powers(1e-6, 0.1),
    "mass_ratio": _powers(1e-6, 1e6),
    "speed": _powers(1e-2, 100.0),
    "friction": _zero_and_powers(1e-3, 10.0),
    "margin": _zero_and_powers(1e-6, 0.02),
    "depth": _depth,
}
