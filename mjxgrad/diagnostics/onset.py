r"""Whether a rollout takes small enough steps through the beginning of its contacts.

The force of a contact rises with the impedance, from $d_0$ at the first touch to $d_w$ at the depth `width`. The exact
derivative of the discrete step knows of this rise only what the steps see of it. Two things hide it.

*A jump.* The part $d_0$ is there at once, and its derivative is nowhere: that the time of impact moves goes unseen, at
every time step. The derivative of the speed after a bounce by where it starts, which is zero, becomes $-d_0 / d_w$ of

$$2 \zeta \omega_0 e,$$

$e$ the restitution ($2 \zeta \omega_0 = b$ is what the dashpot gives a body of unit speed at the first touch, $e$ what the
bounce leaves of it), and the place it reaches is off by that times the time since. With MuJoCo's default, 12.8 1/s.

*A rise within a step.* With $d_0 = 0$ the simulated outcome is continuous, so the mean of the discrete derivative over
where within a step the contact falls is right, however long the step. Its spread is not. With

$$n = \text{width} / (\text{approach speed} \times \text{time step}),$$

the steps across the rise, a share $1 - n$ of all phases does not meet it at all if $n < 1$, and has the derivative of a
jump; the rest make up for it. The standard deviation over phases, in the unit above ($h \omega_0$ of 0.02 and of 0.1,
MuJoCo's default at 2 ms; ζ of 0.3 and 1):

| n | 0.03 | 0.3 | 1 | 1.5 | 2 | 3 | 5 | 10 |
|---|---|---|---|---|---|---|---|---|
| standard deviation | 6.6–6.8 | 1.9 | 0.6 | 0.14–0.18 | 0.004–0.05 | 0.06 | 0.02–0.08 | 0.01–0.06 |

From `STEPS_NEEDED` on, where both halves of the rise (MuJoCo's two parabolas) are met, it falls no further.

So a first-order estimate from fewer samples than 1/n is biased as if $d_0$ were large, and nothing in the samples says
so; then `onset=mg.Onset()`, shorter steps or a wider rise are called for.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjxgrad._mjx import mjx
from mjxgrad._rollout import Trajectory
from mjxgrad.contact.parameters import ContactPair
from mjxgrad.dynamics.collision import collide
from mjxgrad.dynamics.rows import contact_jacobian
from mjxgrad.scene import Scene

STEPS_NEEDED = 2.0
"""Steps across the rise of the impedance from which an onset is resolved."""
LARGEST_JUMP = 0.01
"""Impedance at the first touch up to which the force counts as continuous."""


class OnsetResolution(eqx.Module):
    """Every beginning of a contact in a rollout, and whether its steps resolve it; see `onset_resolution`.

    Attributes:
        is_onset: whether a pair begins to touch in a step.
        speed: at which it does, along the normal (m/s); 0 elsewhere.
        width: over which the impedance rises (m), by pair.
        jump: impedance at the first touch, by pair.
        timestep: of the scene (s).
        pairs: in the order of the columns.
    """

    is_onset: Bool[Array, "*batch horizon pairs"]
    speed: Float[Array, "*batch horizon pairs"]
    width: Float[Array, "*batch pairs"]
    jump: Float[Array, "*batch pairs"]
    timestep: Float[Array, "*batch"]
    pairs: tuple[ContactPair, ...] = eqx.field(static=True)

    @property
    def num_onsets(self) -> Int[Array, "*batch pairs"]:
        """Beginnings of contact, by pair."""
        return self.is_onset.sum(axis=-2)

    @property
    def num_steps(self) -> Float[Array, "*batch horizon pairs"]:
        """Steps across the rise, width / (speed × time step), of each onset; infinite where there is none."""
        crossed = self.speed * self.timestep[..., None, None]
        width = jnp.broadcast_to(self.width[..., None, :], crossed.shape)
        return jnp.where(self.is_onset & (crossed > 0), width / jnp.where(crossed > 0, crossed, 1.0), jnp.inf)

    @property
    def worst(self) -> Float[Array, "*batch pairs"]:
        """Fewest steps across the rise, by pair; infinite without an onset."""
        return self.num_steps.min(axis=-2, initial=jnp.inf)

    @property
    def is_resolved(self) -> Bool[Array, "*batch pairs"]:
        """Whether all onsets of a pair begin without a jump and take `STEPS_NEEDED` steps; true without an onset."""
        return (self.num_onsets == 0) | ((self.worst >= STEPS_NEEDED) & (self.jump <= LARGEST_JUMP))

    def messages(self) -> list[str]:
        """Say in a sentence for each pair that is not resolved what helps; batches of rollouts are taken together.

        Raises:
            ValueError: if the values are traced.
        """
        if isinstance(self.speed, jax.core.Tracer):
            raise ValueError("messages needs known values, got traced ones; call it outside of jax.jit")
        sentences = []
        for i, pair in enumerate(self.pairs):
            if np.all(self.is_resolved[..., i]):
                continue
            count, speed = int(np.sum(self.num_onsets[..., i])), float(np.max(self.speed[..., i]))
            # In a batch of scenes the sentence is of the pair's worst.
            width, step = float(np.min(self.width[..., i])), float(np.max(self.timestep))
            steps, jump = float(np.min(self.worst[..., i])), float(np.max(self.jump[..., i]))
            reasons = [f"the force begins with a jump, at an impedance of {jump:.3g}"] * (jump > LARGEST_JUMP)
            if steps < STEPS_NEEDED:
                reasons.append(
                    f"its rise over {width:.3g} m is crossed in {steps:.2g} steps of {STEPS_NEEDED:g} needed"
                )
            shorter = f", or a time step of at most {width / (STEPS_NEEDED * speed):.2g} s" * (jump <= LARGEST_JUMP)
            sentences.append(
                f"{count} onset{'s' if count > 1 else ''} of {pair}, at up to {speed:.3g} m/s, "
                f"{'are' if count > 1 else 'is'} not resolved: {' and '.join(reasons)}; take onset=mg.Onset(), or an impedance "
                f"from 0 (at most {LARGEST_JUMP:g}) over a width of at least {STEPS_NEEDED * speed * step:.2g} m{shorter}"
            )
        return sentences


def onset_resolution(scene: Scene, trajectory: Trajectory) -> OnsetResolution:
    """Find where contacts begin along a rollout, and how many steps their force takes to rise.

    Traceable; for a batch of rollouts use `jax.vmap`. Collision is found anew from the positions, so that no rollout need
    have kept it. The speed is that of the step in which a pair comes closer than its margin, along its normal after it.
    In a contact that is active in the first state, no onset is counted.
    """
    distance, speed = jax.vmap(lambda qpos, qvel: _pair_states(scene, qpos, qvel))(trajectory.qpos, trajectory.qvel)
    is_onset = (distance[:-1] >= 0) & (distance[1:] < 0)
    parameters = scene.contact_parameters()
    return OnsetResolution(
        is_onset=is_onset,
        speed=jnp.where(is_onset, jnp.maximum(speed[1:], 0.0), 0.0),
        width=parameters.width,
        jump=parameters.impedance[:, 0],
        timestep=parameters.timestep,
        pairs=scene.pairs,
    )


def _pair_states(
    scene: Scene, qpos: Float[Array, " nq"], qvel: Float[Array, " nv"]
) -> tuple[Float[Array, " pairs"], Float[Array, " pairs"]]:
    """Give of every pair the distance less the margin, and the speed of approach where it is least."""
    model = scene.model
    if not scene.pairs:
        return jnp.zeros(0, qpos.dtype), jnp.zeros(0, qpos.dtype)
    data = scene.data.replace(qpos=qpos, qvel=qvel)
    data = collide(model, mjx.com_pos(model, mjx.kinematics(model, data)))
    contact = data._impl.contact
    bodies = jnp.asarray(model.geom_bodyid)[contact.geom]
    normals = contact_jacobian(model, data, contact.pos, contact.frame, bodies, dim=1)[:, 0]
    residual = contact.dist - contact.includemargin
    wanted = jnp.array([[pair.geom1, pair.geom2] for pair in scene.pairs])[:, None]
    geoms = jnp.asarray(contact.geom)
    is_of = jnp.all(wanted == geoms, axis=-1) | jnp.all(wanted == geoms[:, ::-1], axis=-1)
    # A slot without a contact has a distance of MJX's own choice, beyond every margin.
    distances = jnp.where(is_of, residual, jnp.inf)
    return distances.min(axis=1), -(normals @ qvel)[distances.argmin(axis=1)]
