"""A rapidly exploring random tree whose metric is what a smoothed step can reach."""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

from mjxgrad._arrays import known
from mjxgrad._programs import compiled
from mjxgrad.objective.task import optional_pytree
from mjxgrad.planning import LinearModel, Smoother, System
from mjxgrad.planning.system import ControlVector, StateVector

Index = Int[Array, ""]

# Kinds of samples: a pose of what the goal is about, wherever the rest may be; or all positions.
_POSE, _EVERYTHING = 0, 1
# An extension goes on while each step takes it nearer by at least this share of the squared distance.
_PROGRESS = 0.02


class Reach(eqx.Module):
    r"""What one step can reach around a state: an ellipsoid around c, the mean next state, with the axes of B.

    B is that of positions times the reach of each control. The distance of a change $e$ from the centre is
    $e^\top (B B^\top + \Gamma)^{-1} e$, with $\Gamma$ = diag(resolution²). A coordinate that does not count has infinite
    resolution, so that its weight in W = Γ⁻¹ is zero; and by Woodbury's identity only (I + Bᵀ W B)⁻¹ is needed, the `inverse`
    for each W.
    """

    c: StateVector
    B: Float[Array, "p m"]
    inverse: Float[Array, "kinds m m"]

    def distance(
        self, system: System, sample: StateVector, weights: Float[Array, "kinds p"], kind: Index
    ) -> tuple[Float[Array, ""], ControlVector]:
        """Return the squared distance of a sample, and the control that leads there as far as one does, in units of the reach."""
        away = system.difference(sample, self.c)[: system.num_positions]
        weighted = weights[kind] * away
        pulled = self.B.T @ weighted
        control = self.inverse[kind] @ pulled
        return away @ weighted - pulled @ control, control


def reach(model: LinearModel, radius: ControlVector, weights: Float[Array, "kinds p"]) -> Reach:
    """Return what controls reach that can go as far as `radius` from where a linear model was made.

    The weights are inverse squared resolutions, 0 where a coordinate does not count; one row per kind of sample.
    """
    B = model.B[: weights.shape[1]] * radius
    gram = jnp.einsum("pm,kp,pn->kmn", B, weights, B)
    return Reach(model.c, B, jnp.linalg.inv(jnp.eye(B.shape[1], dtype=B.dtype) + gram))


class Nodes(eqx.Module):
    """Nodes with room for more, those from `size` on empty; or, without the leading axis, a single one.

    Attributes:
        states: of the system itself, each a true successor of its parent.
        controls: that led from the parent here.
        parents: −1 for the root.
        errors: distance from the goal in units of its tolerance, the largest over coordinates.
        reaches: of each node.
        size: how many nodes there are.
    """

    states: Float[Array, "*capacity state"]
    controls: Float[Array, "*capacity m"]
    parents: Int[Array, "*capacity"]
    errors: Float[Array, "*capacity"]
    reaches: Reach
    size: Index

    @property
    def is_node(self) -> Bool[Array, " capacity"]:
        """Which places are taken."""
        return jnp.arange(len(self.parents)) < self.size

    @property
    def best(self) -> Index:
        """The node nearest to the goal."""
        return jnp.argmin(jnp.where(self.is_node, self.errors, jnp.inf))

    def add(self, new: "Nodes", is_valid: Bool[Array, "*many"]) -> "Nodes":
        """Append new nodes, those that are valid, in their order; those beyond the capacity are lost.

        A parent p below −1 is the new node −2 − p, counted over all axes; that of a valid one must be valid.
        """
        valid = is_valid.ravel()
        many = valid.size
        places = jnp.where(valid, self.size + jnp.cumsum(valid) - 1, len(self.parents))
        parents = new.parents.ravel()
        parents = jnp.where(parents < -1, places[jnp.clip(-2 - parents, 0, many - 1)], parents)

        def put(old: Array, rows: Array) -> Array:
            return old.at[places].set(rows.reshape(many, *old.shape[1:]).astype(old.dtype), mode="drop")

        size = jnp.minimum(self.size + valid.sum(), len(self.parents))
        old = (self.states, self.controls, self.parents, self.errors, self.reaches)
        rows = jax.tree.map(put, old, (new.states, new.controls, parents, new.errors, new.reaches))
        return Nodes(*rows, size)  # pyright: ignore[reportCallIssue]


