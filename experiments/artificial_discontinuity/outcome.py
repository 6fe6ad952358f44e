"""The numbers of an experiment on artificial discontinuities."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from experiments.artificial_discontinuity.settings import Settings
from mjxgrad.diagnostics import Jumps

# Which force jumps: under the shape's own contact, which begins with a jump of force but for lattices; with an impedance that
# rises from zero; under the shape's own contact, smoothed; and C MuJoCo's.
PLAIN, GENTLE, SMOOTHED, C = "plain", "gentle", "smoothed", "C MuJoCo"
WAYS = ("first order, discrete", "first order, event", "zeroth order")


@dataclass(frozen=True)
class Static:
    """Jumps of the force on a body held along a path, by `PLAIN`, `GENTLE`, `SMOOTHED` and `C`; torque is over half an edge (N).

    A lattice's own contact is gentle, and it is not smoothed. Contacts are different points on the grid, as MJX finds them, and
    copies those beside them in the same places.
    """

    shape: str
    path: str
    num_rows: int
    is_lattice: bool
    jumps: dict[str, Jumps]
    contacts: Int[np.ndarray, " points"]
    copies: Int[np.ndarray, " points"]

    def worst(self, force: str) -> float:
        return worst(self.jumps[force])


@dataclass(frozen=True)
class Judged:
    """A jump of the box's force, over that force, beside the gradient of the overlap volume, the reference, over itself.

    Geometric is what is there when contact begins gently, too. Changes are over a penetration depth to each side.
    """

    path: str
    place: float
    relative: float
    is_geometric: bool
    reference_jump: float
    reference_change: float
    contacts: tuple[int, int]


@dataclass(frozen=True)
class Slopes:
    """Estimates of the slope of a short push under noise on the start, one body on one path, in the order of `WAYS`.

    The reference is the slope of the mean outcome, by stratified samples, with its standard error over repeats. The jump is what
    the outcome jumps by in the middle of the noise, if it does: all jumps, each times the noise's density.
    """

    shape: str
    path: str
    place: float
    estimates: Float[np.ndarray, " ways"]
    errors: Float[np.ndarray, " ways"]
    reference: float
    reference_error: float
    jump: float
    starts: Float[np.ndarray, " samples"]
    outcomes: Float[np.ndarray, " samples"]

    @property
    def bias(self) -> Float[np.ndarray, " ways"]:
        return self.estimates - self.reference

    @property
    def deviation(self) -> Float[np.ndarray, " ways"]:
        """Of the estimates from the reference, in standard errors of both."""
        both = np.hypot(self.errors, self.reference_error)
        return np.abs(self.bias) / np.where(both > 0, both, 1.0)


@dataclass(frozen=True)
class Mating:
    """A peg and a hole: force on the held peg, and depth (m) of the dropped one, against its offset; slopes across the edge."""

    label: str
    force: Jumps
    depth: Jumps
    slopes: Slopes


@dataclass(frozen=True)
class Outcome:
    """Every shape along every path, lattices last; the reference is on the box's grid, friction against the sliding speed."""

    settings: Settings
    statics: list[Static]
    judged: list[Judged]
    reference: dict[str, Float[np.ndarray, "points 3"]]
    slopes: list[Slopes]
    matings: list[Mating]
    friction: Jumps

    @property
    def by_shape(self) -> dict[str, list[Static]]:
        """Give each shape's measurements by its label, in the order of the paths."""
        labels = dict.fromkeys(one.shape for one in self.statics)
        return {label: [one for one in self.statics if one.shape == label] for label in labels}

    def rows(self) -> list[dict[str, Any]]:
        return [
            {
                "shape": one.shape,
                "path": one.path,
                "rows": one.num_rows,
                "num_jumps": len(one.jumps[PLAIN].places),
                "largest_jump": largest(one.jumps[PLAIN]),
                "largest_jump_over_force": one.worst(PLAIN),
                "gentle_jump_over_force": one.worst(GENTLE),
                "place_of_largest": at_largest(one.jumps[PLAIN], np.nan),
                "share_of_variation": one.jumps[PLAIN].share,
                "smoothed_jump_over_force": np.nan if one.is_lattice else one.worst(SMOOTHED),
                "c_mujoco_jump_over_force": one.worst(C),
                "c_mujoco_num_jumps": len(one.jumps[C].places),
                "most_contacts": int(one.contacts.max()),
                "most_copies": int(one.copies.max()),
            }
            for one in self.statics
        ]


def worst(jumps: Jumps) -> float:
    """Give the largest jump over the largest value on the path; zero without any."""
    return largest(jumps) / jumps.scale if jumps.scale else 0.0


def largest(jumps: Jumps) -> float:
    """Give the largest jump in its own units; zero without any."""
    return float(jumps.sizes.max(initial=0.0))


def at_largest(jumps: Jumps, otherwise: float) -> float:
    """Give where the largest jump is."""
    return float(jumps.places[jumps.largest]) if len(jumps.places) else otherwise
