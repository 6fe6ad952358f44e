"""Smoothing kernels: the noise that a force at a distance stands for, against samples of it."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Float
from pydantic import Field, model_validator

import mjxgrad as mg
from experiments.problems.equivalent_noise import EquivalentNoise, contact_profile, probe
from experiments.report import Table
from experiments.settings import Positive, RunSettings
from experiments.theme import DEFAULT, FIRST, MUTED, ONSET, REFERENCE, ZEROTH, Drawings, legend_below, subplots
from experiments.words import capitalised, joined, quantity
from experiments.workspace import Workspace
from mjxgrad.solver.kernels import KERNELS

KernelName = Literal["gaussian", "logistic", "log_barrier"]


class Settings(RunSettings):
    """Force at a distance, the noise it stands for, and motion and derivatives against samples of that noise."""

    kernels: Annotated[tuple[KernelName, ...], Field(min_length=1, max_length=3)]
    """To compare."""
    length: Positive
    """Of the noise, in m."""
    impedance: Annotated[float, Field(gt=1e-4, lt=1)]
    """Of the moving scene, the same at every depth."""
    time_constant: Positive
    """First number of `solref`, in s; the second is 1."""
    timestep: Positive
    """In s."""
    speed: Positive
    """Towards the plane, in m/s."""
    start: Positive
    """Distance at which the motion begins, in m."""
    horizon: Annotated[int, Field(ge=10)]
    """Steps of the motion."""
    num_rollouts: Annotated[int, Field(ge=10)]
    """With noise drawn afresh in each step."""
    num_samples: Annotated[int, Field(ge=100)]
    """Of single steps."""

    @model_validator(mode="after")
    def _check(self) -> "Settings":
        if self.timestep > 0.25 * self.time_constant:
            raise ValueError(f"timestep must be at most a quarter of time_constant, got {self.timestep:g}")
        return self


# Half width of differences by velocity and force (m/s, N), so little that it smooths nothing.
_LITTLE = 1e-3
# Derivatives of the velocity after a step, and what they are by: two entries of A and the one of B.
_ENTRIES = ("velocity by height (1/s)", "velocity by velocity", "velocity by force (1/N)")
WAYS = ("smoothed solver", "mean of derivatives", "zeroth order")


@dataclass(frozen=True)
class Outcome:
    """All that was measured.

    `motion` is by `kernel` and `time` (s): the `height` (m) of the smoothed rollout and its `slope` by the start height, the
    same of the mean over rollouts with noise in each step (`sampled`, `sampled_slope`, each with its `_error`), and without
    noise (`hard`, `hard_slope`, that of the simulated map). `linear` is A and B of one step by `kernel`, `velocity` (m/s),
    `entry` and `way`, with the `error`, zero where nothing is sampled, and the `deviation` from the smoothed solver in errors.
    """

    settings: Settings
    force: xr.DataArray  # static, per mass (N/kg), by `profile` and `distance` between the bodies (m)
    noise: dict[str, EquivalentNoise]  # of each profile
    motion: xr.Dataset
    linear: xr.Dataset

    def rows(self) -> list[dict[str, Any]]:
        """One row per kernel, velocity, entry and way, for metrics.csv."""
        return self.linear.to_dataframe().reset_index().to_dict("records")


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Probe forces at a distance, then hold smoothed motion and derivatives against sampled noise."""
    scene = _scene(settings, settings.impedance, settings.impedance)
    workspace.check(scene, speed=settings.speed)
    motions, linear, velocities = [], [], (0.0, -settings.speed)
    with workspace.stage("kernels", "kernels", len(settings.kernels)) as advance_to:
        for i, name in enumerate(settings.kernels):
            key = jax.random.fold_in(jax.random.key(settings.seed), i)
            found = workspace.once(name, lambda name=name, key=key: _kernel(scene, settings, name, velocities, key))
            motions.append(found[0])
            linear.append(found[1])
            advance_to(i + 1)
    names = ("height", "slope", "sampled", "sampled_error", "sampled_slope", "sampled_slope_error")
    time = settings.timestep * np.arange(settings.horizon + 1)
    coords = {"kernel": list(settings.kernels), "name": list(names), "time": time}
    motion = xr.DataArray(np.array(motions), coords).to_dataset("name")
    motion["hard"], motion["hard_slope"] = (("time", each) for each in _smoothed_motion(scene, settings, mg.Discrete()))
    value, error = np.moveaxis(np.array(linear), 2, 0)
    dims = {"kernel": list(settings.kernels), "velocity": list(velocities), "entry": list(_ENTRIES), "way": list(WAYS)}
    table = xr.Dataset({"value": (list(dims), value), "error": (list(dims), error)}, coords=dims)
    deviation = abs(table.value - table.value.isel(way=0)) / table.error.where(table.error > 0, np.inf)
    return Outcome(settings, *_profiles(settings), motion, table.assign(deviation=deviation))


