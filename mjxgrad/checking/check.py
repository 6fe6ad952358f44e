"""One call for a scene of one's own: can it be differentiated, how, and up to which horizon."""

import contextlib
import dataclasses
import functools
import math
import os
import string
import textwrap
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjxgrad._arrays import function, instance, real, whole
from mjxgrad._interrupts import finished, patiently
from mjxgrad._text import Paged, format_number, paced
from mjxgrad.batched import device
from mjxgrad.checking import findings
from mjxgrad.checking.costs import Cost, named_cost
from mjxgrad.checking.findings import Finding, Recommendation
from mjxgrad.checking.measure import Line, Measured, Noise, checked_horizon, measure, seconds_by_engine, slopes
from mjxgrad.checking.motions import (
    Motions,
    Mover,
    Outcomes,
    half_range,
    heaviest,
    most_contacts,
    random_motions,
    seconds_of,
)
from mjxgrad.diagnostics.stability import StabilityReport, check_stability
from mjxgrad.engines import ENGINES, QUICK
from mjxgrad.objective.task import as_pytree, checked_cost
from mjxgrad.report import INK, Block, page, svg
from mjxgrad.rollouts.start import key_of
from mjxgrad.scene import Scene, SceneWarning, load_scene

Source = str | os.PathLike[str] | mujoco.MjSpec | mujoco.MjModel | Scene
_Function = TypeVar("_Function", bound=Callable)
_BATCH = 64  # motions along a line, or under noise
_SPARE_CONTACTS, _MANY_CONTACTS = 4, 40
_WIDTH = 100
_SIZE = (4.6, 2.9)  # of a figure, in inches
_UNITS = {"where": "m, rad", "how": "m/s, rad/s"}  # by an outcome's first word; others have the user's units
_NUM_STEPS, _FEWEST, _MOST_SAMPLES = 30, 4, 16  # of a program's optimisation
_UNNAMED = "scene.xml"  # in code for a scene that is of no file
_PATIENCE = 90.0  # s that it may take with more than the fewest samples
_MOVED = 0.6  # approximate share of the budget for simulating motions


@dataclass(frozen=True)
class Verdict(Paged):
    """The result of `check`.

    Attributes:
        name: name of the scene.
        headline: the answer, and what to mind most, in sentences of at most 25 words.
        findings: faults first, then errors and prices; at last what was left out for lack of time.
        recommendation: recommended settings.
        code: the recommended settings as code to paste.
        outcomes: names of the outcomes.
        scene: the scene that was checked.
        stability: stability of each contact at the time step.
        motions: motions by C MuJoCo.
        measured: measurements of derivatives; None if derivatives were not asked for.
        seconds: duration in s of a time step of a "motion", and of its "discrete" gradient and its "slope", by C MuJoCo on
            all cores; none without actuators.
        start: the key frame that was asked for; None for all.
        horizon: the number of time steps that was asked for; None for that of the recommendation.
    """

    name: str
    headline: str
    findings: tuple[Finding, ...]
    recommendation: Recommendation
    code: str
    outcomes: tuple[str, ...]
    scene: Scene
    stability: StabilityReport
    motions: Motions
    measured: Measured | None
    seconds: dict[str, float]
    start: str | int | None
    horizon: int | None

    @property
    def faults(self) -> tuple[Finding, ...]:
        """The findings that call for a change or caution."""
        return tuple(finding for finding in self.findings if finding.is_fault)

    def summary(self) -> str:
        """Return a report for a terminal: the answer, faults, numbers, code, then the scene in detail."""
        lines = [f"{self.name}: {self.headline}", ""]
        for finding in self.findings:
            lead = "! " if finding.is_fault else "- "
            lines.append(textwrap.fill(finding.text, _WIDTH, initial_indent=lead, subsequent_indent="  "))
        return "\n\n".join(["\n".join(lines), textwrap.indent(self.code, "    ").rstrip(), *self._details().values()])

    __str__ = summary

    def _details(self) -> dict[str, str]:
        """Return the detailed report: measurements, scene, time step."""
        found = {"The scene": self.scene.summary(), "Time step and contacts": self.stability.summary()}
        if self.measured is None:
            return found
        lines = [f"Outcomes: {'; '.join(self.outcomes)}.", *map(_noise_text, self.measured.noises)]
        return {"What was measured": "\n".join(lines), **found}

    def as_html(self) -> str:
        """Return the verdict as a self-contained page; needs `mjxgrad[render]`."""
        figure = [telling(self.measured, self.outcomes)] if self.measured else []
        faults, notes = ([one.text for one in self.findings if one.is_fault == wanted] for wanted in (True, False))
        folded = [Block(folded=title, code=text) for title, text in self._details().items()]
        blocks = [*figure, Block(faults=faults, items=notes), Block(title="To paste", code=self.code), *folded]
        return page(self.headline, f"mjxgrad check {self.name}", blocks)


