"""What a softness does not do, or does besides."""

from collections.abc import Iterator

import jax
import mujoco
import numpy as np

from mjxgrad._mjx import mjx
from mjxgrad._static import is_known
from mjxgrad.contact.parameters import ContactPair, contact_pairs, contact_parameters
from mjxgrad.contact.softness import Softness

_ABOVE_NOTHING = 1e-6  # m; a body that hovers by less rests where it should


def softness_warnings(softness: Softness, model: mjx.Model, mj_model: mujoco.MjModel | None = None) -> list[str]:
    """Say which parts of a softness have no effect on a model, and where bodies rest otherwise than they touch.

    Args:
        softness: as applied; parts that are traced are not looked at.
        model: of MJX, with the softness applied.
        mj_model: the same in C MuJoCo, to measure distances at the reference pose; without it they are not looked at.

    Returns:
        Sentences; none if every part has its effect and no other.
    """
    if not contact_pairs(model):
        return ["softness has no effect: no two geoms of the scene can touch"]
    low, high = mujoco.mjMINIMP, mujoco.mjMAXIMP
    messages = []
    if is_known(softness.impedance):
        for value in np.unique(np.asarray(softness.impedance)):
            if not low <= value <= high:
                messages.append(
                    f"impedance {value:g} has the effect of {np.clip(value, low, high):g}: "
                    f"MuJoCo keeps it between {low:g} and {high:g}"
                )
    leaves = (softness.margin, model.geom_margin, model.pair_margin, model.geom_solref, model.opt.gravity)
    if all(is_known(leaf) for leaf in leaves):
        pairs = softness.selected(model)
        # Inside jit, operations on known values would be traced, too.
        with jax.ensure_compile_time_eval():
            messages += _grouped(_resting_otherwise(softness, model, pairs))
            if mj_model is not None:
                messages += _grouped(_pushed_apart(model, mj_model, pairs))
    return messages


def _resting_otherwise(
    softness: Softness, model: mjx.Model, pairs: tuple[ContactPair, ...]
) -> Iterator[tuple[ContactPair, str]]:
    gravity = float(np.linalg.norm(np.asarray(model.opt.gravity)))
    parameters = contact_parameters(model, pairs)
    if gravity == 0 or np.asarray(parameters.margin).ndim != 1 or not np.all(np.asarray(parameters.stiffness) > 0):
        return
    distances = np.asarray(parameters.rest_distance(gravity), float)
    for pair, distance, margin in zip(pairs, distances, np.asarray(parameters.margin, float), strict=True):
        if margin <= 0:
            continue
        size = _smaller_size(model, pair)
        if distance < -size / 2:
            yield (
                pair,
                f"under gravity alone bodies rest {-distance:.3g} m inside each other, more than half the size of the "
                f"smaller ({size:.3g} m); take a smaller margin than {margin:.3g} m, or keep the height under gravity's "
                "acceleration",
            )
        elif distance > _ABOVE_NOTHING and softness.rest_acceleration is None:
            yield (
                pair,
                f"with a margin of {margin:.3g} m bodies at rest under gravity hover {distance:.3g} m above each other; "
                f"rest_acceleration={gravity:.3g} keeps their height, by a softer contact",
            )


def _pushed_apart(
    model: mjx.Model, mj_model: mujoco.MjModel, pairs: tuple[ContactPair, ...]
) -> Iterator[tuple[ContactPair, str]]:
    """Find geoms that do not touch at the reference pose, but are closer than their margin."""
    data = mujoco.MjData(mj_model)
    mujoco.mj_kinematics(mj_model, data)
    margins = np.asarray(contact_parameters(model, pairs).margin, float)
    for pair, margin in zip(pairs, margins, strict=True):
        distance = mujoco.mj_geomDistance(mj_model, data, pair.geom1, pair.geom2, margin + 1e-6, None)
        if _ABOVE_NOTHING < distance < margin:
            yield (
                pair,
                f"at the reference pose these are {distance:.3g} m apart, less than their margin of {margin:.3g} m, so that "
                "they push each other from the start although they do not touch; take a smaller margin, or select pairs "
                "without these",
            )


def _smaller_size(model: mjx.Model, pair: ContactPair) -> float:
    """Give the least half extent of two geoms, planes left out (m)."""
    sizes = []
    for geom in (pair.geom1, pair.geom2):
        kind, size = mujoco.mjtGeom(int(model.geom_type[geom])), np.asarray(model.geom_size[geom], float)
        if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE):
            sizes.append(size[0])
        elif kind != mujoco.mjtGeom.mjGEOM_PLANE:
            sizes.append(size[size > 0].min(initial=np.inf))
    return float(min(sizes, default=np.inf))


def _grouped(found: Iterator[tuple[ContactPair, str]]) -> list[str]:
    messages: dict[str, list[ContactPair]] = {}
    for pair, text in found:
        messages.setdefault(text, []).append(pair)
    return [
        f"contact of {pairs[0]}" + (f" + {len(pairs) - 1} more" if len(pairs) > 1 else "") + f": {text}"
        for text, pairs in messages.items()
    ]
