"""A C model with other numbers. It needs MuJoCo alone: processes that know nothing of JAX import it."""

import copy
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

PARAMETERS = "parameters"
"""Name of numbers by which those of a model are given, and, before a colon and a field's name, of the field's rates by them."""
_PLACES = ("geom_pos", "geom_quat", "geom_size", "geom_rbound", "body_ipos", "body_iquat")
_FRAMES = {"geom": ("geom_pos", "geom_quat"), "site": ("site_pos", "site_quat"), "body": ("body_ipos", "body_iquat")}
_OWN_FRAME = mujoco.mjtSameFrame.mjSAMEFRAME_NONE.value
_OF_INERTIA = (mujoco.mjtSameFrame.mjSAMEFRAME_INERTIA.value, mujoco.mjtSameFrame.mjSAMEFRAME_INERTIAROT.value)
_SWITCHED = ("body_gravcomp", "geom_surfacevel", "geom_adhesion", "pair_adhesion")


def with_numbers(mj_model: mujoco.MjModel, numbers: Mapping[str, Any]) -> mujoco.MjModel:
    """Return a copy of a C model with the numbers of an MJX model, where it has them."""
    target = copy.deepcopy(mj_model)
    for name, value in numbers.items():
        holder, name, value = (
            target.opt if name.startswith("opt.") else target,
            name.removeprefix("opt."),
            np.asarray(value),
        )
        given = np.asarray(getattr(holder, name, None))
        if not np.issubdtype(given.dtype, np.floating):
            continue
        if given.size != value.size:
            remedy = "take one element of the batch"
            raise ValueError(f"to_mujoco needs one scene, got {name} of shape {value.shape}; {remedy}")
        # Numbers that differ only by float32 rounding keep the digits of the file.
        value = value.reshape(given.shape)
        used = np.where(value == given.astype(value.dtype), given, value)
        setattr(holder, name, used if used.ndim else float(used))
    # MuJoCo's compiler notes what no body has, for which steps do not look.
    for name in _SWITCHED:
        if name in numbers:
            setattr(target, f"flg_{name.partition('_')[2]}", 1)
    _part_frames(target, numbers)
    if any(not np.array_equal(getattr(target, name), getattr(mj_model, name)) for name in _PLACES):
        _enclose(target)
    if not np.array_equal(target.geom_margin, mj_model.geom_margin):
        target.body_margin[:] = 0.0  # by the largest of its geoms' C MuJoCo rejects bodies of several
        np.maximum.at(target.body_margin, target.geom_bodyid, target.geom_margin)
    return target


def _part_frames(target: mujoco.MjModel, numbers: Mapping[str, Any]) -> None:
    """Have frames that were compiled as those of their body, or of its centre of mass, looked up, where either may change."""
    # Kinematics copies such frames; small differences of what is given move them, too.
    is_own = {kind: any(name in numbers for name in names) for kind, names in _FRAMES.items()}
    for kind, frames in (("geom", target.geom_sameframe), ("site", target.site_sameframe)):
        if is_own[kind]:
            frames[:] = _OWN_FRAME
        elif is_own["body"]:
            frames[np.isin(frames, _OF_INERTIA)] = _OWN_FRAME
    if is_own["body"]:
        target.body_sameframe[:] = _OWN_FRAME


def _enclose(target: mujoco.MjModel) -> None:
    """Enlarge the bounding boxes by which C MuJoCo rejects pairs, around geoms that have moved or grown."""
    turn = np.zeros(9)
    for body, (first, count) in enumerate(zip(target.body_bvhadr, target.body_bvhnum, strict=True)):
        mujoco.mju_quat2Mat(turn, target.body_iquat[body])
        for node in reversed(range(first, first + count)):  # parents come before their children
            geom, children = target.bvh_nodeid[node], first + target.bvh_child[node]
            if geom < 0:
                centres, halves = np.split(target.bvh_aabb[children], 2, axis=1)
                low, high = (centres - halves).min(axis=0), (centres + halves).max(axis=0)
                target.bvh_aabb[node] = np.concatenate([(low + high) / 2, (high - low) / 2])
            elif (radius := target.geom_rbound[geom]) > 0:  # a plane has none
                centre = turn.reshape(3, 3).T @ (target.geom_pos[geom] - target.body_ipos[body])
                target.bvh_aabb[node] = np.concatenate([centre, np.full(3, radius)])
                target.geom_aabb[geom] = np.repeat([0.0, radius], 3)
