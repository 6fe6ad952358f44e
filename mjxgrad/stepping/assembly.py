r"""All constraint rows of a state: Jacobian, reference acceleration and weight.

The rows and their order are those of `mjx.make_constraint`, so that `mjx.Data` keeps its meaning. MJX's impedance has NaN
derivatives beyond its width, its stiffness for a direct solref without damping, and its norms have none near zero. Here the
Jacobian is a map that is applied without being formed, and the impedance is evaluated once per contact.

References:
    MuJoCo documentation, "Modeling", "Solver parameters"; "Computation", "Constraint model".
"""

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjxgrad._mjx import mjx
from mjxgrad.bodies.kinematics import inertia_of
from mjxgrad.solver.constraint import ConeGroup, Noise, RowLayout, Rows
from mjxgrad.solver.implicit import System
from mjxgrad.stepping import equality, rows
from mjxgrad.stepping.rows import Block

_CONDIMS = (1, 3, 4, 6)


def row_layout(model: mjx.Model, data: mjx.Data) -> RowLayout:
    """Return the layout of the laws over the rows of data."""
    impl, cones = data._impl, []
    if model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
        for dim in _CONDIMS[1:]:
            is_dim = np.asarray(impl.contact.dim) == dim
            if is_dim.any():
                start = int(np.asarray(impl.contact.efc_address)[is_dim][0])
                cones.append(ConeGroup(start, int(is_dim.sum()), dim))
    return RowLayout(int(impl.ne), int(impl.nf), int(impl.nefc), tuple(cones))


def gather(model: mjx.Model, data: mjx.Data) -> list[Block]:
    """Return all rows of a state, inactive ones included, kind by kind in MuJoCo's order."""
    disabled, bits = model.opt.disableflags, mujoco.mjtDisableBit
    if disabled & bits.mjDSBL_CONSTRAINT:
        return []
    blocks: list[Block | None] = []
    if not disabled & bits.mjDSBL_EQUALITY and model.neq:
        blocks += equality.blocks(model, data)
    if not disabled & bits.mjDSBL_FRICTIONLOSS:
        blocks.append(rows.friction_loss(model, data))
    if not disabled & bits.mjDSBL_LIMIT:
        blocks += rows.limits(model, data)
    blocks += [rows.contacts(model, data, dim) for dim in _CONDIMS]
    return [block for block in blocks if block is not None]


def make_constraint(model: mjx.Model, data: mjx.Data, blocks: list[Block]) -> mjx.Data:
    """Fill the `efc_` fields from rows, as `mjx.make_constraint` does."""
    if not blocks:
        empty = jnp.zeros(0, data.qpos.dtype)
        fields = dict.fromkeys(("D", "aref", "frictionloss", "pos", "margin"), empty)
        fields["J"] = jnp.zeros((0, model.nv), data.qpos.dtype)  # pyright: ignore[reportArgumentType]
    else:
        block = rows.joined(blocks)
        reference, weight = rows.law(model, data.qvel, block)
        fields = {
            "J": jnp.where(block.is_active[:, None], block.map.matrix(model.nv), 0.0),
            "D": weight,
            "aref": reference,
            "frictionloss": block.friction_loss,
            "pos": jnp.where(block.is_active, block.residual, 0.0) + block.margin,
            "margin": block.margin,
        }
    return data.tree_replace({f"_impl.efc_{name}": value for name, value in fields.items()})  # pyright: ignore[reportReturnType]


def system_of(model: mjx.Model, data: mjx.Data, layout: RowLayout, block: Block, noise: Noise | None = None) -> System:
    """Return the equations of motion of a state from its smooth forces, its rows, and noise on them."""
    reference, weight = rows.law(model, data.qvel, block)
    laws = Rows(reference, weight, block.friction_loss, cone_scales(model, data, layout), noise)
    return System(inertia_of(model, data), data.qfrc_smooth, block.map, block.is_active, laws)  # pyright: ignore[reportArgumentType]


def cone_scales(model: mjx.Model, data: mjx.Data, layout: RowLayout) -> tuple[Float[Array, "contacts dim"], ...]:
    """Return (μ, f₁, ...) of each elliptic contact, by group."""
    touching, scales = data._impl.contact, []
    for group in layout.cones:
        friction = rows.least_friction(touching.friction)[np.asarray(touching.dim) == group.dim]
        friction = friction[:, : group.dim - 1]
        mu = friction[:, :1] / jnp.sqrt(model.opt.impratio)
        scales.append(jnp.concatenate([mu, friction], axis=1))
    return tuple(scales)