def in_double(call: _Function) -> _Function:
    """Have a function compute in double precision, which at an exact touch decides as C MuJoCo does, and sees jumps."""

    @functools.wraps(call)
    def doubled(source: Source, *args: Any, **kwargs: Any) -> Any:
        with jax.enable_x64(True):
            if isinstance(source, Scene) and source.data.qpos.dtype == jnp.float32:
                is_single = lambda x: getattr(x, "dtype", None) == jnp.float32  # noqa: E731
                source = jax.tree.map(lambda x: jnp.asarray(x, float) if is_single(x) else x, source)
                source = eqx.tree_at(lambda scene: scene.data.qpos, source, jnp.asarray(source.mj_model.qpos0))
            return call(source, *args, **kwargs)

    return doubled  # pyright: ignore[reportReturnType]


@in_double
def check(
    source: Source,
    cost: str | Cost | None = None,
    *,
    start: str | int | None = None,
    horizon: int | None = None,
    derivatives: bool = True,
    mjx: bool = False,
    budget: int | float = 12.0,
    seed: int = 0,
    log: Callable[[str], None] | None = None,
    progress: bool = True,
) -> Verdict:
    """Check whether and how a scene can be differentiated.

    Random motions by C MuJoCo come first: they show what touches and what has no effect. Derivatives are then measured along
    lines through these motions and under noise. The measurements tell which derivative is the slope, where outcomes jump, how
    much better first order is than zeroth, and up to which time. All diagnostics are from `mjxgrad.diagnostics`.

    Args:
        source: an MJCF file, MJCF as a string, a `MjSpec`, a `MjModel` or a scene.
        cost: function from a trajectory, also a shorter one, to its cost, as `SceneTask` takes it, or its name as in `sweep`;
            motions are then simulated from their start. None uses random mixes of final positions and velocities.
        start: a key frame, by name or index, from which all motions begin, about its controls. None takes all key frames and
            the reference pose, and controls about the middle of their ranges.
        horizon: number of time steps over which derivatives are measured, such as your task's: at least 4, and at most those of
            the random motions, 2 s, but 50 to 1000. Slow scenes then get fewer motions. None takes 40 to 300 by first touches
            and the budget.
        derivatives: whether to measure derivatives; False looks at motions alone, and calls a cost once.
        mjx: whether to compare a step by MJX with C MuJoCo's, too; it takes up to a minute to compile.
        budget: approximate duration in s, half of it for motions and derivatives. Slow scenes get fewer steps. The verdict names
            measurements that are left out; one line, by eight motions at least, is never.
        seed: seed of all random numbers.
        log: called with the name of each part as it starts.
        progress: whether a check of more than two seconds tells on stderr where it is, without a log.

    Returns:
        The verdict; `print` it.

    Raises:
        ValueError: if `budget` is not positive, `horizon` is out of range, there is no such key frame, or the cost does not
            return a number or numbers to be added up.
        SceneError: if MuJoCo cannot read the source; also all errors of `load_scene`.
    """
    instance("derivatives", derivatives, bool, "True or False")
    instance("mjx", mjx, bool, "True or False")
    instance("progress", progress, bool, "True or False")
    if not real("budget", budget) > 0:
        raise ValueError(f"budget must be positive, got {budget}; derivatives=False measures nothing")
    function("log", log, "text")
    function("cost", None if isinstance(cost, str) else cost, "trajectory")
    say = log or (paced("check") if progress else lambda _: None)
    begun = time.perf_counter()
    rng = np.random.default_rng(whole("seed", seed, 0))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        # By C MuJoCo, as is measured and advised: what MJX would do otherwise is asked for by `mjx`.
        engine = QUICK if device.is_cpu() and not mjx else None
        scene = source if isinstance(source, Scene) else load_scene(source, engine=engine)
        key = None if start is None else key_of(scene.mj_model, start)
        outcome = named_cost(scene, cost) if isinstance(cost, str) else as_pytree(cost)
        started = time.perf_counter()
        try:
            motions = patiently(lambda: random_motions(scene, rng, key))
            stability = check_stability(scene, speed=motions.touch_speed or None)
        except KeyboardInterrupt:
            say(f"interrupted before anything was measured of\n\n{scene.summary()}")
            raise
    horizon = checked_horizon(horizon, motions)
    found = [*findings.static_findings(scene, motions, stability), *_warned(caught)]
    for finding in found:
        say(("! " if finding.is_fault else "- ") + finding.text)
    names, outcomes = outcomes_of(scene, outcome, rng)
    is_any_sound = (motions.bad_steps < 0).any()
    measured, prices, was_interrupted = None, {}, False
    # After Ctrl-C, whenever it comes, the verdict is of what is known by then.
    try:
        if outcome is not None and is_any_sound:
            found += findings.index_findings(scene, motions, outcome)
            found.append(patiently(lambda: findings.cost_finding(motions, Mover(scene, 1, outcomes))))
        # Prices come first: after Ctrl-C there is nothing left to measure.
        asked = time.perf_counter()
        if scene.model.nu and is_any_sound:
            say("timing gradients by C MuJoCo")
            prices = patiently(lambda: seconds_of(scene, key))
        if derivatives and is_any_sound:
            say("measuring derivatives by C MuJoCo")
            end = max(begun + budget, started + budget / 2) + time.perf_counter() - asked
            mover = Mover(scene, _BATCH, outcomes, end)
            settings = {"from_start": cost is not None, "seconds": _MOVED * budget, "log": say, "horizon": horizon}
            with contextlib.suppress(TimeoutError):
                measured = measure(scene, motions, mover, rng, **settings)
        was_interrupted = measured is not None and measured.was_interrupted
        if mjx and is_any_sound and not was_interrupted:
            say("compiling a step by MJX")
            found.append(findings.engine_finding(scene, motions))
    except KeyboardInterrupt:
        was_interrupted = True
    path = str(source) if isinstance(source, str | os.PathLike) and scene.name != "the MJCF" else _UNNAMED
    if derivatives and is_any_sound:
        measured = measured if measured and measured.lines else None
        found += findings.measured_findings(measured) if measured else ()
        found += findings.untouched_findings(scene, motions, measured) if measured and cost is None else ()
        found += findings.left_out_findings(measured, None if was_interrupted else budget)
    seen = scene, motions, stability, measured, prices
    of = path, cost if isinstance(cost, str) else None, start, horizon
    return finished(lambda: _verdict(*seen, [*found], names, of, None if was_interrupted else say))


