"""jaxsim's soft contact, its default, at its default step of 1 ms; bodies meet the ground alone, by points of their surface."""

import jax
import jax.numpy as jnp
import jaxsim.api as js
from jaxsim.rbda.contacts import SoftContactsParams
from protocol import Pair, Scene, UnsupportedError, by_jax, serve

_STEP = 1e-3
# The law is of Hunt and Crossley: as stiff as the scene's linear spring at this depth (m).
_DEPTH = 0.02
_BODY = """<sdf version="1.10"><model name="body"><link name="base">
  <inertial><mass>{mass}</mass><inertia>
    <ixx>{inertia}</ixx><iyy>{inertia}</iyy><izz>{inertia}</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia></inertial>
  <collision name="box"><geometry><box><size>0.2 0.2 {height}</size></box></geometry></collision>
</link></model></sdf>"""


def make(scene: Scene, variant: str) -> Pair:
    """Roll out a box, for a ball would be 50 points; four corners share the stiffness."""
    if scene["name"] not in ("bounce", "slide"):
        raise UnsupportedError("contact with the ground alone")
    height = 2 * scene["radius"]
    share = scene["mass"] / 4 / _DEPTH**0.5
    params = SoftContactsParams.build(K=scene["stiffness"] * share, D=scene["damping"] * share, mu=scene["friction"])
    text = _BODY.format(mass=scene["mass"], inertia=0.004 if scene["name"] == "bounce" else 0.01, height=height)
    build = js.model.JaxSimModel.build_from_model_description
    model = build(text, is_urdf=False, time_step=_STEP, contact_params=params)
    steps = round(scene["duration"] / _STEP)

    def outcome(value: jax.Array) -> jax.Array:
        place = jnp.array([0, 0, value if scene["name"] == "bounce" else height / 2])
        speed = jnp.array([0 if scene["name"] == "bounce" else value, 0, 0])
        data = js.data.JaxSimModelData.build(model, base_position=place, base_linear_velocity=speed)
        data, _ = jax.lax.scan(lambda data, _: (js.model.step(model, data), None), data, None, steps)
        return data.base_position[scene["read"]]

    return by_jax(outcome)


if __name__ == "__main__":
    serve(make)
