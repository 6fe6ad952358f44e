"""From settings to numbers."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Float

import mjxgrad as mg
from experiments.kernels.settings import Settings
from experiments.workspace import Workspace
from mjxgrad.diagnostics.equivalent_noise import EquivalentNoise, contact_profile, probe
from mjxgrad.dynamics.kernels import KERNELS

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
            motion_key, step_key = jax.random.split(jax.random.fold_in(jax.random.key(settings.seed), i))
            smoothed = _smoothed_motion(scene, settings, mg.Smoothing(settings.length, name))
            motions.append([*smoothed, *_sampled_motion(scene, settings, name, motion_key)])
            linear.append([_linear(scene, settings, name, velocity, step_key) for velocity in velocities])
            advance_to(i + 1)
    names = ("height", "slope", "sampled", "sampled_error", "sampled_slope", "sampled_slope_error")
    time = settings.timestep * np.arange(settings.horizon + 1)
    coords = {"kernel": list(settings.kernels), "name": list(names), "time": time}
    motion = xr.DataArray(np.array(motions), coords).to_dataset("name")
    motion["hard"], motion["hard_slope"] = (("time", each) for each in _smoothed_motion(scene, settings, None))
    value, error = np.moveaxis(np.array(linear), 2, 0)
    dims = {"kernel": list(settings.kernels), "velocity": list(velocities), "entry": list(_ENTRIES), "way": list(WAYS)}
    table = xr.Dataset({"value": (list(dims), value), "error": (list(dims), error)}, coords=dims)
    deviation = abs(table.value - table.value.isel(way=0)) / table.error.where(table.error > 0, np.inf)
    return Outcome(settings, *_profiles(settings), motion, table.assign(deviation=deviation))


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


def _move(scene, smoothing, point, noise):
    """Step once from height, velocity and force, with the contact's distance shifted by the noise."""
    height, velocity, force = point
    data = scene.data.replace(qpos=(height + noise)[None], qvel=velocity[None], ctrl=force[None])
    moved = mg.step(scene.model, data, smoothing=smoothing)
    return moved.qpos[0] - noise, moved.qvel[0]


@eqx.filter_jit
def _heights(scene, smoothing, start, speed, noise):
    def advance(state, w):
        moved = _move(scene, smoothing, (*state, jnp.zeros(())), w)
        return moved, moved[0]

    _, heights = jax.lax.scan(advance, (start, -speed), noise)
    return jnp.concatenate([start[None], heights])


def _smoothed_motion(scene, settings: Settings, smoothing) -> tuple[np.ndarray, np.ndarray]:
    speed, noise = jnp.array(settings.speed), jnp.zeros(settings.horizon)
    start, one = jnp.array(settings.start), jnp.array(1.0)
    height, slope = jax.jvp(lambda start: _heights(scene, smoothing, start, speed, noise), (start,), (one,))
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
def _slope(scene, smoothing, point, noise):
    """Return the velocity after a step, and its derivative by height, velocity and force."""
    return jax.value_and_grad(lambda p: _move(scene, smoothing, p, noise)[1])(point)


@eqx.filter_jit
def _samples(scene, point, noise, score):
    """Return samples of the derivative by first and by zeroth order: by the noise's score, and by differences."""
    still = _move(scene, None, point, 0.0)[1]

    def value(shift, w):
        return _move(scene, None, point + shift, w)[1]

    pushes = _LITTLE * jnp.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])

    def sample(w, score):
        middle, first = _slope(scene, None, point, w)
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