def _kernel(
    scene: mg.Scene, settings: Settings, name: str, velocities: Sequence[float], key: Array
) -> tuple[list, list]:
    """Give motion and derivatives under one kernel, smoothed and sampled."""
    motion_key, step_key = jax.random.split(key)
    smoothed = _smoothed_motion(scene, settings, mg.Smoothing(settings.length, name))
    motion = [*smoothed, *_sampled_motion(scene, settings, name, motion_key)]
    return motion, [_linear(scene, settings, name, velocity, step_key) for velocity in velocities]


def _scene(settings: Settings, first: float, last: float, margin: float = 0.0) -> mg.Scene:
    """Give a ball on a slide joint over a plane, without gravity, driven by a force."""
    contact = f'condim="1" solref="{settings.time_constant} 1" solimp="{first} {last} .002" margin="{margin}"'
    return mg.load_scene(f"""
        <mujoco model="ball"><option timestep="{settings.timestep}" gravity="0 0 0" tolerance="1e-12"/>
        <default><geom {contact}/></default>
        <worldbody><geom type="plane" size="1 1 .1"/>
        <body pos="0 0 .1"><joint name="z" type="slide" axis="0 0 1"/><geom size=".1" mass="1"/></body></worldbody>
        <actuator><motor joint="z"/></actuator></mujoco>""")


def _profiles(settings: Settings) -> tuple[xr.DataArray, dict[str, EquivalentNoise]]:
    """Probe each kernel on a constant impedance, and what MuJoCo has of its own."""
    plain, length = _scene(settings, 0.9, 0.9), settings.length
    cases = {name: contact_profile(plain, smoothing=mg.Smoothing(length, name)) for name in settings.kernels}
    # Those of both bodies add up.
    cases["margin"] = contact_profile(_scene(settings, 0.9, 0.9, margin=length / 2))
    cases["impedance"] = contact_profile(_scene(settings, 0.2, 0.9))
    grid = np.linspace(-4 * length, 4 * length, 401)
    force = np.stack([np.asarray(profile(jnp.asarray(grid))) for profile in cases.values()])
    noise = {name: probe(profile, reach=25 * length) for name, profile in cases.items()}
    return xr.DataArray(force, {"profile": list(cases), "distance": grid}), noise


def _draw(name: str, key: Array, shape: tuple[int, ...]) -> Array:
    """Draw noise in units of the length."""
    uniform = jax.random.uniform(key, shape, minval=1e-12, maxval=1.0)
    if name == "gaussian":
        return jax.scipy.stats.norm.ppf(uniform)
    size = np.sqrt(2 / np.pi)  # the mean size that all kernels share
    if name == "logistic":
        return size / (2 * np.log(2)) * (jnp.log(uniform) - jnp.log1p(-uniform))
    # Student's t with two degrees of freedom.
    return size * (uniform - 0.5) / jnp.sqrt(uniform * (1 - uniform))


def _move(scene, contact, point, noise):
    """Step once from height, velocity and force, with the contact's distance shifted by the noise."""
    height, velocity, force = point
    data = scene.data.replace(qpos=(height + noise)[None], qvel=velocity[None], ctrl=force[None])
    moved = mg.step(scene.model, data, contact=contact)
    return moved.qpos[0] - noise, moved.qvel[0]


