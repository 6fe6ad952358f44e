"""What gradients say across jumps: short pushes from starts under noise, and a peg dropped into a hole."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float
from scipy.stats import norm

import mjxgrad as mg
from experiments.artificial_discontinuity.outcome import Mating, Slopes, at_largest
from experiments.artificial_discontinuity.settings import Settings
from experiments.artificial_discontinuity.shapes import PATHS, Shape
from experiments.parallel import in_threads
from experiments.workspace import Workspace
from mjxgrad.diagnostics import jumps_along
from mjxgrad.tasks import scene_path

_NUM_STEPS = 15  # of 2 ms: the body is still in contact, or has just left it
# Of the outcome's largest jump near the start; smaller ones are teeth of the time step.
_SMALLEST = 1e-3

# A peg and a hole, whose contact is told by boxes, by points on the peg alone, or by points on both.
TILT = 0.1  # rad
_LENGTH = 0.04  # m, half length of the peg
_BELOW = 0.02  # m, how deep the peg's end is where the force is read
_ABOVE = 0.002  # m, how high above the hole it is let go
OFFSETS = (0.0, 0.016)  # m
_NUM_DROPPED = 100  # of 2 ms
_SMALLEST_DEPTH = 0.02  # of the depth; smaller jumps are teeth of the time step

# From starts and the name of a gradient to outcomes and derivatives.
Simulate = Callable[[np.ndarray, str], tuple[Any, Any]]


def push_slopes(settings: Settings, body: Shape, places: dict[str, float], index: int) -> list[Slopes]:
    """Let a body go on each path from a mean start, and estimate how high it is pushed, by where it was."""
    found = []
    for number, (name, place) in enumerate(places.items()):
        path = PATHS[name]

        def simulate(starts: np.ndarray, gradient: str, path=path) -> tuple[Array, Array]:
            # Poses come from SciPy, so that their derivative along the path is a difference; they are smooth.
            little = 1e-6 * path.length
            at, ahead, behind = (path.poses(body, settings.depth, starts + s * little) for s in (0, 1, -1))
            return _ends(
                body.scene, jnp.asarray(at), jnp.asarray(ahead - behind) / (2 * little), gradient, _NUM_STEPS, 2
            )

        rng = np.random.default_rng([settings.seed, index, number])
        found.append(slopes_at(settings, body.label, name, simulate, place, settings.stddev * path.length, rng))
    return found


def slopes_at(
    settings: Settings, label: str, path: str, simulate: Simulate, place: float, stddev: float, rng: np.random.Generator
) -> Slopes:
    """Estimate a slope under noise about a start, in its unit, by first and zeroth order, with a reference."""
    sizes = settings.sizes
    noise = rng.normal(size=sizes.num_samples)
    # One place in each of equal shares of the noise, so that the reference's error is far below the estimates'.
    shape = (sizes.num_repeats, sizes.num_strata)
    strata = norm.ppf((np.arange(sizes.num_strata) + rng.uniform(size=shape)) / sizes.num_strata)
    every = np.concatenate([noise, strata.ravel()])
    found = in_threads(lambda name: simulate(place + stddev * every, name), ("discrete", "event"))
    (values, discrete), (_, event) = ([np.asarray(each) for each in both] for both in found)
    own, repeats = values[: sizes.num_samples], values[sizes.num_samples :].reshape(shape)
    # Less the mean of the others, which keeps it unbiased.
    baseline = (own.sum() - own) / (len(own) - 1)
    samples = np.stack([discrete[: len(own)], event[: len(own)], (own - baseline) * noise / stddev])
    # Each repeat less the mean of the other repeats, for the same reason.
    others = (repeats.mean(axis=1).sum() - repeats.mean(axis=1)) / (len(repeats) - 1)
    references = ((repeats - others[:, None]) * strata / stddev).mean(axis=1)
    jumps = jumps_along(
        lambda starts: simulate(starts, "discrete")[0],
        (place - 3 * stddev, place + 3 * stddev),
        num_points=sizes.num_rollouts,
        num_refinements=2,
        smallest=_SMALLEST,
    )
    density = norm.pdf((jumps.places - place) / stddev) / stddev
    order = np.argsort(every)
    return Slopes(
        shape=label,
        path=path,
        place=place,
        estimates=samples.mean(axis=1),
        errors=samples.std(axis=1, ddof=1) / np.sqrt(len(own)),
        reference=float(references.mean()),
        reference_error=float(references.std(ddof=1) / np.sqrt(len(references))),
        jump=float((jumps.after - jumps.before) @ density) if len(jumps.places) else 0.0,
        starts=(place + stddev * every)[order],
        outcomes=values[order],
    )


def matings(settings: Settings, workspace: Workspace) -> list[Mating]:
    """Hold the peg in the hole, and drop it beside it."""
    scenes = {label: mg.load_scene(_peg_and_hole(label)) for label in settings.sizes.geometries}
    jobs = []
    for i, (label, scene) in enumerate(scenes.items()):
        workspace.check(scene, name=f"mating, {label}")
        jobs.append((label, scene, np.random.default_rng([settings.seed, 100 + i])))
    with workspace.stage("mating", "geometries", len(scenes)) as advance_to:
        return in_threads(lambda job: _mate(settings, *job), jobs, advance_to)


def _peg_and_hole(label: str) -> mujoco.MjModel:
    """Leave out the points of `mjcf/peg_and_hole.xml`, the rim's or all; boxes meet where there are none."""
    spec = mujoco.MjSpec.from_file(str(scene_path("peg_and_hole")))
    left_out = {"boxes": ("point", "rim"), "points on the peg": ("rim",), "points on both": ()}[label]
    for geom in [one for one in spec.geoms if one.classname.name in left_out]:
        spec.delete(geom)
    if label == "boxes":
        next(one for one in spec.geoms if one.classname.name == "peg").conaffinity = 1
    return spec.compile()


