"""Scenes that MJX can step, from MJCF: their contents, conversions and omissions."""

from mjxgrad.scene.load import load_scene
from mjxgrad.scene.scene import Scene, SceneError, SceneWarning, sensor, site_position