def _verdict(
    scene: Scene,
    motions: Motions,
    stability: StabilityReport,
    measured: Measured | None,
    prices: dict[str, float],
    found: list[Finding],
    names: tuple[str, ...],
    of: tuple[str, str | None, str | int | None, int | None],
    say: Callable[[str], None] | None,
) -> Verdict:
    """Return what all findings amount to, of a file, a cost's name, a start and a horizon; without `say` engines go untimed."""
    path, cost, start, horizon = of
    # Fewer contact slots, if motions needed far fewer than all; other motions may have more contacts than these.
    room = 2 * most_contacts(scene, motions.qpos) + _SPARE_CONTACTS if scene.pairs else 0
    slots = room if scene.data._impl.ncon > max(2 * room, _MANY_CONTACTS) else None
    price = prices["slope"] / prices["discrete"] if prices else math.inf
    advice = findings.recommend(motions, stability, measured, slots, price)
    if measured is None and horizon is not None:
        advice = dataclasses.replace(advice, horizon=horizon)
    # It compiles for minutes, which a quick check, or one that was interrupted, does not wait for.
    is_asked = prices and measured and not device.is_cpu()
    if say and is_asked and (seconds := seconds_by_engine(scene, ENGINES, say)):
        advice = dataclasses.replace(advice, engine=min(seconds, key=lambda engine: seconds[engine][1]))
        found.append(findings.engine_prices_finding(seconds))
    told = slopes(measured.lines) if measured else ()
    totals = {kind: advice.horizon * seconds for kind, seconds in prices.items()}
    if prices:
        found.append(findings.price_finding(totals, told, advice.horizon))
    order = {"slope": 0, "price": 1, "left_out": 3, "not_measured": 3}
    return Verdict(
        name=scene.name,
        headline=findings.headline(found, advice, motions, told, totals),
        findings=tuple(sorted(found, key=lambda one: (not one.is_fault, order.get(one.kind, 2)))),
        recommendation=advice,
        code=_code(scene, advice, path, cost, start),
        outcomes=names,
        scene=scene,
        stability=stability,
        motions=motions,
        measured=measured,
        seconds=prices,
        start=start,
        horizon=horizon,
    )


