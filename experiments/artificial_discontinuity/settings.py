"""What an experiment on artificial discontinuities can be told; imports nothing heavy."""

from typing import Annotated, Literal

from pydantic import Field

from experiments.settings import RunSettings, SettingsTable

ShapeName = Literal["box", "mesh", "edges", "balls", "ball", "rounded_lattice"]
GeometryName = Literal["boxes", "points on the peg", "points on both"]
PathName = Literal["slide", "askew", "roll", "yaw", "corner"]


class Sizes(SettingsTable):
    """What a size of the experiment stands for."""

    shapes: tuple[ShapeName, ...]
    """Besides the lattices."""
    paths: tuple[PathName, ...]
    """Along which they are moved."""
    lattices: tuple[int, ...]
    """Points along an edge of the lattices that stand for a pressure field."""
    pushed: tuple[ShapeName | int, ...]
    """Of the shapes and lattices, which are let go, too."""
    geometries: tuple[GeometryName, ...]
    """Of a peg and a hole."""
    num_points: int
    """Of a path's grid."""
    num_samples: int
    """Rollouts of an estimate."""
    num_strata: int
    """Rollouts of one repeat of the reference."""
    num_repeats: int
    """Of the reference."""

    @property
    def num_rollouts(self) -> int:
        """Of one evaluation, those of the estimates and of the reference."""
        return self.num_samples + self.num_strata * self.num_repeats


class Settings(RunSettings):
    """Jumps of contact force along paths of a body over a cube, and what gradients say across them."""

    size: Literal["quick", "default", "full"] = "default"
    """How many shapes, paths, points and samples."""
    sizes: Sizes
    """The numbers that go with the size: those of the file's table of that name."""
    depth: Annotated[float, Field(gt=1e-4, le=0.02, allow_inf_nan=False)] = 0.005
    """By which the body's lowest point lies in the cube of 0.2 m, in m."""
    smoothing: Annotated[float, Field(gt=0, le=0.02, allow_inf_nan=False)] = 0.001
    """Length of the smoothing to try, in m."""
    stddev: Annotated[float, Field(gt=0, le=0.2, allow_inf_nan=False)] = 0.01
    """Of the noise on the path's parameter, as a share of the path's length."""
    threshold: Annotated[float, Field(gt=0, lt=1)] = 0.05
    """Jump, over the force, from which a shape counts as jumping."""
