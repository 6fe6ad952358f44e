r"""Two tasks whose driven body does not touch at the start what it is to move: a ball knocks another, a pin presses a bed.

With $z$ where the others are in the end, $z^\ast$ where they should be and $u$ the controls, the cost is

$$\sum_i (z_i - z_i^\ast)^2 / s + w \overline{u^2}.$$

As long as nothing touches, the derivative knows of the effort alone. What helps to see the others changes scene or cost
(`seen_from_afar`), never what is judged in the end: the cost of the task as it is loaded.

References:
    Zhong, Han, Brikis. Differentiable Physics Simulations with Contacts: Do They Have Correct Gradients w.r.t. Position,
    Velocity and Control? arXiv:2207.05060, task 3 (the ball; its optimum for balls that collide in no time is 1.396542).
    Huang, Hu, Du, Zhou, Su, Tenenbaum, Gan. PlasticineLab: A Soft-Body Manipulation Benchmark with Differentiable
    Physics. ICLR 2021, arXiv:2104.03311 (the pin, and soft contact of its tools).
"""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from numpy.polynomial import Polynomial
from scipy.optimize import minimize

import mjxgrad as mg
from mjxgrad.objective import ParameterNoise, parameter_noise
from mjxgrad.objective.task import InScene, finite_cost
from mjxgrad.rollouts import Trajectory, initial_state, rollout
from mjxgrad.scene import load_scene
from mjxgrad.tasks import scene_path


