"""Constraint rows of one kind."""

import equinox as eqx
from jaxtyping import Array, Bool, Float

from mjxgrad.contact.law import Impedance
from mjxgrad.dynamics.jacobian import RowMap


class Block(eqx.Module):
    """Constraint rows of one kind, before gating and scaling. All fields have the rows as leading axis.

    Attributes:
        map: from joint velocities to the rows, also where the row is inactive.
        residual: r in a_ref (m or rad).
        impedance: d(r), with dw and d0.
        solimp: what the impedance follows from.
        inverse_weight: Â, inverse inertia (1/kg).
        solref: stiffness and damping in MuJoCo's formats.
        margin: distance at which the row begins (m or rad).
        friction_loss: largest force of a friction loss row.
        is_active: whether the row takes part.
        rows_each: how many consecutive rows begin and end together, those of a contact or of a limit; 0 if none ever does.
        is_pyramid: whether these are the edges of a pyramid, whose mean is the normal row; otherwise the first one is.
        is_contact: whether these are contacts.
    """

    map: RowMap
    residual: Float[Array, " rows"]
    impedance: Impedance
    solimp: Float[Array, "rows 5"]
    inverse_weight: Float[Array, " rows"]
    solref: Float[Array, "rows 2"]
    margin: Float[Array, " rows"]
    friction_loss: Float[Array, " rows"]
    is_active: Bool[Array, " rows"]
    rows_each: int = eqx.field(static=True, default=0, kw_only=True)
    is_pyramid: bool = eqx.field(static=True, default=False, kw_only=True)
    is_contact: bool = eqx.field(static=True, default=False, kw_only=True)

    @property
    def jacobian(self) -> Float[Array, "rows nv"]:
        """The map as a matrix."""
        return self.map.matrix()
