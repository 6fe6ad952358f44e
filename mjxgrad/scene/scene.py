"""What `load_scene` returns."""

import warnings
from dataclasses import dataclass

import equinox as eqx
import jax
import mujoco
import numpy as np

from mjxgrad._mjx import mjx
from mjxgrad.contacts import ContactPair, ContactParameters, contact_pairs, contact_parameters
from mjxgrad.softness import Softness


class SceneError(ValueError):
    """A scene cannot be loaded; the message names what, what is required and the remedy."""


@dataclass(frozen=True)
class Conversion:
    """A setting that MJX cannot take, replaced by one that gives the same motion.

    Attributes:
        what: the setting, as MJCF calls it.
        given: its value in the file.
        used: what stands in its place.
        reason: why the motion is the same.
    """

    what: str
    given: str
    used: str
    reason: str


@dataclass(frozen=True)
class Omission:
    """Work that a step of this scene does not do.

    Attributes:
        what: the stage or the elements left out.
        reason: why the motion does not need them.
    """

    what: str
    reason: str


class Scene(eqx.Module):
    """A scene ready to be stepped.

    Attributes:
        model: for MJX; its array leaves may be differentiated, replaced and batched.
        data: template at `qpos0`, before any stage of the dynamics has run.
        mj_model: the complete C model, for rendering and names.
        omissions: what a step leaves out, and why.
        conversions: settings replaced by equivalent ones.
    """

    model: mjx.Model
    data: mjx.Data
    mj_model: mujoco.MjModel = eqx.field(static=True)
    omissions: tuple[Omission, ...] = eqx.field(static=True, default=())
    conversions: tuple[Conversion, ...] = eqx.field(static=True, default=())
    pairs: tuple[ContactPair, ...] = eqx.field(static=True, default=())

    def contact_parameters(self) -> ContactParameters:
        """Effective parameters of every pair in `pairs`, traceable."""
        return contact_parameters(self.model, self.pairs)

    def with_softness(self, softness: Softness) -> "Scene":
        """The same scene with other contact softness; only leaves of `model` change."""
        return eqx.tree_at(lambda s: s.model, self, softness.apply(self.model))
