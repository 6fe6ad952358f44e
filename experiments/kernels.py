"""Smoothing kernels: the noise that each softened contact averages over, and what its tail buys far from contact."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field
from scipy import stats

import mjxgrad as mg
from experiments.problems.planar_pusher import planar_pusher
from experiments.report import Table
from experiments.settings import Positive, RunSettings
from experiments.theme import FIRST, ONSET, REFERENCE, ZEROTH, Drawings, legend_below, subplots
from experiments.words import joined, quantity
from experiments.workspace import Workspace, in_threads
from mjxgrad.planning import Analytic, optimise_trajectory

_SIZE = np.sqrt(2 / np.pi)  # mean |w| of all kernels, in lengths
# Name, colour and distribution by kernel. The distributions are scipy's, not the library's: samples are drawn from them.
KERNELS: dict[str, tuple[str, str, Any]] = {
    "gaussian": ("Gaussian", FIRST, stats.norm()),
    "logistic": ("logistic", ZEROTH, stats.logistic(scale=_SIZE / (2 * np.log(2)))),
    "log_barrier": ("log barrier", ONSET, stats.t(2, scale=_SIZE / np.sqrt(2))),
}
# Distances in lengths, and those of them where forces are sampled.
_NEAR, _SAMPLED = np.linspace(-2, 4, 121), slice(0, None, 10)
_FAR, _TOLD = np.geomspace(0.1, 100, 31), (10, 20)  # the table tells those at 1 and 10
# Its impedance is the same at every depth, so that the law is exactly a mean.
_BALL = """<mujoco model="ball"><option gravity="0 0 0" tolerance="1e-12"/><worldbody>
  <geom type="plane" size="1 1 .1"/><body pos="0 0 .1"><joint type="slide" axis="0 0 1"/>
  <geom size=".1" mass="1" priority="1" condim="1" solimp="0.9 0.9"/></body></worldbody></mujoco>"""
_GOAL, _ARRIVED = (0.05, 0.15, 0.4), 0.02  # pose of the rod (m, m, rad), and how near it must be (m)
_PUSH_LENGTH = 0.05  # m, of the noise around the rod when planning begins; it falls to a fiftieth
_plan = eqx.filter_jit(optimise_trajectory)


class Settings(RunSettings):
    """A ball above a floor, and a rod that a finger is to push, under each kernel."""

    length: Positive  # length of the noise under the ball (m)
    num_samples: Annotated[int, Field(ge=100)]  # samples of the noise for each mean of forces
    gaps: tuple[Positive, ...]  # gaps between finger and rod at the start of a push (m)
    # The quick size takes a tenth of the samples, and the first two gaps.
    size: Literal["quick", "default"] = "default"


@dataclass(frozen=True)
class Kernel:
    """What one kernel does to a ball of 1 kg: forces in N, and slopes of the speed after a step by the height in 1/s."""

    near: Float[np.ndarray, " near"]  # forces of the smoothed step
    far: Float[np.ndarray, "2 far"]  # forces and slopes
    means: Float[np.ndarray, "2 sampled"]  # of MuJoCo's force over samples, and their standard errors
    misses: Float[np.ndarray, " gaps"]  # distance of the pushed rod from its goal (m)


@dataclass(frozen=True)
class Outcome:
    """All kernels, and MuJoCo's own force."""

    settings: Settings
    kernels: dict[str, Kernel]
    hard: Float[np.ndarray, " near"]

    @property
    def off(self) -> float:
        """Largest difference between a law and a mean, in standard errors."""
        each = [(k.near[_SAMPLED] - k.means[0]) / k.means[1] for k in self.kernels.values()]
        return float(np.abs(each).max())

    def rows(self) -> list[dict[str, Any]]:
        """One row per kernel and sampled distance, for metrics.csv."""
        return [
            {"kernel": name, "distance_m": self.settings.length * r, "force_N": force, "mean_N": mean, "error_N": error}
            for name, one in self.kernels.items()
            for r, force, mean, error in zip(_NEAR[_SAMPLED], one.near[_SAMPLED], *one.means, strict=True)
        ]


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Step the ball, sample MuJoCo's force, and plan pushes, by each kernel."""
    if settings.size == "quick":
        fewer = {"num_samples": settings.num_samples // 10, "gaps": settings.gaps[:2]}
        settings = settings.model_copy(update=fewer)
    with workspace.stage("kernels", "kernels", len(KERNELS)) as advance_to:
        found = in_threads(lambda name: workspace.once(name, lambda: _kernel(settings, name)), KERNELS, advance_to)
    return Outcome(settings, dict(zip(KERNELS, found, strict=True)), _motion(mg.Discrete(), settings.length * _NEAR)[0])


def _kernel(settings: Settings, name: str) -> Kernel:
    near, far = (_motion(mg.Smoothing(settings.length, kernel=name), settings.length * r) for r in (_NEAR, _FAR))
    return Kernel(near[0], far, _means(settings, name, near[0]), np.array([_miss(name, gap) for gap in settings.gaps]))


def _motion(contact: Any, heights: np.ndarray) -> np.ndarray:
    """Return the force of contact at each height, and the slope of the speed after a step by the height."""
    scene = mg.load_scene(_BALL)

    def speed(height: Array) -> tuple[Array, Array]:
        moved = mg.step(scene.model, scene.data.replace(qpos=height[None]), contact=contact)
        return moved.qvel[0], moved.qacc[0]

    slopes, forces = jax.jit(jax.vmap(jax.grad(speed, has_aux=True)))(jnp.asarray(heights))
    return np.stack([forces, slopes])


def _means(settings: Settings, name: str, forces: np.ndarray) -> np.ndarray:
    """Return means of MuJoCo's force over samples of the noise, and their standard errors.

    They are by its inverse dynamics, at the smoothed step's acceleration: the mean is over the law, not over the motion.
    Quantiles are v², weighed by 2v: forces under Student's t alone, which go as 1/v, have no variance.
    """
    model, random, samples = mujoco.MjModel.from_xml_string(_BALL), np.random.default_rng(settings.seed), []
    data = mujoco.MjData(model)
    for r, force in zip(_NEAR[_SAMPLED], forces[_SAMPLED], strict=True):
        quantiles = random.uniform(size=settings.num_samples)
        for v, w in zip(quantiles, KERNELS[name][2].ppf(quantiles**2), strict=True):
            data.qpos[:], data.qacc[:] = settings.length * (r + w), force
            mujoco.mj_inverse(model, data)
            samples.append(2 * v * data.qfrc_constraint[0])
    each = np.reshape(samples, (-1, settings.num_samples))
    return np.stack([each.mean(axis=1), each.std(axis=1) / np.sqrt(settings.num_samples)])


def _miss(name: str, gap: float) -> float:
    """Plan a push from rest while the smoothing vanishes, and return how far from its goal the rod ends (m)."""
    task = planar_pusher((0.0, -0.04 - gap), _GOAL)
    problem = task.system, task.cost, task.start, jnp.zeros((25, 2))
    smoother = Analytic(mg.Smoothing(_PUSH_LENGTH, kernel=name))
    end = _plan(*problem, jax.random.key(0), smoother=smoother, schedule=np.geomspace(1, 0.02, 40)).states[-1]
    return float(jnp.linalg.norm(end[2:4] - jnp.asarray(_GOAL[:2])))


def answer(outcome: Outcome) -> str:
    """Say whether laws are means, and from how far each finds the push."""
    gaps = {n: np.compress(k.misses <= _ARRIVED, outcome.settings.gaps) for n, k in outcome.kernels.items()}
    told = joined(f"{max([0.0, *found]):g} ({KERNELS[name][0]})" for name, found in gaps.items())
    return f"Samples {'agree' if outcome.off < 5 else 'disagree'}; pushes found from {told} m."


def verdict(outcome: Outcome) -> str:
    """Say how near laws are to means, and what is left ten lengths away."""
    far = joined(f"{quantity(k.far[0, _TOLD[1]])} N ({KERNELS[name][0]})" for name, k in outcome.kernels.items())
    near = f"A smoothed step's force is within {outcome.off:.1f} standard errors of MuJoCo's mean over the density."
    return f"{near} Ten lengths away, where nothing touches, it is {far}."


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate forces and slopes near and far."""
    rows = [[KERNELS[n][0], *map(quantity, k.far[:, _TOLD].T.ravel().tolist())] for n, k in outcome.kernels.items()]
    heads = (
        "kernel",
        *(f"{what} at {at}" for at in ("1 length", "10 lengths") for what in ("force (N)", "slope (1/s)")),
    )
    return [Table(heads, rows, "Slope: of the speed after a step by the height.")]


def drawings(outcome: Outcome) -> Drawings:
    """Draw forces near contact, slopes far from it, and where the rod ends."""
    figure, axes = subplots(1, 3, height=3.9)
    near, far, push = axes[0]
    near.plot(_NEAR, outcome.hard, color=REFERENCE, lw=1, ls=(0, (3, 2)), label="MuJoCo's own")
    for name, one in outcome.kernels.items():
        label, colour, _ = KERNELS[name]
        near.plot(_NEAR, one.near, color=colour, label=label)
        near.errorbar(_NEAR[_SAMPLED], one.means[0], 2 * one.means[1], color=colour, fmt="o", ms=3.5, lw=1)
        far.plot(_FAR, -one.far[1], color=colour)
        push.plot(np.divide(outcome.settings.gaps, _PUSH_LENGTH), 1e3 * one.misses, color=colour, marker="o")
    near.set(title="Force on the ball (N)", xlabel="distance / length")
    far.set(title="Slope of its speed by its height (1/s)", xlabel="distance / length", ylim=(1e-9, 10))
    far.loglog()
    push.set(title="Pushed rod from its goal (mm)", xlabel="gap at the start / length", ylim=(0, None))
    legend_below(figure, near, 4)
    caption = (
        "Left, lines by the smoothed step, dots means of MuJoCo's force over samples of the density, at the same acceleration. "
        "Middle, what is left of the gradient of one step. Right, where a finger that does not touch a rod is planned to push it."
    )
    return {"kernels": (figure, "Force at a distance, its gradient, and a push that it finds", caption)}