def _warned(caught: list[warnings.WarningMessage]) -> Iterator[Finding]:
    """Yield what the library warned of, without the scene's name; of other libraries' warnings the first of each kind."""
    found: dict[Any, set[str]] = {}
    for one in caught:
        text = str(one.message)
        if issubclass(one.category, SceneWarning):
            text = text.partition(": ")[2]
            if "refsafe" not in text and "h²k" not in text:  # a separate finding tells where the time step is too long
                found[text] = {text}
        elif issubclass(one.category, UserWarning):
            found.setdefault((one.filename, one.lineno), set()).add(text)
    for first, *more in map(sorted, found.values()):
        text = first.rstrip(".") + (f" ({len(more)} more alike)" if more else "")
        yield Finding("note", f"{text[:1].upper()}{text[1:]}.")


def outcomes_of(scene: Scene, cost: Cost | None, rng: np.random.Generator) -> tuple[tuple[str, ...], Outcomes]:
    """Return the names of outcomes, and the function from a trajectory to them: the cost, or mixes of the final state."""
    if cost is not None:
        return ("the cost",), lambda trajectory: checked_cost(cost(trajectory), len(trajectory.ctrl)).sum()[None]
    model = scene.mj_model
    roots = heaviest(model)
    dof_joints, sizes = model.dof_jntid, np.diff([*model.jnt_qposadr, model.nq])
    mixes = []
    for joints in (np.repeat(np.arange(model.njnt), sizes), dof_joints):
        is_own = model.body_rootid[model.jnt_bodyid[joints]] == np.array([*roots])[:, None]
        weights = rng.normal(size=is_own.shape) * is_own
        mixes.append(jnp.asarray(weights / np.sqrt((weights**2).sum(axis=1, keepdims=True))))
    words = [f"where {x} ends up" for x in roots.values()] + [f"how fast {x} is in the end" for x in roots.values()]
    ends = lambda trajectory: (trajectory.qpos[-1], trajectory.qvel[-1])  # noqa: E731
    return tuple(words), lambda t: jnp.concatenate([mix @ end for mix, end in zip(mixes, ends(t), strict=True)])


def _noise_text(noise: Noise) -> str:
    """Return variances and bias at the last time, one number per outcome."""
    first, zeroth = noise.first[:, -1], noise.zeroth[:, -1]
    variances = [one.var(axis=0, ddof=1) for one in (first, zeroth)]
    error = np.sqrt(sum(variances) / len(first))
    columns = *variances, first.mean(axis=0) - zeroth.mean(axis=0), error
    of_first, of_zeroth, bias, off = (", ".join(f"{x:.2g}" for x in one) for one in columns)
    where = "the file" if noise.stiffness is None else format_number(noise.stiffness)
    told = f"variance {of_first} of first order, {of_zeroth} of zeroth; first less zeroth {bias} ± {off}"
    return f"Noise {noise.stddev:g}, {where}: {told}"


