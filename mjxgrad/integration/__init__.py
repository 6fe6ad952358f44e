"""Other ways to step a scene than at equal intervals: what the event correction leaves over, and references.

The event-corrected derivative (`gradient="event"`) is right on average over the phase, the place within a time step at which
a contact begins. What remains is its spread over phases, and the discretisation error of the motion itself. Measured on
bounces and a thrown box (`make cube_toss`), in the order of what to try first:

1. a smaller time step with `gradient="event"`: error and spread fall together with it, and it works under `jax.vmap`;
2. `phase_average`: the mean over N phases of the step. It removes most of the spread at N times the price; it is what to use
   where the step is given, or under noise, where samples may differ in phase for nothing. Without the correction the mean
   stays wrong;
3. `substepped_rollout`: fine steps only where a contact begins or ends. For single rollouts only: under `jax.vmap` all
   members pay for the fine steps all the time, and then fine steps everywhere are better;
4. `adaptive_rollout`: diffrax with error control. A reference for the motion, to any accuracy. Its own derivative misses
   events just as the discrete one does, however small the tolerance, unless forces begin continuously: take differences.
"""

from mjxgrad.integration.adaptive import AdaptiveTrajectory, adaptive_rollout
from mjxgrad.integration.phase import phase_average, shifted_rollout
from mjxgrad.integration.substeps import substepped_rollout, substepped_step

__all__ = [
    "AdaptiveTrajectory",
    "adaptive_rollout",
    "phase_average",
    "shifted_rollout",
    "substepped_rollout",
    "substepped_step",
]
