r"""Two motions from either side of an event, followed until the derivative along the motion explains how they differ.

A step that spans an event has a large derivative: one side was pushed by a contact, the other is pushed a step later. After a few
steps both have been, and differ little. Between, the outcome's change is D_j L x, with D_j the difference of the two motions
after j steps over their distance before. It joins the change x along the motion once D_{j+1} = A D_j to a twentieth, in three
steps in a row, and is at most 10; or after a hundred steps. A is the derivative of each of these along the motion, its events as
they are after one step. Motions that are farther apart span many phases of the next event, and a derivative would multiply there.

A landing is over after four steps. Chatter goes on for longer, and there this matters: a derivative is multiplied at each event,
a difference of two motions is not.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby

import mujoco
import numpy as np
from jaxtyping import Float

# Let go after one step that is alike, a rolling ball's derivatives scatter twice as far. Of a falling arm that bounces twice,
# four keep both motions until the second bounce, which then is not averaged over its own phases. Alike to a tenth, within thirty
# steps and half the slots, derivatives of dm_control's walker that falls for half a second scatter ten times as far.
_NUM_ALIKE, _ALIKE = 3, 0.05
_FEWEST_SLOTS = 96
_FAR = 10.0  # times the distance at first; the arm is off with 5

End = Sequence[np.ndarray]
"""Position, velocity and activation."""


@dataclass
class Pair:
    """Two motions that begin at either side of an event.

    Attributes:
        model: the model of both.
        ends: where both are.
        distance: how far apart they began.
        felt: the share of that distance by which a change of the state moves the event.
        scale: weights of the entries of a difference.
        apart: how far apart they are after each step, over the distance.
        place: which course, and which of its steps, the event is in.
        by_others: `felt`, by each entry of what else moves gaps.
        longest: after how many steps they are let go in any case.
        num_alike: how many steps in a row the motion's derivative has explained.
    """

    model: mujoco.MjModel
    ends: Sequence[End]
    distance: float
    felt: Float[np.ndarray, " size"]
    scale: Float[np.ndarray, " size"]
    apart: list[Float[np.ndarray, " size"]]
    place: tuple[int, int] = (0, 0)
    by_others: dict[str, np.ndarray] = field(default_factory=dict)
    longest: int = 100
    num_alike: int = 0

    @property
    def is_over(self) -> bool:
        """Whether the motion's derivative may take over."""
        if len(self.apart) >= self.longest:
            return True
        return self.num_alike >= _NUM_ALIKE and np.linalg.norm(self.scale * self.apart[-1]).item() <= _FAR

    def size(self, step: int) -> float:
        """Return how far apart both are before a step of the course, infinite where they begin."""
        past = step - self.place[1]
        return np.linalg.norm(self.scale * self.apart[past - 1]).item() if past else np.inf

    def go_on(
        self,
        ends: Sequence[End],
        difference: Float[np.ndarray, " size"],
        expected: Float[np.ndarray, " size"],
    ) -> bool:
        """Take where both are after a further step, and what the motion's derivative expects; return whether it is finite."""
        apart = difference / self.distance
        if not np.isfinite(apart).all():
            return False
        self.ends = ends
        self.apart.append(apart)
        off, size = (np.linalg.norm(self.scale * x) for x in (apart - expected, apart))
        self.num_alike = self.num_alike + 1 if off <= _ALIKE * size else 0
        return True


def num_slots(model: mujoco.MjModel) -> int:
    """Return how many pairs of a motion are followed at a time; a step begins no more than there are velocities."""
    return max(3 * model.nv, _FEWEST_SLOTS)


def settle(pairs: Sequence[Pair], found: Mapping[str, np.ndarray]) -> None:
    """Give pairs their slots, and write what each feels, how far it is apart and whether it goes on.

    Where slots lack, the pair that is least apart is let go.

    Args:
        pairs: those of all courses.
        found: "felt", "slot", "apart" and "stays", and "felt name" of others, with axes of courses and steps in front.
    """
    slots = range(found["stays"].shape[-1])
    for _, course in groupby(sorted(pairs, key=lambda one: one.place), key=lambda one: one.place[0]):
        holder: dict[int, Pair] = {}
        held = []
        for now, begun in groupby(course, key=lambda one: one.place[1]):
            holder = {slot: one for slot, one in holder.items() if one.place[1] + len(one.apart) > now}
            for number, one in enumerate(begun):
                free = [slot for slot in slots if slot not in holder]
                slot = free[0] if free else min(holder, key=lambda k: holder[k].size(now))
                if not free:
                    del holder[slot].apart[now - holder[slot].place[1] :]
                holder[slot] = one
                held.append((number, slot, one))
        for number, slot, one in held:
            (course_number, first), last = one.place, one.place[1] + len(one.apart)
            found["apart"][course_number, first:last, :, slot] = one.apart
            found["stays"][course_number, first : last - 1, slot] = 1.0
            found["slot"][course_number, first, number] = slot
            found["felt"][course_number, first, number] = one.felt
            for name, share in one.by_others.items():
                found[f"felt {name}"][course_number, first, number] = share
