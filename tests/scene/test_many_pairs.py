"""A scene that would load for minutes is refused at once."""

import mujoco
import pytest

import mjxgrad as mg
from mjxgrad.scene import SceneError


def _balls(count: int) -> str:
    balls = "".join(f'<body pos="{i} 0 0"><freejoint/><geom size=".1"/></body>' for i in range(count))
    return f"<mujoco><worldbody>{balls}</worldbody></mujoco>"


def test_too_many_pairs_are_refused_with_their_number():
    with pytest.raises(SceneError, match=r"at most 20000 pairs .* got about 44850"):
        mg.load_scene(_balls(300))


def test_a_spec_loads_as_its_mjcf_does():
    assert mg.load_scene(mujoco.MjSpec.from_string(_balls(2))).pairs == mg.load_scene(_balls(2)).pairs
