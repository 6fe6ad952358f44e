"""Interpretation of the measurements: named faults, findings and recommended settings, with the names of the scene."""

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjxgrad._interrupts import patiently
from mjxgrad._text import format_number, name_pairs
from mjxgrad.checking.measure import (
    AFTER,
    FEWEST_READINGS,
    NUM_COMPARED,
    STDDEVS,
    STEPS_COMPARED,
    Measured,
    Slope,
    nearest,
    slopes,
    unmeasured,
)
from mjxgrad.checking.motions import REFINED, Direction, Motions, Mover, heaviest, run, start_of
from mjxgrad.diagnostics.stability import Spring, StabilityReport
from mjxgrad.engines import ENGINES, QUICK, Trajectory
from mjxgrad.engines.state import LARGEST_GROWTH
from mjxgrad.rollouts import rollout
from mjxgrad.rollouts.start import pose_warnings
from mjxgrad.scene import Scene, SceneError, load_scene
from mjxgrad.stepping import EngineName

_NUM_COMPARED, _ALIKE = 32, 1e-6  # states, and difference of a step over the largest speed, 1 at least (m/s, rad/s)
_NUM_INDEXED = 3  # steps of a trajectory whose indices are tried
_MANY_PAIRS = 1000  # fewest pairs of geoms whose number is a finding
_SPARE_STEP = 0.9
_DEGREES = 10.0  # least share of a control range and its joint's that tells of degrees, which are 57 times rad
_OFF = 0.25  # expected error of a derivative from which it is a fault
_ENOUGH = 32  # motions
_CLEAR = 0.1  # largest relative error of a usable slope
_DISAGREES = 0.1  # relative difference beyond which the slopes at two time steps disagree


@dataclass(frozen=True)
class Finding:
    """A finding: its kind, a sentence or two about the scene, and whether it is a fault."""

    kind: str
    text: str
    is_fault: bool = False


def chosen(gradient: str) -> str:
    """Return a gradient as an argument."""
    return f"contact=mg.{gradient.title()}()"


@dataclass(frozen=True)
class Recommendation:
    """Recommended settings.

    Attributes:
        gradient: gradient of MuJoCo's motion, "slope" or "discrete".
        estimator: name in `mjxgrad.estimators`.
        stddev: standard deviation of the noise, as a share of half the range of controls.
        horizon: number of steps up to which first order was better, or was measured.
        timestep: time step in s; None, here and below, keeps the file's.
        stiffness: stiffness of all contacts, in 1/s².
        max_contacts: number of contact slots.
        engine: who steps a batch soonest; None is the scene's own.
    """

    gradient: str
    estimator: str
    stddev: float
    horizon: int
    timestep: float | None = None
    stiffness: float | None = None
    max_contacts: int | None = None
    engine: EngineName | None = None


def static_findings(scene: Scene, motions: Motions, stability: StabilityReport) -> Iterator[Finding]:
    """Yield findings from random motions and contact parameters alone."""
    if len(scene.pairs) >= _MANY_PAIRS:
        yield Finding("many_pairs", f"{len(scene.pairs)} pairs of geoms can touch: exclude those that never do.", True)
    for spring in _steps_too_long(stability):
        yield Finding("time_step", _time_step(spring), True)
    bad = [pose for pose, step in zip(motions.poses, motions.bad_steps, strict=True) if step >= 0]
    if bad:
        first = float(motions.bad_steps[motions.bad_steps >= 0].min() * motions.timestep)
        text = f"From {bad[0]} the motion is not finite after {first:.3g} s, in C MuJoCo too: shorten the time step."
        start = motions.state(int(np.argmax(motions.bad_steps >= 0)), 0)
        if not all(np.isfinite(x).all() for x in (start.qpos, start.qvel, start.act)):
            text = f"{bad[0][:1].upper()}{bad[0][1:]} must hold numbers, got NaN."
        yield Finding("not_finite", text, True)
    pose = motions.qpos[0, 0]
    if np.isfinite(pose).all() and (warned := next(pose_warnings(scene.model, scene.mj_model, pose), "")):
        yield Finding("start", f"In {motions.poses[0]} {warned}.", True)
    if degrees := _in_degrees(scene.mj_model):
        text = f"In degrees? The control range of {', '.join(degrees)} is over ten times that of its joint in rad"
        yield Finding(
            "degrees", f"{text}: MuJoCo's compiler turns ranges of joints into rad, but no control ranges.", True
        )
    yield from _contact_findings(scene, motions)
    if motions.exact:
        yield Finding("note", exact_text(motions.exact))
    if motions.idle:
        text = f"No effect: {', '.join(motions.idle)}. A change of the control changes no position."
        yield Finding("no_effect", text, True)


