"""Policies through contact: which gradient learns soonest, how good it is meanwhile, and what it is worth in C MuJoCo."""

import itertools
import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydantic import Field, model_validator
from scipy.stats import mannwhitneyu

import mjxgrad as mg
from experiments import ppo
from experiments.problems.gymnasium_v5 import gymnasium_returns
from experiments.problems.humanoid import pushed_humanoid
from experiments.problems.pusher import pusher
from experiments.problems.quadruped import go1_joystick, quadruped
from experiments.problems.tracking import tracking
from experiments.problems.trot import apg, trot
from experiments.report import MOST_WORDS, Table
from experiments.settings import Positive, SettingsTable, SizedSettings, VideoSettings
from experiments.theme import FIRST, ONSET, ZEROTH, Drawings, legend_below, plain, subplots
from experiments.video import film, shown_speed, with_coarse_shadows
from experiments.words import capitalised, counted, joined, named, quantity
from experiments.workspace import Workspace
from mjxgrad import envs, learning
from mjxgrad.envs import Environment
from mjxgrad.stepping import EngineName

Method = Literal["onset", "discrete", "slope", "bundled", "alpha", "zeroth", "ppo"]
NAMES = {
    "onset": "first order with an onset",
    "discrete": "first order",
    "slope": "first order by the slope",
    "bundled": "first order, bundled",
    "alpha": "α-order",
    "zeroth": "zeroth order",
    "ppo": "PPO",
}
_COLOURS = dict(zip(NAMES, (FIRST, "#8c6d31", "#56b4e9", "#cc79a7", ONSET, ZEROTH, "#777777"), strict=True))
Name = Literal[
    "cartpole", "hopper", "half_cheetah", "ant", "humanoid", "pusher", "quadruped", "go1", "trot", "pushed_humanoid",
    "tracking", "hopper_v5", "walker2d_v5", "half_cheetah_v5", "ant_v5", "humanoid_v5",
]  # fmt: skip
_OURS: dict[str, Callable[..., Environment]] = {
    "pusher": pusher, "quadruped": quadruped, "go1": go1_joystick, "trot": trot, "pushed_humanoid": pushed_humanoid,
    "tracking": tracking,
    **{name: envs.ENVIRONMENTS[name.removesuffix("_v5")] for name in get_args(Name) if name.endswith("_v5")},
}  # fmt: skip
_LOADERS = {name: _OURS.get(name) or getattr(envs.diffrl, name) for name in get_args(Name)}
_OWN_STEPS = ("cartpole", *_OURS)  # whose time steps are their own
_COMMANDED = ("quadruped", "go1")
_SHOWN = 8.0  # s of an episode
_LOADED = 400 / (35 * 9.81)  # weights of a robot above which BCG bundles: 400 N of a humanoid of 35 kg
_FINER = 8  # times, by which time steps are shorter where a policy is judged a second time


class Sizes(SettingsTable):
    """How much is spent."""

    num_seeds: Annotated[int, Field(ge=1)]  # policies per method, learned side by side
    num_updates: Annotated[int, Field(ge=2)]  # of each policy
    num_environments: Annotated[int, Field(ge=2)] = 64  # of each policy
    num_episodes: Annotated[int, Field(ge=1)] = 16  # of each policy in C MuJoCo, by which it is judged
    # Factor of the steps that PPO takes: three times as many last about as long as those of the others.
    ppo_steps: Positive = 1.0


