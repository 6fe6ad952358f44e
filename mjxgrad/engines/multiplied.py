"""A word of warning where slopes of the outcome multiply from step to step as the outcome itself does not.

Where contacts chatter, single slopes scatter by several times the slope, and their products over many steps by powers of that.
Motions beside the given one tell: they part as the outcome does, for a few rollouts where the derivatives took a hundred.
"""

from collections.abc import Callable, Mapping

import mujoco
import numpy as np
from jaxtyping import Float

from mjxgrad._text import format_number
from mjxgrad.engines.flight import NUM_SLOTS, PAIRS, advance
from mjxgrad.engines.layout import MOTION, Layout

_Arrays = Mapping[str, np.ndarray]
_FEWEST = 20  # steps, of which products scatter little
# Sizes of a change of all coordinates by which motions are apart (m or rad, and per second): of nearer ones a jump says nothing.
_APART = (1e-3, 1e-2)
_MOST = 10.0  # times as far as motions part a derivative may take a change


class SlopeWarning(UserWarning):
    """Slopes of the outcome multiply, see `multiplied`."""


def multiplied(
    run: Callable[[_Arrays, _Arrays, _Arrays], _Arrays],
    model: mujoco.MjModel,
    layout: Layout,
    numbers: _Arrays,
    before: _Arrays,
    inputs: _Arrays,
    found: _Arrays,
) -> str:
    """Return what to say of slopes of a motion, the first of its batch; nothing where motions beside it part as far."""
    steps, nv = inputs["ctrl"].shape[1], model.nv
    if steps < _FEWEST or not np.isfinite(before["qpos"][0]).all():
        return ""
    change = np.zeros(layout.num_changes)
    change[: 2 * nv] = np.random.default_rng(0).normal(size=2 * nv)
    change /= np.linalg.norm(change)
    expected = _followed(found, change)[:, :nv]
    seen = _parted(run, model, numbers, before, inputs, change)
    by_slopes, by_motions = (np.linalg.norm(x, axis=-1).max(initial=0.0) for x in (expected, seen))
    if not np.isfinite(by_motions) or by_slopes <= _MOST * by_motions:
        return ""
    grows, parts = map(format_number, (by_slopes, by_motions))
    told = f"a small change of the start grows {grows} times by them, and {parts} times between motions that begin beside it"
    remedy = "take contact=mg.Discrete(), fewer steps, or shorter ones"
    return f"slopes of the outcome multiply over {steps} steps, since contacts chatter: {told}; {remedy}"


def _followed(found: _Arrays, change: Float[np.ndarray, " changes"]) -> Float[np.ndarray, "steps changes"]:
    """Return what becomes of a change of the start by the derivatives of the steps."""
    main, held, course = change, np.zeros(NUM_SLOTS), []
    with np.errstate(invalid="ignore", over="ignore"):
        for t in range(len(found["state"][0])):
            step = {name: found[name][0, t] for name in ("state", *PAIRS)} | {"by state": 0.0, "by felt": 0.0}
            main, held, total = advance(np, main, held, step)
            course.append(total)
    return np.nan_to_num(course, nan=np.inf)


def _parted(
    run: Callable[[_Arrays, _Arrays, _Arrays], _Arrays],
    model: mujoco.MjModel,
    numbers: _Arrays,
    before: _Arrays,
    inputs: _Arrays,
    change: Float[np.ndarray, " changes"],
) -> Float[np.ndarray, "widths steps nv"]:
    """Return how far motions part whose starts are apart along a change, over that."""
    nv, sizes = model.nv, np.array([side * size for size in _APART for side in (1.0, -1.0)])
    start = {name: np.repeat(before[name][:1, 0], len(sizes), axis=0) for name in ("time", *MOTION) if name in before}
    for qpos, size in zip(start["qpos"], sizes, strict=True):
        mujoco.mj_integratePos(model, qpos, change[:nv], size)
    start["qvel"] = start["qvel"] + sizes[:, None] * change[nv : 2 * nv]
    own = {name: value[:1] for name, value in numbers.items()}
    ends = run(own, start, {name: np.repeat(value[:1], len(sizes), axis=0) for name, value in inputs.items()})["qpos"]
    parted = np.zeros((len(_APART), ends.shape[1], nv))
    for (k, t), width in np.ndenumerate(np.broadcast_to(2 * np.array(_APART)[:, None], parted.shape[:2])):
        mujoco.mj_differentiatePos(model, parted[k, t], width, ends[2 * k + 1, t], ends[2 * k, t])
    return parted