def _in_degrees(model: mujoco.MjModel) -> list[str]:
    """Return the position servos of limited hinges whose control range is many times that of the hinge."""
    found = []
    control, is_affine = model.actuator_ctrladr, model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE
    for i in np.flatnonzero(model.actuator_ctrllimited[control] & is_affine):
        joint, is_of_joint = model.actuator_trnid[i, 0], model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
        is_servo = 0 < model.actuator_gainprm[i, 0] == -model.actuator_biasprm[i, 1]
        if (
            is_of_joint
            and is_servo
            and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
            and model.jnt_limited[joint]
        ):
            reach = np.abs(model.actuator_gear[i, 0] * model.jnt_range[joint]).max()
            if np.abs(model.actuator_ctrlrange[control[i]]).max() > _DEGREES * reach:
                found.append(model.actuator(i).name or f"actuator {i}")
    return found


def exact_text(pairs: Sequence[str]) -> str:
    """Say what is open where geoms touch exactly, and who decides."""
    return (
        f"{name_pairs(pairs)} touches exactly at the start, within rounding: single precision by MJX may begin without that "
        "contact, which double precision has, here and by C MuJoCo. Begin a hair deeper or higher, 1e-5 m."
    )


def _contact_findings(scene: Scene, motions: Motions) -> Iterator[Finding]:
    if not scene.pairs:
        yield Finding("note", "No two geoms can touch, so all derivatives are those of smooth motion.")
    elif not motions.touches and not motions.touching:
        seconds = motions.controls.shape[1] * motions.timestep
        text = (
            f"Nothing touches within {seconds:.3g} s, although {name_pairs(scene.pairs)} could: derivatives know of "
            "no contact. Start nearer, or take mg.Smoothing or a margin."
        )
        yield Finding("no_contact", text, True)
    elif motions.touches:
        first = motions.touches[0]
        more = f", then {len(motions.touches) - 1} more" if len(motions.touches) > 1 else ""
        text = f"First to touch: {first.pair}, after {first.time:.3g} s at {first.speed:.2g} m/s{more}."
        yield Finding("note", text)
    else:
        yield Finding("note", f"In contact from the start, and nothing else touches: {name_pairs(motions.touching)}.")


def untouched_findings(scene: Scene, motions: Motions, measured: Measured) -> Iterator[Finding]:
    """Yield those of the heaviest bodies that were not touched within the measured time: their outcomes tell of no contact."""
    model = scene.mj_model
    trees = model.body_rootid[model.geom_bodyid]
    could = {int(tree) for pair in scene.pairs for tree in trees[[pair.geom1, pair.geom2]]}
    num_steps = round(measured.times[-1] / motions.timestep)
    for root, name in heaviest(model).items():
        first = motions.reached[:, trees == root].min(axis=1, initial=np.inf)
        soonest = min((first[motion] - begin for motion, begin in measured.windows), default=np.inf)
        if num_steps < soonest < np.inf:
            needed = min(int(soonest) + AFTER, motions.controls.shape[1])
            text = (
                f"{name} is not touched within the {measured.times[-1]:.2g} s that were measured, but after "
                f"{soonest * motions.timestep:.2g} s: give --horizon {needed}, in Python horizon={needed}."
            )
            yield Finding("untouched", text, True)
        elif root in could and np.isinf(first).all() and (motions.touches or motions.touching):
            seconds = motions.controls.shape[1] * motions.timestep
            yield Finding("note", f"{name} can be touched, but no random motion does so within {seconds:.3g} s.")


