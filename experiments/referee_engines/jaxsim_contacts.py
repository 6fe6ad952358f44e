"""jaxsim's soft contact, its default, at 1 ms, its default; bodies meet the ground alone, by points of their surface."""

# pyright: reportMissingImports=false

import jax
import jax.numpy as jnp
import jaxsim.api as js
from jaxsim.rbda.contacts import SoftContactsParams
from protocol import Pair, Scene, UnsupportedError, by_jax, serve

_STEP, _DEPTH = 1e-3, 0.02  # s; m, where its law (Hunt and Crossley) is as stiff as the scene's spring
_BODY = """<sdf version="1.10"><model name="body"><link name="base"><inertial><mass>{mass}</mass><inertia>
  <ixx>{0}</ixx><iyy>{0}</iyy><izz>{0}</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia></inertial>
  <collision name="box"><geometry><box><size>0.2 0.2 {1}</size></box></geometry></collision></link></model></sdf>"""


def make(scene: Scene, variant: str) -> Pair:
    """Roll out a box, for a ball would be 50 points; four corners share the stiffness."""
    if not scene.get("floor"):
        raise UnsupportedError("contact is with the ground alone, and no MJCF is loaded")
    text, share = _BODY.format(scene["inertia"], 2 * scene["radius"], **scene), scene["mass"] / 4 / _DEPTH**0.5
    law = SoftContactsParams.build(K=scene["stiffness"] * share, D=scene["damping"] * share, mu=scene["friction"])
    build = js.model.JaxSimModel.build_from_model_description
    model, steps = build(text, is_urdf=False, time_step=_STEP, contact_params=law), round(scene["duration"] / _STEP)

    def outcome(value: jax.Array) -> jax.Array:
        place, speed = jnp.array(scene["starts"][0], float), jnp.zeros(3)
        unit = jnp.eye(3)[scene["vary"][1]] * value
        place, speed = (place + unit, speed) if scene["vary"][0] == "qpos" else (place, speed + unit)
        data = js.data.JaxSimModelData.build(model, base_position=place, base_linear_velocity=speed)
        data, _ = jax.lax.scan(lambda data, _: (js.model.step(model, data), None), data, None, steps)
        return data.base_position[scene["read"]]

    return by_jax(outcome)


if __name__ == "__main__":
    serve(make)
