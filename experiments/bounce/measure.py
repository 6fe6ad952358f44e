"""From settings to numbers."""

import itertools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from experiments.bounce.outcome import Cell, Outcome
from experiments.bounce.settings import ImpedanceSettings, Settings
from experiments.motion import ARMS, DISCRETE, at_time_step, motion
from experiments.workspace import Workspace
from mjxgrad.diagnostics import compare_to_slope, phases
from mjxgrad.scene import Scene
from mjxgrad.tasks.textbook import Bounce, bounce_scene, integrated_restitution

_TINY = 1e-7  # m; the ball flies 500 times as far in the shortest of time steps


class _Contacts(eqx.Module):
    """All contacts at one time step; time steps differ in arrays alone, so one compilation serves them all."""

    scene: Scene
    solref: Float[Array, "cells 2"]
    solimp: Float[Array, "cells 5"]
    timestep: Float[Array, ""]
    num_steps: Int[Array, ""]
    speed: Float[Array, ""]

    def height(self, start: Float[Array, ""], cell: Int[Array, ""], arm: str) -> Float[Array, ""]:
        """Bounce once, from a start height to the height at the end."""
        model = at_time_step(self.scene.model, self.timestep)
        model = model.replace(
            geom_solref=jnp.broadcast_to(self.solref[cell], model.geom_solref.shape),
            geom_solimp=jnp.broadcast_to(self.solimp[cell], model.geom_solimp.shape),
        )
        data = self.scene.data.replace(qpos=start[None], qvel=-self.speed[None])
        gradient, onset = ARMS[arm]
        return motion(model, data, _height, num_times=1, steps_between=self.num_steps, gradient=gradient, onset=onset)[
            0
        ]


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Compare derivatives with the slope for every contact and time step."""
    grid = itertools.product(settings.damping_ratios, settings.time_constants, settings.impedances)
    with workspace.stage("quadrature", "steps", 1):
        cells = [_cell(settings, *point) for point in grid]
    scene = bounce_scene()
    found, differences = {arm: [] for arm in ARMS}, []
    starts = jnp.asarray(phases(settings.heights, settings.num_phases))
    with workspace.stage("rollouts", "time steps", len(settings.timesteps)) as advance_to:
        for timestep in settings.timesteps:
            contacts = _contacts(scene, cells, settings, timestep)
            for arm, each in found.items():
                heights, derivatives = _values_and_derivatives(contacts, starts, arm)
                each.append(compare_to_slope(starts, heights, [derivatives], (arm,)))
            widths = (_TINY, settings.speed * timestep)
            quotients = [_differences(contacts, starts, width) for width in widths]
            # Their means need the weights of the derivatives' to be compared with them.
            heights = found[DISCRETE][-1].outcomes
            differences.append(compare_to_slope(starts, heights, quotients, ("tiny", "wide")))
            advance_to(len(differences))
    return Outcome(
        settings=settings,
        cells=cells,
        found=found,
        tiny=np.array([one.mean[0] for one in differences]),
        wide=np.array([one.mean[1] for one in differences]),
        wide_spread=np.array([one.spread[1] for one in differences]),
    )


def _cell(settings: Settings, ratio: float, constant: float, impedance: ImpedanceSettings) -> Cell:
    numbers = (impedance.first, impedance.last, impedance.width)
    restitution, duration = integrated_restitution(constant, ratio, numbers, settings.speed)
    is_constant = impedance.first == impedance.last
    closed = -float(Bounce(constant, ratio, settings.speed).restitution) if is_constant else np.nan
    return Cell(ratio, constant, impedance, -restitution, closed, duration)


def _contacts(scene: Scene, cells: list[Cell], settings: Settings, timestep: float) -> _Contacts:
    impedances = [(cell.impedance.first, cell.impedance.last, cell.impedance.width, 0.5, 2.0) for cell in cells]
    return _Contacts(
        scene,
        jnp.array([(cell.time_constant, cell.damping_ratio) for cell in cells]),
        jnp.array(impedances),
        jnp.asarray(timestep),
        jnp.int32(round(settings.duration / timestep)),
        jnp.asarray(settings.speed),
    )


def _height(qpos: Float[Array, " 1"], qvel: Float[Array, " 1"]) -> Float[Array, ""]:
    return qpos[0]


@eqx.filter_jit
def _values_and_derivatives(
    contacts: _Contacts, starts: Float[Array, " phases"], arm: str
) -> tuple[Float[Array, "phases cells"], Float[Array, "phases cells"]]:
    def one(start: Float[Array, ""], cell: Int[Array, ""]) -> tuple[Array, Array]:
        return jax.jvp(lambda x: contacts.height(x, cell, arm), (start,), (jnp.ones_like(start),))

    return _over_grid(one, starts, contacts)


@eqx.filter_jit
def _values(contacts: _Contacts, starts: Float[Array, " phases"]) -> Float[Array, "phases cells"]:
    return _over_grid(lambda start, cell: contacts.height(start, cell, DISCRETE), starts, contacts)


def _over_grid(function: Callable, starts: Float[Array, " phases"], contacts: _Contacts):
    """Evaluate at every start and every contact, as a single batch."""
    count = len(contacts.solref)
    values = jax.vmap(function)(jnp.repeat(starts, count), jnp.tile(jnp.arange(count), len(starts)))
    return jax.tree.map(lambda x: x.reshape(len(starts), count), values)


def _differences(
    contacts: _Contacts, starts: Float[Array, " phases"], width: float
) -> Float[np.ndarray, "phases cells"]:
    """Give central differences of a width at each start."""
    ahead, behind = (_values(contacts, starts + side * width / 2) for side in (1, -1))
    return np.asarray(ahead - behind) / width
