"""The recursion that takes a change through the steps of a motion: the one place where derivatives of steps are composed.

It is written for one motion, and for NumPy as for JAX; see `engines.flight` for its formula.
"""

from typing import Any

PAIRS = ("felt", "slot", "apart", "stays")
"""Of a slope, beside "state": what each event that begins feels, its slot, D of each slot, and whether a slot goes on."""
FIRST = ("before", "enters")
"""D before the first step, and which slots go on into it."""


def begin(total: Any, held: Any, first: dict[str, Any]) -> tuple[Any, Any]:
    """Return a change without what is in flight, and what is, before the first step."""
    held = (first["enters"][:, None] if held.ndim > 1 else first["enters"]) * held
    return total - first["before"] @ held, held


def advance(xp: Any, main: Any, held: Any, step: dict[str, Any]) -> tuple[Any, Any, Any]:
    """Return the change along the motion, what is in flight after a step, and the whole change.

    Args:
        xp: `numpy` or `jax.numpy`.
        main: the change, of one column or several.
        held: a number for each slot, which it has felt.
        step: "state", "by state", what the step adds to a change; of a slope, "felt", "by felt", "slot", "apart", "stays".
    """
    end = step["state"] @ main + step["by state"]
    if "felt" not in step:
        return end, held, end
    slots = (step["slot"] == xp.arange(len(held))[:, None]).astype(end.dtype)
    held = held + slots @ (step["felt"] @ main + step["by felt"])
    total = end + step["apart"] @ held
    kept = (step["stays"][:, None] if held.ndim > 1 else step["stays"]) * held
    return total - step["apart"] @ kept, kept, total
