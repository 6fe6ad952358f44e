"""What `load_scene` returns."""

import copy
import warnings

import equinox as eqx
import jax
import mujoco
import numpy as np

from mjxgrad._mjx import mjx
from mjxgrad.contact import Softness, softness_warnings
from mjxgrad.contact.parameters import ContactPair, ContactParameters, contact_parameters
from mjxgrad.scene.contact_check import contact_warnings
from mjxgrad.scene.conversions import Conversion
from mjxgrad.scene.leave_out import OmittedPair
from mjxgrad.scene.omissions import Omission
from mjxgrad.scene.summary import summarise


class SceneWarning(UserWarning):
    """A scene moves otherwise than its file says, or has a contact that its time step cannot."""


class Scene(eqx.Module):
    """A scene ready to be stepped.

    Indices of bodies, joints and geoms are those of the C model, so that
    `scene.model.geom_friction[i]` is what a user of MuJoCo expects.

    Attributes:
        model: for MJX; its array leaves may be differentiated, replaced and batched.
        data: template at `qpos0`; no stage of the dynamics has run.
        mj_model: the C model of the same motion, complete, for rendering and names. It keeps the
            contact parameters of the file: see `to_mujoco`.
        omissions: what a step leaves out, and why.
        conversions: settings replaced by others, and why.
        pairs: geoms that can touch, in the order of `contact_parameters`.
        omitted_pairs: geoms whose contact is left out although the file has it, as `LeaveOut` asked.
        name: where the scene came from.
    """

    model: mjx.Model
    data: mjx.Data
    mj_model: mujoco.MjModel = eqx.field(static=True)
    omissions: tuple[Omission, ...] = eqx.field(static=True)
    conversions: tuple[Conversion, ...] = eqx.field(static=True)
    pairs: tuple[ContactPair, ...] = eqx.field(static=True)
    omitted_pairs: tuple[OmittedPair, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)

    def contact_parameters(self) -> ContactParameters:
        """Effective parameters of the pairs that can touch, one row each; traceable."""
        return contact_parameters(self.model, self.pairs)

    def with_softness(self, softness: Softness) -> "Scene":
        """Soften or stiffen the contacts; only array leaves of `model` change.

        Works under `jax.jit`, `jax.vmap` and `jax.grad`. If the values are known, it warns about
        parts without effect and about contacts that the time step cannot follow.

        Args:
            softness: what to change, and for which pairs.

        Returns:
            The scene with other contact parameters.

        Raises:
            ValueError: as `Softness.apply`.
        """
        scene = eqx.tree_at(lambda s: s.model, self, softness.apply(self.model))
        for message in softness_warnings(softness, scene.model, self.mj_model) + scene.warnings():
            # Equinox wraps methods, so the caller is one level further up.
            warnings.warn(f"{self.name}: {message}", SceneWarning, stacklevel=3)
        return scene

    def warnings(self) -> list[str]:
        """Sentences on contacts that `refsafe` alters or that the time step cannot follow.

        Returns:
            An empty list while the model is traced or batched, for its values are not known then.
        """
        leaves = (self.model.geom_solref, self.model.pair_solref, self.model.opt.timestep)
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return []
        if np.ndim(self.model.geom_solref) != 2 or np.ndim(self.model.opt.timestep) != 0:
            return []
        return contact_warnings(self.model, self.pairs) + self._margin_warnings()

    def _margin_warnings(self) -> list[str]:
        proven = [one for one in self.omitted_pairs if one.distance is not None]
        if not proven:
            return []
        with jax.ensure_compile_time_eval():
            margins = np.asarray(contact_parameters(self.model, tuple(one.pair for one in proven)).margin)
        return [
            f"contact of {one.pair} is left out, proven {1e3 * one.distance:.3g} mm apart, which its margin of "
            f"{1e3 * margin:.3g} mm exceeds; load the scene with a larger clearance in leave_out"
            for one, margin in zip(proven, margins.tolist(), strict=True)
            if one.distance is not None and margin >= one.distance
        ]

    def to_mujoco(self) -> mujoco.MjModel:
        """Copy of the C model with the present values of `model`, softness included.

        Returns:
            A model that C MuJoCo steps as MJX steps this scene. Sizes and flags are those of
            `mj_model`.

        Raises:
            ValueError: if the scene is batched or traced.
        """
        target = copy.deepcopy(self.mj_model)
        for source, destination in ((self.model, target), (self.model.opt, target.opt)):
            for field in source.fields():
                value = getattr(source, field.name, None)
                if not isinstance(value, jax.Array):
                    continue
                if isinstance(value, jax.core.Tracer):
                    raise ValueError("to_mujoco needs known values, got a traced scene")
                _copy_into(destination, field.name, np.asarray(value))
        return target

    def summary(self) -> str:
        """Describe the scene for a human: sizes, options, contacts, conversions, omissions.

        Returns:
            Text of several lines, fit for a terminal about 120 characters wide.

        Raises:
            ValueError: if the scene is batched or traced.
        """
        return summarise(self)


def _copy_into(target: mujoco.MjModel | mujoco.MjOption, name: str, value: np.ndarray) -> None:
    present = getattr(target, name, None)
    if not isinstance(present, float | np.ndarray):
        return
    given = np.asarray(present)
    if not np.issubdtype(given.dtype, np.floating):
        return
    if given.size != value.size:
        raise ValueError(f"to_mujoco needs one scene, got {name} of shape {value.shape}; take one element of the batch")
    value = value.reshape(given.shape)
    # What float32 alone has rounded keeps the digits of the file.
    changed = value != given.astype(value.dtype)
    if isinstance(present, float):
        setattr(target, name, float(value if changed else given))
    else:
        present[changed] = value[changed]