def _setup(
    scene: Scene, advice: Recommendation, file: str, start: str | int | None, more: str = "", cost: str | None = None
) -> str:
    """Return the beginning of a program with the recommended settings, up to its start and its task; its file is code."""
    yours = "  # your file" * (file == repr(_UNNAMED) and not Path(_UNNAMED).exists())
    drive = " + 1e-3 * (trajectory.ctrl**2).mean()"
    costing = f"""\
# Your cost, from a trajectory to a number; here how far it comes (m or rad).
cost = lambda trajectory: -trajectory.qpos[-1, 0]{drive * bool(scene.model.nu)}
"""
    if cost is not None:
        more, costing = f"from mjxgrad.checking import named_cost\n{more}", f"cost = named_cost(scene, {cost!r})\n"
    # On GPUs what was fastest; elsewhere what compiles nothing.
    engine = QUICK if device.is_cpu() else advice.engine
    given = {"timestep": advice.timestep, "max_contacts": advice.max_contacts, "engine": engine}
    settings = "".join(f", {name}={value!r}" for name, value in given.items() if value is not None)
    if advice.stiffness is not None:
        settings += f", softness=mg.Softness(stiffness={format_number(advice.stiffness)}, damping_ratio=1.0)"
    return f"""\
import jax
import jax.numpy as jnp
import mjxgrad as mg
{more}
scene = mg.load_scene({file}{settings}){yours}
{costing}\
start = mg.initial_state(scene{_keyframe(scene, start)})
task = mg.SceneTask(scene, start, cost, horizon={advice.horizon}, {findings.chosen(advice.gradient)})
"""


def _key(scene: Scene, start: str | int | None) -> str:
    """Return the key frame from which a program begins, by default the first."""
    return repr((scene.mj_model.key(0).name or 0) if start is None else start)


def _keyframe(scene: Scene, start: str | int | None) -> str:
    return f", keyframe={_key(scene, start)}" if scene.mj_model.nkey else ""


def _home(scene: Scene, start: str | int | None) -> str:
    """Return the controls about which a program begins: the key frame's."""
    return f"scene.mj_model.key({_key(scene, start)}).ctrl" if scene.mj_model.nkey else "jnp.zeros(scene.model.nu)"


def _code(scene: Scene, advice: Recommendation, path: str, cost: str | None, start: str | int | None) -> str:
    """Return the recommendation as a program."""
    stddev = (advice.stddev * half_range(scene)).round(6).tolist() if scene.model.nu else [advice.stddev]
    noise = f"{stddev[0]:g}" if len(set(stddev)) == 1 else f"jnp.array({stddev})"
    objective = f"mg.open_loop(task, stddev={noise})"
    if not scene.model.nu:
        run = f"task.run(None, start=mg.initial_state(scene, qvel=velocity{_keyframe(scene, start)})).cost"
        objective = f"mg.parameter_noise(lambda velocity: {run}, stddev={noise}, dim={scene.model.nv})"
    return f"""\
{_setup(scene, advice, repr(path), start, cost=cost)}\
objective = {objective}
params = {f"jnp.tile({_home(scene, start)}, task.horizon)" if scene.model.nu else "jnp.zeros(objective.dim)"}
estimate = mg.estimators.{advice.estimator}(objective, params, jax.random.key(0), num_samples=32)
"""


