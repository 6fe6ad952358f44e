"""From the name of a method to something that runs."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import optax
from jaxtyping import Array, Key

import mjxgrad as mg
from experiments.optimisation.published import TASKS, Published
from experiments.optimisation.settings import MethodSettings, Settings
from mjxgrad.diagnostics import Rollouts
from mjxgrad.diagnostics.comparison import affordable
from mjxgrad.estimators import GradientEstimate, rules

Run = Callable[..., mg.Optimisation]

_SCENES = {
    "push_soft": lambda: mg.tasks.push(10.0),
    "push_stiff": lambda: mg.tasks.push(1000.0),
    "friction": lambda: mg.tasks.friction(),
    "motion_planning": lambda: mg.tasks.motion_planning(),
    "tennis": lambda: mg.tasks.tennis(),
}
_ELITE = 0.2  # share of the candidates that cross-entropy fits to
# How to optimise the scenes; found by trying, so that few steps show what each is about.
_PUSH = {"num_samples": 10, "learning_rate": 1e-3, "num_steps": 200, "gamma": 1e8, "bound": 100.0}
_SCENE_SETTINGS = {
    "push_soft": _PUSH,
    "push_stiff": _PUSH,
    "friction": {"num_samples": 10, "learning_rate": 1e-4, "num_steps": 100, "gamma": 2e4, "bound": 100.0},
    "motion_planning": {"num_samples": 50, "learning_rate": 0.03, "num_steps": 100, "gamma": 150.0, "bound": 10.0},
    "tennis": {
        "num_samples": 100, "learning_rate": 1e-6, "num_steps": 60, "gamma": 1000.0, "bound": 1000.0, "num_starts": 500
    },
}  # fmt: skip


def problem(settings: Settings) -> Published:
    """Set up the task, with the run's own settings in place of the published ones, which alone have reference results."""
    if settings.dynamics == "published":
        found = TASKS[settings.task]()
    else:
        task, name = _SCENES[settings.task](), settings.task
        found = Published(
            name=name.split("_")[0] if name.startswith("push") else name,
            objective=task.objective(),
            params=task.initial_params(),
            reference={},
            **_SCENE_SETTINGS[name],
        )
    chosen = settings.model_dump(include={"num_steps", "num_samples", "learning_rate"}, exclude_none=True)
    return dataclasses.replace(found, **chosen, reference={}) if chosen else found


def scene(settings: Settings) -> mg.Scene | None:
    """Give the scene of the task; None under the published equations, which have none."""
    return None if settings.dynamics == "published" else _SCENES[settings.task]().scene


def estimator(method: MethodSettings, task: Published) -> Callable[..., GradientEstimate]:
    """Give a function of `mjxgrad.estimators`, its options bound; its rule may take the published constants of the task."""
    options = method.options
    if method.rule is not None:
        options["rule"] = {
            "consistent": rules.Consistent,
            "inverse_variance": rules.InverseVariance,
            "concavity": rules.Concavity,
            "bias_constrained": lambda: rules.BiasConstrained(task.gamma, task.bound),
        }[method.rule]()
    return functools.partial(getattr(mg.estimators, method.name), **options)


def runner(method: MethodSettings, task: Published, key: Key[Array, ""]) -> Run:
    """Give the function that runs a method, of keys, one per seed, and of the options of `mg.optimise`.

    A baseline without noise is a rollout, too: an estimator gets as many samples as the rollouts of a step allow.
    """
    if method.is_search:
        return _search(method, task)
    function = estimator(method, task)
    afforded = affordable(function, task.objective, task.params, key, Rollouts(task.num_samples)).num_samples

    def run(keys: Key[Array, " seeds"], **options: Any) -> mg.Optimisation:
        return mg.optimise(
            task.objective,
            task.params,
            keys,
            estimator=functools.partial(function, num_samples=afforded),
            # The schedules of tasks are optax's, but for the arrays that optax allows and they do not need.
            optimiser=optax.sgd(task.learning_rate),  # pyright: ignore[reportArgumentType]
            num_steps=task.num_steps,
            **options,
        )

    return run


def _search(method: MethodSettings, task: Published) -> Run:
    objective, width = task.objective, method.stddev
    if width is None and isinstance(objective, mg.objective.OpenLoop):
        # The controls are the parameters, so noise on the ones is noise on the others.
        width = jax.numpy.broadcast_to(objective.stddev, objective.noise_shape).ravel()
    own = {"num_elite": max(2, round(_ELITE * task.num_samples))} if method.name == "cross_entropy" else {}
    search = getattr(mg.baselines, method.name)
    sizes = {"num_samples": task.num_samples, "num_steps": task.num_steps}
    return functools.partial(search, objective, task.params, stddev=width, **sizes, **own)
