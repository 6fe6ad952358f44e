"""A scene that would load for minutes is refused at once."""

import pytest

import mjxgrad as mg
from mjxgrad.scene import SceneError, load


def _balls(count: int) -> str:
    balls = "".join(f'<body pos="{i} 0 0"><freejoint/><geom size=".1"/></body>' for i in range(count))
    return f"<mujoco><worldbody>{balls}</worldbody></mujoco>"


def test_too_many_pairs_are_refused():
    with pytest.raises(SceneError, match=r"at most 20000 pairs .* got more"):
        mg.load_scene(_balls(300), engine="mjx")
    with pytest.warns(mg.scene.SceneWarning, match="C MuJoCo steps it: .*got more"):
        assert mg.load_scene(_balls(300)).engine == "mujoco"


def test_pairs_that_are_excluded_do_not_count(monkeypatch):
    monkeypatch.setattr(load, "MOST_PAIRS", 2)
    with pytest.raises(SceneError, match=r"at most 2 pairs .* got more"):
        mg.load_scene(_balls(3), engine="mjx")
    apart = "</worldbody><contact><exclude body1='one' body2='other'/></contact>"
    named = _balls(3).replace("<body", "<body name='one'", 1).replace("<body p", "<body name='other' p", 1)
    assert len(mg.load_scene(named.replace("</worldbody>", apart)).pairs) == 2
