"""The motions: where they start, what is changed of the start, and what is read."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import jax.numpy as jnp
import mujoco

from experiments.motion import Read
from mjxgrad.tasks import scene_path

_ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"

# From positions and velocities to what is read of a motion.
_READ: dict[str, Read] = {
    "planar": lambda qpos, qvel: qpos[:3],
    "free": lambda qpos, qvel: jnp.array([qpos[0], qpos[2], 2 * (qpos[3] * qpos[5] - qpos[6] * qpos[4])]),
    "ball": lambda qpos, qvel: jnp.array([qpos[0], qpos[2], qvel[4]]),
    "two_balls": lambda qpos, qvel: jnp.array([qpos[0], qpos[1], qpos[7], qpos[8]]),
    "arm": lambda qpos, qvel: qpos[:2],
}


@dataclass(frozen=True)
class Case:
    """A motion with impacts."""

    title: str
    model: mujoco.MjModel  # with its own contact, limits, integrator and time step
    moved: int  # index in `qpos` of the coordinate to which the parameter is added
    interval: tuple[float, float]  # of the parameter (m or rad); it moves the first impact through several time steps
    labels: tuple[str, ...]  # of what is read, with units
    read: Read
    duration: float  # in s
    qpos: Mapping[int, float] = field(default_factory=dict)  # start positions that differ from the model's, by index
    qvel: Mapping[int, float] = field(default_factory=dict)  # start velocities that differ from zero, by index


def case(name: str) -> Case:
    """Build a motion by one of the names in `experiments.sawtooth.settings.CaseName`."""
    return _BUILDERS[name]()


def _robot(title: str, file: str, qpos: dict[int, float], speed: float = 0.5, **other: Any) -> Case:
    """One of gymnasium's robots, dropped while it moves forwards."""
    planar = {"moved": 1, "labels": ("x", "z", "pitch (rad)"), "read": _READ["planar"]}
    model = mujoco.MjModel.from_xml_path(str(_ASSETS / file))
    return Case(title, model, interval=(0.0, 0.03), duration=0.5, qpos=qpos, qvel={0: speed}, **planar | other)


_BALL = """<mujoco model="ball">
  <option timestep="0.002" cone="{cone}"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1" euler="0 {slope} 0" condim="{condim}" friction="{friction}"/>
    <body name="ball" pos="0 0 {height}">
      <freejoint/>
      <geom name="ball" type="sphere" size="0.05" condim="{condim}" friction="{friction}"/>
    </body>
  </worldbody>
</mujoco>"""


def ball(
    cone: str = "pyramidal", condim: int = 3, slope: float = 0.0, friction: float = 1.0, height: float = 0.1
) -> mujoco.MjModel:
    """Build a ball of 5 cm at a height (m) over a plane that is inclined by some degrees."""
    xml = _BALL.format(cone=cone, condim=condim, slope=slope, friction=friction, height=height)
    return mujoco.MjModel.from_xml_string(xml)


def _ball_case(cone: str, condim: int, slope: float = 0.0) -> Case:
    """A ball thrown down with spin; gravity brings it back for smaller bounces."""
    place = f"plane inclined by {slope:g}°" if slope else "level plane"
    return Case(
        f"Ball, {place}, {cone}, condim {condim}",
        ball(cone, condim, slope),
        moved=2,
        interval=(0.0, 0.03),
        labels=("x", "height", "spin (1/s per m)"),
        read=_READ["ball"],
        duration=0.24,
        qvel={0: 1.0, 2: -1.5, 3: 2.0, 4: -10.0, 5: 5.0},
    )


def _two_balls_case(cone: str) -> Case:
    """An oblique hit, with its impact parameter moved."""
    model = mujoco.MjModel.from_xml_path(str(scene_path("two_balls")))
    model.opt.cone = getattr(mujoco.mjtCone, f"mjCONE_{cone.upper()}")
    return Case(
        f"Two balls, oblique, {cone}",
        model,
        moved=1,
        interval=(0.03, 0.06),
        labels=("first, along", "first, across", "second, along", "second, across"),
        read=_READ["two_balls"],
        duration=0.24,
        qvel={0: 1.5, 5: 3.0},
    )


_BUILDERS = {
    "hopper": lambda: _robot("Hopper", "hopper.xml", {1: 1.22, 3: -0.4, 4: -0.5, 5: 0.3}),
    "walker2d": lambda: _robot(
        "Walker2d", "walker2d.xml", {1: 1.24, 3: -0.3, 4: -0.4, 5: 0.3, 6: -0.1, 7: -0.7, 8: 0.2}
    ),
    "half_cheetah": lambda: _robot("Half cheetah", "half_cheetah.xml", {1: 0.05, 2: 0.1, 3: 0.3, 4: -0.3, 6: 0.2}),
    # Legs half bent and the trunk tilted, so that the feet land one after the other.
    "ant": lambda: _robot(
        "Ant",
        "ant.xml",
        {2: 0.72, 3: 0.9962, 4: 0.05, 5: 0.07, 7: 0.2, 8: 0.9, 10: -0.9, 12: -0.8, 14: 0.8},
        speed=0.3,
        moved=2,
        labels=("x", "z", "pitch (sine)"),
        read=_READ["free"],
    ),
    "ball_frictionless": lambda: _ball_case("pyramidal", 1),
    "ball": lambda: _ball_case("pyramidal", 3),
    "ball_elliptic": lambda: _ball_case("elliptic", 3),
    "ball_torsion": lambda: _ball_case("elliptic", 4),
    "ball_rolling": lambda: _ball_case("pyramidal", 6),
    "ball_inclined": lambda: _ball_case("pyramidal", 3, 20.0),
    "ball_inclined_rolling": lambda: _ball_case("elliptic", 6, 20.0),
    "two_balls": lambda: _two_balls_case("pyramidal"),
    "two_balls_elliptic": lambda: _two_balls_case("elliptic"),
    "arm": lambda: Case(
        "Two-link arm",
        mujoco.MjModel.from_xml_path(str(scene_path("falling_arm"))),
        moved=0,
        interval=(0.0, 0.06),
        labels=("shoulder (rad)", "elbow (rad)"),
        read=_READ["arm"],
        duration=0.4,
        qpos={0: 0.3, 1: 0.4},
    ),
}