@eqx.filter_jit
def _heights(scene, contact, start, speed, noise):
    def advance(state, w):
        moved = _move(scene, contact, (*state, jnp.zeros(())), w)
        return moved, moved[0]

    _, heights = jax.lax.scan(advance, (start, -speed), noise)
    return jnp.concatenate([start[None], heights])


def _smoothed_motion(scene, settings: Settings, contact) -> tuple[np.ndarray, np.ndarray]:
    speed, noise = jnp.array(settings.speed), jnp.zeros(settings.horizon)
    start, one = jnp.array(settings.start), jnp.array(1.0)
    height, slope = jax.jvp(lambda start: _heights(scene, contact, start, speed, noise), (start,), (one,))
    return np.asarray(height), np.asarray(slope)


def _sampled_motion(scene, settings: Settings, name: str, key: Array) -> list[np.ndarray]:
    """Average rollouts whose contact has other noise in each step, from three start heights with the same noise."""
    noise = settings.length * _draw(name, key, (settings.num_rollouts, settings.horizon))
    width = 0.25 * settings.length
    starts = settings.start + width * jnp.array([-1.0, 0.0, 1.0])
    each = jax.vmap(_heights, in_axes=(None, None, None, None, 0))
    low, middle, high = jax.vmap(each, in_axes=(None, None, 0, None, None))(
        scene, None, starts, jnp.array(settings.speed), noise
    )
    return [*_mean(middle), *_mean((high - low) / (2 * width))]


def _mean(samples: Float[Array, "samples *rest"]) -> tuple[np.ndarray, np.ndarray]:
    values = np.asarray(samples)
    return values.mean(axis=0), values.std(axis=0, ddof=1) / np.sqrt(len(values))


@eqx.filter_jit
def _slope(scene, contact, point, noise):
    """Return the velocity after a step, and its derivative by height, velocity and force."""
    return jax.value_and_grad(lambda p: _move(scene, contact, p, noise)[1])(point)


@eqx.filter_jit
def _samples(scene, point, noise, score):
    """Return samples of the derivative by first and by zeroth order: by the noise's score, and by differences."""
    still = _move(scene, mg.Discrete(), point, 0.0)[1]

    def value(shift, w):
        return _move(scene, mg.Discrete(), point + shift, w)[1]

    pushes = _LITTLE * jnp.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])

    def sample(w, score):
        middle, first = _slope(scene, mg.Discrete(), point, w)
        ends = jax.vmap(value, in_axes=(0, None))(jnp.concatenate([pushes, -pushes]), w)
        others = (ends[:2] - ends[2:]) / (2 * _LITTLE)
        return first, jnp.concatenate([((middle - still) * score)[None], others])

    return jax.vmap(sample)(noise, score)


def _linear(
    scene, settings: Settings, name: str, velocity: float, key: Array
) -> tuple[Float[np.ndarray, "entries ways"], Float[np.ndarray, "entries ways"]]:
    """Differentiate the velocity after one step, half a length above the plane, in three ways: values and their errors."""
    length = settings.length
    point = jnp.array([0.5 * length, velocity, 0.0])
    noise = length * _draw(name, key, (settings.num_samples,))
    # The noise on height moves the height itself, so the derivative of the mean is minus that by the noise, whose score is known.
    density = KERNELS[name].density
    score = -jax.vmap(jax.grad(lambda w: jnp.log(density(w))))(noise / length) / length
    first, zeroth = (_mean(samples) for samples in _samples(scene, point, noise, score))
    exact = np.asarray(_slope(scene, mg.Smoothing(length, name), point, jnp.zeros(()))[1])
    return np.stack([exact, first[0], zeroth[0]], axis=1), np.stack([0 * exact, first[1], zeroth[1]], axis=1)


# Beyond it, of some twenty numbers, none is expected by chance.
_FAR = 4.0


