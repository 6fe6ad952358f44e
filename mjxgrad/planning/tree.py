r"""A rapidly exploring random tree whose metric is what a smoothed step can reach.

From a state, controls within a reach $\rho$ of the last control $\bar u$ lead to the ellipsoid around the next state
$c = f(x, \bar u)$ with the axes of $B_\rho \rho$. The distance of a sample that is a change $e$ away from c is

    d² = eᵀ (B Bᵀ + Γ)⁻¹ e,    Γ = diag(resolution²),    B = B_ρ diag(ρ).

It is small along what controls move and large across it, so a sample is grown from the node that can go there. By Woodbury's
identity only (I + Bᵀ Γ⁻¹ B)⁻¹ is needed, and coordinates of infinite resolution drop out. An extension takes the least-squares
control, ū + ρ (I + Bᵀ Γ⁻¹ B)⁻¹ Bᵀ Γ⁻¹ e, shortened to the reach. Its step is the system's own, so that a path is a rollout.

References:
    LaValle, Kuffner. Randomized Kinodynamic Planning. IJRR 2001.
    Pang, Suh, Yang, Tedrake. Global Planning for Contact-Rich Manipulation via Local Smoothing of Quasi-dynamic Contact
    Models. T-RO 2023, arXiv:2206.10787 (the metric). There a robot jumps to sampled contacts and its way is planned
    afterwards; here it moves there within the tree.
"""

import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PRNGKeyArray

from mjxgrad._arrays import instance, one_key, whole
from mjxgrad.planning.linear_model import Smoother
from mjxgrad.planning.system import ControlVector, StateVector, System
from mjxgrad.planning.trajectory import per_control, state_of

_Nodes = dict[str, Any]
_PerChange = Float[ArrayLike, " _"]
_POSE, _EVERYTHING = 0, 1  # what counts of a sample: what the goal is about, or all
_GOAL, _ELSEWHERE = 0.2, 0.3  # shares of the samples: the goal; states of which all counts
_MOST_STEPS = 3  # towards one sample
_PROGRESS = 0.98  # an extension goes on while each step leaves at most this share of the squared distance


class TreePath(eqx.Module):
    """The way to the node nearest to the goal, and the tree.

    Attributes:
        found: whether that node is at the goal within its tolerance.
        states: states of the path, the start first.
        controls: controls between them, one row per step of the system.
        nodes: states of all nodes, the start first.
        parents: number of each node's parent, −1 for the start.
        errors: distance of each node from the goal in units of its tolerance, the largest over coordinates.
        num_steps: steps that were tried, kept or not.
        seconds: duration of the search (s), without compilation.
    """

    found: bool
    states: Float[np.ndarray, "states state"]
    controls: Float[np.ndarray, "horizon m"]
    nodes: Float[np.ndarray, "nodes state"]
    parents: Int[np.ndarray, " nodes"]
    errors: Float[np.ndarray, " nodes"]
    num_steps: int
    seconds: float


