"""What an identification says, for a page and for programs: the answer, signals, values, and the motion before and after."""

import base64
import html
import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import jax
import mujoco
import numpy as np

from mjxgrad.check.page import document
from mjxgrad.identification import Identification, Recording, Stopped
from mjxgrad.identification.files import simulated
from mjxgrad.identification.recording import stack
from mjxgrad.rollouts import render
from mjxgrad.scene import Scene

_WIDTH, _HEIGHT, _LEFT, _TOP = 360.0, 130.0, 66.0, 18.0
_MOST_SIGNALS, _MOST_DOTS = 8, 300
_FRAME = (240, 320)


@dataclass(frozen=True)
class Identified:
    """A result beside what was measured.

    Attributes:
        name: of the scene.
        scene: with the nominal values.
        result: of the search.
        recordings: that were fitted.
        held_out: that were judged by.
        seconds: that it took.
    """

    name: str
    scene: Scene
    result: Identification
    recordings: Sequence[Recording]
    held_out: Sequence[Recording]
    seconds: float

    @property
    def is_sound(self) -> bool:
        """Whether the search ended and every number was found."""
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

    def as_json(self) -> str:
        """Write it for programs; numbers in SI units, what is not determined as null."""
        result = self.result
        lower, upper = (
            result.coordinates.unravel(np.asarray(x)) for x in (result.coordinates.lower, result.coordinates.upper)
        )
        table = {
            "scene": self.name,
            "headline": self.headline,
            "parameters": {
                name: {
                    "value": _plain(value),
                    "half_width_95": _plain(result.half_width[name]),
                    "start": _plain(result.start[name]),
                    "lower": _plain(lower[name]),
                    "upper": _plain(upper[name]),
                    "unit": result.units.get(name, ""),
                }
                for name, value in result.values.items()
            },
            "condition_number": _plain(np.asarray(result.condition_number)),
            "without_effect": result.without_effect,
            "inseparable": result.inseparable,
            "at_bounds": result.at_bounds,
            "rms": result.rms,
            "held_out_rms": result.held_out_rms,
            "stopped": result.stopped.value,
            "num_steps": result.num_steps,
            "seconds": self.seconds,
        }
        return json.dumps(table, indent=2, ensure_ascii=False)

    def as_html(self) -> str:
        """Write it as one page that needs nothing beside it."""
        figures = "".join(self._figures())
        told = "".join(f"<li class=fault>{html.escape(text.strip())}</li>" for text in self.result.warnings())
        caption = "Dots: measured. Dashed: at the start of the search. Line: with the values found. Grey: held out."
        number = f"{self.result.condition_number:.2g}"
        condition = (
            f"Condition number {number}: beyond 100 or so, single intervals are much wider than those of combinations."
        )
        body = (
            f"{self._video()}<figure>{figures}<figcaption>{caption}</figcaption></figure>"
            f"<ul>{told}<li>{condition}</li></ul>{self._table()}"
        )
        return document(f"mjxgrad identify {self.name}", self.headline, body, {"In words": self.result.summary()})

    def _table(self) -> str:
        head, *rows = self.result.rows()
        cells = lambda row, tag: "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in row)  # noqa: E731
        lines = f"<tr>{cells(head, 'th')}</tr>" + "".join(f"<tr>{cells(row, 'td')}</tr>" for row in rows)
        return f"<div class=scroll><table>{lines}</table></div>"

    @property
    def _shown(self) -> Recording:
        """One motion: what was held out where it is the end of it, else the first."""
        return (self.held_out if len(self.recordings) == 1 and self.held_out else self.recordings)[0]

    @cached_property
    def _courses(self) -> tuple[dict[str, np.ndarray], ...]:
        windows, found = stack(self.scene, [self._shown]), self.result
        run = jax.jit(lambda scene, delay: simulated(scene, windows, delay))
        courses = [run(s, v.get("delay", 0.0)) for s, v in ((self.scene, found.start), (found.scene, found.values))]
        return tuple(jax.tree.map(np.asarray, course) for course in courses)

    def _figures(self) -> list[str]:
        """Draw signals, those first that the search changed most."""
        before, after = self._courses
        timestep = float(self.scene.model.opt.timestep)
        motions = [*self.recordings[:1], *([self._shown] if self._shown is not self.recordings[0] else [])]
        signals = []
        for name in self._shown.measured:
            titles = _titles(self.scene, name, before[name].shape[1])
            for i in range(before[name].shape[1]):
                times = np.concatenate([np.asarray(one.times) for one in motions])
                values = np.concatenate([one.measured[name][:, i] for one in motions])
                known = np.isfinite(values)
                if known.any():
                    spread = max(float(np.ptp(values[known])), 1e-12)
                    change = float(np.abs(after[name][:, i] - before[name][:, i]).max()) / spread
                    signals.append(
                        (change, titles[i], times[known], values[known], before[name][:, i], after[name][:, i])
                    )
        signals.sort(key=lambda one: -one[0])
        split = float(motions[0].times[-1]) if len(motions) > 1 else None
        shown = [_panel(timestep, split, *one[1:]) for one in signals[:_MOST_SIGNALS]]
        more = len(signals) - len(shown)
        return [*shown, *([f"<p>The {len(shown)} of {len(signals)} signals that changed most.</p>"] if more else [])]

    def _video(self) -> str:
        """Film the motion before and after, side by side, what was measured drawn into both where all of it was."""
        one = self._shown
        before, after = (course["qpos"] for course in self._courses)
        timestep = float(self.scene.model.opt.timestep)
        words = "Left: at the start of the search. Right: with the values found."
        parts = [*self.recordings[:1], one]
        wholes = [(np.asarray(p.times), p.measured["qpos"]) for p in parts if "qpos" in p.measured]
        height, width = _FRAME
        try:
            shots = [
                render.frames(s, q, height=height, width=width)
                for s, q in zip((self.scene, self.result.scene), (before, after), strict=True)
            ]
            times = np.concatenate([t for t, _ in wholes]) if wholes else np.zeros(0)
            rows = np.concatenate([q for _, q in wholes]) if wholes else np.zeros((0, self.scene.model.nq))
            times, rows = times[(known := np.isfinite(rows).all(axis=1))], rows[known]
            if len(times) > 1 and times[-1] >= (len(before) - 1.5) * timestep:
                order = np.argsort(times)
                nearest = np.abs(times[order] - timestep * np.arange(len(before))[:, None]).argmin(axis=1)
                real = render.frames(self.scene, rows[order][nearest], height=height, width=width)
                shots = [((shot.astype(np.uint16) + real) // 2).astype(np.uint8) for shot in shots]
                words += " Both with what was measured drawn into them."
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "motion.mp4"
                render.write_video(path, np.concatenate(shots, axis=2))
                data = base64.b64encode(path.read_bytes()).decode()
        except (RuntimeError, ValueError) as error:
            return f"<p>No video: {html.escape(str(error))}</p>"
        source = f"data:video/mp4;base64,{data}"
        video = f'<video controls loop muted autoplay playsinline src="{source}"></video>'
        return f"<figure>{video}<figcaption>{words}</figcaption></figure>"


def _titles(scene: Scene, name: str, width: int) -> list[str]:
    """Name the numbers of a signal: positions and velocities by their joints, with units; others by their place."""
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


def _panel(
    timestep: float,
    split: float | None,
    title: str,
    times: np.ndarray,
    values: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
) -> str:
    """Draw one signal: measured, at the start, found."""
    at = timestep * np.arange(len(before))
    shown = np.concatenate([values, after])
    low, high = float(shown.min()), float(shown.max())
    room = 0.15 * (high - low) or max(abs(low), 1e-9)
    low, high = low - room, high + room
    across = lambda t: _LEFT + t / max(at[-1], times.max()) * (_WIDTH - _LEFT - 8)  # noqa: E731
    up = lambda y: _TOP + (_HEIGHT - _TOP - 22) * (1 - (np.clip(y, low, high) - low) / (high - low))  # noqa: E731
    marks = []
    if split is not None:
        x, height = across(split), _HEIGHT - _TOP - 22
        size = f'width="{_WIDTH - 8 - x:.1f}" height="{height}"'
        marks.append(f'<rect class="out" x="{x:.1f}" y="{_TOP}" {size}/>')
    few = slice(None, None, max(1, len(times) // _MOST_DOTS))
    marks += [
        f'<circle class="measured" cx="{x:.1f}" cy="{y:.1f}" r="1.6"/>'
        for x, y in zip(across(times[few]), up(values[few]), strict=True)
    ]
    few = slice(None, None, max(1, len(at) // _MOST_DOTS))
    for style, curve in (("before", before), ("after", after)):
        points = "L".join(f"{x:.1f} {y:.1f}" for x, y in zip(across(at[few]), up(curve[few]), strict=True))
        marks.append(f'<path class="{style}" d="M{points}"/>')
    marks.append(f'<text x="{_LEFT}" y="12">{html.escape(title)}</text>')
    marks += [
        f'<text x="{_LEFT - 6}" y="{up(v) + 4:.1f}" text-anchor="end">{v:.3g}</text>' for v in (low + room, high - room)
    ]
    marks.append(f'<text x="{_WIDTH - 8}" y="{_HEIGHT - 6}" text-anchor="end">{at[-1]:.3g} s</text>')
    return f'<svg viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" role="img">{"".join(marks)}</svg>'


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


def _plain(value: np.ndarray) -> float | list | None:
    """Return numbers as JSON has them: null for what is not finite."""
    made = np.where(np.isfinite(value), value, np.nan).astype(object)
    made = np.array([None if x != x else float(x) for x in np.ravel(made)], object).reshape(np.shape(value))
    return made.tolist()