def cost_finding(motions: Motions, mover: Mover) -> Finding:
    """Call the cost with its derivative along a random motion that stays finite; useless ones are a fault by kind."""
    rng, motion = np.random.default_rng(0), int(np.argmax(motions.bad_steps < 0))
    controls = motions.controls[motion, None, :100]  # a cost of long motions may take long
    start = jax.tree.map(lambda leaf: np.array(leaf)[None], motions.state(motion, 0))
    change = Direction(*[rng.normal(size=x.shape[1:]) for x in (start.qvel, start.qvel, controls)])
    found = mover.move("slope", start, controls, change, [controls.shape[1]])
    when = f"after {controls.shape[1] * motions.timestep:.2g} s of a random motion"
    value, derivative = found.outcomes.item(), found.derivatives.item()
    kind, remedy = "cost", ""
    if not math.isfinite(value):
        kind, remedy = "cost_not_finite", " Look for divisions, roots and logarithms in it."
    elif derivative == 0 or not math.isfinite(derivative):
        remedy = " Norms and roots at zero have no derivative; counts and comparisons have zero."
        start.qvel[:] += change.velocities
        found = mover.move("plain", start, controls + change.controls, change, [controls.shape[1]])
        if found.outcomes.item() == value:
            kind, remedy = "cost_unfelt", " It is the same of another motion: it must depend on the trajectory."
    text = f"The cost is {value:.3g} {when}, its derivative along a change {derivative:.2g}.{remedy}"
    return Finding(kind, text, bool(remedy))


def index_findings(scene: Scene, motions: Motions, cost: Callable[[Trajectory], Any]) -> Iterator[Finding]:
    """Yield what NumPy says of a cost that indexes beyond the trajectory's arrays, where JAX takes the last number."""
    motion = int(np.argmax(motions.bad_steps < 0))
    found = rollout(scene.with_engine(QUICK), motions.state(motion, 0), motions.controls[motion, :_NUM_INDEXED])
    try:
        cost(jax.tree.map(np.asarray, found))
    except Exception as error:  # any other: the cost needs arrays of JAX
        for one in (error, error.__cause__):
            if isinstance(one, IndexError):
                yield Finding("index", f"The cost looks beyond an array, where JAX takes its last number: {one}.", True)


def engine_finding(scene: Scene, motions: Motions) -> Finding:
    """Compare a step by MJX, which is compiled, with C MuJoCo's, both solved to rounding, in states of the motions."""
    model = scene.to_mujoco()
    opt = model.opt
    opt.iterations, opt.ls_iterations, opt.tolerance = max(200, opt.iterations), max(200, opt.ls_iterations), 1e-14
    try:
        with warnings.catch_warnings(action="ignore"):
            scene = load_scene(model, engine=next(iter(ENGINES)), keep_everything=True)
    except SceneError as error:
        return Finding("engines", f"{error}.")
    rng, whole = np.random.default_rng(0), np.flatnonzero(motions.bad_steps < 0)
    at = rng.choice(whole, _NUM_COMPARED), rng.integers(motions.controls.shape[1], size=_NUM_COMPARED)
    states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(motions.state, *(one.tolist() for one in at)))
    step = jax.jit(jax.vmap(lambda state, control: rollout(scene, state, control[None]).qvel[-1]))
    ours = np.asarray(patiently(lambda: step(states, motions.controls[at])))  # compiles for up to a minute
    theirs = run(scene, start_of(states), motions.controls[at][:, None])["qvel"][:, 1]
    off = np.abs(ours - theirs) / np.maximum(np.abs(theirs).max(axis=1, keepdims=True), 1)
    place, dof = np.unravel_index(off.argmax(), off.shape)
    text = f"A step by MJX is C MuJoCo's to {off.max():.1g} of the speeds, in {_NUM_COMPARED} states"
    if off.max() < (_ALIKE if ours.dtype == np.float64 else np.sqrt(_ALIKE)):
        return Finding("engines", f"{text}.")
    joint = scene.mj_model.joint(scene.mj_model.dof_jntid[dof]).name or f"joint {scene.mj_model.dof_jntid[dof]}"
    when = f"{motions.poses[at[0][place]]}, {at[1][place] * motions.timestep:.3g} s on"
    return Finding("engines", f"{text}, worst at {joint} ({when}). C MuJoCo's own step is by engine mujoco.", True)


