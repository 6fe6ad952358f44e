"""From MJCF to a scene that MJX can step: what it has, what was converted and left out."""

from mjxgrad.scene.conversions import Conversion
from mjxgrad.scene.leave_out import LeaveOut, OmittedPair
from mjxgrad.scene.load import SceneError, load_scene
from mjxgrad.scene.omissions import Omission
from mjxgrad.scene.scene import Scene, SceneWarning

__all__ = [
    "Conversion",
    "LeaveOut",
    "Omission",
    "OmittedPair",
    "Scene",
    "SceneError",
    "SceneWarning",
    "load_scene",
]
