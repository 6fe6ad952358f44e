"""Who steps a scene, and takes derivatives of its steps: MJX, C MuJoCo or MuJoCo Warp, behind the same calls."""

from mjxgrad.engines.engine import Engine, Motion, Observe, PolicyFunction, Rows, Sees
from mjxgrad.engines.mjx import MJX
from mjxgrad.engines.mujoco import MuJoCo
from mjxgrad.engines.multiplied import SlopeWarning
from mjxgrad.engines.state import DivergedError, State, Trajectory
from mjxgrad.engines.warp import Warp
from mjxgrad.scene import Scene, SceneError
from mjxgrad.stepping import Contact, Discrete, EngineName, check_contact

ENGINES: dict[EngineName, Engine] = {"mjx": MJX(), "mujoco": MuJoCo(), "warp": Warp()}
QUICK: EngineName = "mujoco"
"""The engine whose first step does not wait for a compiler."""


def engine_of(scene: Scene, contact: Contact = Discrete()) -> Engine:
    """Return who steps a scene: its own engine, or MJX where that does not know such contact.

    Raises:
        ValueError: if contact is none of the four records.
        SceneError: if MJX would have to step it, and cannot.
    """
    check_contact(contact)
    engine = ENGINES[scene.engine]
    is_able = engine is not ENGINES["mjx"] or not scene.unsupported
    if isinstance(contact, engine.contacts) and is_able:
        return engine
    if scene.unsupported:
        alone = f"contact=mg.{type(contact).__name__}(...) is MJX's alone: " * (
            not isinstance(contact, engine.contacts)
        )
        raise SceneError(alone + scene.unsupported)
    return ENGINES["mjx"]


__all__ = [
    "ENGINES", "QUICK", "DivergedError", "Engine", "Motion", "Observe", "PolicyFunction", "Rows", "Sees", "SlopeWarning", "State",
    "Trajectory", "engine_of",
]  # fmt: skip
