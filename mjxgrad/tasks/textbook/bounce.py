"""The scene of a ball that bounces once, whose outcome is known (`contact.bounce`)."""

from mjxgrad.scene import Scene, load_scene

# Reference accelerations are taken as written: `refsafe` would replace a time constant below two time steps.
_SCENE = """
<mujoco model="bounce">
  <option gravity="0 0 0" timestep="{timestep}"><flag refsafe="disable"/></option>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <body name="ball" pos="0 0 0.05">
      <joint name="height" type="slide" axis="0 0 1"/>
      <geom name="ball" type="sphere" size="0.05"/>
    </body>
  </worldbody>
</mujoco>
"""


def bounce_scene(timestep: float = 1e-3) -> Scene:
    """Load the ball over the floor; its position is its height above it, in m. Contact is MuJoCo's default.

    Args:
        timestep: in s.

    Returns:
        The scene, without gravity and without `refsafe`.
    """
    return load_scene(_SCENE.format(timestep=timestep))
