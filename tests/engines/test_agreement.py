"""A scene that MJX moves otherwise than C MuJoCo is told so by its first rollout."""

import copy
import dataclasses
import warnings

import jax.numpy as jnp
import mujoco
import pytest

import mjxgrad as mg
from mjxgrad.scene import SceneWarning

# It falls for 60 ms, and then slides along the floor.
BOX = """<mujoco><worldbody><geom type="plane" size="5 5 .1"/><body pos="0 0 .12"><joint name="along" type="slide" axis="1 0 0"/>
  <joint name="up" type="slide" axis="0 0 1"/><geom type="box" size=".1 .1 .1" mass="1"/></body></worldbody>
  <actuator><motor joint="along" ctrlrange="-1 1"/></actuator></mujoco>"""


def _roll(scene):
    start = mg.initial_state(scene, qvel=jnp.array([0.5, 0.0]))
    return mg.rollout(scene, start, jnp.full((50, 1), 0.3))


def test_nothing_is_said_where_both_move_it_alike():
    scene = mg.load_scene(BOX)
    with warnings.catch_warnings(action="error"):
        _roll(scene)
        # Numbers that the file does not have are C MuJoCo's, too.
        _roll(mg.load_scene(BOX).with_model(geom_friction=jnp.full((2, 3), 0.2), timestep=0.001))


def test_the_joint_that_moves_otherwise_is_named_once():
    """MJX here has a contact that C MuJoCo's model lacks; it acts from the 32nd step on."""
    scene, other = mg.load_scene(BOX), copy.copy(mujoco.MjModel.from_xml_string(BOX))
    other.geom_contype[:] = other.geom_conaffinity[:] = 0
    scene = dataclasses.replace(scene, mj_model=other)
    with pytest.warns(SceneWarning, match=r"step \d+ by MJX is not C MuJoCo's: up has a speed of .* engine='mujoco'"):
        _roll(scene)
    with warnings.catch_warnings(action="error"):
        _roll(scene)
