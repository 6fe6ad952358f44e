r"""Policies learned from short windows: SHAC, its α-order form, and the likelihood ratio, in one loop.

An update runs one window in every environment (see `window`) and moves the policy along a mixture of both gradients (see
`mixing`). It then fits the value function to TD($\lambda$) targets. The methods differ only in the weight of first order:

| `alpha` | method |
|---|---|
| 1 | first order: SHAC, with the blended adjoint of `window` |
| 0 | zeroth order: REINFORCE with a value function |
| None | both, with the least error: α-order, the default |

Without a value function (`has_critic=False, trace=1.0`) first order is analytic policy gradients (APG).

References:
    Xu, Makoviychuk, Narang, Ramos, Matusik, Garg, Macklin. Accelerated Policy Learning with Parallel Differentiable Simulation.
    ICLR 2022, arXiv:2204.07137 (SHAC).
"""

import warnings
from collections.abc import Sequence
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, UInt32

from mjxgrad._arrays import instance, is_known, whole
from mjxgrad._text import Printed, format_range
from mjxgrad.batched.device import fits
from mjxgrad.envs import Environment
from mjxgrad.learning.learner import ActorCritic, Learner, Policy
from mjxgrad.learning.settings import Settings
from mjxgrad.loop.run import Log, run, side_by_side


class Learned(eqx.Module, Printed):
    """The result of `learn`.

    Attributes:
        policy: the learned policy.
        history: one number per update for each name; see `learn`.
        learner: the state of the learner after the last update.
    """

    policy: Policy
    history: dict[str, Float[Array, "updates *policies"]]
    learner: Learner

    def __str__(self) -> str:
        reward, agreement = (np.asarray(self.history[name]) for name in ("reward", "agreement"))
        late = slice(-max(1, len(reward) // 10), None)
        mean = reward[late].mean(axis=0)
        rewards = format_range((float(mean.min()), float(mean.max())), " to ")
        agreed = f"halves of the environments agree to {np.nanmean(agreement[late]):.2f}"
        seconds = np.asarray(self.history["seconds"]).reshape(len(reward), -1)[:, 0].sum()
        return f"Reward {rewards} a step in the last of {len(reward)} updates, {seconds:.3g} s; {agreed}."

    def __repr__(self) -> str:
        is_told = all(is_known(one) and one.ndim for one in self.history.values())
        return f"Learned({self} {self.policy})" if is_told and self.history else super().__repr__()


def learn(
    environment: Environment | Sequence[Environment],
    key: Key[Array, "*seeds"] | UInt32[Array, "*seeds 2"],
    *,
    num_updates: int,
    settings: Settings | None = None,
    log: Log | None = None,
    log_every: int = 10,
    checkpoint: str | Path | None = None,
    progress: bool = True,
) -> Learned:
    """Learn a policy; Ctrl-C returns what was learnt in the updates done.

    The history has one number per update for each of these names:

    - `reward`, mean per step; `return`, mean over the episodes that ended, NaN without any;
    - `alpha`, weight of first order; `gradient_norm`, norm of the gradient by the parameters;
    - `agreement`, cosine between the gradients of two halves of the environments: near 0 they are noise;
    - `cosine`, between the means of both gradients, of the last fifty updates: far below 1 derivatives are biased;
    - `first_variance` and `zeroth_variance`, of both gradients by the parameters, from the two halves;
    - `ended`, share of windows in which an episode ended for good: no derivative passes such an end;
    - `not_finite`, share of first-order gradients that were not finite; `shortened`, share of those that were too large, see
      `Settings.largest_sample`; `diverged`, number of steps without a meaningful next state;
      `skipped`, 1 if the mixture was not finite and the policy was not changed;
    - `change`, relative entropy in nats of the policy's noisy actions by which an update would have changed them, in the mean;
      see `Settings.largest_change`;
    - `critic_loss`, loss of the value function;
    - `seconds`, wall-clock time of an update of all policies, without compilation.

    Args:
        environment: the environment to learn in, or several that differ only in numbers, such as the stiffness of contact.
            Several learn side by side from the same keys, and the result gets a first axis for them.
        key: consumed here; an array of keys learns one policy per key side by side, and the result gets an axis for them.
        num_updates: total number of updates, those before a checkpoint included. A run may go on with more; rates then fall to
            zero at the new number.
        settings: settings of the learner; None takes the defaults.
        log: function called after every `log_every` updates with their means, such as
            `lambda update, metrics: wandb.log(metrics, step=update)`.
        log_every: updates between two logs or checkpoints.
        checkpoint: file to resume from if it exists, written after every `log_every` updates. Settings, key and environment
            (numbers and code) must be the same. The result is that of an uninterrupted run to the bit, except for `seconds`.
        progress: whether a run of more than ten seconds tells on stderr what it will take, and how far it is.

    Raises:
        ValueError: if a number is below 1, environments differ in more than numbers, or the checkpoint is from another run.
    """
    settings = Settings() if settings is None else settings
    instance("settings", settings, Settings, "of mg.learning.Settings")
    instance("key", key, jax.Array, "of jax.random.key")
    num_updates, log_every = whole("num_updates", num_updates), whole("log_every", log_every)
    if not jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        if key.dtype != jnp.uint32 or key.shape[-1:] != (2,):
            raise ValueError(f"key must be of jax.random.key, got {key.dtype} of shape {key.shape}")
        key = jax.random.wrap_key_data(key)
    environments = [environment] if not isinstance(environment, Sequence) else list(environment)
    if not environments or not all(isinstance(one, Environment) for one in environments):
        raise ValueError(f"environment must be one mg.envs.Environment or several, got {environment!r:.80}")
    counted = settings.counted(float(environments[0].interval))
    method, axes = side_by_side([ActorCritic(one, counted, num_updates) for one in environments])
    shape, over = key.shape, [None] * key.ndim
    if not isinstance(environment, Environment):
        shape, over = (len(environments), *shape), [axes, *over]
    each = counted.window * (environments[0].num_actions + environments[0].scene.model.nv)
    remedy = "fewer num_environments, or a shorter window"
    fits(f"{settings.num_environments} environments", 4.0 * settings.num_environments * each, remedy)
    where = {"log": log, "checkpoint": checkpoint, "progress": progress, "what": ("learn", "update")}
    how = {"num_steps": num_updates, "segment": log_every, "over": over, "on_all_devices": True, **where}
    done = run(method, jnp.broadcast_to(key, shape), **how)
    seconds = np.broadcast_to(done.seconds.reshape(-1, *(1 for _ in shape)), (len(done.seconds), *shape))
    if done.found["skipped"][-log_every:].all():
        warnings.warn(
            f"nothing was learnt: no gradient of the last {log_every} updates was finite, and their mean reward is "
            f"{done.found['reward'][-1].mean():.3g}; look for roots and divisions in rewards and observe",
            stacklevel=2,
        )
    history = {name: jnp.asarray(values) for name, values in (done.found | {"seconds": seconds}).items()}
    return Learned(done.carry.policy, history, done.carry)