def answer(outcome: Outcome) -> str:
    """Name the noise, and count where sampling agrees with the solver's average."""
    noisy = [NAMES[name] for name, found in outcome.noise.items() if found.is_noise and found.stddev > 0]
    close = outcome.linear.deviation.sel(way="zeroth order") <= _FAR
    share = f"all {close.size}" if close.all() else f"{int(close.sum())} of {close.size}"
    return f"{capitalised(joined(noisy or ['no']))} noise; sampling agrees in {share} derivatives."


def verdict(outcome: Outcome) -> str:
    """Say which profiles are noise, and whether the smoothed solver is the mean over it."""
    noisy = [NAMES[name] for name, found in outcome.noise.items() if found.is_noise and found.stddev > 0]
    others = [NAMES[name] for name, found in outcome.noise.items() if not found.is_noise]
    motion = outcome.motion
    height = float(abs(motion.height - motion.sampled).max())
    slope = float(abs(motion.slope - motion.sampled_slope).max())
    last = motion.isel(time=-1)
    ends = [
        f"{quantity(float(one.sampled_slope), float(one.sampled_slope_error))} ({TITLES[str(one.kernel.values)]})"
        for one in (last.isel(kernel=i) for i in range(last.kernel.size))
    ]
    return (
        f"Equivalent to noise on the distance: {joined(noisy or ['none'])}; to none: {joined(others or ['no profile'])}. The "
        f"smoothed rollout is within {1e3 * height:.2g} mm of the mean over sampled noise, and its derivative within "
        f"{slope:.2g} of that mean's slope. That slope ends at {joined(ends)}; without noise the derivative ends at "
        f"{quantity(float(last.hard_slope))}."
    )


