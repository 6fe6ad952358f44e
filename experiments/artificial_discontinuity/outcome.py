"""The numbers of an experiment on artificial discontinuities, and what follows from them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from experiments.artificial_discontinuity.paths import Path
from experiments.artificial_discontinuity.settings import Settings
from mjxgrad.diagnostics import Jumps

WAYS = ("first order, discrete", "first order, event", "zeroth order")
REAL, TURN, ARTIFICIAL = "real", "real change, made sudden", "artificial"
ONSET = "onset of a contact under load"
# Of a jump, what the continuous reference must do nearby for it to be the same change.
_SAME = 0.5


@dataclass(frozen=True)
class Static:
    """Force on a body held along a path: three components (N), and the torque over half an edge (N).

    Jumps are measured over the largest force on the path.

    Attributes:
        shape: label.
        path: key of the path.
        num_rows: constraint rows of the shape.
        is_lattice: whether the shape stands for a pressure field.
        plain: jumps of mjxgrad's force under the shape's own contact, which begins with a jump of force but for lattices.
        gentle: the same with an impedance that rises from zero; None for lattices.
        smoothed: under the shape's own contact with smoothing; None for lattices.
        c_mujoco: jumps of C MuJoCo's force.
        contacts: number of different contact points on the grid, as MJX finds them.
        copies: how many contacts there are beside these, in the same places.
    """

    shape: str
    path: str
    num_rows: int
    is_lattice: bool
    plain: Jumps
    gentle: Jumps | None
    smoothed: Jumps | None
    c_mujoco: Jumps
    contacts: Int[np.ndarray, " points"]
    copies: Int[np.ndarray, " points"]

    @property
    def worst(self) -> float:
        """Largest jump over the largest force on the path; zero without any."""
        return worst(self.plain)

    @property
    def geometric(self) -> float:
        """The same of contact that begins gently: what is left is of the geometry."""
        return worst(self.gentle or self.plain)


@dataclass(frozen=True)
class Judged:
    """A jump of the box's force beside the gradient of the overlap volume.

    Attributes:
        path: key of the path.
        place: of the jump.
        relative: jump over force.
        is_geometric: whether it is there when contact begins gently, too.
        reference_jump: jump of the reference at that place, over itself.
        reference_change: change of the reference from a penetration depth before to one after, over itself.
        from_contacts: number of contacts before.
        to_contacts: number after.
    """

    path: str
    place: float
    relative: float
    is_geometric: bool
    reference_jump: float
    reference_change: float
    from_contacts: int
    to_contacts: int

    @property
    def kind(self) -> str:
        """What the jump is, by what the reference does there."""
        if not self.is_geometric:
            return ONSET
        if self.reference_jump > _SAME * self.relative:
            return REAL
        return TURN if self.reference_change > _SAME * self.relative else ARTIFICIAL


@dataclass(frozen=True)
class Slopes:
    """Estimates of the slope of a short push under noise on the start, one body on one path.

    Attributes:
        shape: label.
        path: key of the path.
        place: mean start.
        estimates: in the order of `WAYS`, from as many rollouts each.
        errors: their standard errors.
        reference: slope of the mean outcome, by stratified samples.
        reference_error: its standard error, over repeats.
        jump: what the outcome jumps by in the middle of the noise, if it does: all jumps, each times the noise's density.
        outcomes: on a grid, with the starts, for figures.
        starts: of these.
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
        """Estimates less the reference."""
        return self.estimates - self.reference

    @property
    def deviation(self) -> Float[np.ndarray, " ways"]:
        """Of the estimates from the reference, in standard errors of both."""
        both = np.hypot(self.errors, self.reference_error)
        return np.abs(self.bias) / np.where(both > 0, both, 1.0)


@dataclass(frozen=True)
class Mating:
    """A peg above a hole, by how contact is told: where it ends against where it starts.

    Attributes:
        label: of the geometry.
        num_rows: constraint rows.
        force: jumps of the force on the peg held half-way in, against its offset.
        depth: jumps of how deep it is in the end (m), against the offset it is dropped at.
        slopes: estimates across the edge of the hole.
    """

    label: str
    num_rows: int
    force: Jumps
    depth: Jumps
    slopes: Slopes


@dataclass(frozen=True)
class Outcome:
    """All that was measured.

    Attributes:
        settings: of the run.
        paths: by key.
        statics: every shape along every path.
        judged: the jumps of the box.
        reference: gradient of the overlap volume on the box's grid, by path.
        slopes: of short pushes.
        matings: a peg and a hole, by geometry.
        friction: jumps of the friction on a sliding ball against its speed, and its steepest slope.
    """

    settings: Settings
    paths: dict[str, Path]
    statics: list[Static]
    judged: list[Judged]
    reference: dict[str, Float[np.ndarray, "points 3"]]
    slopes: list[Slopes]
    matings: list[Mating]
    friction: Jumps

    def of(self, shape: str) -> list[Static]:
        """Give one shape's measurements, in the order of the paths."""
        return [one for one in self.statics if one.shape == shape]

    @property
    def shapes(self) -> list[str]:
        """Give the labels in order, lattices last."""
        return list(dict.fromkeys(one.shape for one in self.statics))

    def rate(self, path: str) -> tuple[float, float]:
        """Give the power of the number of points along an edge by which a lattice's largest jump falls, and its error.

        NaN for fewer than three lattices, and where one of them does not jump or only a single point touches.

        Args:
            path: key of the path.
        """
        lattices = [one for one in self.statics if one.is_lattice and one.path == path]
        # Nothing is refined where a single point touches; without a jump there is no logarithm.
        if len(lattices) < 3 or any(one.worst == 0 or one.contacts.max() < 2 for one in lattices):
            return np.nan, np.nan
        count = np.log([np.sqrt(one.num_rows) for one in lattices])
        size = np.log([one.worst for one in lattices])
        centred = count - count.mean()
        power = centred @ size / (centred @ centred)
        rest = size - size.mean() - power * centred
        return -float(power), float(np.sqrt(rest @ rest / (len(rest) - 2) / (centred @ centred)))

    def rows(self) -> list[dict[str, Any]]:
        """One row per body and path, for metrics.csv."""
        return [
            {
                "shape": one.shape,
                "path": one.path,
                "rows": one.num_rows,
                "num_jumps": len(one.plain.places),
                "largest_jump": largest(one.plain),
                "largest_jump_over_force": one.worst,
                "gentle_jump_over_force": one.geometric,
                "place_of_largest": _place(one.plain),
                "share_of_variation": one.plain.share,
                "smoothed_jump_over_force": np.nan if one.smoothed is None else worst(one.smoothed),
                "c_mujoco_jump_over_force": worst(one.c_mujoco),
                "c_mujoco_num_jumps": len(one.c_mujoco.places),
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


def _place(jumps: Jumps) -> float:
    return float(jumps.places[jumps.largest]) if len(jumps.places) else np.nan
