"""A scene with everything, without one group, and without all that it does not need."""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

import mjxgrad as mg
from mjxgrad.contact.parameters import contact_pairs
from mjxgrad.scene.omissions import omit, switch_off

EVERYTHING, NEEDED, REACHED = "everything", "all that is not needed", "all not needed or not reached"
RENDERING, SENSORS, TENDONS = "rendering elements", "sensors", "unused tendons"
FUSED, DAMPING = "fixed bodies", "implicit damping of zero"
PAIRS, LIMITS = "contacts not reached", "limits not reached"


@dataclass(frozen=True)
class Variant:
    """A scene with something left out."""

    name: str  # of the group that is left out
    scene: mg.Scene  # without it
    what: str  # what was left out, in a few words

    @property
    def num_rows(self) -> int:
        """Of constraints."""
        return int(self.scene.data._impl.nefc)


def variants(path: Path, recorded: mg.Trajectory) -> list[Variant]:
    """Build a scene with everything, without each group that it has, and without all that it does not need.

    The one with everything comes first; last the one without all that no motion needs, and where the recorded motions leave
    more unreached, the one without that, too.
    """
    with warnings.catch_warnings():
        # On the file, so the same for every variant: deprecated words, and contacts unlike C MuJoCo's.
        warnings.simplefilter("ignore", UserWarning)
        everything = mg.load_scene(path, keep_everything=True)
        unused = mg.diagnostics.unused(everything, recorded)
        found = [Variant(EVERYTHING, everything, "")]
        edits = (_without_rendering, _without_sensors, _without_tendons, _fused, _without_damping)
        for name, edit in zip((RENDERING, SENSORS, TENDONS, FUSED, DAMPING), edits, strict=True):
            edited = edit(path)
            if edited is not None:
                found.append(Variant(name, mg.load_scene(edited[0], keep_everything=True), edited[1]))
        found += _constraints(everything, unused)
        found.append(_lean(NEEDED, path, mg.LeaveOut()))
        if unused.pairs or unused.limits:
            found.append(_lean(REACHED, path, unused))
    return found


def _lean(name: str, path: Path, wanted: mg.LeaveOut) -> Variant:
    scene = mg.load_scene(path, leave_out=wanted)
    parts = {"pairs": len(scene.omitted_pairs), "limits": len(wanted.limits)}
    listed = [f"{count} {word}" for word, count in parts.items() if count]
    return Variant(name, scene, ", ".join(["as load_scene does", *listed]))


def _constraints(everything: mg.Scene, unused: mg.LeaveOut) -> Iterator[Variant]:
    for name, wanted in ((PAIRS, mg.LeaveOut(pairs=unused.pairs)), (LIMITS, mg.LeaveOut(limits=unused.limits))):
        model = everything.to_mujoco()
        omitted, omissions = omit(model, wanted)
        if omissions:
            pairs = f"{len(omitted)} of {len(everything.pairs)} pairs"
            what = f"{len(unused.limits)} limits" if name == LIMITS else pairs
            yield Variant(name, mg.load_scene(model, keep_everything=True), what)


def _without_rendering(path: Path) -> tuple[mujoco.MjModel, str] | None:
    """Delete geoms that touch nothing, sites at which nothing acts, cameras and lights; bodies keep their inertia."""
    spec = mujoco.MjSpec.from_file(str(path))
    model = spec.compile()
    touching = {geom for pair in contact_pairs(model) for geom in (pair.geom1, pair.geom2)}
    visual = [geom for geom in spec.geoms if geom.id not in touching]
    acts = model.nsensor or model.ntendon or (model.actuator_trntype == mujoco.mjtTrn.mjTRN_SITE).any()
    sites = [] if acts else list(spec.sites)
    others = [*spec.cameras, *spec.lights]
    spec.compiler.inertiafromgeom, spec.compiler.settotalmass = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO, -1.0
    for body in spec.bodies[1:]:
        body.explicitinertial = True
        body.mass, body.ipos, body.iquat = model.body_mass[body.id], model.body_ipos[body.id], model.body_iquat[body.id]
        body.inertia, body.fullinertia = model.body_inertia[body.id], [np.nan, 0, 0, 0, 0, 0]
    for element in (*visual, *sites, *others):
        spec.delete(element)
    what = f"{len(visual)} geoms, {len(sites)} sites, {len(others)} cameras and lights"
    return (spec.compile(), what) if visual or sites or others else None


def _without_sensors(path: Path) -> tuple[mujoco.MjModel, str] | None:
    spec = mujoco.MjSpec.from_file(str(path))
    sensors = list(spec.sensors)
    for sensor in sensors:
        spec.delete(sensor)
    return (spec.compile(), f"{len(sensors)} sensors") if sensors else None


def _without_tendons(path: Path) -> tuple[mujoco.MjModel, str] | None:
    """Delete all tendons, if none of them pulls, is driven, limited or tied."""
    spec = mujoco.MjSpec.from_file(str(path))
    model = spec.compile()
    acts = (
        model.tendon_stiffness, model.tendon_damping, model.tendon_frictionloss, model.tendon_armature, model.tendon_limited,
        model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON, model.eq_type == mujoco.mjtEq.mjEQ_TENDON,
    )  # fmt: skip
    if not model.ntendon or model.nsensor or any(np.any(x) for x in acts):
        return None
    for tendon in list(spec.tendons):
        spec.delete(tendon)
    return spec.compile(), f"{model.ntendon} tendons"


def _fused(path: Path) -> tuple[mujoco.MjModel, str] | None:
    before = mujoco.MjModel.from_xml_path(str(path)).nbody
    spec = mujoco.MjSpec.from_file(str(path))
    spec.compiler.fusestatic = True
    model = spec.compile()
    return (model, f"{before - model.nbody} fused into parents") if model.nbody < before else None


def _without_damping(path: Path) -> tuple[mujoco.MjModel, str] | None:
    model = mujoco.MjModel.from_xml_path(str(path))
    before = model.opt.disableflags
    switch_off(model)
    return (model, "a second factorisation") if model.opt.disableflags != before else None
