"""From MJCF to a scene that MJX can step: what it has, what was converted and left out."""

from mjxgrad.scene.load import load_scene
from mjxgrad.scene.scene import Conversion, Omission, Scene, SceneError

__all__ = ["Conversion", "Omission", "Scene", "SceneError", "load_scene"]