class Search(eqx.Module):
    """A finished search; see `path` for the way it found.

    Attributes:
        nodes: the tree.
        is_solved: whether some node is at the goal within its tolerance.
        num_steps: steps of the system that were tried, kept or not.
    """

    nodes: Nodes
    is_solved: Bool[Array, ""]
    num_steps: Index


class Path(eqx.Module):
    """The way to the node nearest to the goal.

    Attributes:
        nodes: numbers in the tree, the root first.
        states: one per node.
        controls: between them.
    """

    nodes: Int[np.ndarray, " states"]
    states: Float[np.ndarray, "states state"]
    controls: Float[np.ndarray, "horizon m"]


class Sampling(eqx.Module):
    """Where samples fall, and how the tree grows towards them.

    Attributes:
        lower: least positions sampled, as changes of the start.
        upper: largest ones.
        resolution: displacement of each position below which it does not matter that no control causes it.
        goal_share: share of the samples that are the goal.
        transit_share: share that moves only what the goal is not about, from the pose of some node: to let go and begin
            elsewhere. As often as the goal is sampled, that node is the one nearest to it.
        transit: where to begin elsewhere, from a key and that node's state to a state, such as next to the object; None is
            anywhere between the bounds.
        batch: samples per turn.
        max_extension: steps towards one sample.
    """

    lower: Float[Array, " p"] = eqx.field(converter=jnp.asarray)
    upper: Float[Array, " p"] = eqx.field(converter=jnp.asarray)
    resolution: Float[Array, " p"] = eqx.field(converter=jnp.asarray)
    goal_share: float = 0.2
    transit_share: float = 0.3
    transit: Callable[[PRNGKeyArray, StateVector], StateVector] | None = eqx.field(
        converter=optional_pytree, default=None
    )
    batch: int = eqx.field(static=True, default=16)
    max_extension: int = eqx.field(static=True, default=8)


def search(
    system: System,
    start: Float[ArrayLike, " state"],
    goal: Float[ArrayLike, " state"],
    tolerance: Float[ArrayLike, " n"],
    key: PRNGKeyArray,
    *,
    smoother: Smoother,
    sampling: Sampling,
    lower: ArrayLike | None = None,
    upper: ArrayLike | None = None,
    capacity: int = 4000,
    max_turns: int = 1000,
) -> Search:
    """Grow a tree of true steps from the start until it meets the goal.

    Each node knows what a smoothed step can reach from it. The tree is extended towards a sample from the node whose reach is
    least far from it, by the least-squares control, shortened to the limits; the step itself is the system's own, so that a
    path is a rollout. Without smoothing a node that does not touch anything reaches what moves the robot alone, and has no
    control that takes an object nearer to anything.

    Args:
        system: to be controlled.
        start: the root.
        goal: to be reached.
        tolerance: how near, per coordinate of a change; infinite where a coordinate does not matter.
        key: consumed here.
        smoother: which linear models.
        sampling: where to sample.
        lower: limits of the controls, a number or one per control; finite. Models are made at their middle. None are the
            actuators' own, `ctrlrange`.
        upper: likewise.
        capacity: how many nodes there is room for.
        max_turns: of sampling and extending.

    Returns:
        The search.

    Raises:
        ValueError: if shapes do not fit, limits are not finite or in the wrong order, or no or all positions matter for the goal.

    References:
        LaValle, Kuffner. Randomized Kinodynamic Planning. IJRR 2001.
        Pang, Suh, Yang, Tedrake. Global Planning for Contact-Rich Manipulation via Local Smoothing of Quasi-dynamic Contact
        Models. T-RO 2023, arXiv:2206.10787 (the metric). There a robot jumps to sampled contacts and its way is planned
        afterwards; here it moves there within the tree.
    """
    start, goal, tolerance = jnp.asarray(start), jnp.asarray(goal), np.asarray(tolerance, float)
    low, high = system.limits(lower, upper, start.dtype)
    _check(system, sampling, tolerance, low, high, capacity)
    matters = np.isfinite(tolerance)[: system.num_positions]
    weight = 1 / sampling.resolution**2
    weights = jnp.stack([jnp.where(matters, weight, 0.0), weight])
    grower = _Grower(system, smoother, sampling, start, goal, jnp.asarray(tolerance), weights, low, high)
    return _grown(grower, key, max_turns, capacity)


