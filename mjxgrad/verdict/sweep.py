"""Bias and variance of gradients of a scene of one's own, over contact stiffness, as one answer and one page."""

import html
import io
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from mjxgrad.contact.warnings import format_number
from mjxgrad.diagnostics import BiasVariance, bias_variance
from mjxgrad.diagnostics.bias_variance import ESTIMATES
from mjxgrad.scene import load_scene
from mjxgrad.verdict.check import Source, _outcomes
from mjxgrad.verdict.page import document
from mjxgrad.verdict.task import by_stiffness, scene_task

STIFFNESS = (1e2, 1e3, 1e4, 1e5, 1e6)
_SMALL, _SEEN = (
    0.05,
    0.5,
)  # shares of the truth: a bias below the first is none, one above the second must have been seen


@dataclass(frozen=True)
class Sweep:
    """What `sweep` measured.

    Attributes:
        name: of the scene.
        question: what was differentiated by what, under which noise.
        stiffness: of each row in 1/s², the file's own contact last, NaN.
        result: of `mjxgrad.diagnostics.bias_variance`.
        seconds: that it took.
    """

    name: str
    question: str
    stiffness: tuple[float, ...]
    result: BiasVariance
    seconds: float

    @property
    def labels(self) -> list[str]:
        """What each row is called."""
        return ["the file's" if np.isnan(k) else format_number(k) for k in self.stiffness]

    def is_right(self, estimate: str) -> list[bool]:
        """Say in which rows an estimate has no bias worth the name, seen well enough to say so."""
        return [
            not (row[f"{estimate}_is_biased"] and abs(row[f"{estimate}_bias"]) > _SMALL * abs(row["truth"]))
            and row[f"{estimate}_bias_high"] - row[f"{estimate}_bias_low"] < 2 * _SEEN * abs(row["truth"])
            for row in self.result.rows()
        ]

    @property
    def headline(self) -> str:
        """The answer, in at most 15 words."""
        said = [
            f"{ESTIMATES[x]} {self._where(self.is_right(x))}" for x in ESTIMATES if getattr(self.result, x) is not None
        ]
        return f"Right to {_SMALL:.0%}: {', '.join(said)}."

    def _where(self, is_right: Sequence[bool]) -> str:
        if all(is_right) or not any(is_right):
            return "everywhere" if any(is_right) else "nowhere"
        last = is_right.index(False)
        return (
            f"up to {self.labels[last - 1]} 1/s²"
            if last and not any(is_right[last:-1])
            else f"at {sum(is_right)} of {len(is_right)}"
        )

    def summary(self) -> str:
        """Say it for a terminal: the answer, what was asked, the table."""
        return f"{self.name}: {self.headline}\n\n{self.question}\n\n{self.result.summary(self.labels)}"

    def __str__(self) -> str:
        return self.summary()

    def as_json(self) -> str:
        """Write it for programs; numbers in SI units, and null for the file's own stiffness."""
        rows = [
            row | {"softness": None if np.isnan(row["softness"]) else row["softness"]} for row in self.result.rows()
        ]
        table = {
            "scene": self.name,
            "headline": self.headline,
            "question": self.question,
            "rows": rows,
            "seconds": self.seconds,
        }
        return json.dumps(table, indent=2, ensure_ascii=False)

    def as_html(self) -> str:
        """Write it as one page that needs nothing beside it; its picture is drawn by matplotlib, where that is installed."""
        try:
            file = io.StringIO()
            self.result.plot().savefig(file, format="svg")
            picture = file.getvalue()[file.getvalue().index("<svg") :]
        except ImportError as error:
            picture = f"<p>{html.escape(str(error))}</p>"
        told = f"<pre>{html.escape(self.result.summary(self.labels))}</pre>"
        body = f"<p>{html.escape(self.question)}</p><figure>{picture}</figure>{told}"
        return document(f"mjxgrad sweep {self.name}", self.headline, body, {})


def sweep(
    source: Source,
    cost: str | None = None,
    *,
    start: str | None = None,
    horizon: int | None = None,
    noise: float = 0.1,
    stiffness: Sequence[float] = STIFFNESS,
    num_samples: int = 256,
    num_reference: int = 2048,
    gradient: str = "onset",
    seed: int = 0,
    log: Callable[[str], None] | None = None,
) -> Sweep:
    """Measure bias and variance of first, zeroth and α-order over contact stiffness, in a scene of one's own.

    Args:
        source: an MJCF file, or what else `load_scene` takes.
        cost: as `scene_task` takes it; None is a fixed random mix of where the heaviest body ends up.
        start: a key frame by name.
        horizon: steps.
        noise: standard deviation on every control at every step, in halves of its range; without actuators on the
            velocities at the start (m/s, rad/s).
        stiffness: to sweep in 1/s², besides the file's own.
        num_samples: rollouts of each estimate.
        num_reference: rollouts of the truth.
        gradient: as in `scene_task`.
        seed: of all that is random.
        log: called with what is being done.

    Raises:
        ValueError: as `scene_task` and `bias_variance`, and if a stiffness is not positive.
    """
    started = time.perf_counter()
    scene = load_scene(source)
    names, outcomes = _outcomes(scene, None, np.random.default_rng(seed))
    task = scene_task(scene, cost or (lambda t: outcomes(t)[0]), start=start, horizon=horizon, gradient=gradient)
    objective, by = by_stiffness(task, noise, seed)
    swept = (*sorted(stiffness), float("nan")) if scene.pairs else (float("nan"),)
    if not min(swept) > 0:
        raise ValueError(f"stiffness must be positive, got {min(swept):g}")
    on = "every control at every step" if task.num_controls else "it"
    asked = (
        f"Cost: {cost or f'a random mix of {names[0]}'}, after {task.horizon} steps. By {by}; noise {noise:g} on {on}."
    )
    if not scene.pairs:
        asked += " No two geoms can touch, so stiffness has no effect."
    result = bias_variance(
        objective,
        jnp.zeros((1, 1)),
        jax.random.key(seed),
        softness=jnp.array(swept),
        num_samples=num_samples,
        num_reference=num_reference,
        progress=None if log is None else lambda done, total: log(f"{done} of {total} stiffnesses"),
    )
    return Sweep(scene.name, asked, swept, result, time.perf_counter() - started)