def measured_findings(measured: Measured) -> Iterator[Finding]:
    """Yield findings from measurements along lines and under noise."""
    jumps = [line for line in measured.lines if line.changed]
    if jumps:
        line = max(jumps, key=lambda one: float(one.jumps.sizes.max()))
        pairs = name_pairs(line.changed)
        verb = "touches" if len(line.changed) == 1 else "touch"
        text = f"The outcome jumps along a change of {line.varied}: {pairs} {verb} on one side only."
        yield Finding("jump", f"{text} No derivative sees that; alpha_order does.", True)
    growth = np.array([line.growth for line in measured.lines])
    largest = float(np.nanmax(growth, initial=0.0))
    if largest > LARGEST_GROWTH:
        when = measured.times[int(np.nanmax(growth, axis=0).argmax())]
        text = f"The derivative explodes: a change of the start grows {largest:.1e} times within {when:.3g} s."
        yield Finding("explodes", text + " Shorten the horizon or soften the contact.", True)
    num_diverged = sum(line.num_diverged for line in measured.lines)
    if num_diverged:
        yield Finding("not_finite", f"{num_diverged} motions along the lines diverged: shorten the time step.", True)
    if scattered := [one for one in measured.noises if one.stiffness is None and one.advantage < 1]:
        until = min(one.crossover for one in scattered)
        text = f"Derivatives of single motions scatter more than zeroth order from {until:.2g} s on."
        yield Finding("explodes", text + " Shorten the horizon or soften the contact.", True)
    yield slope_finding(slopes(measured.lines))
    yield from _time_step_findings(measured)
    yield from _order_findings(measured)


def left_out_findings(measured: Measured | None, budget: int | float | None) -> Iterator[Finding]:
    """Yield the measurements that were left out for lack of time; without a budget, by an interruption."""
    if measured is None:
        within = "" if budget is None else f" within a budget of {budget:g} s; a larger one measures them"
        yield Finding("not_measured", f"Derivatives were not measured{within or ': it was interrupted'}.")
    elif measured.left_out:
        why = "after an interruption" if budget is None else f"for a budget of {budget:g} s"
        remedy = "" if budget is None else " A larger one measures it, too."
        yield Finding("left_out", f"Left out {why}: {'; '.join(measured.left_out)}.{remedy}")


def slope_finding(found: Sequence[Slope]) -> Finding:
    """Return how far each derivative is from the slope, and which is nearer how often; a fault where both are known to be far."""
    slope, discrete = found
    if not (count := slope.errors.size):
        return Finding("slope", "Which derivative is the slope cannot be told: no slope was clear enough to compare.")
    far, errors = _is_far(found), [percent(one.error) for one in found]
    readings = f"{count} reading{'s' * (count > 1)} by {slope.num_motions} motions each"
    lead = f"Expected error beside the slope of the outcome, over {readings}"
    both = f"{chosen('slope')} {errors[0]}, {chosen('discrete')} {errors[1]}"
    nearer, alike = (slope.errors < discrete.errors).sum(), (slope.errors == discrete.errors).sum()
    text = f"{lead}: {both}. The slope is nearer in {nearer}" + f" and as near in {alike}" * bool(alike)
    text += ", which is too few to choose by: a larger budget measures more" * (count < FEWEST_READINGS)
    return Finding("slope", f"{text}.", is_fault=far and count >= FEWEST_READINGS)


def price_finding(prices: Mapping[str, float], found: Sequence[Slope], horizon: int) -> Finding:
    """Return what a gradient costs, and whether the slope is worth its price."""
    slope, discrete = (prices[kind] for kind in ("slope", "discrete"))
    text = (
        f"A gradient of one rollout of {horizon} steps takes {slope:.2g} s by {chosen('slope')} and {discrete:.2g} s by "
        f"{chosen('discrete')}, by C MuJoCo in a batch on all cores"
    )
    if found and found[0].errors.size and slope > discrete and nearest(found, slope / discrete) == "discrete":
        text += f". The slope costs {slope / discrete:.2g} times as much and is no nearer beyond doubt"
    more = "Over many more steps slopes may scatter: mjxgrad sweep with your --horizon tells which derivative errs less"
    return Finding("price", f"{text}. {more}.")


