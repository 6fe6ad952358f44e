"""Report of an identification as a page: the answer, signals before and after, and values."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import mujoco
import numpy as np

from mjxgrad.identification import Identification, Recording, Stopped
from mjxgrad.identification.recording import simulated, stack
from mjxgrad.report import INK, Block, Table, page, svg
from mjxgrad.scene import Scene

_MOST_SIGNALS, _MOST_DOTS = 8, 300
_SIZE = (4.6, 2.1)  # inches


@dataclass(frozen=True)
class Identified:
    """A result beside its recordings.

    Attributes:
        name: name of the scene.
        scene: the scene with the nominal values.
        result: the result of the search.
        recordings: the fitted recordings.
        held_out: the held-out recordings.
    """

    name: str
    scene: Scene
    result: Identification
    recordings: Sequence[Recording]
    held_out: Sequence[Recording]

    @property
    def is_sound(self) -> bool:
        """Whether the search converged and determined every number."""
        result = self.result
        return result.stopped is Stopped.CONVERGED and not (
            result.without_effect or result.inseparable or result.at_bounds
        )

    @property
    def headline(self) -> str:
        """The answer, in at most 15 words."""
        result = self.result
        lost = int(np.isinf(np.concatenate([np.ravel(half) for half in result.half_width.values()])).sum())
        if result.stopped is not Stopped.CONVERGED:
            ended = "stalled" if result.stopped is Stopped.STALLED else "was cut short"
            return f"The search {ended}: do not trust the values."
        count = len(result.names)
        found = f"{count - lost} of {count} numbers found" if lost else f"All {count} found" if count > 1 else "Found"
        if result.at_bounds and not lost:
            found = f"{len(result.at_bounds)} of {count} numbers ended at a bound"
        rms, which = (result.rms, "error") if result.held_out_rms is None else (result.held_out_rms, "held-out error")
        return f"{found}: {which} {_percent(rms[1])} of the motion, {_percent(rms[0])} before."

    def as_html(self) -> str:
        """Return the result as a self-contained page; needs `mjxgrad[render]`."""
        number, (head, *rows) = f"{self.result.condition_number:.2g}", self.result.rows()
        condition = (
            f"Condition number {number}: beyond 100 or so, single intervals are much wider than those of combinations."
        )
        faults = [text.strip() for text in self.result.warnings()]
        numbers = Block(faults=faults, items=[condition], table=Table(head, rows))
        blocks = [self._figures(), numbers, Block(folded="In words", code=self.result.summary())]
        return page(self.headline, f"mjxgrad identify {self.name}", blocks)

    @property
    def _shown(self) -> Recording:
        """The motion to show: the held-out end of a single recording, else the first recording."""
        return (self.held_out if len(self.recordings) == 1 and self.held_out else self.recordings)[0]

    def _figures(self) -> Block:
        """Draw the signals, sorted by how much the search changed them."""
        window, found = jax.tree.map(lambda leaf: leaf[0], stack(self.scene, [self._shown])), self.result
        run = jax.jit(lambda scene, delay: simulated(scene, window, None, delay)[0])
        courses = [run(s, v.get("delay", 0.0)) for s, v in ((self.scene, found.start), (found.scene, found.values))]
        before, after = jax.tree.map(np.asarray, courses)
        motions = list({id(one): one for one in (self.recordings[0], self._shown)}.values())
        times = np.concatenate([motion.times for motion in motions])
        signals = []
        for name in self._shown.measured:
            rows = np.concatenate([motion.measured[name] for motion in motions])
            titles = _titles(self.scene, name, rows.shape[1])
            for title, values, old, new in zip(titles, rows.T, before[name].T, after[name].T, strict=True):
                if (known := np.isfinite(values)).any():
                    change = np.abs(new - old).max() / max(np.ptp(values[known]), 1e-12)
                    signals.append((change, title, times[known], values[known], old, new))
        signals.sort(key=lambda one: -one[0])
        drawings = [
            svg(lambda one=one: self._panel(*one[1:]), f"{one[1]} over time") for one in signals[:_MOST_SIGNALS]
        ]
        caption = "Dots: measured. Dashed: at the start of the search. Line: with the values found. Grey: held out."
        if len(signals) > len(drawings):
            caption += f" The {len(drawings)} of {len(signals)} signals that changed most."
        return Block(drawings=drawings, caption=caption)

    def _panel(self, title: str, times: np.ndarray, values: np.ndarray, before: np.ndarray, after: np.ndarray) -> Any:
        """Draw a signal over time: measured, at the start, identified; the curve at the start may leave the picture."""
        import matplotlib.pyplot as plt

        figure, axis = plt.subplots(figsize=_SIZE)
        at = float(self.scene.model.opt.timestep) * np.arange(len(before))
        end = max(at[-1], times.max())
        if self._shown is not self.recordings[0]:
            axis.axvspan(float(self.recordings[0].times[-1]), end, color="#8b94a1", alpha=0.2, lw=0)
        shown = slice(None, None, max(1, len(times) // _MOST_DOTS))
        axis.plot(times[shown], values[shown], "o", color=INK, ms=2.5, mew=0, alpha=0.6)
        axis.plot(at, before, "--", color="#d55e00", lw=1.2)
        axis.plot(at, after, "-", color="#0072b2", lw=1.4)
        low, high = (float(pick([pick(values), pick(after)])) for pick in (np.min, np.max))
        room = 0.15 * (high - low) or max(abs(low), 1e-9)
        axis.set_title(title, parse_math=False)  # names may contain dollars
        axis.set(xlabel="time, s", xlim=(0, end), ylim=(low - room, high + room))
        return figure


def _titles(scene: Scene, name: str, width: int) -> list[str]:
    """Return titles for the numbers of a signal: joints with units for positions and velocities, else indices."""
    if name not in ("qpos", "qvel"):
        return [name] if width == 1 else [f"{name}[{i}]" for i in range(width)]
    model, found = scene.mj_model, []
    for joint in range(model.njnt):
        label = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint)
        # A free joint often has no name, but its body has one.
        label = label or mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, model.jnt_bodyid[joint]) or f"joint {joint}"
        kind, rate = mujoco.mjtJoint(model.jnt_type[joint]), "/s" * (name == "qvel")
        turns = [f"rotation {axis}, rad/s" for axis in "xyz"] if rate else [f"quaternion {part}" for part in "wxyz"]
        parts = {
            mujoco.mjtJoint.mjJNT_FREE: [*(f"{axis}, m{rate}" for axis in "xyz"), *turns],
            mujoco.mjtJoint.mjJNT_BALL: turns,
            mujoco.mjtJoint.mjJNT_SLIDE: [f"m{rate}"],
            mujoco.mjtJoint.mjJNT_HINGE: [f"rad{rate}"],
        }[kind]
        found += [f"{label}, {part}" if len(parts) == 1 else f"{label} {part}" for part in parts]
    return found


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 0.995 else f"{100 * share:.0f} %"
