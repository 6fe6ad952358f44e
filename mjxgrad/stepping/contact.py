"""How contact is stepped: one record for the motion and for its derivative.

| record | motion | derivative |
|---|---|---|
| `Discrete` | MuJoCo's own | each step's own, equal to its finite differences |
| `Slope` | MuJoCo's own | one whose mean is the slope of the outcome |
| `Onset` | continuous, near MuJoCo's | the motion's own, which is the slope |
| `Smoothing` | averaged over noise, or MuJoCo's own | the averaged motion's |

All are pytrees. Lengths and widths are leaves, so a sweep over them is one `jax.vmap`.
"""

import dataclasses
from typing import Any, ClassVar, Literal, get_args

import equinox as eqx
import jax

from mjxgrad._arrays import one_of
from mjxgrad.stepping.onset import Onset
from mjxgrad.stepping.smoothing import Smoothing

EngineName = Literal["mjx", "mujoco", "warp"]
Gradient = Literal["discrete", "slope"]
"""Names of the derivatives along MuJoCo's own motion, for command lines and files; see `own_motion`."""


class Discrete(eqx.Module):
    """MuJoCo's own motion, to the bit, with the derivative of each step, equal to its finite differences."""

    gradient: ClassVar[Gradient] = "discrete"


class Slope(eqx.Module):
    """MuJoCo's own motion, to the bit, with the derivative whose mean is the slope of the outcome.

    It knows that a change moves the times of contact and limit events. All engines have it by the same rule: `engines.events`
    and `engines.flight` say which, `stepping.pairs` has it for MJX and MuJoCo Warp.
    """

    gradient: ClassVar[Gradient] = "slope"


OwnMotion = Discrete | Slope
Contact = OwnMotion | Onset | Smoothing


def own_motion(gradient: str) -> OwnMotion:
    """Return the record of a derivative along MuJoCo's own motion, by its name.

    Raises:
        ValueError: if there is no such derivative.
    """
    one_of("gradient", gradient, get_args(Gradient))
    return Slope() if gradient == "slope" else Discrete()


def check_contact(contact: Any) -> None:
    """Refuse anything but one of the four records, and lengths with a leading axis."""
    if not isinstance(contact, Contact):
        given = f'"{contact}"' if isinstance(contact, str) else repr(contact)
        raise ValueError(f"contact must be mg.Discrete(), mg.Slope(), mg.Onset() or mg.Smoothing(), got {given}")
    for field in dataclasses.fields(contact):
        value = getattr(contact, field.name)
        if isinstance(value, jax.Array) and value.ndim:
            raise ValueError(
                f"{field.name} must be one value for a step, got shape {value.shape}: sweep under jax.vmap"
            )