def findings(outcome: Outcome) -> list[str]:
    """Say what each profile is as noise, and how often A and B agree."""
    found = [f"{capitalised(NAMES[name])}: {_describe(one)}." for name, one in outcome.noise.items()]
    for way in WAYS[:0:-1]:
        close = outcome.linear.deviation.sel(way=way) <= _FAR
        found.append(
            f"A and B by {way} agree with the smoothed solver within {_FAR:g} standard errors in {int(close.sum())} of "
            f"{close.size} entries."
        )
    return found


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate A and B three ways."""
    rows, emphasised = [], set()
    linear = outcome.linear.stack(row=("kernel", "velocity", "entry")).transpose("row", "way")
    for i, (kernel, velocity, entry) in enumerate(linear.row.values):
        one = linear.isel(row=i)
        cells = [quantity(v, e or None) for v, e in zip(one.value.values, one.error.values, strict=True)]
        rows.append([TITLES[kernel], f"{velocity:g}".replace("-", "−"), entry, *cells])
        emphasised |= {(i, 3 + int(j)) for j in np.flatnonzero(one.deviation > _FAR)}
    caption = (
        "Derivatives of the velocity after one step, half a length above the plane, at rest and approaching. In bold what is "
        f"more than {_FAR:g} standard errors from the smoothed solver. Derivatives of sampled steps do not know that noise moves "
        "the surface past the body: where the force jumps there, at an approach, their mean misses the jump."
    )
    return [Table(("kernel", "velocity (m/s)", "derivative", *WAYS), rows, caption, frozenset(emphasised))]


def _describe(found) -> str:
    if not found.is_noise:
        text = found.reason
    elif found.stddev == 0:
        text = f"noise of no width, shifted by {1e3 * found.mean:.3g} mm"
    else:
        width = "infinite" if np.isinf(found.stddev) else f"{1e3 * found.stddev:.3g} mm"
        text = f"{found.reason}, mean {1e3 * found.mean:.2g} mm, standard deviation {width}"
    return re.sub(r"-(?=\d)", "−", text)


COLOURS = {"gaussian": FIRST, "logistic": ZEROTH, "log_barrier": ONSET, "margin": DEFAULT, "impedance": MUTED}
TITLES = {"gaussian": "Gaussian", "logistic": "logistic", "log_barrier": "log barrier"}
NAMES = TITLES | {"margin": "margin of one length", "impedance": "impedance from 0.2 to 0.9"}


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    return {"profiles": profiles, "motion": motion}


def profiles(outcome: Outcome):
    """Forces over distance, near and far, and equivalent densities."""
    figure, axes = subplots(1, 3, height=3.8)
    near, far, right = axes[0]
    length = outcome.settings.length
    x = outcome.force.distance.values / length
    for name, found in outcome.noise.items():
        look = {"color": COLOURS[name], "lw": 1.4 if name in TITLES else 1.1}
        force = outcome.force.sel(profile=name) / (found.slope * length)
        near.plot(x, force, label=NAMES[name], **look)
        if name in TITLES:
            far.plot(x, force, **look)
        if found.stddev != 0:
            right.plot(found.noise / length, found.density * length, **look)
        else:
            right.axvline(found.mean / length, **look)
    near.plot(x, np.maximum(-x, 0), color=REFERENCE, lw=0.9, ls=(0, (3, 2)), label="hard contact", zorder=1)
    near.set(xlim=(-2.5, 2.5), ylim=(-0.08, 2.2), title="Force, over slope × length", xlabel="distance / length")
    far.set(xlim=(0, 4), ylim=(1e-4, 1), yscale="log", title="The same, far out", xlabel="distance / length")
    right.set(xlim=(-3, 3), ylim=(-0.45, 0.75), title="Density of the noise, × length", xlabel="noise / length")
    right.axhline(0, color=MUTED, lw=0.7)
    legend_below(figure, near, 6)
    settings = outcome.settings
    caption = (
        "Static force of a contact against distance, in units of its slope deep inside and of the length of the noise, "
        f"{1e3 * settings.length:g} mm; in the middle on a logarithmic scale. Right, the second derivative of the same curves "
        "over their slope: the density of the noise that they are the mean over, where there is one. A margin is a shift (a "
        "point mass, drawn as a line). MuJoCo's rising impedance is negative somewhere, and so no density."
    )
    return figure, "Force at a distance, and the noise that it is", caption


def motion(outcome: Outcome):
    """Height and its derivative over time, lines smoothed and dots sampled."""
    figure, axes = subplots(1, 2, height=4.0)
    left, right = axes[0]
    found, time = outcome.motion, outcome.motion.time.values
    few = found.isel(time=slice(None, None, max(1, len(time) // 30)))
    panels = ((left, 1e3, "hard", "height", "sampled"), (right, 1.0, "hard_slope", "slope", "sampled_slope"))
    for axis, scale, hard, line, dots in panels:
        axis.plot(time, scale * found[hard], color=REFERENCE, lw=1.0, ls=(0, (3, 2)), label="without noise")
        for name in found.kernel.values:
            one, look = few.sel(kernel=name), {"color": COLOURS[name], "fmt": "o", "ms": 3.2, "lw": 0.9}
            axis.plot(time, scale * found[line].sel(kernel=name), color=COLOURS[name], label=TITLES[name])
            axis.errorbar(one.time, scale * one[dots], 2 * scale * one[f"{dots}_error"], label="sampled", **look)
    left.set(title="Height (mm)", xlabel="time (s)")
    right.set(title="Derivative of the height by the start height", xlabel="time (s)")
    # The derivative without noise is one of the simulated map, and may leave the picture.
    right.set_ylim(min(1.5 * float(found[["slope", "sampled_slope"]].to_array().min()), -0.3), 1.2)
    legend_below(figure, left, 7)
    settings = outcome.settings
    caption = (
        f"A ball thrown at a plane with {settings.speed:g} m/s. Lines: one rollout of the smoothed solver. Dots: mean over "
        f"{settings.num_rollouts} rollouts of MuJoCo's own contact whose distance is shifted by other noise in each step, "
        "with bars of two standard errors. Right, the derivative: lines by automatic differentiation of the smoothed rollout, "
        "dots by differences of the sampled mean. Dashed, MuJoCo's contact without noise and the exact derivative of its "
        "simulated map, which does not see that the time of impact moves."
    )
    return figure, "A ball that meets a plane, smoothed and sampled", caption
