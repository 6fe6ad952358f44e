"""What an experiment on artificial discontinuities can be told; imports nothing heavy."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from experiments.settings import RunSettings

ShapeName = Literal["box", "mesh", "edges", "balls", "ball", "rounded_lattice"]
GeometryName = Literal["boxes", "points on the peg", "points on both"]
PathName = Literal["slide", "askew", "roll", "yaw", "corner"]


@dataclass(frozen=True)
class Sizes:
    """What a size of the experiment stands for.

    Attributes:
        shapes: besides the lattices.
        paths: along which they are moved.
        pushed: of the shapes and lattices, which are let go, too.
        lattices: points along an edge of the lattices that stand for a pressure field.
        geometries: of a peg and a hole.
        num_points: of a path's grid.
        num_samples: rollouts of an estimate.
        num_strata: rollouts of one repeat of the reference.
        num_repeats: of the reference.
    """

    shapes: tuple[ShapeName, ...]
    paths: tuple[PathName, ...]
    lattices: tuple[int, ...]
    pushed: tuple[ShapeName | int, ...]
    geometries: tuple[GeometryName, ...]
    num_points: int
    num_samples: int
    num_strata: int
    num_repeats: int

    @property
    def num_rollouts(self) -> int:
        """Of one evaluation, those of the estimates and of the reference."""
        return self.num_samples + self.num_strata * self.num_repeats


_ALL: tuple[ShapeName, ...] = ("box", "mesh", "edges", "balls", "ball", "rounded_lattice")
_PATHS: tuple[PathName, ...] = ("slide", "askew", "roll", "yaw", "corner")
_GEOMETRIES: tuple[GeometryName, ...] = ("boxes", "points on the peg", "points on both")
_MOST: tuple[ShapeName | int, ...] = ("box", "edges", "balls", "rounded_lattice", 8)
# Samples and strata together are a multiple of 16, so that one compilation serves them and the search for jumps.
SIZES = {
    "quick": Sizes(("box", "balls"), ("slide", "roll"), (2, 4, 8), ("box",), _GEOMETRIES[2:], 64, 112, 16, 8),
    "default": Sizes(_ALL, _PATHS, (2, 4, 8, 16), _MOST, _GEOMETRIES, 256, 512, 64, 8),
    "full": Sizes(_ALL, _PATHS, (2, 4, 8, 16, 32), (*_ALL, 8, 16), _GEOMETRIES, 1024, 2048, 256, 16),
}


class Settings(RunSettings):
    """Jumps of contact force along paths of a body over a cube, and what gradients say across them."""

    size: Literal["quick", "default", "full"] = "default"
    """How many shapes, paths, points and samples."""
    depth: Annotated[float, Field(gt=1e-4, le=0.02, allow_inf_nan=False)] = 0.005
    """By which the body's lowest point lies in the cube of 0.2 m, in m."""
    smoothing: Annotated[float, Field(gt=0, le=0.02, allow_inf_nan=False)] = 0.001
    """Length of the smoothing to try, in m."""
    stddev: Annotated[float, Field(gt=0, le=0.2, allow_inf_nan=False)] = 0.01
    """Of the noise on the path's parameter, as a share of the path's length."""
    threshold: Annotated[float, Field(gt=0, lt=1)] = 0.05
    """Jump, over the force, from which a shape counts as jumping."""

    @property
    def sizes(self) -> Sizes:
        """What the size stands for."""
        return SIZES[self.size]