def _mate(settings: Settings, label: str, scene: mg.Scene, rng: np.random.Generator) -> Mating:
    def simulate(offsets: np.ndarray, gradient: str) -> tuple[Array, Array]:
        height, slope = _ends(scene, _tilted(offsets, _ABOVE), jnp.eye(3)[0], gradient, _NUM_DROPPED, 1)
        return _LENGTH - height, -slope

    depth = jumps_along(
        lambda offsets: np.asarray(simulate(offsets, "discrete")[0]),
        OFFSETS,
        num_points=settings.sizes.num_rollouts,
        num_refinements=2,
        smallest=_SMALLEST_DEPTH,
    )
    num_points = settings.sizes.num_points
    force = jumps_along(lambda at: np.asarray(_forces(scene, _tilted(at, -_BELOW))), OFFSETS, num_points=num_points)
    edge, stddev = at_largest(depth, float(np.mean(OFFSETS))), settings.stddev * (OFFSETS[1] - OFFSETS[0])
    return Mating(label, force, depth, slopes_at(settings, label, "offset", simulate, edge, stddev, rng))


def _tilted(offsets: Float[np.ndarray, " offsets"], end: float) -> Float[Array, "offsets 3"]:
    """Place the tilted peg so that its lower end is at a height."""
    still = np.zeros_like(offsets)
    return jnp.stack([offsets, still + end + _LENGTH * np.cos(TILT), still + TILT], axis=1)


@eqx.filter_jit
def _forces(scene: mg.Scene, poses: Float[Array, "offsets 3"]) -> Float[Array, "offsets 3"]:
    force = jax.vmap(lambda pose: mg.forward(scene.model, scene.data.replace(qpos=pose)).qfrc_constraint)(poses)
    return force / np.array([1.0, 1.0, _LENGTH])


@eqx.filter_jit
def _ends(
    scene: mg.Scene,
    poses: Float[Array, "starts nq"],
    tangents: Float[Array, "*starts nq"],
    gradient: str,
    horizon: int,
    index: int,
) -> tuple[Float[Array, " starts"], Float[Array, " starts"]]:
    """Return a position (m) after some steps from each pose, and the derivative along the tangents."""

    def outcome(pose: Float[Array, " nq"]) -> Float[Array, ""]:
        state = mg.initial_state(scene, pose)
        return mg.rollout(scene, state, horizon=horizon, gradient=gradient).final.qpos[index]  # pyright: ignore[reportArgumentType]

    every = jnp.broadcast_to(tangents, poses.shape)
    return jax.vmap(lambda pose, tangent: jax.jvp(outcome, (pose,), (tangent,)))(poses, every)
