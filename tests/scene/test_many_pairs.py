"""A scene that would load for minutes is refused at once."""

import mujoco
import pytest

import mjxgrad as mg
from mjxgrad.contact.parameters import contact_pairs
from mjxgrad.scene import SceneError, load
from mjxgrad.scene.load import count_pairs


def _balls(count: int) -> str:
    balls = "".join(f'<body pos="{i} 0 0"><freejoint/><geom size=".1"/></body>' for i in range(count))
    return f"<mujoco><worldbody>{balls}</worldbody></mujoco>"


def test_too_many_pairs_are_refused_with_their_number():
    with pytest.raises(SceneError, match=r"at most 20000 pairs .* got about 44850"):
        mg.load_scene(_balls(300), engine="mjx")


# Two limbs on a trunk, and a box that is fixed to it; a weight in the air; two balls. Masks are those of MuJoCo, or named.
TREE = """<mujoco><option>{flag}</option><worldbody><geom name="floor" type="plane" size="9 9 1"/>
<body name="trunk"><freejoint/><geom name="t" size=".1"/>
  <body name="fixed"><geom name="f" size=".1"/></body>
  <body name="arm"><joint/><geom name="a" size=".1"/><body name="hand"><joint/><geom name="h" size=".1"/></body></body>
  <body name="leg"><joint/><geom name="l" size=".1" contype="2" conaffinity="5"/></body></body>
<body name="weight"><geom name="w" size=".1"/></body>
<body name="ball"><freejoint/><geom name="b" size=".1" contype="4"/></body></worldbody>
<contact>{contact}</contact></mujoco>"""


@pytest.mark.parametrize("flag", ["", "<flag filterparent='disable'/>", "<flag contact='disable'/>"])
@pytest.mark.parametrize(
    "exclude", [(), (("hand", "leg"),), (("trunk", "arm"), ("trunk", "fixed"), ("fixed", "arm"), ("ball", "hand"))]
)
def test_pairs_are_counted_as_mjx_lists_them(flag, exclude):
    contact = "".join(f"<exclude body1='{one}' body2='{other}'/>" for one, other in exclude)
    model = mujoco.MjModel.from_xml_string(TREE.format(flag=flag, contact=contact))
    assert count_pairs(model) == len(contact_pairs(model))
    assert bool(contact_pairs(model)) == ("contact" not in flag)


def test_pairs_that_are_excluded_do_not_count(monkeypatch):
    monkeypatch.setattr(load, "MOST_PAIRS", 2)
    with pytest.raises(SceneError, match=r"at most 2 pairs .* got about 3"):
        mg.load_scene(_balls(3), engine="mjx")
    apart = "</worldbody><contact><exclude body1='one' body2='other'/></contact>"
    named = _balls(3).replace("<body", "<body name='one'", 1).replace("<body p", "<body name='other' p", 1)
    assert len(mg.load_scene(named.replace("</worldbody>", apart)).pairs) == 2


def test_a_spec_loads_as_its_mjcf_does():
    assert mg.load_scene(mujoco.MjSpec.from_string(_balls(2))).pairs == mg.load_scene(_balls(2)).pairs