class Untouched(InScene):
    """A body under two forces, `qpos[:2]`, and others that it is to move, `qpos[2:]`."""

    target: Float[Array, " others"]  # where the others should be in the end, less where they begin (m)
    unit: Float[Array, ""]  # by what the squared error is divided (m²)
    effort: Float[Array, ""]  # price of the mean squared control
    proximity: Float[Array, ""]  # price of the mean squared distance to the others, over that at the start
    softness: mg.Softness  # the scene's own contact, with its margin
    centre: Float[Array, "bodies 2"]  # of the driven body at the start, less those of the others (m)
    reach: Float[Array, ""]  # radii of the driven body and of another together (m)
    num_pieces: int = eqx.field(static=True)  # controls are constant over as many pieces of the time
    horizon: int = eqx.field(static=True)  # number of steps, a multiple of `num_pieces`

    def start(self, control: float) -> Float[Array, " dim"]:
        """Return constant controls."""
        return jnp.full(2 * self.num_pieces, control)

    def trajectory(self, params: Float[Array, " dim"]) -> Trajectory:
        """Roll out controls that have both axes of a piece side by side."""
        controls = jnp.repeat(params.reshape(-1, 2), self.horizon // self.num_pieces, axis=0)
        return rollout(self.scene, initial_state(self.scene), controls, contact=self.contact)

    def error(self, trajectory: Trajectory) -> Float[Array, ""]:
        """Return how far the others are from their target, squared."""
        return jnp.sum((trajectory.qpos[-1, 2:] - self.target) ** 2) / self.unit

    def cost(self, params: Float[Array, " dim"]) -> Float[Array, ""]:
        """Return the cost, NaN if the rollout diverged."""
        trajectory = self.trajectory(params)
        far = jnp.maximum(jax.vmap(self.distance)(trajectory.qpos), 0.0) / self.distance(trajectory.qpos[0])
        effort = self.effort * jnp.mean(params**2)
        return finite_cost(self.error(trajectory) + effort + self.proximity * jnp.mean(far**2), trajectory)

    def distance(self, qpos: Float[Array, " nq"]) -> Float[Array, ""]:
        """Return the distance to the nearest of the others, negative inside (m)."""
        places = self.centre + qpos[:2] - self.moved(qpos[2:])
        return jnp.min(jnp.linalg.norm(places, axis=1)) - self.reach

    def moved(self, others: Float[Array, " others"]) -> Float[Array, "bodies 2"]:
        """Return how far each of the others has come, by both axes (m)."""
        return others.reshape(-1, 2)

    def seen_from_afar(
        self, proximity: Float[ArrayLike, ""], radius: Float[ArrayLike, ""], margin: Float[ArrayLike, ""]
    ) -> "Untouched":
        """Return the task with a price of the distance, a larger driven body, or contact that begins earlier (m)."""
        driven = self.scene.mj_model.body_geomadr[1]
        scene = self.scene.with_model(geom_size=self.scene.model.geom_size.at[driven, 0].add(radius))
        softness = dataclasses.replace(self.softness, margin=jnp.asarray(self.softness.margin) + margin)
        return dataclasses.replace(self, scene=scene, proximity=self.proximity + proximity).with_softness(softness)

    def objective(self, stddev: float | Float[Array, ""]) -> ParameterNoise:
        """Return the cost as a function of the controls, with noise on each piece of them."""
        return parameter_noise(self.cost, stddev, dim=2 * self.num_pieces)


def billiards(*, num_pieces: int = 20) -> Untouched:
    """Load the stroke: the balls are 1.01 m apart, the target is 1.41 m behind the second, and there is one second of time.

    Controls are forces in N; below 1.43 N per axis the balls do not touch. Standing still costs 2 m². With 20 pieces the
    optimum is dearer by 0.0005 than that of a force that may change at any time.
    """
    scene = load_scene(scene_path("billiards"))
    return Untouched(
        scene,
        target=jnp.asarray(-KNOCKED),
        unit=jnp.asarray(1.0),
        effort=jnp.asarray(2 * EFFORT),  # the price is of the square of both axes together
        proximity=jnp.asarray(0.0),
        softness=mg.Softness(margin=scene.model.pair_margin[0]),
        centre=jnp.asarray([DRIVEN - KNOCKED]),
        reach=jnp.asarray(CONTACT),
        num_pieces=num_pieces,
        horizon=round(1 / scene.mj_model.opt.timestep),
    )


class RollingPin(Untouched):
    """The pin over its bed, whose pillars move up and down."""

    def moved(self, others: Float[Array, " others"]) -> Float[Array, "bodies 2"]:
        return jnp.stack([jnp.zeros_like(others), others], axis=1)


DENT, DEPTH = (2, 3, 4, 5), 0.015  # pillars of eight that are to be lower in the end, and by how much (m)


def rolling_pin(*, horizon: int = 120) -> RollingPin:
    """Load the dent: four of eight pillars are to be 15 mm lower in the end; the untouched bed costs 1.

    Controls are the forces on the pin along x and z, in units of 10 N, one for each step of 5 ms. The pin begins at rest 30 mm
    above the first of the four, so that it has to come down, and then to roll along. A margin changes no depth under 50 m/s²,
    about 8 N on a pillar.
    """
    scene = load_scene(scene_path("rolling_pin"))
    model = scene.mj_model
    caps, pin = [model.geom(f"pillar_{i}").id for i in range(8)], model.geom("pin").id
    at_rest = model.body_pos[model.geom_bodyid] + model.geom_pos
    target = np.zeros(8)
    target[list(DENT)] = -DEPTH
    return RollingPin(
        scene,
        target=jnp.asarray(target),
        unit=jnp.asarray(np.sum(target**2)),
        effort=jnp.asarray(1e-3),
        proximity=jnp.asarray(0.0),
        softness=mg.Softness(1e4, 1.0, margin=0.0, rest_acceleration=50.0),
        centre=jnp.asarray((at_rest[pin] - at_rest[caps])[:, [0, 2]]),
        reach=jnp.asarray(model.geom_size[pin, 0] + model.geom_size[caps[0], 0]),
        num_pieces=horizon,
        horizon=horizon,
    )


# The same stroke with hard balls: closed forms that share no code with the simulation. A driven ball from rest, accelerated by u,
# has to cover the vector d in the time s and arrive at velocity v. The least ∫|u|² for that is 12|d|²/s³ − 12 d·v/s² + 4|v|²/s
# (a force linear in time). Then both balls, of equal mass, exchange what is along the line of centres: the collision is elastic.
DRIVEN, KNOCKED = np.array([-2.0, -2.0]), np.array([-1.0, -1.0])
CONTACT = 0.4  # m, between the centres
EFFORT = 0.1


@functools.cache
def hard_optimum() -> tuple[float, float, float]:
    """Find the best stroke: its cost (m²), the time of the collision (s) and the speed at it (m/s)."""
    gap = np.linalg.norm(KNOCKED - DRIVEN) - CONTACT
    miss = np.linalg.norm(KNOCKED)

    def cost(x):
        time, speed = x
        effort = 12 * gap**2 / time**3 - 12 * gap * speed / time**2 + 4 * speed**2 / time
        return (miss - (1 - time) * speed) ** 2 + EFFORT * effort

    best = minimize(cost, [0.7, 2.5], method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-14})
    return float(best.fun), float(best.x[0]), float(best.x[1])


def hard_cost(forces: np.ndarray) -> float:
    """Play forces (pieces, 2), in N and constant over pieces of the second, on hard balls; gives the cost (m²)."""
    forces = np.asarray(forces, float)
    piece = 1 / len(forces)
    position, velocity = DRIVEN.copy(), np.zeros(2)
    end = KNOCKED
    for i, force in enumerate(forces):
        way = [Polynomial(along) for along in zip(position - KNOCKED, velocity, force / 2, strict=True)]
        roots = (way[0] ** 2 + way[1] ** 2 - CONTACT**2).roots()
        times = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real >= 0) & (roots.real < piece)]
        if times.size:
            time = times.min()
            normal = -np.array([along(time) for along in way]) / CONTACT
            end = KNOCKED + (1 - i * piece - time) * ((velocity + time * force) @ normal) * normal
            break
        position, velocity = position + piece * velocity + piece**2 / 2 * force, velocity + piece * force
    return float(end @ end + EFFORT * piece * np.sum(forces**2))
