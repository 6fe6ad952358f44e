"""Constraint rows as maps against their matrix, and that matrix against MJX's; the mass matrix as a map likewise."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad._mjx import mjx
from mjxgrad.batched import linear
from mjxgrad.bodies import kinematics
from mjxgrad.bodies.kinematics import inertia_of
from mjxgrad.contact.collision import collide
from mjxgrad.solver import constraint
from mjxgrad.solver.constraint import RowHessian
from mjxgrad.solver.hessian import SparseRows
from mjxgrad.solver.jacobian import AxisRows, ContactRows
from mjxgrad.stepping import assembly
from mjxgrad.stepping.rows import joined

# Two free balls on a plane and on each other, one of them heavy and rolling; an arm that bends back on itself, touches
# the floor and a ball, and has a limit and friction loss. Contacts within one tree, between two, and with the world; all condims.
SCENE = """
<mujoco>
  <option cone="{cone}" impratio="2"/>
  <worldbody>
    <geom type="plane" size="5 5 .1" friction=".8 .02 .01"/>
    <body pos="0 0 .095"><freejoint/><geom size=".1" condim="6" friction=".5 .03 .02"/></body>
    <body pos=".15 .05 .19"><freejoint/><geom size=".1" condim="4" mass="3"/></body>
    <body pos="-.4 0 .3">
      <joint name="hip" axis="0 1 0" range="-10 30" limited="true" frictionloss=".1" armature=".02"/>
      <geom type="capsule" fromto="0 0 0 .2 0 -.2" size=".05" condim="1"/>
      <body pos=".2 0 -.2"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .1 0 0" size=".04"/>
        <body pos=".1 0 0"><joint axis="0 1 0"/><joint type="slide" axis="1 0 0"/>
          <geom type="capsule" fromto="0 0 0 -.2 .02 .12" size=".04" condim="3"/></body></body></body>
  </worldbody>
</mujoco>
"""
# Sums of at most some twenty products of numbers of order ten.
ROUNDING = 1e3 * np.finfo(float).eps


@pytest.fixture(scope="module", params=["pyramidal", "elliptic"])
def rows(request):
    """Return the model, MJX's data, and all rows of a state with contacts of every kind, as a map and as a matrix."""
    mj_model = mujoco.MjModel.from_xml_string(SCENE.format(cone=request.param))
    mj_data = mujoco.MjData(mj_model)
    mj_data.joint("hip").qpos = -0.3
    mj_data.qvel[:] = np.random.default_rng(0).normal(size=mj_model.nv)
    model = mjx.put_model(mj_model)

    def prepare(data):
        data = kinematics.com_pos(model, kinematics.kinematics(model, data))
        data = collide(model, kinematics.com_vel(model, kinematics.crb(model, data)))
        block = joined(assembly.gather(model, data))
        return data, block, block.map.matrix(model.nv)

    data, block, matrix = jax.jit(prepare)(mjx.put_data(mj_model, mj_data))
    return model, data, block, np.asarray(matrix)


@pytest.fixture
def random():
    return np.random.default_rng(1)


def test_the_matrix_is_that_of_mjx(rows):
    model, data, block, matrix = rows
    theirs = jax.jit(lambda d: mjx.make_constraint(model, d))(data)._impl.efc_J
    ours = np.where(block.is_active[:, None], matrix, 0)
    np.testing.assert_allclose(ours, theirs, atol=ROUNDING)


def test_rows_as_a_map_are_their_matrix_and_its_transpose(rows, random):
    model, _, block, matrix = rows
    velocity, force = (jnp.asarray(random.normal(size=size)) for size in (model.nv, len(matrix)))
    found = jax.jit(lambda v, f: (block.map.mv(v), block.map.rmv(f)))(velocity, force)
    for one, expected in zip(found, (matrix @ velocity, matrix.T @ force), strict=True):
        np.testing.assert_allclose(one, expected, atol=ROUNDING)


@pytest.mark.parametrize(
    ("most_groups", "batch"),
    [(24, ()), (24, (3,)), (0, (3,))],
    ids=["by groups", "batch by groups", "batch in one matrix"],
)
def test_sparse_rows_are_the_matrix_without_its_zeros(rows, random, batch, most_groups, monkeypatch):
    """J x, Jᵀ f and M + Jᵀ S J of the rows that act, for one state and with a trailing batch."""
    monkeypatch.setattr("mjxgrad.solver.hessian._MOST_GROUPS", most_groups)
    model, data, block, matrix = rows
    layout, count = assembly.row_layout(model, data), len(matrix)
    matrix = np.where(block.is_active[:, None], matrix, 0)
    assert 0 < np.sum(block.is_active) < count
    simple, cones, dense = random.uniform(size=layout.simple_stop), [], np.zeros((count, count))
    np.fill_diagonal(dense[: layout.simple_stop], simple)
    for cone in layout.cones:
        square = random.normal(size=(cone.count, cone.dim, cone.dim))
        cones.append(jnp.asarray(square + square.transpose(0, 2, 1)))
        for k in range(cone.count):
            at = slice(cone.start + k * cone.dim, cone.start + (k + 1) * cone.dim)
            dense[at, at] = cones[-1][k]
    mass, x, force = (jnp.asarray(random.normal(size=size)) for size in ((model.nv, model.nv), model.nv, count))

    def spread(tree):
        return jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf[(..., *[None] * len(batch))], (*leaf.shape, *batch)), tree
        )

    @eqx.filter_jit
    def products(rows, is_active, row_hessian, mass, x, force):
        sparse = SparseRows.of(rows, is_active, model.nv)
        return sparse.matvec(x), sparse.rmatvec(force), sparse.gram(mass, layout, row_hessian)

    row_hessian = RowHessian(jnp.asarray(simple), tuple(cones))
    results = products(*spread((block.map, block.is_active, row_hessian, mass, x, force)))
    expected = matrix @ x, matrix.T @ force, mass + matrix.T @ dense @ matrix
    for result, known in zip(results, expected, strict=True):
        np.testing.assert_allclose(result, spread(known), atol=ROUNDING)


