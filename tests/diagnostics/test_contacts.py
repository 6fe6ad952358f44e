"""Recorded motions tell how many contacts a scene needs room for."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

import mjxgrad as mg
from mjxgrad.diagnostics import contacts_needed


@pytest.fixture(scope="module")
def falling():
    """A box falls flat from 5 cm, for three steps of 2 ms: no farther than 0.2 mm."""
    scene = mg.load_scene(
        """<mujoco><worldbody><geom type="plane" size="5 5 .1"/><body pos="0 0 .15"><freejoint/>
        <geom type="box" size=".1 .1 .1"/></body></worldbody></mujoco>"""
    )
    return scene, jax.jit(lambda: mg.rollout(scene, mg.initial_state(scene), horizon=3))()


def test_contacts_that_came_near_at_once_are_counted(falling):
    assert contacts_needed(*falling, clearance=0.051) == 4
    assert contacts_needed(*falling, clearance=0.049) == 1


def test_a_trajectory_of_another_scene_is_refused(falling):
    scene, trajectory = falling
    with pytest.raises(ValueError, match=r"trajectory\.qpos must have 7 columns in this scene, got 6"):
        contacts_needed(scene, dataclasses.replace(trajectory, qpos=trajectory.qpos[:, :6]))
    with pytest.raises(ValueError, match=r"trajectory\.qpos must be finite"):
        contacts_needed(scene, dataclasses.replace(trajectory, qpos=jnp.full((4, 7), jnp.nan)))
