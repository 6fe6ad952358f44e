r"""A rolling pin above a bed that it does not touch: a first-order gradient of exactly zero, and ways around it.

The bed is to have a dent. With $z$ the heights of its pillars in the end, $z^\ast$ those wished for and $u$ the controls,
the true cost is

$$\sum_i (z_i - z_i^\ast)^2 / \sum_i (z_i^\ast)^2 + w_u \overline{u^2},$$

1 for an untouched bed. What helps to find the bed changes the simulation or the cost (`with_proximity`), never what is
judged in the end: `true_cost` is of the scene as it is loaded.

References:
    Huang, Hu, Du, Zhou, Su, Tenenbaum, Gan. PlasticineLab: A Soft-Body Manipulation Benchmark with Differentiable
    Physics. ICLR 2021, arXiv:2104.03311 (the rolling pin, and soft contact of its tools).
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from mjxgrad.rollouts import Trajectory, initial_state
from mjxgrad.scene import load_scene
from mjxgrad.tasks import ActionTask, scene_path

NUM_PILLARS = 8
DENT = (2, 3, 4, 5)
DEPTH = 0.015  # m
CONTROL_WEIGHT = 1e-3  # of the mean square of the controls
STIFFNESS = 1e4  # 1/s², of the scene's contact, which is critically damped


class DentCost(eqx.Module):
    """What the bed looks like in the end, and what it took; see the module.

    Attributes:
        target: heights of the pillars, less those at rest (m).
        proximity_weight: of the mean square of the distance between pin and bed, over that at the start.
        centre: of the pin at rest, less those of the pillars' caps (m): x, z.
        reach: radii of pin and cap together (m).
    """

    target: Float[Array, " pillars"]
    proximity_weight: Float[Array, ""]
    centre: Float[Array, "pillars 2"]
    reach: Float[Array, ""]

    def __call__(self, trajectory: Trajectory) -> Float[Array, ""]:
        error = jnp.sum((trajectory.qpos[-1, 2:] - self.target) ** 2) / jnp.sum(self.target**2)
        effort = CONTROL_WEIGHT * jnp.mean(trajectory.ctrl**2)
        distance = jax.vmap(self.distance)(trajectory.qpos)
        far = jnp.maximum(distance, 0.0) / self.distance(jnp.zeros_like(trajectory.qpos[0]))
        return error + effort + self.proximity_weight * jnp.mean(far**2)

    def distance(self, qpos: Float[Array, " nq"]) -> Float[Array, ""]:
        """Return the distance of the pin from the nearest pillar, negative inside (m)."""
        offset = self.centre + jnp.stack([jnp.broadcast_to(qpos[0], self.target.shape), qpos[1] - qpos[2:]], axis=1)
        return jnp.min(jnp.linalg.norm(offset, axis=1)) - self.reach


class RollingPin(ActionTask):
    """The pin and its bed; see `rolling_pin`. Every remedy gives another task, of the same controls."""

    @property
    def target(self) -> Float[Array, " pillars"]:
        """Heights wished for, less those at rest (m)."""
        return self.cost.target  # pyright: ignore[reportFunctionMemberAccess]

    def with_proximity(self, weight: Float[ArrayLike, ""]) -> "RollingPin":
        """Return the task whose cost draws the pin to the bed."""
        return eqx.tree_at(lambda task: task.cost.proximity_weight, self, jnp.asarray(weight, float))

    def enlarged(self, extra: Float[ArrayLike, ""]) -> "RollingPin":
        """Return the task with a pin of a radius larger by so much (m); it is no heavier."""
        size = self.scene.model.geom_size.at[self.scene.mj_model.geom("pin").id, 0].add(extra)
        return dataclasses.replace(self, scene=self.scene.with_model(geom_size=size))

    def true_cost(self, params: Float[Array, " dim"]) -> Float[Array, ""]:
        """Return the cost of flattened controls, without noise."""
        return self.run(params.reshape(self.horizon, self.num_controls)).cost


def rolling_pin(*, horizon: int = 120) -> RollingPin:
    """Load the task: four of eight pillars are to be 15 mm lower in the end.

    Controls are the forces on the pin along x and z, in units of 10 N. The pin begins at rest 30 mm above the first of the
    four, so that it has to come down, and then to roll along. A step is 5 ms.
    """
    scene = load_scene(scene_path("rolling_pin"))
    model = scene.mj_model
    caps = np.array([model.geom(f"pillar_{i}").id for i in range(NUM_PILLARS)])
    pin = model.geom("pin").id
    at_rest = model.body_pos[model.geom_bodyid] + model.geom_pos
    target = np.zeros(NUM_PILLARS)
    target[list(DENT)] = -DEPTH
    cost = DentCost(
        target=jnp.asarray(target),
        proximity_weight=jnp.zeros(()),
        centre=jnp.asarray((at_rest[pin] - at_rest[caps])[:, [0, 2]]),
        reach=jnp.asarray(model.geom_size[pin, 0] + model.geom_size[caps[0], 0]),
    )
    start = jnp.zeros((horizon, scene.model.nu))
    return RollingPin(scene, initial_state(scene), cost, horizon, start_params=start)  # pyright: ignore[reportCallIssue]
