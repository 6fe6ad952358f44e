"""Costs by name: functions of files and modules, and height, speed, uprightness and reach of bodies."""

import contextlib
import difflib
import importlib
import importlib.util
import runpy
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float

from mjxgrad.bodies.kinematics import kinematics
from mjxgrad.rollouts import Trajectory
from mjxgrad.scene import Scene

Cost = Callable[[Trajectory], Float[Array, "..."]]
_BUILT_IN = {"height": 1, "speed": 1, "upright": 1, "reach": 2}  # costs, and the number of bodies or sites of each
_SHOWN = 10  # functions of a file


def named_cost(scene: Scene, name: str) -> Cost:
    """Return a cost by its name: of a file, of a module, or of a body or site of the scene."""
    kind, _, what = name.partition(":")
    if kind not in _BUILT_IN:
        is_module = kind.endswith(".py") or importlib.util.find_spec(kind.partition(".")[0]) is not None
        if not is_module and (near := difflib.get_close_matches(kind, _BUILT_IN, 1)):
            known = ", ".join(_BUILT_IN)
            raise ValueError(f"cost must be one of {known}, or a function; did you mean {near[0]}:{what}?")
        return _function(name)
    if len(names := what.split("/")) != _BUILT_IN[kind]:
        raise ValueError(f"cost: {kind} is of {'two, as reach:hand/ball' if kind == 'reach' else 'one'}, got {what!r}")
    found = [_body_or_site(scene.mj_model, name) for name in names]
    data, seconds = scene.data, scene.mj_model.opt.timestep

    def frames(qpos: Float[Array, " nq"]) -> list[tuple[Array, Array]]:
        placed = kinematics(scene.model, data.replace(qpos=qpos))
        parts = {True: (placed.xpos, placed.xmat), False: (placed.site_xpos, placed.site_xmat)}
        return [(place[i], turn[i]) for i, is_body in found for place, turn in [parts[is_body]]]

    def cost(trajectory: Trajectory) -> Float[Array, ""]:
        (place, turn), *other = frames(trajectory.qpos[-1])
        if kind == "reach":
            return jnp.linalg.norm(place - other[0][0])
        if kind == "speed":
            return (frames(trajectory.qpos[0])[0][0] - place)[0] / (seconds * len(trajectory.ctrl))
        return -place[2] if kind == "height" else 1 - turn[2, 2]

    return cost


def _function(name: str) -> Callable[..., Any]:
    """Return a function by file.py:function or module:function, the module also in the current folder."""
    source, colon, function = name.rpartition(":")
    if not colon:
        raise ValueError(f"cost must be file.py:function, module:function, or of a body as height:torso, got {name!r}")
    if source.endswith(".py") and not Path(source).is_file():
        raise ValueError(f"cost: there is no file {source}")
    with _told(name):
        sys.path.insert(0, str(Path.cwd()))
        names = runpy.run_path(source) if source.endswith(".py") else vars(importlib.import_module(source))
    if not callable(names.get(function)):
        there = [key for key, one in names.items() if callable(one) and not key.startswith("_")]
        near = (difflib.get_close_matches(function, there, _SHOWN) if len(there) > _SHOWN else there) or there[:_SHOWN]
        more = f" and {len(there) - len(near)} more" * (len(near) < len(there))
        raise ValueError(f"cost: {source} has no function {function!r}, but {', '.join(near) or 'none'}{more}")
    return _told(name)(names[function])


@contextlib.contextmanager
def _told(name: str) -> Iterator[None]:
    """Put an error in a user's file, which may be any, into a sentence."""
    try:
        yield
    except SystemExit as error:
        raise ValueError(
            f"cost {name!r} ended the program; put what it runs under if __name__ == '__main__'"
        ) from error
    except Exception as error:
        source = name.rpartition(":")[0]
        file = getattr(sys.modules.get(source), "__file__", None) or source
        frames = traceback.extract_tb(error.__traceback__)
        lines = [one.lineno for one in frames if Path(one.filename).resolve() == Path(file).resolve()]
        place = f" ({file}, line {lines[-1]})" if lines else ""
        if isinstance(error, jax.errors.TracerArrayConversionError | jax.errors.ConcretizationTypeError):
            wanted = "must compute with jax.numpy, got NumPy, float() or if on traced numbers"
            raise ValueError(f"cost {name!r} {wanted}{place}") from error
        forms = "; a cost must be file.py:function, module:function, or of a body as height:torso"
        forms *= isinstance(error, ModuleNotFoundError) and error.name == source
        raise ValueError(f"cost {name!r} raised {type(error).__name__}: {error}{place}{forms}") from error


def _body_or_site(model: mujoco.MjModel, name: str) -> tuple[int, bool]:
    """Return the id of a named body or site, and whether it is a body."""
    counts = {"body": (model.nbody, model.body), "site": (model.nsite, model.site)}
    known = {kind: [at(i).name for i in range(count)] for kind, (count, at) in counts.items()}
    for kind, names in known.items():
        if name and name in names:
            return names.index(name), kind == "body"
    there = "; ".join(f"{kind}: {', '.join(filter(None, names)) or 'none'}" for kind, names in known.items())
    raise ValueError(f"there is no body or site {name!r} in the scene, but {there}")
