"""A cube is thrown down on a plane; where does it end, and how does that depend on the throw?

References:
    Paulus, Geist, Schumacher, Musil, Rappenecker, Martius. Hard Contacts with Soft Gradients: Refining Differentiable
    Simulators for Learning and Control (DiffMJX). arXiv:2506.14186; the cube of its timing experiment.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from mjxgrad._rollout import State, initial_state
from mjxgrad.scene import Scene, load_scene
from mjxgrad.tasks import scene_path

DURATION = 1.0  # s
PUBLISHED_SPEED = -2.0  # m/s, upwards
PUBLISHED_DERIVATIVE = 0.17267  # m per m/s
_DRIFT = -0.1  # m/s, sideways

# (solref, solimp): what DiffMJX was timed on, whose force begins without a jump, and what MuJoCo takes if
# nothing is said.
_CONTACTS = {
    "published": ((0.005, 1.0), (0.0, 0.95, 0.001, 0.5, 2.0)),
    "default": ((0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0)),
}


class CubeToss(eqx.Module):
    """The throw; see `cube_toss`."""

    scene: Scene

    def start(self, speed: Float[ArrayLike, ""]) -> State:
        """Return the state at a throw upwards at a speed in m/s."""
        qvel = jnp.zeros_like(self.scene.data.qvel).at[1].set(_DRIFT).at[2].set(speed)
        return initial_state(self.scene, qvel=qvel)

    def outcome(self, qpos: Float[Array, "*states 7"]) -> Float[Array, "*states"]:
        """Return how far sideways the cube is, in m."""
        return qpos[..., 1]


def cube_toss(contact: str = "published", *, timestep: float | None = None) -> CubeToss:
    """Load the throw, with contact whose force begins without a jump or with one; `timestep` (s) is the scene's if None."""
    scene = load_scene(scene_path("cube_toss"), timestep=timestep)
    solref, solimp = (jnp.array([row]) for row in _CONTACTS[contact])
    return CubeToss(scene.with_model(pair_solref=solref, pair_solimp=solimp))