def path(found: Search) -> Path:
    """Return the way to the node nearest to the goal, whether it is near enough or not; on the host."""
    parents, line = np.asarray(found.nodes.parents), [int(found.nodes.best)]
    while parents[line[-1]] >= 0:
        line.append(int(parents[line[-1]]))
    line = np.asarray(line[::-1])
    return Path(line, np.asarray(found.nodes.states)[line], np.asarray(found.nodes.controls)[line[1:]])


class _Grower(eqx.Module):
    """What stays the same while the tree grows."""

    system: System
    smoother: Smoother
    sampling: Sampling
    start: StateVector
    goal: StateVector
    tolerance: Float[Array, " n"]
    weights: Float[Array, "kinds p"]
    lower: ControlVector
    upper: ControlVector

    def node(self, state: StateVector, control: ControlVector, parent: Index, key: PRNGKeyArray) -> Nodes:
        """Return a node, with what it can reach."""
        model = self.smoother.linear_model(self.system, state, self.middle, key, wrt_state=False)
        here = reach(model, self.radius, self.weights)
        return Nodes(state, control, parent, self.error(state), here, jnp.asarray(1))

    @property
    def middle(self) -> ControlVector:
        """The controls at which models are made."""
        return 0.5 * (self.lower + self.upper)

    @property
    def radius(self) -> ControlVector:
        """How far the controls go from there."""
        return 0.5 * (self.upper - self.lower)

    def error(self, state: StateVector) -> Float[Array, ""]:
        """Return the distance from the goal in units of its tolerance."""
        return jnp.max(jnp.abs(self.system.difference(state, self.goal)) / self.tolerance)

    def root(self) -> Nodes:
        """Return the start as a node that reaches nothing but itself.

        A model of its own would be compiled a second time; the first extension of all stays where it is and makes one.
        """
        p, m, kinds = self.system.num_positions, self.lower.size, len(self.weights)
        dtype = self.start.dtype
        here = Reach(self.start, jnp.zeros((p, m), dtype), jnp.broadcast_to(jnp.eye(m, dtype=dtype), (kinds, m, m)))
        return Nodes(self.start, jnp.zeros(m, dtype), jnp.asarray(-1), self.error(self.start), here, jnp.asarray(1))

    def grow(self, nodes: Nodes, key: PRNGKeyArray) -> tuple[Nodes, Index]:
        """Extend the tree towards a batch of samples; return it and the number of steps tried."""
        draw_key, model_key = jax.random.split(key)
        keys = jax.random.split(draw_key, self.sampling.batch)
        samples, kinds = jax.vmap(functools.partial(self.draw, nodes))(keys)
        nearest = jax.vmap(functools.partial(self.nearest, nodes))(samples, kinds)
        new, is_valid = jax.vmap(functools.partial(self.extend, nodes, model_key))(
            jnp.arange(self.sampling.batch), nearest, samples, kinds
        )
        return nodes.add(new, is_valid), jnp.asarray(self.sampling.batch * self.sampling.max_extension)

    def nearest(self, nodes: Nodes, sample: StateVector, kind: Index) -> Index:
        """Return the node from whose reach a sample is least far."""
        distances, _ = jax.vmap(lambda one: one.distance(self.system, sample, self.weights, kind))(nodes.reaches)
        return jnp.argmin(jnp.where(nodes.is_node & jnp.isfinite(distances), distances, jnp.inf))

    def draw(self, nodes: Nodes, key: PRNGKeyArray) -> tuple[StateVector, Index]:
        """Return a sample and its kind."""
        kind_key, place_key, node_key, best_key = jax.random.split(key, 4)
        settings, p = self.sampling, self.system.num_positions
        share = jax.random.uniform(kind_key)
        is_goal = share < settings.goal_share
        is_transit = share > 1 - settings.transit_share
        place = jax.random.uniform(place_key, (p,), self.start.dtype, settings.lower, settings.upper)
        any_node = jax.random.randint(node_key, (), 0, nodes.size)
        base = jnp.where(jax.random.uniform(best_key) < settings.goal_share, nodes.best, any_node)
        anywhere = self._moved(place)
        if settings.transit is None:
            held = self.system.difference(nodes.states[base], self.start)[:p]
            elsewhere = self._moved(jnp.where(self.weights[_POSE] > 0, held, place))
        else:
            elsewhere = settings.transit(place_key, nodes.states[base])
        sample = jnp.where(is_goal, self.goal, jnp.where(is_transit, elsewhere, anywhere))
        return sample, jnp.where(is_transit, _EVERYTHING, _POSE)

    def _moved(self, place: Float[Array, " p"]) -> StateVector:
        """Return the start with its positions changed."""
        change = jnp.zeros(self.system.num_changes, place.dtype).at[: place.size].set(place)
        return self.system.retract(self.start, change)

    def extend(
        self, nodes: Nodes, key: PRNGKeyArray, number: Index, nearest: Index, sample: StateVector, kind: Index
    ) -> tuple[Nodes, Bool[Array, " steps"]]:
        """Go from a node towards a sample as long as it comes nearer."""
        most = self.sampling.max_extension

        def advance(carry, step: Index):
            state, here, is_on = carry
            distance, control = here.distance(self.system, sample, self.weights, kind)
            control = self.middle + self.radius * control / jnp.maximum(1, jnp.max(jnp.abs(control)))
            moved = self.system.step(state, control)
            # Beyond −1 a parent is another new node, by its number among them all.
            parent = jnp.where(step == 0, nearest, -2 - (number * most + step - 1))
            node = self.node(moved, control, parent, jax.random.fold_in(jax.random.fold_in(key, number), step))
            after, _ = node.reaches.distance(self.system, sample, self.weights, kind)
            is_first_of_all = (nodes.size == 1) & (number == 0) & (step == 0)
            is_on &= jnp.all(jnp.isfinite(moved)) & ((after < (1 - _PROGRESS) * distance) | is_first_of_all)
            return (moved, node.reaches, is_on), (node, is_on)

        at = jax.tree.map(lambda x: x[nearest], (nodes.states, nodes.reaches))
        _, (new, is_valid) = jax.lax.scan(advance, (*at, jnp.asarray(True)), jnp.arange(most))
        return new, is_valid


