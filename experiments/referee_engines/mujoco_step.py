"""Whatever steps MuJoCo's models: mjxgrad, mjx.step by autodiff, and MuJoDiCo, a fork of it with contact laws of its own.

MJX `forward` keeps the file's iterations of the solver, whose loops only forward mode passes; `reverse` allows one iteration and
four of the line search, as DeepMind's notebook on policy gradients does; `soft` is `reverse` with contact of a slow spring.
"""

import importlib

import jax
import jax.numpy as jnp
import mujoco
from protocol import Pair, Scene, by_jax, serve, starts

jax.config.update("jax_enable_x64", True)
_MJX = ("forward", "reverse", "soft")


def make(scene: Scene, variant: str) -> Pair:
    """Roll out mjxgrad by an engine and a derivative ("mujoco slope"), MJX, or MuJoDiCo by a contact law ("Hunt-Crossley")."""
    model = mujoco.MjModel.from_xml_string(scene["xml"])
    steps = round(scene["duration"] / scene["timestep"])
    if " " in variant:
        return _ours(scene, model, steps, *variant.split())
    mjx = importlib.import_module("mujoco.mjx" if variant in _MJX else "mujodico.mjx")
    if variant in ("reverse", "soft"):
        model.opt.iterations, model.opt.ls_iterations = 1, 4
    if variant == "soft":
        model.geom_solref[:], model.geom_solimp[:, :3] = [0.1, 1.0], [0.0, 0.95, 0.01]
    law = {}
    if variant not in _MJX:
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER  # its solver refuses the hopper's
        law = {"contact_approximation": variant, "contact_smoothing": 1e-5}
    on_device = mjx.put_model(model, **law)

    def outcome(value: jax.Array) -> jax.Array:
        qpos, qvel, ctrl = starts(scene, model, value)
        data = mjx.make_data(on_device).replace(qpos=qpos, qvel=qvel, ctrl=ctrl)
        data, _ = jax.lax.scan(lambda data, _: (mjx.step(on_device, data), None), data, None, steps)
        return data.qpos[scene["read"]]

    return by_jax(outcome, forward=variant == "forward")


def _ours(scene: Scene, model: mujoco.MjModel, steps: int, engine: str, derivative: str) -> Pair:
    mg = importlib.import_module("mjxgrad")
    contact = {"discrete": mg.Discrete(), "slope": mg.Slope()}[derivative]
    loaded = mg.load_scene(model).with_engine(engine)

    def outcome(value: jax.Array) -> jax.Array:
        qpos, qvel, ctrl = starts(scene, model, value)
        controls = jnp.broadcast_to(ctrl, (steps, ctrl.size))
        course = mg.rollout(loaded, mg.initial_state(loaded, qpos, qvel), controls, contact=contact)
        return course.qpos[-1, scene["read"]]

    return by_jax(outcome)


if __name__ == "__main__":
    serve(make)
