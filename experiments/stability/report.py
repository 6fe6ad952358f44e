"""The answer of an experiment on stability in words, computed from its numbers."""

from collections import Counter
from collections.abc import Iterator

import numpy as np

from experiments.report import Table
from experiments.stability.classes import Derivative, Motion
from experiments.stability.limits import load
from experiments.stability.outcome import C_MUJOCO, Behaviour, Outcome, SceneOutcome
from experiments.stability.reasons import UNEXPLAINED, reasons

_FAILS = Motion.GAINS_ENERGY


def verdict(outcome: Outcome) -> str:
    """Say whether a failure goes unflagged, and how mjxgrad compares with C MuJoCo."""
    precisions = outcome.settings.precisions
    silent = sum(outcome.total(name, "is_silent") for name in precisions)
    missed = sum(outcome.total(name, "is_missed") for name in precisions)
    sentences = [
        f"Over {outcome.num_points} points, {' and '.join(precisions)}, {_count(silent)} left a rollout with a number that is "
        f"not finite and no flag, and `soundness` missed {_count(missed)} of the gradients that are not finite or explode."
    ]
    for name in precisions:
        stopped = sum(int((one.behaviour[name].motion == Motion.UNSOLVED).sum()) for one in outcome.scenes)
        untold = outcome.total(name, "is_untold")
        worse = sum(int(one.worse(name).sum()) for one in outcome.scenes)
        better = sum(int(one.better(name).sum()) for one in outcome.scenes)
        open_ones = _reasons(outcome, name)[UNEXPLAINED]
        sentences.append(
            f"In {name} the motion is of a worse kind than that of C MuJoCo at {_count(worse)} of the points"
            f"{f' ({_count(open_ones)} without a reason found)' if worse else ''}, and of a better one at {_count(better)}; "
            f"{_count(stopped)} {'have' if stopped > 1 else 'has'} a step that is not solved to a thousandth"
            + (f", which `Trajectory.unsolved` does not tell at {_count(untold)}." if stopped else ".")
        )
    return " ".join(sentences)


def findings(outcome: Outcome) -> list[str]:
    """Single findings, one sentence each."""
    found = [_limit(outcome), *(_gradients(outcome, name) for name in outcome.settings.precisions)]
    found += [_unflagged(outcome, name) for name in outcome.settings.precisions]
    return [sentence for sentence in found if sentence]


def tables(outcome: Outcome) -> list[Table]:
    """Count classes by scene and simulator, and give the reasons of what is worse than C MuJoCo."""
    return [_motions(outcome), _derivatives(outcome), *_explained(outcome)]


def _count(number: int) -> str:
    return "none" if number == 0 else f"{number}"


def _limit(outcome: Outcome) -> str | None:
    """Compare the limit with what single bounces do."""
    predicted, fails = [], []
    for one in outcome.scenes:
        if one.scene.bounces:
            predicted.append(load(one.scene, one.points))
            fails.append(one.behaviour["float64"].motion >= _FAILS)
    if not predicted:
        return None
    ratio, fails = np.concatenate(predicted), np.concatenate(fails)
    below, beyond = ratio < 1, ratio >= 1
    exceptions = int((fails & below).sum())
    gain = "gains" if exceptions == 1 else "gain"
    sentence = f"Of {below.sum()} single bounces within the explicit limit {_count(exceptions)} {gain} energy"
    if exceptions:
        sentence += f", the earliest at {ratio[fails].min():.2g} times the largest stable time step"
    spared = int((~fails & beyond).sum())
    return f"{sentence}; of {beyond.sum()} beyond it " + (f"all but {spared} do." if spared else "all do.")


def _gradients(outcome: Outcome, precision: str) -> str:
    kinds = _joined(outcome, precision, "derivative")
    motions = np.concatenate([one.behaviour[precision].motion for one in outcome.scenes])
    by_parameters = _joined(outcome, precision, "by_parameters")
    is_fine = motions < _FAILS
    judged = np.isin(kinds, (Derivative.RIGHT, Derivative.WRONG, Derivative.EXPLODES, Derivative.NON_FINITE))
    also = np.isin(by_parameters, (Derivative.RIGHT, Derivative.WRONG, Derivative.EXPLODES, Derivative.NON_FINITE))
    return (
        f"In {precision}, where the motion is fine, the derivative by the start is right at "
        f"{((kinds == Derivative.RIGHT) & is_fine).sum()} of {(judged & is_fine).sum()} points that finite differences can judge"
        f", that by contact parameters, friction and time step at {((by_parameters == Derivative.RIGHT) & is_fine).sum()} of "
        f"{(also & is_fine).sum()}."
    )