def engine_prices_finding(seconds: Mapping[EngineName, tuple[float, float]]) -> Finding:
    """Return what gradients cost by each engine, the fastest first."""
    ordered = sorted(seconds, key=lambda engine: seconds[engine][1])
    told = [
        f"{seconds[one][1]:.2g} s by {ENGINES[one].title} (the first time {seconds[one][0]:.2g} s)" for one in ordered
    ]
    text = (
        f"Discrete gradients of {NUM_COMPARED} rollouts of {STEPS_COMPARED} steps side by side take {', '.join(told)}"
    )
    return Finding("engine_prices", f"{text}.")


def _is_far(found: Sequence[Slope]) -> bool:
    """Return whether each kind of derivative is far from the slope, by motions enough to tell that from scatter."""
    return all(one.error > _OFF and one.num_motions >= _ENOUGH for one in found)


def _time_step_findings(measured: Measured) -> Iterator[Finding]:
    """Yield a finding where the slope of MuJoCo's outcome depends on its time step."""
    differing, readings = 0, 0
    for line in measured.lines:
        own, fine = line.plain, line.fine
        size, error = np.abs(fine.slope), np.hypot(own.slope_error, fine.slope_error)
        is_clear = (size > fine.resolution) & (error <= _CLEAR * size)
        readings += int(is_clear.sum())
        differing += int((is_clear & (np.abs(own.slope - fine.slope) > 2 * error + _DISAGREES * size)).sum())
    if differing:
        text = f"At {differing} of {readings} readings the slope is another at a time step {REFINED} times shorter."
        yield Finding("note", f"{text} Statements about slopes concern the file's own time step.")


def _order_findings(measured: Measured) -> Iterator[Finding]:
    """Yield a sentence for the file's contact, and one for a softer one."""
    for is_own in (True, False):
        felt = [one for one in measured.noises if (one.stiffness is None) == is_own and not np.isnan(one.advantage)]
        if not felt:
            continue
        until = min(one.crossover for one in felt)
        ends = f"It is better up to {until:.2g} s" if math.isfinite(until) else "It is better as far as measured"
        stiffness = felt[0].stiffness
        lead = "One" if stiffness is None else f"With all contacts at {format_number(stiffness)} 1/s² one"
        noises = " and ".join(f"{one.stddev:g}" for one in felt)
        ratios = [one.advantage for one in felt]
        times = ["over a million" if x > 1e6 else format_number(float(f"{x:.1g}")) for x in ratios]
        values = " and ".join(dict.fromkeys(times))
        text = f"{lead} first-order sample is worth {values} of zeroth order, under noise of {noises}. {ends}."
        yield Finding("order", text)


def recommend(
    motions: Motions,
    stability: StabilityReport,
    measured: Measured | None,
    max_contacts: int | None,
    price: int | float = math.inf,
) -> Recommendation:
    """Return the recommended settings from measurements and the price of a slope in that of a discrete derivative.

    Infinity is a price that is not known.
    """
    needed = [_largest_step(spring) for spring in _steps_too_long(stability)]
    timestep = float(f"{_SPARE_STEP * min(needed):.1e}") if needed else None
    if measured is None or not measured.lines:
        horizon = max(40, round(0.2 / motions.timestep))
        return Recommendation(unmeasured(price), "alpha_order", STDDEVS[0], horizon, timestep, None, max_contacts)
    found = slopes(measured.lines)
    touches = bool(motions.touches or motions.touching)
    best = nearest(found, price) if touches else "discrete"
    has_jumps = any(line.changed for line in measured.lines)
    stddev = STDDEVS[-1] if has_jumps else STDDEVS[0]
    own = [noise for noise in measured.noises if noise.stiffness is None and noise.stddev == stddev]
    softer = [noise for noise in measured.noises if noise.stiffness is not None and noise.stddev == stddev]
    limits = [noise.crossover for noise in own]
    limits += [t for line in measured.lines for t in measured.times[line.growth > LARGEST_GROWTH].tolist()]
    limit = min(limits, default=math.inf)
    last = float(measured.times[-1])
    is_limited = limit < last
    is_helped = is_limited and any(soft.advantage > 4 * max(one.advantage, 1) for soft in softer for one in own)
    return Recommendation(
        gradient=best,
        estimator="alpha_order" if has_jumps or is_limited or not own or _is_far(found) else "first_order",
        stddev=stddev,
        horizon=round(max(min(10 * motions.timestep, last), min(limit, last)) / motions.timestep),
        timestep=timestep,
        stiffness=softer[0].stiffness if is_helped else None,
        max_contacts=max_contacts,
    )


