"""Scenes for the tests of the step, and how to compare derivatives."""

from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjxgrad._mjx import mjx

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"

# Straight up from a floor, without gravity: its mean motion under noise on the distance is a closed form.
PUSHED_BALL = """<mujoco><option timestep="{h}" gravity="0 0 0" tolerance="1e-12"/><worldbody>
  <geom name="floor" type="plane" size="1 1 .1"/><body><joint name="z" type="slide" axis="0 0 1"/>
  <geom name="ball" size="0.1" mass="1" pos="0 0 0.1"/></body></worldbody>
  <contact><pair geom1="ball" geom2="floor" condim="1" {contact}/></contact>
  <actuator><motor joint="z"/></actuator></mujoco>"""

# Everything the step has a formula for, on nine small bodies. Only the floor collides, so that the rows stay few.
ZOO = """
<mujoco>
  <option timestep="0.002" cone="{cone}" integrator="{integrator}" tolerance="1e-13" iterations="100" impratio="2"/>
  <default><geom contype="0" conaffinity="1"/></default>
  <worldbody>
    <geom type="plane" size="5 5 .1" contype="1" friction="0.8 0.01 0.001"/>
    <body pos="0 0 .098"><freejoint/><geom size=".1" condim="6" friction="0.7 0.02 0.01"/></body>
    <body pos=".5 0 .098"><freejoint/><geom size=".1" condim="4" friction="0.6 0.03 0.01"/></body>
    <body pos="1.5 0 .098"><joint type="slide" axis="0 0 1"/><joint type="slide" axis="1 0 0"/>
      <geom size=".1" condim="1"/></body>
    <body pos="2 0 .098"><joint type="slide" axis="0 0 1"/><joint type="hinge" axis="0 1 0"/>
      <geom type="capsule" size=".1 .05" euler="0 90 0" condim="3"/></body>
    <body pos="0 1 1"><joint name="a" axis="0 1 0" range="-20 20" limited="true" frictionloss=".3" armature=".01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" conaffinity="0"/>
      <body pos="0 0 -.3"><joint type="ball" range="0 25" limited="true" damping=".05"/>
        <geom type="capsule" fromto="0 0 0 .05 0 -.3" size=".03" conaffinity="0"/></body></body>
    <body pos="0 2 1"><joint name="s" type="slide" axis="1 0 0" range="-.1 .1" limited="true" stiffness="3"/>
      <geom size=".05" conaffinity="0"/></body>
    <body pos="0 3 1"><joint name="t" type="slide" axis="1 0 0" damping="1"/><geom size=".05" conaffinity="0"/></body>
    {welded}
  </worldbody>
  <tendon>
    <fixed name="f" range="-.05 .05" limited="true" frictionloss=".1"><joint joint="s" coef="1"/>
      <joint joint="t" coef="-.5"/></fixed>
    <fixed name="g"><joint joint="a" coef=".3"/></fixed>
  </tendon>
  <equality>
    <joint joint1="t" joint2="s" polycoef="0.01 .5 .2 0 0"/>
    <tendon tendon1="g" tendon2="f" polycoef="0 .1 0 0 0" solref=".1 1"/>
    {equality}
  </equality>
  <actuator><motor joint="a"/><motor joint="s" gear="2"/></actuator>
</mujoco>
"""
# MuJoCo in C takes the acceleration of turning bodies off what connect and weld ask for, MJX does not.
_WELDED = """
    <body name="p" pos="1 2 1"><freejoint/><geom size=".05" conaffinity="0"/></body>
    <body name="q" pos="1.2 2 1"><freejoint/><geom type="box" size=".05 .04 .03" conaffinity="0"/>
      <site name="x" pos=".1 0 0"/></body>
    <site name="y" pos="1.3 2 1"/>
"""
_EQUALITY = """<connect body1="p" anchor="0 0 .1"/><weld body1="q" body2="p" torquescale="1.5"/>
    <connect site1="x" site2="y"/>"""


def zoo(cone="pyramidal", integrator="Euler", welded=False):
    """Return the model of all kinds of rows and a state in which most of them are active."""
    text = ZOO.format(
        cone=cone, integrator=integrator, welded=_WELDED if welded else "", equality=_EQUALITY if welded else ""
    )
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    random = np.random.default_rng(1)
    # The zero pose is the contact-rich one; the arm and the slider start beyond their limits.
    for joint, value in (("a", 0.4), ("s", 0.12), ("t", 0.05)):
        data.joint(joint).qpos = value
    data.qvel[:] = 0.3 * random.normal(size=model.nv)
    data.ctrl[:] = [0.5, -0.4]
    return model, data


def published(name, settle=300):
    """Return one of gymnasium's models at tolerance 1e-12, settled and then pushed."""
    model = mujoco.MjModel.from_xml_path(str(ASSETS / f"{name}.xml"))
    model.opt.tolerance, model.opt.iterations, model.opt.ls_iterations = 1e-12, 100, 50
    # Newton and CG minimise the same convex cost; C's CG stops far from 1e-12.
    model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    data = mujoco.MjData(model)
    for _ in range(settle):
        mujoco.mj_step(model, data)
    random = np.random.default_rng(0)
    data.qvel[:] += 0.3 * random.normal(size=model.nv)
    data.ctrl[:] = 0.2 * random.normal(size=model.nu)
    return model, data


def put(text):
    """Return the MJX model and data of an MJCF string."""
    model = mujoco.MjModel.from_xml_string(text)
    return mjx.put_model(model), mjx.make_data(model)


def central_difference(function, x, width):
    """Return the Jacobian of a vector function by central differences, columns mapped in one call."""
    steps = width * jnp.eye(x.size, dtype=x.dtype)
    ahead, behind = jnp.split(jax.vmap(function)(x + jnp.concatenate([steps, -steps])), 2)
    return (ahead - behind).T / (2 * width)