def _unflagged(outcome: Outcome, precision: str) -> str | None:
    unflagged = outcome.total(precision, "is_unflagged")
    if not unflagged:
        return None
    kinds = _joined(outcome, precision, "derivative")
    return (
        f"In {precision}, {unflagged} gradients explode or are not finite ({(kinds == Derivative.NON_FINITE).sum()} of them not "
        "finite) although their rollouts did not diverge: only `soundness`, or an estimator's count, tells."
    )


def _joined(outcome: Outcome, precision: str, what: str) -> np.ndarray:
    return np.concatenate([getattr(one.behaviour[precision], what) for one in outcome.scenes])


def _simulators(one: SceneOutcome) -> Iterator[tuple[str, Behaviour]]:
    for name, behaviour in one.behaviour.items():
        yield (name if name == C_MUJOCO else f"mjxgrad, {name}"), behaviour


def _cells(values: np.ndarray, kinds: type[Motion] | type[Derivative]) -> list[str]:
    counts = np.bincount(values, minlength=len(kinds))
    return [str(count) if count else "" for count in counts]


def _motions(outcome: Outcome) -> Table:
    rows = []
    for one in outcome.scenes:
        for i, (name, behaviour) in enumerate(_simulators(one)):
            rows.append(["" if i else one.scene.name, name, *_cells(behaviour.motion, Motion)])
    return Table(
        ("scene", "simulator", *(kind.label for kind in Motion)),
        rows,
        "Points by what the motion does. Bounces are judged by their restitution where it is known, by closed form or quadrature"
        "; “gains energy” is more kinetic energy than start, gravity and compressed springs had to give; “not solved” is an "
        "acceleration that is off by a thousandth of a step’s velocity, by the forces that it leaves unbalanced; where these are "
        "rounded, in float32, by the forces of the same state in float64.",
    )


def _derivatives(outcome: Outcome) -> Table:
    rows = []
    for one in outcome.scenes:
        first = one.scene.name
        for name, behaviour in _simulators(one):
            lines = (
                ("by the start", behaviour.derivative),
                ("by parameters", behaviour.by_parameters),
                ("event", behaviour.event),
            )
            for what, values in lines:
                if values is not None:
                    rows.append([first, name, what, *_cells(values, Derivative)])
                    first = ""
    return Table(
        ("scene", "simulator", "derivative", *(kind.label for kind in Derivative)),
        rows,
        "Points by what the derivative is. C MuJoCo’s is a central difference; it is unjudged where two widths disagree. Those "
        "of mjxgrad are judged by central differences of mjxgrad in float64, the event gradient by the restitution.",
    )


def _reasons(outcome: Outcome, precision: str) -> Counter[str]:
    return Counter(reason for one in outcome.scenes for reason in reasons(one, precision).values())


def _explained(outcome: Outcome) -> list[Table]:
    rows = []
    for one in outcome.scenes:
        for precision in outcome.settings.precisions:
            found = reasons(one, precision)
            for reason, count in Counter(found.values()).most_common():
                index = next(i for i, why in found.items() if why == reason)
                rows.append([one.scene.name, precision, reason, str(count), _example(one, precision, index)])
    if not rows:
        return []
    caption = "Points where the motion of mjxgrad is of a worse kind than that of C MuJoCo, by the reason found, with one each."
    return [Table(("scene", "precision", "reason", "points", "for instance"), rows, caption)]


def _example(one: SceneOutcome, precision: str, index: int) -> str:
    plane = one.points.family[index]
    point = one.points[index]
    names = point if plane < 0 else dict.fromkeys(one.points.planes[plane])
    shown = ", ".join(f"{name.replace('_', ' ')} {point[name]:.3g}" for name in names)
    ours, theirs = (Motion(one.behaviour[name].motion[index]).label for name in (precision, C_MUJOCO))
    return f"{shown}: {ours}, C MuJoCo {theirs}"
