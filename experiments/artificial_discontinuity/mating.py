"""A peg and a hole, whose contact is told by boxes, by points on the peg alone, or by points on both."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import mjxgrad as mg
from experiments.artificial_discontinuity.outcome import Mating, place
from experiments.artificial_discontinuity.pushes import slopes_at
from experiments.artificial_discontinuity.settings import Settings
from experiments.parallel import in_threads
from experiments.workspace import Workspace
from mjxgrad.diagnostics import jumps_along

TILT = 0.1  # rad
_HOLE, _PEG, _LENGTH = 0.022, 0.019, 0.04  # m, half widths and half length of the peg
_POINT = 0.003  # m
_BELOW = 0.02  # m, how deep the peg's end is where the force is read
_ABOVE = 0.002  # m, how high above the hole it is let go
OFFSETS = (0.0, 0.016)  # m
_NUM_STEPS = 100  # of 2 ms
_SMALLEST = 0.02  # of the depth; smaller jumps are teeth of the time step

_SCENE = """<mujoco><option timestep="0.002" tolerance="1e-10"/>
<default><geom condim="1" mass="0"/><default class="hole"><geom contype="1" conaffinity="0"/></default>
<default class="rim"><geom contype="2" conaffinity="0" size="{point}"/></default>
<default class="peg"><geom contype="0" conaffinity="{peg}"/></default>
<default class="point"><geom contype="0" conaffinity="1" size="{point}"/></default></default>
<worldbody><geom class="hole" type="box" size=".05 .02 .05" pos="{left} 0 -.05"/>
<geom class="hole" type="box" size=".05 .02 .05" pos="{right} 0 -.05"/>
{rim}<body><joint type="slide" axis="1 0 0" damping=".5"/><joint type="slide" axis="0 0 1" damping=".5"/>
<joint type="hinge" axis="0 1 0" damping="1e-4"/><inertial pos="0 0 0" mass=".1" diaginertia="1e-4 1e-4 1e-4"/>
<geom class="peg" type="box" size="{width} .01 {length}"/>{points}</body></worldbody></mujoco>"""


def measure(settings: Settings, workspace: Workspace) -> list[Mating]:
    """Hold the peg in the hole, and drop it beside it."""
    scenes = {label: mg.load_scene(_mjcf(label)) for label in settings.sizes.geometries}
    for label, scene in scenes.items():
        workspace.check(scene, name=f"mating, {label}")

    def mate(i: int, label: str) -> Mating:
        return _mate(settings, label, scenes[label], np.random.default_rng([settings.seed, 100 + i]))

    with workspace.stage("mating", "geometries", len(scenes)) as advance_to:
        return in_threads(lambda one: mate(*one), enumerate(scenes), advance_to)


def _mjcf(label: str) -> str:
    """Write a scene: points of either part meet the box of the other one, and boxes meet where there are no points."""
    points = [(s * (_PEG - _POINT), t * (_LENGTH - _POINT)) for s in (-1, 1) for t in (-1, 1)]
    rim = [(s * (_HOLE + _POINT), -_POINT) for s in (-1, 1)]
    has_points, has_rim = label != "boxes", label == "points on both"
    return _SCENE.format(
        peg=2 if has_points else 1,
        point=_POINT,
        left=-_HOLE - 0.05,
        right=_HOLE + 0.05,
        width=_PEG,
        length=_LENGTH,
        points="".join(f'<geom class="point" pos="{x} 0 {z}"/>' for x, z in points) if has_points else "",
        rim="".join(f'<geom class="rim" pos="{x} 0 {z}"/>' for x, z in rim) if has_rim else "",
    )


def _mate(settings: Settings, label: str, scene: mg.Scene, rng: np.random.Generator) -> Mating:
    def simulate(offsets: np.ndarray, gradient: str) -> tuple[Array, Array]:
        return _depths(scene, jnp.asarray(offsets), gradient)

    depth = jumps_along(
        lambda offsets: simulate(offsets, "discrete")[0],
        OFFSETS,
        num_points=settings.sizes.num_rollouts,
        num_refinements=2,
        smallest=_SMALLEST,
    )
    edge = place(depth, float(np.mean(OFFSETS)))
    stddev = settings.stddev * (OFFSETS[1] - OFFSETS[0])
    return Mating(
        label=label,
        force=jumps_along(lambda at: _forces(scene, jnp.asarray(at)), OFFSETS, num_points=settings.sizes.num_points),
        depth=depth,
        slopes=slopes_at(settings, label, "offset", simulate, edge, stddev, rng),
    )


def _pose(offset: Float[Array, ""], end: float) -> Float[Array, " 3"]:
    """Place the tilted peg so that its lower end is at a height."""
    return jnp.stack([offset, jnp.asarray(end + _LENGTH * np.cos(TILT)), jnp.asarray(TILT)])


@eqx.filter_jit
def _forces(scene: mg.Scene, offsets: Float[Array, " offsets"]) -> Float[Array, "offsets 3"]:
    def one(offset: Float[Array, ""]) -> Float[Array, " 3"]:
        data = mg.forward(scene.model, scene.data.replace(qpos=_pose(offset, -_BELOW)))
        return data.qfrc_constraint / np.array([1.0, 1.0, _LENGTH])

    return jax.vmap(one)(offsets)


@eqx.filter_jit
def _depths(
    scene: mg.Scene, offsets: Float[Array, " offsets"], gradient: str
) -> tuple[Float[Array, " offsets"], Float[Array, " offsets"]]:
    def depth(offset: Float[Array, ""]) -> Float[Array, ""]:
        state = mg.initial_state(scene, _pose(offset, _ABOVE))
        end = mg.rollout(scene, state, horizon=_NUM_STEPS, gradient=gradient).final.qpos  # pyright: ignore[reportArgumentType]
        return _LENGTH - end[1]

    return jax.vmap(lambda x: jax.jvp(depth, (x,), (jnp.ones_like(x),)))(offsets)