def test_no_column_is_kept_that_no_contact_of_a_group_needs(rows):
    """The joint velocities of a group are those that move one of its bodies, less those that move both."""
    model, _, block, matrix = rows
    start = 0
    for group in block.map.groups:
        own = matrix[start : start + group.num_rows]
        start += group.num_rows
        assert not np.any(np.delete(own, group.dofs, axis=1))
        assert np.any(own[:, list(group.dofs)], axis=0).all()
    assert any(len(group.dofs) < model.nv / 2 for group in block.map.groups)


def test_what_moves_both_bodies_of_a_contact_is_of_neither(rows):
    """The hip carries the whole arm: it has no part where the arm's last link touches its first."""
    model, data, block, _ = rows
    contacts = [side for part in block.map.parts if isinstance(part, ContactRows) for side in part.sides]
    own, hip = np.asarray(model.geom_bodyid)[np.asarray(data._impl.contact.geom)], 12
    within = [sides for sides, pair in zip(contacts, own, strict=True) if set(pair) == {3, 5}]
    assert within
    assert all(hip not in dofs for sides in within for _, dofs in sides)


def test_inertia_as_a_map_is_the_mass_matrix(rows, random):
    model, data, *_ = rows
    acceleration = jnp.asarray(random.normal(size=model.nv))
    inertia = inertia_of(model, data)
    assert inertia.bodies is not None
    np.testing.assert_allclose(inertia.apply(acceleration), mjx.full_m(model, data) @ acceleration, atol=ROUNDING)


def test_a_curvature_applied_is_its_matrix(rows, random):
    """Against the derivative of the force, minus the curvature, at a point inside all zones."""
    model, data, block, matrix = rows
    layout = assembly.row_layout(model, data)

    @jax.jit
    def both(x, moved):
        rows = assembly.system_of(model, data, layout, block).rows
        _, change = jax.jvp(lambda x: constraint.force(layout, rows, x), (x,), (moved,))
        return change, constraint.hessian_product(layout, constraint.hessian(layout, rows, x), moved)

    change, bent = both(*jnp.asarray(random.normal(size=(2, len(matrix)))))
    # Stiffness of contacts is up to 1e4.
    np.testing.assert_allclose(bent, -change, rtol=1e-10, atol=1e-9)


def test_reverse_mode_does_not_solve_again():
    """A checkpointed step keeps its acceleration: one loop over the solver's iterations and in it one along the line, forward.

    Backward there is that of the linear solve alone, held for either direction: it turns once, unless rounding has made a
    Hessian indefinite.
    """
    scene = mg.load_scene(mujoco.MjModel.from_xml_string(SCENE.format(cone="pyramidal")))

    def end(qvel):
        return jnp.sum(mg.rollout(scene, mg.initial_state(scene, qvel=qvel), horizon=2).final.qpos)

    program = jax.make_jaxpr(jax.value_and_grad(end))(jnp.zeros(scene.model.nv))
    forward, backward = [eqn for eqn in program.eqns if eqn.primitive.name == "scan"]
    assert _num_loops(forward.params["jaxpr"].jaxpr) == 2
    assert _num_loops(backward.params["jaxpr"].jaxpr) == 2


def _num_loops(jaxpr):
    inner = [part for eqn in jaxpr.eqns for part in jax.tree.leaves(list(eqn.params.values()), is_leaf=_is_program)]
    own = sum(eqn.primitive.name == "while" for eqn in jaxpr.eqns)
    return own + sum(_num_loops(getattr(part, "jaxpr", part)) for part in inner if _is_program(part))


def _is_program(part):
    return hasattr(part, "eqns") or hasattr(getattr(part, "jaxpr", None), "eqns")


@pytest.mark.parametrize("chosen", [(0, 1, 2), (1, 3, 4), (2,), (0, 4)])
def test_blocks_are_added_where_they_belong(chosen, random):
    x, part = random.normal(size=(5, 5)), random.normal(size=(len(chosen), len(chosen)))
    expected = x.copy()
    expected[np.ix_(chosen, chosen)] += part
    np.testing.assert_array_equal(linear.add_to_block(jnp.asarray(x), chosen, jnp.asarray(part)), expected)
    np.testing.assert_array_equal(linear.take(jnp.asarray(x), chosen), x[list(chosen)])


def test_a_gpu_adds_the_same_blocks(monkeypatch, random):
    """Padded, for one operation in place of many; the same numbers."""
    x, part = jnp.asarray(random.normal(size=(5, 5, 2))), jnp.asarray(random.normal(size=(3, 3, 2)))
    in_place = linear.add_to_block(x, (1, 3, 4), part), linear.add_at(x, (1, 3, 4), part[:, :1] * jnp.ones((1, 5, 1)))
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    padded = linear.add_to_block(x, (1, 3, 4), part), linear.add_at(x, (1, 3, 4), part[:, :1] * jnp.ones((1, 5, 1)))
    jax.tree.map(np.testing.assert_array_equal, in_place, padded)


def test_rows_of_one_joint_each_keep_their_order(random):
    rows, x = AxisRows(jnp.array([1.0, -1.0]), (1, 3), 4), jnp.asarray(random.normal(size=4))
    np.testing.assert_array_equal(rows.mv(x), [x[1], -x[3]])
    np.testing.assert_array_equal(rows.rmv(jnp.array([2.0, 3.0])), [0, 2, 0, -3])