class Tree:
    """Search for controls from a start to a goal; its first search compiles for `compile_seconds`."""

    def __init__(
        self, system: System, goal: Float[ArrayLike, " state"], tolerance: _PerChange, *, smoother: Smoother,
        lower: _PerChange, upper: _PerChange, resolution: _PerChange, reach: ArrayLike, batch: int = 16,
    ):  # fmt: skip
        """Keep what searches share.

        Args:
            system: the system, whose limits, if it has some, bound the controls.
            goal: state to be reached.
            tolerance: distance that counts as reached, per coordinate of a change; infinite where it does not matter.
            smoother: the smoother of the linear models; of `Sampled` noise on the control alone will do.
            lower: least changes of the start that are sampled.
            upper: largest ones.
            resolution: change of each coordinate that needs no cause; infinite where one never matters, such as a speed.
            reach: how far a step's controls go from the last one, a number or one per control.
            batch: samples per turn; a step of all is one call.

        Raises:
            ValueError: if shapes do not fit, the goal is not finite, a number is not positive, or no coordinate matters for the
                goal.
        """
        instance("system", system, System, "one such as planning.SceneSystem(scene=scene)")
        instance("smoother", smoother, Smoother, "one of mg.planning, such as Exact() or Analytic(mg.Smoothing(0.01))")
        self.system, self.smoother, self.batch, dtype = system, smoother, whole("batch", batch), system.origin.dtype
        self.goal = np.asarray(state_of("goal", goal, system), dtype)
        given = {"tolerance": tolerance, "lower": lower, "upper": upper, "resolution": resolution}
        for name, value in given.items():
            if np.shape(value) != (system.num_changes,):
                raise ValueError(f"{name} must have shape ({system.num_changes},), got {np.shape(value)}")
        self.tolerance, self.lower, self.upper, widths = (np.asarray(x, dtype) for x in given.values())
        self.reach = np.broadcast_to(np.asarray(reach, dtype), (system.num_controls,))
        matters = np.isfinite(self.tolerance) & np.isfinite(widths)
        if not all((x > 0).all() for x in (self.tolerance, widths, self.reach)) or np.isinf(self.reach).any():
            raise ValueError("tolerance, resolution and reach must be positive, and the last one finite")
        if not matters.any():
            raise ValueError("tolerance and resolution must both be finite for one coordinate at least")
        self.weights = jnp.asarray(np.stack([np.where(matters, widths**-2.0, 0.0), widths**-2.0]), dtype)
        self._programs, self.compile_seconds = {}, 0.0

    def search(
        self, start: Float[ArrayLike, " state"], control: Float[ArrayLike, " m"], key: PRNGKeyArray, *,
        capacity: int = 2000, max_seconds: float = np.inf,
    ) -> TreePath:  # fmt: skip
        """Grow a tree from a start until it meets the goal, is full, or its time is over.

        Args:
            start: the first state.
            control: control that led to the start.
            key: consumed here.
            capacity: most nodes.
            max_seconds: most time (s), without compilation; it is looked at between turns.

        Returns:
            The path to the node nearest to the goal; with the same key the same, unless the time was over.

        Raises:
            ValueError: if start or control do not fit the system or are not finite, or no node is allowed.
        """
        one_key(key)
        began, num_steps, turn, before = time.perf_counter() - self.compile_seconds, 0, 0, 0
        spent = lambda: time.perf_counter() - self.compile_seconds - began  # noqa: E731
        keys = jax.random.split(key, self.batch)
        start = np.asarray(state_of("start", start, self.system), self.goal.dtype)
        first = np.asarray(per_control("control", control, self.system, self.goal.dtype))
        if not np.isfinite(first).all():
            raise ValueError(f"control must be finite, got {first.tolist()}")
        samples, controls, kinds = *(np.tile(x, (self.batch, 1)) for x in (start, first)), np.zeros(self.batch, int)
        new = self._ran(self._made, samples, controls, keys, self.goal, samples, kinds)
        nodes = {name: np.zeros((whole("capacity", capacity), *x.shape[1:]), x.dtype) for name, x in new.items()}
        nodes |= {"parent": np.zeros(capacity, int), "is_node": np.zeros(capacity, bool)}
        size, _ = _added(nodes, 0, new, np.arange(self.batch) == 0, np.full(self.batch, -1))
        # A turn that adds nothing is the last: no node moves to finite numbers.
        while nodes["error"][:size].min() > 1 and before < size < capacity and spent() < max_seconds:
            turn, before = turn + 1, size
            keys = jax.random.split(jax.random.fold_in(key, turn), self.batch)
            samples, kinds, at, distance = self._ran(self._chosen, nodes, size, keys, self.goal, start)
            here, is_on = {name: nodes[name][at] for name in new}, np.isfinite(distance)
            for step in range(_MOST_STEPS):
                states, controls = self._ran(self._moved, here, samples, kinds)
                here = self._ran(self._made, states, controls, keys, self.goal, samples, kinds)
                is_on &= np.isfinite(states).all(axis=1) & ((here["distance"] < _PROGRESS * distance) | (step == 0))
                size, at = _added(nodes, size, here, is_on, at)
                distance, num_steps = here["distance"], num_steps + self.batch
                if not is_on.any():
                    break
        line = [int(np.argmin(nodes["error"][:size]))]
        while line[-1] > 0:
            line.append(int(nodes["parent"][line[-1]]))
        path = bool(nodes["error"][line[0]] <= 1), nodes["state"][line[::-1]], nodes["control"][line[-2::-1]]
        every = [nodes[name][:size] for name in ("state", "parent", "error")]
        return TreePath(*path, *every, num_steps, spent())  # pyright: ignore[reportCallIssue]

    def _ran(self, function: Callable, *given: Any) -> Any:
        """Run a method's program; its compilation is counted apart."""
        if (name := (function.__name__, *map(jnp.shape, jax.tree.leaves(given)))) not in self._programs:
            began = time.perf_counter()
            self._programs[name] = jax.jit(function).lower(*given).compile()
            self.compile_seconds += time.perf_counter() - began
        return jax.tree.map(np.array, self._programs[name](*given))

    def _made(self, states: Any, controls: Array, keys: Array, goal: StateVector, samples: Any, kinds: Array):
        """Return nodes, with what each can reach, and the distance of a sample from it."""

        def one(state, control, key, sample, kind) -> _Nodes:
            B = self.smoother.linear_model(self.system, state, control, key).B * self.reach
            inverse = jnp.linalg.inv(jnp.eye(B.shape[1]) + jnp.einsum("nm,kn,np->kmp", B, self.weights, B))
            error = jnp.max(jnp.abs(self.system.difference(state, goal)) / self.tolerance)
            node = {"state": state, "control": control, "centre": self.system.step(state, control), "B": B}
            node |= {"inverse": inverse, "error": error}
            return node | {"distance": self._distance(node, sample, kind)[0]}

        return jax.vmap(one)(states, controls, keys, samples, kinds)

    def _distance(self, node: _Nodes, sample: Any, kind: Array) -> tuple[Float[Array, ""], ControlVector]:
        """Return the squared distance of a sample, and the control that leads there, in units of the reach."""
        away = self.system.difference(sample, node["centre"])
        pulled = node["B"].T @ (weighted := self.weights[kind] * away)
        control = node["inverse"][kind] @ pulled
        return away @ weighted - pulled @ control, control

    def _moved(self, nodes: _Nodes, samples: Any, kinds: Array) -> tuple[Array, Array]:
        """Return the next states towards samples, and their controls."""
        changes = jax.vmap(self._distance)(nodes, samples, kinds)[1]
        changes = self.reach * changes / jnp.maximum(1.0, jnp.abs(changes).max(axis=1, keepdims=True))
        controls = jnp.clip(nodes["control"] + changes, *self.system.control_limits)
        return jax.vmap(self.system.step)(nodes["state"], controls), controls

    def _chosen(self, nodes: _Nodes, size: Array, keys: Array, goal: StateVector, start: StateVector):
        """Return samples, their kinds, the node from which each is least far, and how far."""
        best = jnp.argmin(jnp.where(nodes["is_node"], nodes["error"], jnp.inf))

        def one(key):
            kind_key, place_key, node_key, best_key, seen_key = jax.random.split(key, 5)
            share, is_best = jax.random.uniform(kind_key), jax.random.uniform(best_key) < _GOAL
            base = nodes["state"][jnp.where(is_best, best, jax.random.randint(node_key, (), 0, size))]
            place = jax.random.uniform(place_key, self.lower.shape, start.dtype, self.lower, self.upper)
            # To begin elsewhere, what the goal is about stays as in a node.
            held = jnp.where(self.weights[_POSE] > 0, self.system.difference(base, start), place)
            kind = jnp.where(share > 1 - _ELSEWHERE, _EVERYTHING, _POSE)
            anywhere = self.system.retract(start, jnp.where(kind == _EVERYTHING, held, place))
            sample = jnp.where(share < _GOAL, goal, anywhere)
            found = jax.vmap(lambda node: self._distance(node, sample, kind)[0])(nodes)
            # Each sample sees half of the nodes: the nearest of all, if it can go no further, would else be tried for ever.
            is_there = nodes["is_node"] & jnp.isfinite(found)
            is_seen = is_there & jax.random.bernoulli(seen_key, shape=found.shape)
            found = jnp.where(is_seen | (is_there & ~is_seen.any()), found, jnp.inf)
            return sample, kind, jnp.argmin(found), jnp.min(found)

        return jax.vmap(one)(keys)


def _added(nodes: _Nodes, size: int, new: _Nodes, is_valid: np.ndarray, parents: np.ndarray) -> tuple[int, np.ndarray]:
    """Write valid nodes into places that are free; return how many there are, and the place of each."""
    chosen = np.flatnonzero(is_valid)[: len(nodes["parent"]) - size]
    places = parents.copy()
    places[chosen] = size + np.arange(len(chosen))
    for name, value in (new | {"parent": parents, "is_node": is_valid}).items():
        nodes[name][places[chosen]] = value[chosen]
    return size + len(chosen), places
