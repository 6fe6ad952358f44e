"""Reading a scene."""

import copy
import os
from pathlib import Path

import mujoco

from mjxgrad._mjx import mjx
from mjxgrad.contacts import contact_pairs
from mjxgrad.scene.scene import Scene, SceneError
from mjxgrad.softness import Softness


def load_scene(
    source: str | os.PathLike | mujoco.MjModel,
    *,
    softness: Softness | None = None,
    keep_everything: bool = False,
    timestep: float | None = None,
) -> Scene:
    """Load a scene."""
    mj_model = _compile(source)
    if timestep is not None:
        mj_model.opt.timestep = timestep
    model = mjx.put_model(mj_model, impl="jax")
    data = mjx.make_data(mj_model, impl="jax")
    scene = Scene(model, data, mj_model, (), (), contact_pairs(mj_model))
    return scene if softness is None else scene.with_softness(softness)


def _compile(source) -> mujoco.MjModel:
    """The C model of a source; a copy if the source is one already."""
    if isinstance(source, mujoco.MjModel):
        return copy.deepcopy(source)
    if isinstance(source, str) and source.lstrip().startswith("<"):
        try:
            return mujoco.MjModel.from_xml_string(source)
        except ValueError as error:
            raise SceneError(f"MuJoCo cannot read the MJCF string: {error}") from error
    path = Path(source)
    if path.is_dir():
        raise IsADirectoryError(f"scene must be an MJCF file, got the directory {str(path)!r}")
    if not path.exists():
        raise FileNotFoundError(f"no scene file at {str(path)!r}")
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise SceneError(f"MuJoCo cannot read {str(path)!r}: {error}") from error
