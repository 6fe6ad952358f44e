r"""The knob: how soft contacts are, set alike on every pair of geoms that can touch.

MuJoCo's contact is a spring and damper in units of the contact's own mass, scaled by an
impedance $d \in (0, 1)$: $a_\text{ref} = -B v - K d(r) r$, $K = k / d_w^2$, $B = b / d_w$. The
stiffness is $k = \omega_0^2$ and the damping $b = 2 \zeta \omega_0$. Raising $k$ makes contact
stiffer; raising $d$ makes it yield less to a sustained force: at rest under the acceleration
$a_0$ the depth is $(1 - d_w) a_0 / k$.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjxgrad._mjx import mjx
from mjxgrad.contacts import (
    ContactPair,
    contact_pairs,
    contact_parameters,
    deciding_geoms,
    safe_sqrt,
)


def _as_float(value: Any) -> Array:
    # Integers are converted too: 10000 is a natural way to write a stiffness.
    return jnp.asarray(value, dtype=jnp.result_type(float))


def _as_optional_float(value: Any) -> Array | None:
    return None if value is None else _as_float(value)


class Softness(eqx.Module):
    r"""Contact softness, set consistently on all pairs of geoms or on some of them.

    Stiffness and damping are written in MuJoCo's direct format, solref $= (-k, -b)$ with
    $b = 2 \zeta \sqrt k$: in the standard format `refsafe` silently replaces a time constant
    below two time steps, and the direct one it leaves alone. They are written to both geoms of
    a pair, so that neither mixing nor priority changes them.

    A part left as `None` stays as it is in the model; of stiffness and damping ratio the one not
    given keeps its present effective value. Every part is a leaf of a pytree, so that a sweep is
    one `jax.vmap` over a `Softness` with a leading axis (see `sweep`).

    Attributes:
        stiffness: $k = \omega_0^2$, in 1/s²; positive.
        damping_ratio: $\zeta$; 1 is critical.
        impedance: a constant $d$, or $(d_0, d_w)$ at the surface and at depth `width`. MuJoCo
            keeps it between 1e-4 and 0.9999.
        width: depth over which the impedance rises from $d_0$ to $d_w$, in m.
        geoms: change only pairs with at least one of these geoms, by name.
        pairs: change only these pairs, by the names of their geoms.
    """

    stiffness: Float[Array, "..."] | None = eqx.field(converter=_as_optional_float, default=None)
    damping_ratio: Float[Array, "..."] | None = eqx.field(converter=_as_optional_float, default=None)
    impedance: Float[Array, "..."] | None = eqx.field(converter=_as_optional_float, default=None)
    width: Float[Array, "..."] | None = eqx.field(converter=_as_optional_float, default=None)
    geoms: tuple[str, ...] | None = eqx.field(static=True, default=None)
    pairs: tuple[tuple[str, str], ...] | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        """Refuse two subsets at once, and values without meaning if they are known.

        Raises:
            ValueError: if both `geoms` and `pairs` are given, if stiffness or width is not
                positive, damping ratio negative, or impedance not between 0 and 1.
        """
        if self.geoms is not None and self.pairs is not None:
            raise ValueError("Softness takes either geoms or pairs, got both")
        for name, is_valid, requirement in (
            ("stiffness", lambda x: x > 0, "positive"),
            ("damping_ratio", lambda x: x >= 0, "at least 0"),
            ("impedance", lambda x: (x >= 0) & (x <= 1), "between 0 and 1"),
            ("width", lambda x: x > 0, "positive"),
        ):
            value = getattr(self, name)
            if _is_known(value) and not np.all(is_valid(np.asarray(value))):
                raise ValueError(f"{name} must be {requirement}, got {np.asarray(value).tolist()}")

    @classmethod
    def sweep(cls, **parts: Any) -> "Softness":
        """Stack several values of softness for `jax.vmap`, broadcasting what stays the same.

        `Softness.sweep(stiffness=[1e2, 1e4], damping_ratio=1.0)` has two values of each.

        Args:
            **parts: as for `Softness`, each with or without a leading axis; an impedance
                $(d_0, d_w)$ has its pair of numbers on the last axis.

        Returns:
            One `Softness` whose leaves share their leading axis.
        """
        static = {name: parts.pop(name) for name in ("geoms", "pairs") if name in parts}
        arrays = {name: _as_float(value) for name, value in parts.items() if value is not None}
        lengths = {name: a.shape[0] for name, a in arrays.items() if a.ndim}
        length = max(lengths.values(), default=1)
        for name, a in arrays.items():
            is_pair = name == "impedance" and a.shape == (2,) and length != 2
            if a.ndim == 0 or is_pair:
                arrays[name] = jnp.broadcast_to(a, (length, *a.shape))
        return cls(**arrays, **static)

    def apply(self, model: mjx.Model) -> mjx.Model:
        r"""Write this softness into a model.

        Traceable and differentiable with respect to every part and to the model's leaves. If only
        one of stiffness and damping ratio is given, a geom that takes part in several pairs can
        keep the other's present value only if those pairs agree in it.

        Args:
            model: of MJX.

        Returns:
            The model with other `geom_solref`, `geom_solimp`, `pair_solref`, `pair_solimp`.

        Raises:
            ValueError: if a part has a leading axis; if a name is unknown; if a geom to be changed
                also decides the contact of a pair that was not selected; if the present values
                to be kept disagree.
        """
        self._refuse_batch()
        selected = _select(model, self)
        _refuse_shared_geoms(model, selected)
        # For each place to be written, the pair that it belongs to.
        geoms = {geom: i for i, p in enumerate(selected) for geom in deciding_geoms(model, p)}
        explicit = {p.explicit: i for i, p in enumerate(selected) if p.explicit >= 0}

        replaced = {}
        if self.stiffness is not None or self.damping_ratio is not None:
            solref = self._solref(model, selected)
            replaced["geom_solref"] = _write(model.geom_solref, geoms, solref)
            replaced["pair_solref"] = _write(model.pair_solref, explicit, solref)
        if self.impedance is not None or self.width is not None:
            replaced["geom_solimp"] = self._set_solimp(model.geom_solimp, list(geoms))
            replaced["pair_solimp"] = self._set_solimp(model.pair_solimp, list(explicit))
        return model.replace(**replaced)

    def _solref(self, model: mjx.Model, pairs: tuple[ContactPair, ...]) -> Array:
        """The direct format for each pair."""
        present = contact_parameters(model, pairs)
        stiffness, damping_ratio = self.stiffness, self.damping_ratio
        if stiffness is None:
            stiffness = present.stiffness
            _refuse_disagreement(model, pairs, stiffness, "stiffness")
        if damping_ratio is None:
            damping_ratio = present.damping_ratio
            _refuse_disagreement(model, pairs, damping_ratio, "damping_ratio")
        damping = 2.0 * damping_ratio * safe_sqrt(stiffness)
        return jnp.stack(
            [jnp.broadcast_to(-part, present.stiffness.shape) for part in (stiffness, damping)],
            axis=-1,
        )

    def _set_solimp(self, solimp: Array, rows: list[int]) -> Array:
        """Write impedance and width; they mix linearly, so the rest keeps its mixed value."""
        if not rows:
            return solimp
        if self.impedance is not None:
            solimp = solimp.at[np.array(rows), :2].set(self.impedance)
        if self.width is not None:
            solimp = solimp.at[np.array(rows), 2].set(self.width)
        return solimp

    def _refuse_batch(self) -> None:
        for name in ("stiffness", "damping_ratio", "impedance", "width"):
            value = getattr(self, name)
            allowed = [(), (2,)] if name == "impedance" else [()]
            if value is not None and value.shape not in allowed:
                raise ValueError(
                    f"{name} must be one value to be applied, got shape {value.shape}; apply a sweep under jax.vmap"
                )


def softness_warnings(softness: Softness, model: mjx.Model) -> list[str]:
    """Say which parts of a softness have no effect on a model.

    Args:
        softness: as applied; parts that are traced are not looked at.
        model: of MJX.

    Returns:
        Sentences; none if every part has its effect.
    """
    if not contact_pairs(model):
        return ["softness has no effect: no two geoms of the scene can touch"]
    low, high = mujoco.mjMINIMP, mujoco.mjMAXIMP
    messages = []
    if _is_known(softness.impedance):
        for value in np.unique(np.asarray(softness.impedance)):
            if not low <= value <= high:
                messages.append(
                    f"impedance {value:g} has the effect of {np.clip(value, low, high):g}: "
                    f"MuJoCo keeps it between {low:g} and {high:g}"
                )
    return messages


def _is_known(value: Array | None) -> bool:
    return value is not None and not isinstance(value, jax.core.Tracer)


def _write(values: Array, places: dict[int, int], per_pair: Array) -> Array:
    if not places:
        return values
    return values.at[np.array(list(places))].set(per_pair[np.array(list(places.values()))])


def _select(model: mjx.Model, softness: Softness) -> tuple[ContactPair, ...]:
    """The pairs that a softness changes."""
    pairs = contact_pairs(model)
    if softness.geoms is not None:
        known = {name for pair in pairs for name in pair.names}
        for name in softness.geoms:
            if name not in known:
                raise ValueError(
                    f"softness.geoms must name geoms that can touch another, got {name!r}; "
                    f"those that can: {', '.join(sorted(known)) or 'none'}"
                )
        return tuple(p for p in pairs if set(p.names) & set(softness.geoms))
    if softness.pairs is not None:
        known = {frozenset(pair.names) for pair in pairs}
        for names in softness.pairs:
            if frozenset(names) not in known:
                raise ValueError(
                    f"softness.pairs must name pairs of geoms that can touch, got {names!r}; "
                    f"those that can: {', '.join(str(p) for p in pairs) or 'none'}"
                )
        wanted = {frozenset(names) for names in softness.pairs}
        return tuple(p for p in pairs if frozenset(p.names) in wanted)
    return pairs


def _refuse_shared_geoms(model: mjx.Model, selected: tuple[ContactPair, ...]) -> None:
    decided_by = {geom: pair for pair in selected for geom in deciding_geoms(model, pair)}
    for other in contact_pairs(model):
        if other in selected:
            continue
        for geom in deciding_geoms(model, other):
            if geom in decided_by:
                name = other.names[0] if geom == other.geom1 else other.names[1]
                raise ValueError(
                    f"softness of the pair {decided_by[geom]} would also change the pair {other}, "
                    f"which shares the geom {name!r}; select that pair too, or list one of "
                    f"the two as <pair> in the MJCF's <contact> so that it has its own parameters"
                )


def _refuse_disagreement(model: mjx.Model, pairs: tuple[ContactPair, ...], present: Array, part: str) -> None:
    if isinstance(present, jax.core.Tracer):
        return
    values, first = np.asarray(present), {}
    for i, pair in enumerate(pairs):
        for geom in deciding_geoms(model, pair):
            j = first.setdefault(geom, i)
            if not np.isclose(values[i], values[j], rtol=1e-5):
                raise ValueError(
                    f"{part} must be given, or be the same now in the pairs {pairs[j]} and "
                    f"{pair}, which share a geom, got {values[j]:.4g} and {values[i]:.4g}; "
                    f"give Softness a {part}"
                )