def _steps_too_long(stability: StabilityReport) -> list[Spring]:
    """Return the springs for which the time step is too long, one of each group of equal ones."""
    found = [one for one in stability.springs if _largest_step(one) < one.timestep * (1 - 1e-6)]
    return list({(one.kind, one.replaced, round(one.coupled_load, 6), one.stiffness): one for one in found}.values())


def _largest_step(spring: Spring) -> float:
    """Return the longest time step in s that resolves a spring: as its file asks, stable, and not passing through."""
    asked = math.inf if spring.replaced is None else spring.replaced / 2
    passed = spring.size / spring.speed if spring.speed and spring.kind == "contact" else math.inf
    return min(asked, spring.timestep / spring.coupled_load if spring.coupled_load >= 1 else math.inf, passed)


def _time_step(spring: Spring) -> str:
    step, needed = 1e3 * spring.timestep, format_number(1e3 * _largest_step(spring))
    what = f"The time step of {step:g} ms is too long for {spring.kind} {spring.name}"
    if spring.replaced is not None:
        asked, used = (format_number(1e3 * t) for t in (spring.replaced, spring.time_constant))
        return f"{what}: the file asks for a time constant of {asked} ms and gets {used} ms. At most {needed} ms."
    if spring.coupled_load >= 1:
        return f"{what}: it gains energy. Take less than {needed} ms, or a softer contact."
    return f"{what}: at {spring.speed:.2g} m/s it passes through. Take less than {needed} ms."


def headline(
    findings: Sequence[Finding],
    advice: Recommendation,
    motions: Motions,
    found: Sequence[Slope],
    prices: Mapping[str, float],
) -> str:
    """Return the answer, what to take, how sure and what it costs, and in a second sentence the worst fault."""
    sure = "an unmeasured choice"
    for one in found:
        if one.kind == advice.gradient:
            is_told = (count := one.errors.size) >= FEWEST_READINGS
            sure = f"{percent(one.error)} off by {count} readings" if is_told else "too few readings to tell"
    if not (motions.touches or motions.touching):
        sure = "without contact, exact"
    cost = f"; {prices[advice.gradient]:.2g} s a gradient of one rollout" if prices else ""
    ahead = f"{advice.horizon * motions.timestep:.2g} s ahead"
    minded = {finding.kind: finding.text for finding in reversed(findings) if finding.is_fault}  # of one kind the first
    words = {
        "time_step": "the time step is too long",
        "not_finite": "motions leave all numbers",
        "index": "the cost looks beyond an array",
        "cost_not_finite": "the cost is not finite",
        "cost_unfelt": "the cost does not feel the motion",
        "cost": "the cost has no derivative",
        "engines": "MJX moves it otherwise",
        "start": "it begins in a bad pose",
        "no_contact": "nothing touches",
        "untouched": minded.get("untouched", "").partition(" within")[0],
        "no_effect": "an actuator has no effect",
        "jump": "the outcome jumps",
        "explodes": "the derivative explodes",
        "slope": "no derivative is the slope",
        "many_pairs": "too many pairs can touch",
    }
    worst = next((f" Mind that {words[kind]}." for kind in words if kind in minded), "")
    return f"Take {chosen(advice.gradient)} and {advice.estimator}, {ahead}: {sure}{cost}.{worst}"


def percent(share: float) -> str:
    """Return a share as text."""
    if not 1e-4 <= share <= 10:
        return "under 0.01 %" if share < 1e-4 else "over 1000 %"
    return f"{100 * share:.2g} %" if share < 0.1 else f"{100 * share:.0f} %"