@compiled
def _grown(grower: _Grower, key: PRNGKeyArray, max_turns: int, capacity: int) -> Search:
    """Return the tree, grown until it meets the goal, is full, or has had its turns."""
    rows = jax.tree.map(lambda x: jnp.zeros((capacity, *x.shape), x.dtype).at[0].set(x), grower.root())
    root = eqx.tree_at(lambda nodes: nodes.size, rows, jnp.asarray(1))

    def may_go_on(carry: tuple) -> Bool[Array, ""]:
        nodes, _, turn, _ = carry
        has_room = nodes.size + grower.sampling.batch * grower.sampling.max_extension <= capacity
        return has_room & (turn < max_turns) & (nodes.errors[nodes.best] > 1)

    def go_on(carry: tuple) -> tuple:
        nodes, key, turn, num_steps = carry
        key, now = jax.random.split(key)
        nodes, tried = grower.grow(nodes, now)
        return nodes, key, turn + 1, num_steps + tried

    nodes, _, _, num_steps = jax.lax.while_loop(may_go_on, go_on, (root, key, jnp.asarray(0), jnp.asarray(0)))
    return Search(nodes, nodes.errors[nodes.best] <= 1, num_steps)


def _check(
    system: System,
    sampling: Sampling,
    tolerance: Float[np.ndarray, "..."],
    lower: ControlVector,
    upper: ControlVector,
    capacity: int,
) -> None:
    p = system.num_positions
    for name in ("lower", "upper", "resolution"):
        shape = getattr(sampling, name).shape
        if shape != (p,):
            raise ValueError(f"sampling.{name} must have shape ({p},), one per position, got {shape}")
    if tolerance.shape != (system.num_changes,) or not (tolerance > 0).all():
        raise ValueError(
            f"tolerance must be positive and have shape ({system.num_changes},), infinite where a coordinate "
            f"does not matter, got {tolerance}"
        )
    if not np.isfinite(tolerance[:p]).any():
        raise ValueError("tolerance must be finite for at least one position, got none: there would be no goal")
    least = 1 + sampling.batch * sampling.max_extension
    if capacity < least:
        raise ValueError(f"capacity must be at least {least}, the root and one batch of extensions, got {capacity}")
    low, high = known(lower), known(upper)
    if low is None or high is None:
        return
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
        raise ValueError(f"limits of the controls must be finite, lower below upper, got {low} and {high}")
