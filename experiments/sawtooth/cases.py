"""The motions: where they start, what is changed of the start, and what is read."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float

from experiments.motion import Read

_ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"


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


def _planar(qpos: Float[Array, " nq"], qvel: Float[Array, " nv"]) -> Float[Array, " 3"]:
    return qpos[:3]


def _free(qpos: Float[Array, " nq"], qvel: Float[Array, " nv"]) -> Float[Array, " 3"]:
    w, x, y, z = qpos[3:7]
    return jnp.array([qpos[0], qpos[2], 2 * (w * y - z * x)])


def _ball(qpos: Float[Array, " nq"], qvel: Float[Array, " nv"]) -> Float[Array, " 3"]:
    return jnp.array([qpos[0], qpos[2], qvel[4]])


def _two_balls(qpos: Float[Array, " nq"], qvel: Float[Array, " nv"]) -> Float[Array, " 4"]:
    return jnp.array([qpos[0], qpos[1], qpos[7], qpos[8]])


def _arm(qpos: Float[Array, " nq"], qvel: Float[Array, " nv"]) -> Float[Array, " 2"]:
    return qpos[:2]


def _robot(title: str, file: str, qpos: dict[int, float], speed: float = 0.5, **other: Any) -> Case:
    """One of gymnasium's robots, dropped while it moves forwards."""
    planar = {"moved": 1, "labels": ("x", "z", "pitch (rad)"), "read": _planar}
    model = mujoco.MjModel.from_xml_path(str(_ASSETS / file))
    return Case(title, model, interval=(0.0, 0.03), duration=0.5, qpos=qpos, qvel={0: speed}, **planar | other)


_BALL = """<mujoco model="ball">
  <option timestep="0.002" cone="{cone}"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1" euler="0 {slope} 0" condim="{condim}"/>
    <body name="ball" pos="0 0 0.1">
      <freejoint/>
      <geom name="ball" type="sphere" size="0.05" condim="{condim}"/>
    </body>
  </worldbody>
</mujoco>"""


def _ball_case(cone: str, condim: int, slope: float = 0.0) -> Case:
    """A ball thrown down with spin; gravity brings it back for smaller bounces."""
    place = f"plane inclined by {slope:g}°" if slope else "level plane"
    return Case(
        f"Ball, {place}, {cone}, condim {condim}",
        mujoco.MjModel.from_xml_string(_BALL.format(cone=cone, condim=condim, slope=slope)),
        moved=2,
        interval=(0.0, 0.03),
        labels=("x", "height", "spin (1/s per m)"),
        read=_ball,
        duration=0.24,
        qvel={0: 1.0, 2: -1.5, 3: 2.0, 4: -10.0, 5: 5.0},
    )


_TWO_BALLS = """<mujoco model="two balls">
  <option timestep="0.002" gravity="0 0 0" cone="{cone}"/>
  <worldbody>
    <body name="first" pos="-0.2 0 0"><freejoint/><geom type="sphere" size="0.05"/></body>
    <body name="second"><freejoint/><geom type="sphere" size="0.05"/></body>
  </worldbody>
</mujoco>"""


def _two_balls_case(cone: str) -> Case:
    """An oblique hit, with its impact parameter moved."""
    return Case(
        f"Two balls, oblique, {cone}",
        mujoco.MjModel.from_xml_string(_TWO_BALLS.format(cone=cone)),
        moved=1,
        interval=(0.03, 0.06),
        labels=("first, along", "first, across", "second, along", "second, across"),
        read=_two_balls,
        duration=0.24,
        qvel={0: 1.5, 5: 3.0},
    )


_ARM = """<mujoco model="arm">
  <option timestep="0.002"/>
  <default><joint type="hinge" axis="0 1 0" damping="0.02"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1"/>
    <body name="upper" pos="0 0 0.5">
      <joint name="shoulder"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" contype="0" conaffinity="0"/>
      <body name="lower" pos="0.4 0 0">
        <joint name="elbow"/>
        <geom type="capsule" fromto="0 0 0 0.35 0 0" size="0.03"/>
      </body>
    </body>
  </worldbody>
</mujoco>"""


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
        read=_free,
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
        mujoco.MjModel.from_xml_string(_ARM),
        moved=0,
        interval=(0.0, 0.06),
        labels=("shoulder (rad)", "elbow (rad)"),
        read=_arm,
        duration=0.4,
        qpos={0: 0.3, 1: 0.4},
    ),
}
