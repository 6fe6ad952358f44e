"""Other ways to step a scene than at equal intervals, against the discretisation error of the motion.

- `substepped_rollout`: fine steps only where a contact begins or ends. For single rollouts: under `jax.vmap` all members pay
  for the fine steps all the time.
- `adaptive_rollout`: diffrax with error control. For the motion of a single throw at an accuracy of 1e-6 it is the cheapest.
  Its own derivative misses events as the discrete one does, unless forces begin continuously: take differences.

`make cube_toss` measures error against processor time.
"""

from mjxgrad.integration.adaptive import AdaptiveTrajectory, adaptive_rollout
from mjxgrad.integration.substeps import substepped_rollout, substepped_step

__all__ = [
    "AdaptiveTrajectory",
    "adaptive_rollout",
    "substepped_rollout",
    "substepped_step",
]
