"""brax's generalised, positional and spring pipelines, with the time steps of its own environments."""

# pyright: reportMissingImports=false

from pathlib import Path

import brax
import jax
from brax.generalized import pipeline as generalized
from brax.io import mjcf
from brax.positional import pipeline as positional
from brax.spring import pipeline as spring
from protocol import Pair, Scene, by_jax, serve, starts

jax.config.update("jax_enable_x64", True)
_PIPELINES = {"generalized": generalized, "positional": positional, "spring": spring}


def make(scene: Scene, variant: str) -> Pair:
    """Roll out a pipeline in a scan; the hopper is brax's file of it, whose constants its pipelines need."""
    own = Path(str(brax.__file__)).parent / "envs/assets/hopper.xml"
    system = mjcf.loads(own.read_text() if scene["name"] == "hopper" else scene["xml"])
    pipeline = _PIPELINES[variant]
    steps = round(scene["duration"] / float(system.opt.timestep))

    def outcome(value: jax.Array) -> jax.Array:
        qpos, qvel, ctrl = starts(scene, system.mj_model, value)
        state = pipeline.init(system, qpos, qvel)
        state, _ = jax.lax.scan(lambda state, _: (pipeline.step(system, state, ctrl), None), state, None, steps)
        return state.q[scene["read"]]

    return by_jax(outcome)


if __name__ == "__main__":
    serve(make)
