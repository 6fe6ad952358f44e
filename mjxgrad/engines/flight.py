r"""Two motions from either side of an event, followed while the derivative along the motion does not say how they differ.

A step that spans an event has a large derivative: one side was pushed by a contact, the other is pushed a step later. After a few
steps both have been, and differ little. Between, the outcome's change is D_j h, with D_j the difference of the two motions after
j steps over their distance before, and h the share of that distance by which a change moves the event. Changes go two ways:

    x' = A x + b,        h' = keep (h + slots (F x + f)),        whole change = x' + D h'.

A is the derivative along the motion without events, F what each event that begins feels. A pair that is let go joins x.

- **Explained.** A pair is explained after three steps in a row in which D' is A D to a twentieth. An event between the two adds
  its jump to A D. If it is less far apart than half of the event's window, it may add what a small difference does instead.
- **Let go.** Once explained, it is let go if it is at most ten times as far apart as at first; or, at an event, if it is less far
  apart than the event's own window, which is then a better mean. After a hundred steps all are let go.
- **Slots.** Where a motion has no more room for pairs, explained ones are let go, and then events begin none but are those of a
  discrete gradient. A jump that is let go unexplained is multiplied by what follows.

A landing is over after four steps. Chatter goes on for longer: a derivative is multiplied at each event, a difference is not.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from mjxgrad.engines.layout import Layout
from mjxgrad.stepping import slope

NUM_SLOTS = 96
_Step = Callable[[np.ndarray, list[mujoco.MjModel]], np.ndarray]  # from states and models to the states after a step
PAIRS = ("felt", "slot", "apart", "stays")
"""Of a slope, beside "state": what each event that begins feels, its slot, D of each slot, and whether a slot goes on."""
FIRST = ("before", "enters")
"""D before the first step, and which slots go on into it."""


def begin(total: Any, held: Any, first: dict[str, Any]) -> tuple[Any, Any]:
    """Return a change without what is in flight, and what is, before the first step."""
    held = (first["enters"][:, None] if held.ndim > 1 else first["enters"]) * held
    return total - first["before"] @ held, held


def advance(xp: Any, main: Any, held: Any, step: dict[str, Any]) -> tuple[Any, Any, Any]:
    """Return the change along one motion, what is in flight after a step, and the whole change, by `numpy` or `jax.numpy`."""
    # This is the one place where derivatives of steps are composed. `main` may have several columns. A step has "state"
    # and "by state", what it adds to a change; of a slope, "felt", "by felt", "slot", "apart", "stays".
    end = step["state"] @ main + step["by state"]
    if "felt" not in step:
        return end, held, end
    slots = (step["slot"] == xp.arange(len(held))[:, None]).astype(end.dtype)
    held = held + slots @ (step["felt"] @ main + step["by felt"])
    total = end + step["apart"] @ held
    kept = (step["stays"][:, None] if held.ndim > 1 else step["stays"]) * held
    return total - step["apart"] @ kept, kept, total


@dataclass
class Begun:
    """Pairs that begin in a step, one for each mode of its events."""

    felt: Float[np.ndarray, "modes size"]  # F, by a change
    ends: Float[np.ndarray, "modes 2 motion"]  # both motions after the step
    widths: Float[np.ndarray, " modes"]  # how far apart each pair began
    apart: Float[np.ndarray, "modes size"]  # D after the step
    lost: Float[np.ndarray, "size modes"]  # small differences along the displacements that events replace
    longest: int = slope.LONGEST  # after how many steps these pairs are let go in any case
    # F, by each entry of what else moves gaps.
    by_others: dict[str, Float[np.ndarray, "modes entries"]] = field(default_factory=dict)

    def parted(self, count: int) -> tuple["Begun", "Begun"]:
        def of(part: slice) -> "Begun":
            arrays = {name: getattr(self, name)[part] for name in ("felt", "ends", "widths", "apart")}
            others = {name: share[part] for name, share in self.by_others.items()}
            return Begun(**arrays, lost=self.lost[:, part], longest=self.longest, by_others=others)

        return of(slice(count)), of(slice(count, None))


@dataclass
class Flight:
    """Pairs in flight, of a batch of motions."""

    ends: Float[np.ndarray, "motions slots 2 motion"]
    widths: Float[np.ndarray, "motions slots"]
    left: Int[np.ndarray, "motions slots"]
    alike: Int[np.ndarray, "motions slots"]
    apart: Float[np.ndarray, "motions slots size"]

    @classmethod
    def unpacked(
        cls, packed: Float[np.ndarray, "motions slots numbers"], layout: Layout, rows: Float[np.ndarray, "motions size"]
    ) -> "Flight":
        """Return a flight from its numbers, beside whole states."""
        size = layout.num_changes
        widths, left, alike = np.moveaxis(packed[..., 2 * size :], -1, 0)
        ends = np.zeros((*widths.shape, 2, len(layout.motion)))
        apart = np.zeros((*widths.shape, size))
        if (live := widths > 0).any():
            motions, slots = np.nonzero(live)
            away = packed[motions, slots, : 2 * size].reshape(-1, 2, size)
            both = layout.moved(rows[motions][:, None], away)
            ends[motions, slots] = both[..., layout.motion]
            apart[motions, slots] = layout.difference(both[:, 0], both[:, 1]) / widths[live][:, None]
        return cls(ends, widths.copy(), left.astype(int), alike.astype(int), apart)

    def packed(
        self, layout: Layout, rows: Float[np.ndarray, "motions size"]
    ) -> Float[np.ndarray, "motions slots numbers"]:
        """Return all in one array, with both ends as changes of whole states, which single precision does not round away."""
        size = layout.num_changes
        found = np.zeros((*self.widths.shape, 2 * size + 3))
        if (live := self.widths > 0).any():
            motions, slots = np.nonzero(live)
            both = np.repeat(rows[motions][:, None], 2, axis=1)
            both[..., layout.motion] = self.ends[motions, slots]
            found[motions, slots, : 2 * size] = layout.difference(both, rows[motions][:, None]).reshape(
                len(motions), -1
            )
            found[motions, slots, 2 * size :] = np.stack([self.widths, self.left, self.alike], axis=-1)[live]
        return found


@dataclass(frozen=True)
class Course:
    """Steps of a batch of motions: their states, what their events begin, and derivatives without events."""

    rows: Float[np.ndarray, "motions steps size"]
    matrices: Float[np.ndarray, "motions steps changes changes"]
    begun: dict[tuple[int, int], Begun]
    models: Callable[[int, int], mujoco.MjModel]
    is_finite: Bool[np.ndarray, "motions steps"]


def fly(
    flight: Flight, course: Course, layout: Layout, scale: np.ndarray, step: _Step, found: Mapping[str, np.ndarray]
) -> None:
    """Take pairs in flight through all steps of a course, and write what the recursion needs, see `advance`."""
    # The scale makes changes lengths. What is found has axes of motions and, but for "before" and "enters", of steps.
    steps = course.rows.shape[1]
    by_step: dict[int, list[int]] = {}
    for motion, t in course.begun:
        by_step.setdefault(t, []).append(motion)
    for t in range(steps):
        live, starting = flight.widths > 0, by_step.get(t, ())
        if live.any():
            size = np.linalg.norm(scale * flight.apart, axis=-1)
            known = flight.alike >= slope.NUM_ALIKE
            live &= (flight.left > 0) & ~(known & (size <= slope.FAR))
            for motion in starting:
                near = known[motion] & live[motion]
                if near.any():
                    one = course.begun[motion, t]
                    reach = np.abs(one.felt @ flight.apart[motion].T) * flight.widths[motion]
                    live[motion] &= ~(near & (reach <= one.widths[:, None]).all(axis=0))
        slots = {}
        for motion in starting:
            one, free = course.begun[motion, t], np.flatnonzero(~live[motion])
            if len(free) < (count := len(one.widths)):
                held = np.flatnonzero(live[motion] & (flight.alike[motion] >= slope.NUM_ALIKE))
                order = np.argsort(np.linalg.norm(scale * flight.apart[motion, held], axis=-1))
                free = np.concatenate([free, held[order[: count - len(free)]]])
                live[motion, free] = False
                course.begun[motion, t], missed = one.parted(len(free))
                course.matrices[motion, t] += missed.lost @ missed.felt
                for name, share in missed.by_others.items():
                    found[name][motion, t] += missed.lost @ share
            slots[motion] = free[:count]
        if t:
            found["stays"][:, t - 1] = live
        else:
            found["before"][:], found["enters"][:] = np.swapaxes(flight.apart * live[..., None], -1, -2), live
        flight.widths[~live] = 0.0
        if live.any():
            _advance(flight, live, course, t, layout, scale, step)
        for motion, chosen in slots.items():
            one, count = course.begun[motion, t], len(chosen)
            flight.ends[motion, chosen], flight.widths[motion, chosen] = one.ends, one.widths
            flight.left[motion, chosen], flight.alike[motion, chosen] = one.longest - 1, 0
            flight.apart[motion, chosen] = one.apart
            found["slot"][motion, t, :count], found["felt"][motion, t, :count] = chosen, one.felt
            for name, share in one.by_others.items():
                found[f"felt {name}"][motion, t, :count] = share
        found["apart"][:, t] = np.swapaxes(np.where(flight.widths[..., None] > 0, flight.apart, 0.0), -1, -2)
    found["stays"][:, -1] = flight.widths > 0


def _advance(
    flight: Flight, live: np.ndarray, course: Course, t: int, layout: Layout, scale: np.ndarray, step: _Step
) -> None:
    """Take both motions of each pair through a step, and see whether derivatives say how they differ."""
    motions, slots = np.nonzero(live)
    rows = np.repeat(course.rows[motions, t][:, None], 2, axis=1)
    rows[..., layout.motion] = flight.ends[motions, slots]
    # Pairs of a motion follow each other.
    first = np.flatnonzero(np.diff(motions, prepend=-1))
    counts = np.diff(first, append=len(motions)).tolist()
    models = [
        model for i, n in zip(first, counts, strict=True) for model in 2 * n * [course.models(int(motions[i]), t)]
    ]
    rows = step(rows.reshape(-1, rows.shape[-1]), models).reshape(rows.shape)
    ends = rows[..., layout.motion]
    with np.errstate(invalid="ignore"):
        apart = layout.difference(rows[:, 0], rows[:, 1]) / flight.widths[motions, slots][:, None]
    before = flight.apart[motions, slots]
    expected = (course.matrices[motions, t] @ before[..., None])[..., 0]
    off = np.linalg.norm(scale * (apart - expected), axis=-1)
    for begin, count in zip(first.tolist(), counts, strict=True):
        if (one := course.begun.get((int(motions[begin]), t))) is not None:
            own = slice(begin, begin + count)
            felt, left = before[own] @ one.felt.T, apart[own] - expected[own]
            off[own] = np.linalg.norm(scale * (left - felt @ one.apart), axis=-1)
            reach = np.abs(felt) * flight.widths[motions[own], slots[own]][:, None]
            beside = np.linalg.norm(scale * (left - felt @ one.lost.T), axis=-1)
            is_beside = (reach <= slope.BESIDE * one.widths).all(axis=1)
            off[own] = np.where(is_beside, np.minimum(off[own], beside), off[own])
    is_sound = np.isfinite(apart).all(axis=-1) & course.is_finite[motions, t]
    known = off <= slope.ALIKE * np.linalg.norm(scale * apart, axis=-1)
    flight.alike[motions, slots] = np.where(known, flight.alike[motions, slots] + 1, 0)
    flight.left[motions, slots] -= 1
    flight.ends[motions, slots] = np.where(is_sound[:, None, None], ends, 0.0)
    flight.apart[motions, slots] = np.where(is_sound[:, None], apart, 0.0)
    flight.widths[motions, slots] *= is_sound
