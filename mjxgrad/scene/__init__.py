"""From MJCF to a scene that MJX can step: what it has, what was converted and left out."""

from mjxgrad.scene.conversions import Conversion
from mjxgrad.scene.load import load_scene
from mjxgrad.scene.omissions import Omission
from mjxgrad.scene.scene import Scene, SceneError, SceneWarning, sensor, site_position

__all__ = [
    "Conversion",
    "Omission",
    "Scene",
    "SceneError",
    "SceneWarning",
    "load_scene",
    "sensor",
    "site_position",
]
