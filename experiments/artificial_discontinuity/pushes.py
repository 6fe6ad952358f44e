"""What gradients say across jumps: short pushes from starts under noise."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.stats import norm

import mjxgrad as mg
from experiments.artificial_discontinuity.outcome import Slopes
from experiments.artificial_discontinuity.paths import PATHS
from experiments.artificial_discontinuity.settings import Settings
from experiments.artificial_discontinuity.shapes import Shape
from experiments.parallel import in_threads
from mjxgrad.diagnostics import jumps_along

_NUM_STEPS = 15  # of 2 ms: the body is still in contact, or has just left it
# Of the outcome's largest jump near the start; smaller ones are teeth of the time step.
_SMALLEST = 1e-3

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
            return _pushed(body.scene, jnp.asarray(at), jnp.asarray((ahead - behind) / (2 * little)), gradient)

        rng = np.random.default_rng([settings.seed, index, number])
        found.append(slopes_at(settings, body.label, name, simulate, place, settings.stddev * path.length, rng))
    return found


def slopes_at(
    settings: Settings,
    label: str,
    path: str,
    simulate: Simulate,
    place: float,
    stddev: float,
    rng: np.random.Generator,
) -> Slopes:
    """Estimate a slope under noise on the start by first and zeroth order, with a reference.

    Args:
        settings: of the run.
        label: of what is simulated.
        path: name of the parameter.
        simulate: outcomes and derivatives.
        place: mean start.
        stddev: of the noise, in the start's unit.
        rng: of the samples.
    """
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


@eqx.filter_jit
def _pushed(
    scene: mg.Scene, poses: Float[Array, "starts 7"], tangents: Float[Array, "starts 7"], gradient: str
) -> tuple[Float[Array, " starts"], Float[Array, " starts"]]:
    """Return how high the body is in the end (m), and the derivative along the tangents."""

    def outcome(pose: Float[Array, " 7"]) -> Float[Array, ""]:
        state = mg.initial_state(scene, pose)
        return mg.rollout(scene, state, horizon=_NUM_STEPS, gradient=gradient).final.qpos[2]  # pyright: ignore[reportArgumentType]

    return jax.vmap(lambda pose, tangent: jax.jvp(outcome, (pose,), (tangent,)))(poses, tangents)