class Settings(SizedSettings):
    """Policies learned by several gradients from the same starts, and judged in C MuJoCo."""

    # What is learned: DiffRL's tasks, a pusher, a quadruped or Go1 that follows commands, MuJoCo's trot, a humanoid that is
    # pushed or tracks motions, or gymnasium's robots, in which policies are then judged, too.
    environment: Name
    engine: EngineName = "mjx"  # who steps while learning
    # SHAC, or analytic policy gradients as in brax: no value function, other networks and rates.
    algorithm: Literal["shac", "apg"] = "shac"
    methods: Annotated[tuple[Method, ...], Field(min_length=1)]  # which gradients learn; PPO is brax's
    # By which contact is stiffer than in the scene.
    stiffness: Annotated[tuple[Positive, ...], Field(min_length=1)] = (1.0,)
    # Time steps per action of 1/60 s; stiffer contact needs more. Cart-pole, pusher, quadruped and trot have their own.
    num_substeps: Annotated[int, Field(ge=1)] | None = None
    window: Annotated[int, Field(ge=1)] | None = None  # steps of each environment per update; if left out, 0.27 s
    actor_rate: Positive | None = None  # learning rate of the policy; if left out, the algorithm's
    # Standard deviations of the noise on actions at the beginning and at the end; if left out, the algorithm's.
    stddev: tuple[Positive, Positive] | None = None
    # λ of the returns that a policy climbs; below 1 derivatives reach less far. If left out, a third within 0.17 s.
    trace: Annotated[float, Field(ge=0, le=1)] | None = None
    # Per action; if left out, 0.55 per second.
    discount: Annotated[float, Field(ge=0, le=1)] | None = None
    # Longer first-order gradients are shortened to it; in units of zeroth-order noise.
    largest_sample: Positive = learning.Settings.largest_sample
    sizes: Sizes
    video: VideoSettings | None = None  # of the best policy

    @model_validator(mode="after")
    def _check(self) -> "Settings":
        if self.num_substeps is not None and self.environment in _OWN_STEPS:
            raise ValueError(f"num_substeps must be left out for the {self.environment}, whose time step is its own")
        return self

    def counted(self, environment: Environment) -> "Settings":
        """Return these settings with what is left out counted in actions."""
        how = learning.Settings(num_environments=self.sizes.num_environments, window=self.window, trace=self.trace)
        how = how.counted(float(environment.interval))
        return self.model_copy(update={"window": how.window, "trace": how.trace})

    @property
    def is_gymnasiums(self) -> bool:
        """Whether the robot is one of gymnasium's as it is there, so that a policy can be judged in that."""
        return self.environment.endswith("_v5") and self.stiffness == (1.0,)

    @property
    def num_steps(self) -> int:
        """Steps that a policy learns from in one update, once they are `counted`."""
        return self.sizes.num_environments * (self.window or 1)

    def steps_of(self, method: Method) -> float:
        """Return the steps that a method takes for an update of the others."""
        return self.num_steps * (self.sizes.ppo_steps if method == "ppo" else 1.0)


History = dict[str, Float[np.ndarray, "updates seeds"]]


@dataclass(frozen=True)
class Course:
    """What one method did at one stiffness, for all seeds."""

    method: Method
    stiffness: float
    history: History
    returns: Float[np.ndarray, "seeds episodes"]  # in C MuJoCo
    finer: Float[
        np.ndarray, "seeds episodes"
    ]  # the same, in time steps that are eight times shorter, or in gymnasium itself
    terms: dict[str, Float[np.ndarray, "seeds episodes"]]  # of the reward, means per step there
    qpos: Float[np.ndarray, "states nq"]  # of the best policy's first episode
    num_states: int  # of it

    @property
    def seconds(self) -> float:
        """Of an update of all that learned side by side, without compilation: the median, for a machine may be busy at times."""
        return float(np.median(self.history["seconds"]))

    @property
    def judged(self) -> Float[np.ndarray, " seeds"]:
        """Mean return of each policy in C MuJoCo."""
        return self.returns.mean(axis=1)

    @property
    def reward(self) -> Float[np.ndarray, "updates seeds"]:
        """Mean reward per step while learning, over ten updates."""
        return _smooth(self.history["reward"])