def program(verdict: Verdict, path: str, output: Path) -> tuple[str, float]:
    """Return a program that optimises a motion of a scene with actuators by the recommended settings, and films it.

    It finds the scene from its own folder, the output's. With it go the seconds that its optimisation will take, of which long
    motions get fewer samples.
    """
    advice = verdict.recommendation
    timestep = advice.timestep or verdict.motions.timestep
    horizon = verdict.horizon or min(300, max(50, round(0.5 / timestep)))
    held = max(1, round(0.05 / timestep))
    each = _NUM_STEPS * horizon * verdict.seconds.get(advice.gradient, 0.0)
    num_samples = int(np.clip(_PATIENCE / max(each, 1e-9), _FEWEST, _MOST_SAMPLES)) // 2 * 2
    more = "import optax\n\nmg.keep_compiled()  # on disk, so that the next run starts at once"
    advice = dataclasses.replace(advice, horizon=horizon)
    parts = {
        "name": repr(Path(path).name)[1:-1].replace('"', "'"),  # within a docstring
        "setup": _setup(verdict.scene, advice, _from(output.parent, path), verdict.start, more),
        "home": _home(verdict.scene, verdict.start),
        "held": held,
        "num_knots": -(-horizon // held),
        "stddev": advice.stddev,
        "estimator": advice.estimator,
        "num_samples": num_samples,
        "num_steps": _NUM_STEPS,
    }
    template = string.Template(Path(__file__).with_name("program.txt").read_text("utf-8"))
    return template.substitute(parts), each * num_samples


def _from(folder: Path, path: str) -> str:
    """Return code for the path of a file, seen from the folder of the program; one that is absolute stays so."""
    if Path(path).is_absolute():
        return repr(path)
    # The folders' real places, since `..` leads out of a link's target.
    place = os.path.relpath(os.path.realpath(Path(path).parent), os.path.realpath(folder))
    return f"Path(__file__).parent / {(Path(place) / Path(path).name).as_posix()!r}"


def telling(measured: Measured, outcomes: Sequence[str]) -> Block:
    """Draw the outcome along the most telling line, and its derivatives."""
    line, time, outcome = _most_telling(measured)
    words, of = outcomes[outcome], (slice(None), time, outcome)
    unit = _UNITS.get(words.partition(" ")[0], "units of the cost")
    caption = (
        f"{words[:1].upper() + words[1:]} after {measured.times[time]:.2g} s, along a random change of {line.varied} "
        f"({line.pose}). The other figure: its derivatives, which should lie on the grey slope."
    )
    caption += " Dashed: a jump." * bool(len(line.jumps.places))
    x, fine, (smooth, plain) = line.plain.parameters, line.fine.outcomes[of], line.plain.derivatives[:, *of]

    def panel(what: str, name: str, curve: np.ndarray, dots: dict[str, tuple]) -> Any:
        """Draw dots over a grey curve; of several kinds, those beyond its range lie on the edge."""
        import matplotlib.pyplot as plt

        figure, axis = plt.subplots(figsize=_SIZE)
        axis.plot(x, curve, color="#8b94a1", lw=1.4, label=name)
        axis.margins(y=1 / 3)
        low, high = axis.get_ylim() if len(dots) > 1 else (-np.inf, np.inf)
        axis.set_autoscaley_on(len(dots) == 1)
        for label, (values, colour, marker) in dots.items():
            axis.plot(x, np.clip(values, low, high), marker, color=colour, ms=3, mew=0, label=label, clip_on=False)
        for place in line.jumps.places:
            axis.axvline(place, color="#8b94a1", lw=1, ls="--")
        axis.set(xlabel="place on the line, −1 to 1", ylabel=what)
        figure.legend(loc="outside upper right", ncols=3)
        return figure

    moved = {"MuJoCo": (line.plain.outcomes[of], INK, "o")}
    derived = {"discrete": (plain, "#d55e00", "s"), "slope": (smooth, "#009e73", "o")}
    drawings = [
        svg(lambda: panel(f"outcome ({unit})", "shorter time steps", fine, moved), "The outcome along the line"),
        svg(lambda: panel(f"derivative ({unit})", "its slope", np.gradient(fine, x), derived), "Its derivatives"),
    ]
    return Block(drawings=drawings, caption=caption)


def _most_telling(measured: Measured) -> tuple[Line, int, int]:
    """Return the line of the largest jump, or that on which the discrete derivative is farthest off; a time and an outcome."""
    if jumping := [line for line in measured.lines if len(line.jumps.places)]:
        line = max(jumping, key=lambda one: float(one.jumps.sizes.max()))
        sizes = np.abs(line.jumps.after - line.jumps.before)[line.jumps.largest]
        return line, len(measured.times) - 1, int(sizes.argmax())
    compared = [line.plain for line in measured.lines]
    errors = [np.where(one.is_resolved(), one.relative_error[1], 0) for one in compared]
    number, time, outcome = np.unravel_index(int(np.argmax(errors)), np.shape(errors))
    return measured.lines[int(number)], int(time), int(outcome)