@dataclass(frozen=True)
class Outcome:
    """All courses."""

    settings: Settings
    courses: list[Course]
    environment: Environment

    def rows(self) -> list[dict[str, Any]]:
        """One row per course, seed and update, for metrics.csv."""
        return [
            {"method": course.method, "stiffness": course.stiffness, "seed": seed, "update": update + 1}
            | {name: float(values[update, seed]) for name, values in course.history.items()}
            for course in self.courses
            for seed, update in itertools.product(
                range(self.settings.sizes.num_seeds), range(0, self.settings.sizes.num_updates, _every(self.settings))
            )
        ]

    @property
    def best(self) -> Course:
        """The course whose policies are best in C MuJoCo, among those with contact as it comes if there are any."""
        plain = [course for course in self.courses if course.stiffness == self.settings.stiffness[0]]
        return max(plain, key=lambda course: course.judged.mean())

    @property
    def runner_up(self) -> tuple[Course, float]:
        """The next best after the best, itself if there is no other, and the p-value of the rank test between the two."""
        best = self.best
        others = [one for one in self.courses if one.stiffness == best.stiffness and one is not best]
        second = max(others, key=lambda course: course.judged.mean(), default=best)
        return second, float(mannwhitneyu(best.judged, second.judged).pvalue)

    @property
    def soonest(self) -> list[Course]:
        """The courses, of contact as it comes, that first are half of the way from the lowest reward to the highest, for good."""
        plain = [course for course in self.courses if course.stiffness == self.settings.stiffness[0]]
        curves = np.stack([course.reward.mean(axis=1) for course in plain])
        is_there = curves >= (np.nanmin(curves) + np.nanmax(curves)) / 2
        # A reward that falls again has not been learned.
        stays = np.logical_and.accumulate(is_there[:, ::-1], axis=1)[:, ::-1]
        first = stays.any(axis=0).argmax()
        return [course for course, there in zip(plain, stays[:, first], strict=True) if there]


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Learn by every method at every stiffness."""
    if "ppo" in settings.methods:
        ppo.load()  # or say at once that it is not there
    given: dict[str, Any] = {} if settings.num_substeps is None else {"num_substeps": settings.num_substeps}
    if settings.environment in ("pushed_humanoid", "tracking"):  # whose file MJX would convert
        given["engine"] = settings.engine
    environment = _LOADERS[settings.environment](**given).with_engine(settings.engine)
    settings = settings.counted(environment)
    workspace.check(environment.scene)
    courses, each = [], settings.sizes.num_updates
    with workspace.stage("learning", "updates", len(settings.methods) * each) as advance_to:
        for number, method in enumerate(settings.methods):
            courses += _courses(settings, workspace, environment, method, lambda n, b=number * each: advance_to(b + n))
    return Outcome(settings, courses, environment)


def _courses(
    settings: Settings,
    workspace: Workspace,
    environment: Environment,
    method: Method,
    advance_to: Callable[[int], None],
) -> list[Course]:
    """Learn by one method: at every stiffness side by side, in one program, but for PPO."""
    factors, num_updates = settings.stiffness, settings.sizes.num_updates
    environments = [environment if k == 1 else environment.with_softness(stiffer(environment, k)) for k in factors]
    if method == "ppo":
        learned = [
            _by_ppo(settings, one, lambda done, i=i: advance_to((i * num_updates + done) // len(factors)))
            for i, one in enumerate(environments)
        ]
    else:
        found = learning.learn(
            [_stepped(one, method) for one in environments],
            jax.random.split(jax.random.key(settings.seed), settings.sizes.num_seeds),
            num_updates=num_updates,
            settings=_how(settings, method, environment),
            log=lambda done, _: advance_to(done),
            log_every=_every(settings),
            checkpoint=workspace.keep(method),
        )
        policies = [jax.tree.map(lambda x, i=i: x[i], found.policy) for i in range(len(factors))]
        histories = [{k: np.asarray(x)[:, i] for k, x in found.history.items()} for i in range(len(factors))]
        learned = [(one, operator.call, history) for one, history in zip(policies, histories, strict=True)]
    return [
        _judged_course(settings, one, method, k, *each)
        for one, k, each in zip(environments, factors, learned, strict=True)
    ]


def _by_ppo(
    settings: Settings, environment: Environment, advance_to: Callable[[int], None]
) -> tuple[Any, ppo.Act, History]:
    """Learn by PPO, a policy after the other; what it does not measure is NaN."""
    num_seeds, num_updates = settings.sizes.num_seeds, settings.sizes.num_updates
    learned, acts, rewards, seconds, each = [], [], [], 0.0, settings.steps_of("ppo")
    for seed in range(num_seeds):
        params, act, course = ppo.learn_ppo(
            settings.environment,
            environment,
            settings.seed + seed,
            num_steps=round(num_updates * each),
            report=lambda steps, s=seed: advance_to(int(s * num_updates + steps / each) // num_seeds),
        )
        learned.append(params)
        acts.append(act)
        seconds += course["seconds"][-1]
        rewards.append(np.interp(each * np.arange(1, num_updates + 1), course["steps"], course["reward"]))
    reward = np.stack(rewards, axis=1)
    history = {"reward": reward, "seconds": np.full_like(reward, seconds / num_updates)}
    history |= dict.fromkeys(("not_finite", "skipped", "diverged", "shortened"), np.zeros_like(reward))
    unknown = ("alpha", "agreement", "first_variance", "zeroth_variance")
    history |= dict.fromkeys(unknown, np.full_like(reward, np.nan))
    return jax.tree.map(lambda *x: jnp.stack(x), *learned), acts[0], history


def _judged_course(
    settings: Settings,
    environment: Environment,
    method: Method,
    stiffness: float,
    learned: Any,
    act: Callable[[Any, Any], Any],
    history: History,
) -> Course:
    """Judge what was learned, with an axis for seeds, in C MuJoCo."""
    num_episodes = settings.sizes.num_episodes

    def judge(times: int) -> Any:
        judged, key = environment.refined(times), jax.random.key(settings.seed + 1)

        def one(learned: Any) -> learning.Evaluation:
            return learning.evaluate(judged, lambda obs: act(learned, obs), key, num_episodes=num_episodes)

        return jax.tree.map(np.asarray, jax.vmap(one)(learned))

    def again() -> Float[np.ndarray, "seeds episodes"]:
        if not settings.is_gymnasiums:
            return judge(_FINER).returns
        policies = [jax.tree.map(lambda x, i=i: x[i], learned) for i in range(settings.sizes.num_seeds)]
        name = settings.environment.removesuffix("_v5")
        run = lambda one: gymnasium_returns(name, lambda obs: act(one, obs), num_episodes=num_episodes)  # noqa: E731
        return np.stack([run(one) for one in policies])

    found = judge(1)
    best = int(found.returns.mean(axis=1).argmax())
    return Course(
        method=method,
        stiffness=stiffness,
        history=history,
        returns=found.returns,
        finer=again(),
        terms=found.terms,
        qpos=found.qpos[best, 0],
        num_states=int(found.lengths[best, 0]) + 1,
    )


def _how(settings: Settings, method: Method, environment: Environment) -> learning.Settings:
    own = {"actor_rate": settings.actor_rate, "stddev": settings.stddev, "discount": settings.discount}
    changes: dict[str, Any] = {name: value for name, value in own.items() if value is not None}
    count = settings.sizes.num_environments
    if method == "bundled":
        weight = 9.81 * float(environment.scene.model.body_mass.sum())
        changes["bundle"] = bundle = learning.Bundle(force=_LOADED * weight)
        count = max(2, count // bundle.num_branches)  # as many derivatives as the others take
    wide = learning.Settings.for_gpu if count >= 1024 else learning.Settings
    return (apg if settings.algorithm == "apg" else wide)(
        num_environments=count,
        window=settings.window,
        trace=settings.trace,
        largest_sample=settings.largest_sample,
        alpha={"alpha": None, "zeroth": 0.0}.get(method, 1.0),
        **changes,
    )


def _every(settings: Settings) -> int:
    """Updates in one program: twenty of them in a run, so that its course is seen, and few enough to lose little."""
    return max(1, settings.sizes.num_updates // 20)


def _stepped(environment: Environment, method: Method) -> Environment:
    """Return the environment whose motion and derivative are the method's: MuJoCo's, but for those named after another."""
    return environment.with_contact({"onset": mg.Onset(), "slope": mg.Slope()}.get(method, mg.Discrete()))


def stiffer(environment: Environment, factor: float) -> mg.Softness:
    """Return contact that is stiffer, with the same damping ratio."""
    parameters = environment.scene.contact_parameters()
    return mg.Softness(
        stiffness=factor * float(np.median(parameters.stiffness)),
        damping_ratio=float(np.median(parameters.damping_ratio)),
    )


def _smooth(values: Float[np.ndarray, "updates seeds"]) -> Float[np.ndarray, "updates seeds"]:
    width = min(10, len(values))
    sums = np.cumsum(np.concatenate([np.zeros((1, values.shape[1])), values]), axis=0)
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(ends - width, 0)
    return (sums[ends] - sums[starts]) / (ends - starts)[:, None]


def answer(outcome: Outcome) -> str:
    """Name the gradients that learn soonest and whose policies are worth most, or what stiff contact leaves of them."""
    soft, stiff = outcome.settings.stiffness[0], outcome.settings.stiffness[-1]
    if soft != stiff:
        worth = {(course.method, course.stiffness): course.judged.mean() for course in outcome.courses}
        methods = outcome.settings.methods
        kept = [NAMES[method] for method in methods if worth[method, stiff] >= worth[method, soft] / 2]
        earn = "still earn" + "s" * (len(kept) == 1)
        return f"With contact {stiff:g} times as stiff, {named(kept, len(methods), words=5)} {earn} half."
    best = outcome.best
    if outcome.settings.environment in _COMMANDED:
        speed, turning = (quantity(off.mean()) for off in _off_command(best))
        return f"{capitalised(NAMES[best.method])} is off its command by {speed} m/s and {turning} rad/s."
    worth, num_updates = quantity(best.judged.mean()), outcome.settings.sizes.num_updates
    if outcome.settings.environment == "trot" or len(outcome.courses) == 1:
        spent = f"{quantity(num_updates * outcome.settings.num_steps)} steps, {quantity(num_updates * best.seconds)} s"
        return f"After {spent}, {NAMES[best.method]} returns {worth} in C MuJoCo."
    soonest = [NAMES[course.method] for course in outcome.soonest] or ["none"]
    kind = "Soonest and worth most" if soonest == [NAMES[best.method]] else f"Soonest: {joined(soonest)}; worth most"
    told = f"{kind}: {NAMES[best.method]}, {worth}"
    second, p_value = outcome.runner_up
    if p_value <= 0.05:
        return f"{told}."
    count = counted(best.judged.size, "seed", "seeds")
    doubt = f"{told}; {count} cannot tell it from {NAMES[second.method]}."
    return doubt if len(doubt.split()) <= MOST_WORDS else f"{told} (unproven)."


def verdict(outcome: Outcome) -> str:
    """Say which gradient is worth most in C MuJoCo, and how far the next one is."""
    settings, best = outcome.settings, outcome.best
    shown = [course for course in outcome.courses if course.stiffness == settings.stiffness[0]]
    others = sorted((course for course in shown if course is not best), key=lambda course: -course.judged.mean())
    steps = f"{settings.sizes.num_updates * settings.num_steps:,}".replace(",", " ")
    text = f"After {steps} steps {NAMES[best.method]} returns {_judged(best)} in C MuJoCo"
    if others:
        text += "; " + joined(f"{NAMES[course.method]} {_judged(course)}" for course in others)
    return text + "."


def findings(outcome: Outcome) -> list[str]:
    """Say how good the gradients were, and what was left out."""
    sentences = []
    shares = [(course, float(course.history["shortened"].mean())) for course in outcome.courses]
    if each := [f"{100 * share:.2g}% ({_label(c, outcome)})" for c, share in shares if share and c.method != "zeroth"]:
        sentences.append(
            f"Derivatives longer than {outcome.settings.largest_sample:g} times zeroth-order noise were shortened to that: "
            f"{joined(each)}."
        )
    lost = []
    for course in outcome.courses:
        share = float(course.history["not_finite"].mean())
        skipped, diverged = int(course.history["skipped"].sum()), int(course.history["diverged"].sum())
        if share or skipped or diverged:
            lost.append(
                f"{capitalised(_label(course, outcome))}: {100 * share:.2g}% of the derivatives were no numbers, {diverged} "
                f"steps diverged, {skipped} updates were skipped."
            )
    sentences += lost or ["Every derivative was a number, no step diverged, and no update was skipped."]
    agreements = [
        (course, float(np.nanmean(course.history["agreement"]))) for course in outcome.courses if course.method != "ppo"
    ]
    if each := [f"{cosine:.2f} ({_label(course, outcome)})" for course, cosine in agreements]:
        sentences.append(
            f"Gradients of two halves of the environments agree by a cosine of {joined(each)}; where it is near 0, take more."
        )
    if outcome.settings.environment in _COMMANDED:
        each = []
        for course in outcome.courses:
            speed, turning = (quantity(off.mean(), _spread(off)) for off in _off_command(course))
            each.append(f"{_label(course, outcome)} {speed} m/s and {turning} rad/s")
        sentences.append(f"Off the command, root mean squares in C MuJoCo, pushes included: {'; '.join(each)}.")
    return sentences


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate every course."""
    rows = [
        [
            _label(course, outcome),
            _judged(course),
            quantity(float(course.finer.mean()), _spread(course.finer.mean(axis=1))),
            quantity(float(course.reward[-1].mean()), _spread(course.reward[-1])),
            *_of_gradients(course),
            quantity(course.seconds * outcome.settings.sizes.num_updates),
        ]
        for course in outcome.courses
    ]
    finer = "in gymnasium's own" if outcome.settings.is_gymnasiums else f"in {_FINER} times shorter steps"
    heads = ("gradient", "return in C MuJoCo", finer, "reward per step", "α", "variance, zeroth over first", "seconds")
    caption = (
        "Mean over seeds with their standard deviation. Reward per step: while learning, of the last updates. α: weight of the "
        "first order. Seconds: of all seeds together, without compilation"
        + ("." if len(outcome.settings.stiffness) == 1 else "; but for PPO of all stiffnesses, too.")
    )
    return [Table(heads, rows, caption)]


def _of_gradients(course: Course) -> tuple[str, str]:
    """Return α and the ratio of variances, dashes for PPO."""
    if course.method == "ppo":
        return "–", "–"
    ratio = np.median(course.history["zeroth_variance"] / course.history["first_variance"])
    return quantity(float(course.history["alpha"].mean())), quantity(float(ratio))


def drawings(outcome: Outcome) -> Drawings:
    """Draw the figures in order of reading."""
    found: dict[str, Any] = {"course": course_of_learning(outcome)}
    if len(outcome.settings.stiffness) > 1:
        found["stiffness"] = by_stiffness(outcome)
    if any(course.method != "ppo" for course in outcome.courses):
        found["variance"] = quality(outcome)
    return found


def course_of_learning(outcome: Outcome):
    """Reward against steps and against seconds, a line per method, thin ones per seed."""
    settings = outcome.settings
    shown = [course for course in outcome.courses if course.stiffness == settings.stiffness[0]]
    figure, axes = subplots(1, 2, height=3.8, sharey=True)
    updates = np.arange(1, settings.sizes.num_updates + 1)
    for course in shown:
        look, label = {"color": _COLOURS[course.method]}, NAMES[course.method]
        scales = (settings.steps_of(course.method), course.seconds)
        for axis, scale in zip(axes[0], scales, strict=True):
            axis.plot(scale * updates, course.reward, lw=0.6, alpha=0.4, **look)
            axis.plot(scale * updates, course.reward.mean(axis=1), lw=2, label=label, **look)
    axes[0, 0].set(title="By steps", xlabel="steps of each policy", ylabel="reward per step")
    policies = counted(settings.sizes.num_seeds * len(settings.stiffness), "policy", "policies")
    axes[0, 1].set(title="By time", xlabel=f"seconds for {policies}, without compilation")
    for axis in axes[0]:
        plain(axis.yaxis)
        axis.xaxis.set_major_formatter(lambda value, _: f"{value:g}" if value < 1e4 else f"{value / 1e6:g} M")
    # The first updates of a fall would hide all that follows.
    ends = np.concatenate([course.reward[len(updates) // 20 :].ravel() for course in shown])
    axes[0, 0].set_ylim(np.quantile(ends, 0.01) - 0.1 * np.ptp(ends), ends.max() + 0.05 * np.ptp(ends))
    legend_below(figure, axes[0, 0], 3)
    caption = (
        f"Mean reward per step over ten updates; thin, each of {counted(settings.sizes.num_seeds, 'seed', 'seeds')}, thick "
        "their mean. Lines that coincide cover each other."
    )
    return figure, "Learning", caption


def by_stiffness(outcome: Outcome):
    """Return in C MuJoCo against stiffness, a line per method: in the time steps that were learned in, and in shorter ones."""
    figure, axes = subplots(1, 2, height=3.8, sharey=True)
    for method in outcome.settings.methods:
        courses = [course for course in outcome.courses if course.method == method]
        factors = [course.stiffness for course in courses]
        for axis, name in zip(axes[0], ("returns", "finer"), strict=True):
            judged = [getattr(course, name).mean(axis=1) for course in courses]
            means, spread = [x.mean() for x in judged], [_spread(x) or 0 for x in judged]
            axis.errorbar(factors, means, spread, color=_COLOURS[method], marker="o", capsize=3, label=NAMES[method])
    for axis, title in zip(
        axes[0], ("In the time steps it learned in", f"In {_FINER} times shorter ones"), strict=True
    ):
        axis.set(title=title, xscale="log", xlabel="stiffness of contact, over the scene's")
        axis.set_xticks(outcome.settings.stiffness)
        axis.minorticks_off()
        plain(axis.xaxis)
    axes[0, 0].set_ylabel("return in C MuJoCo")
    plain(axes[0, 0].yaxis)
    legend_below(figure, axes[0, 0], 3)
    caption = "Mean over seeds, bars are their standard deviation. Where contact lasts few steps, the left measures those, too."
    return figure, "Return against stiffness", caption


def quality(outcome: Outcome):
    """Variance of both gradients, bias of the first, and α, against updates."""
    settings = outcome.settings
    shown = [c for c in outcome.courses if c.stiffness == settings.stiffness[0] and c.method != "ppo"]
    figure, axes = subplots(1, 3, height=3.4)
    updates = np.arange(1, settings.sizes.num_updates + 1)
    for course in shown:
        look = {"color": _COLOURS[course.method], "lw": 1.8}
        # Variances of derivatives have heavy tails: one window in a hundred would be all that an arithmetic mean shows.
        first, zeroth = (np.log(course.history[f"{name}_variance"]) for name in ("first", "zeroth"))
        axes[0, 0].plot(updates, np.exp(_smooth(first).mean(axis=1)), label=NAMES[course.method], **look)
        axes[0, 1].plot(updates, np.exp(_smooth(zeroth).mean(axis=1)), **look)
        axes[0, 2].plot(updates, _smooth(course.history["alpha"]).mean(axis=1), **look)
    titles = ("Variance of the first order", "Variance of the zeroth order", "Weight of the first order")
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set(title=title, xlabel="update")
    shown_values = np.concatenate([line.get_ydata() for axis in axes[0, :2] for line in axis.get_lines()])
    for axis in axes[0, :2]:
        axis.set(yscale="log", ylim=(shown_values.min() / 2, 2 * shown_values.max()))
    axes[0, 2].set_ylim(-0.05, 1.05)
    legend_below(figure, axes[0, 0], 3)
    caption = (
        "Left and middle, variance of an update's gradient by the policy's parameters, both from the same windows. "
        "Right, weight of the first order. Means over seeds and ten updates, of the variances geometric ones."
    )
    return figure, "Quality of the gradients", caption


def video(outcome: Outcome, workspace: Workspace, look: VideoSettings) -> tuple[str | None, str]:
    """Film the best policy in C MuJoCo."""
    best, environment = outcome.best, outcome.environment
    interval = float(environment.interval)
    shown = best.qpos[: min(best.num_states, round(_SHOWN / interval))]
    caption = (
        f"The best policy by {NAMES[best.method]}, in C MuJoCo, {shown_speed(look.speed)}: the first {_SHOWN:g} s of an "
        "episode at most."
    )
    model = with_coarse_shadows(environment.scene.to_mujoco())
    camera = {"cartpole": "side", "pusher": "above"}.get(outcome.settings.environment, "track")
    if camera == "above":  # the target of the episode
        start = jax.random.split(jax.random.key(outcome.settings.seed + 1), outcome.settings.sizes.num_episodes)[0]
        model.body("target").pos[:2] = environment.reset(start).memory
    return film(workspace, [(model, shown)], look, camera=camera, caption=caption, timestep=interval)


def _off_command(course: Course) -> list[Float[np.ndarray, " seeds"]]:
    """Return by how much a quadruped misses its command, in m/s and rad/s: root mean squares in C MuJoCo."""
    return [np.sqrt(-course.terms[name].mean(axis=1)) for name in ("speed", "turning")]


def _label(course: Course, outcome: Outcome) -> str:
    text = NAMES[course.method]
    return text if len(outcome.settings.stiffness) == 1 else f"{text}, {course.stiffness:g} times as stiff"


def _judged(course: Course) -> str:
    return quantity(float(course.judged.mean()), _spread(course.judged))


def _spread(values: Float[np.ndarray, " seeds"]) -> float | None:
    return float(values.std(ddof=1)) if len(values) > 1 else None


def headline(outcome: Outcome) -> dict[str, str]:
    """Give the best return, for the page over a sweep."""
    return {"return in C MuJoCo": _judged(outcome.best)}
