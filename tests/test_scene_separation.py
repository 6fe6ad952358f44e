"""What is proven to stay apart does."""

import mujoco
import numpy as np
import pytest

from mjxgrad.contact.parameters import contact_pairs
from mjxgrad.scene.masks import TooManyMasksError, keep_pairs
from mjxgrad.scene.separation import proven_distance
from mjxgrad.scene.volume import rotation_matrix, volume_of

_MESH = "<asset><mesh name='m' vertex='0 0 0 .1 0 0 0 .15 0 0 0 .2 .05 .05 -.1'/></asset>"
_SHAPES = (
    "type='sphere' size='{0}'",
    "type='capsule' size='{0} {1}'",
    "type='cylinder' size='{0} {1}'",
    "type='box' size='{0} {1} {2}'",
    "type='ellipsoid' size='{1} {0} {2}'",
    "type='mesh' mesh='m'",
)


def _numbers(rng, count, scale):
    return " ".join(f"{x:.4f}" for x in rng.uniform(-scale, scale, count))


def _joint(rng):
    kind = rng.choice(["hinge", "hinge", "hinge", "slide", "ball", "none"])
    if kind == "none":
        return ""
    if kind == "ball":
        return f"<joint type='ball' pos='{_numbers(rng, 3, 0.1)}'/>"
    low = rng.uniform(-1.5, 0.5) if kind == "hinge" else rng.uniform(-0.2, 0.0)
    high = low + (rng.uniform(0.2, 1.5) if kind == "hinge" else 0.2)
    limits = f"limited='true' range='{low:.3f} {high:.3f}'" if kind == "slide" or rng.random() < 0.7 else ""
    place = f"axis='{_numbers(rng, 3, 1)}' pos='{_numbers(rng, 3, 0.1)}' ref='{rng.uniform(-0.3, 0.3):.3f}'"
    return f"<joint type='{kind}' {place} {limits}/>"


def _geom(rng):
    shape = _SHAPES[rng.integers(len(_SHAPES))].format(*(f"{x:.4f}" for x in rng.uniform(0.02, 0.12, 3)))
    return f"<geom {shape} pos='{_numbers(rng, 3, 0.15)}' euler='{_numbers(rng, 3, 3)}'/>"


def _tree(rng, depth=0):
    """Bodies with up to two joints, two geoms and two children each."""
    children = "".join(_tree(rng, depth + 1) for _ in range(rng.integers(1, 3))) if depth < 2 else ""
    drawn = [_joint(rng) for _ in range(rng.integers(0, 3))]
    # MuJoCo lets no other turn follow a ball joint.
    joints = next((joint for joint in drawn if "ball" in joint), "".join(drawn))
    geoms = "".join(_geom(rng) for _ in range(rng.integers(1, 3)))
    return f"<body pos='{_numbers(rng, 3, 0.6)}' euler='{_numbers(rng, 3, 3)}'>{joints}{geoms}{children}</body>"


def _random_model(seed):
    rng = np.random.default_rng(seed)
    world = f"<geom type='plane' size='1 1 1' pos='0 0 -.9' euler='{_numbers(rng, 2, 0.5)} 0'/>{_geom(rng)}"
    trees = "".join(_tree(rng) for _ in range(2))
    source = (
        f"<mujoco><compiler angle='radian'/>{_MESH}<default><geom mass='1'/><joint limited='false'/></default>"
        f"<worldbody>{world}{trees}</worldbody></mujoco>"
    )
    return mujoco.MjModel.from_xml_string(source)


def _positions(model, rng, excess):
    """A position within the limits and as far beyond as trusted; extremes often, since that is where geoms meet."""
    qpos = np.zeros(model.nq)
    for joint in range(model.njnt):
        address = model.jnt_qposadr[joint]
        if mujoco.mjtJoint(int(model.jnt_type[joint])) == mujoco.mjtJoint.mjJNT_BALL:
            turn = rng.normal(size=4)
            qpos[address : address + 4] = turn / np.linalg.norm(turn)
            continue
        low, high = model.jnt_range[joint] + [-excess, excess] if model.jnt_limited[joint] else (-np.pi, np.pi)
        share = np.clip(rng.uniform(-0.3, 1.3), 0, 1)
        qpos[address] = low + share * (high - low) + (0.0 if model.jnt_limited[joint] else model.qpos0[address])
    return qpos


@pytest.mark.parametrize(
    ("seed", "num_positions"),
    [*((i, 300) for i in range(3)), *(pytest.param(i, 5000, marks=pytest.mark.slow) for i in range(40))],
)
def test_random_trees_never_bring_together_what_is_proven_apart(seed, num_positions):
    """Distances by C MuJoCo over many positions each; a pair that touches anywhere must not be proven apart."""
    excess, clearance = 0.1, 0.02
    model, rng = _random_model(seed), np.random.default_rng(seed)
    proven = {
        (pair.geom1, pair.geom2): distance
        for pair in contact_pairs(model)
        if (distance := proven_distance(model, pair.geom1, pair.geom2, at_least=clearance, beyond_limits=excess))
    }
    assert proven, "the claim must not be empty"
    data, closest = mujoco.MjData(model), dict.fromkeys(proven, np.inf)
    for _ in range(num_positions):
        data.qpos[:] = _positions(model, rng, excess)
        mujoco.mj_kinematics(model, data)
        for pair in proven:
            closest[pair] = min(closest[pair], mujoco.mj_geomDistance(model, data, *pair, 10.0, None))
    for pair, distance in proven.items():
        assert distance >= clearance
        # C MuJoCo's own search for the closest points of convex bodies stops at 1e-6 m.
        assert closest[pair] >= distance - 1e-6


def _surface(kind, rng):
    """Points on a geom of each kind, in its own frame, from the equation of its surface, and its MJCF."""
    normal = rng.normal(size=(500, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    if kind == "box":
        return np.sign(normal) * [0.1, 0.3, 0.2], "type='box' size='0.1 0.3 0.2'"
    if kind == "ellipsoid":
        return normal * [0.2, 0.3, 0.1], "type='ellipsoid' size='0.2 0.3 0.1'"
    if kind == "cylinder":
        rim = np.column_stack(
            [0.1 * normal[:, :2] / np.linalg.norm(normal[:, :2], axis=1, keepdims=True), normal[:, 2]]
        )
        return rim * [1, 1, 0.3] / [1, 1, np.abs(normal[:, 2]).max()], "type='cylinder' size='0.1 0.3'"
    return 0.1 * normal + np.sign(normal[:, 2:]) * [0, 0, 0.3], "type='capsule' size='0.1 0.3'"


@pytest.mark.parametrize("kind", ["box", "ellipsoid", "cylinder", "capsule"])
def test_a_volume_holds_its_geom_and_touches_it(kind):
    points, shape = _surface(kind, np.random.default_rng(0))
    source = f"<geom {shape} pos='0.1 0.2 0.3' euler='20 30 40'/>"
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{source}</worldbody></mujoco>")
    volume = volume_of(model, 0)
    placed = points @ rotation_matrix(model.geom_quat[0]).T + model.geom_pos[0]
    start, along = volume.ends[0], volume.ends[1] - volume.ends[0]
    share = np.clip((placed - start) @ along / (along @ along), 0, 1)
    distance = np.linalg.norm(placed - start - share[:, None] * along, axis=1)
    assert distance.max() <= volume.radius + 1e-12
    # Its widest points are on the volume's surface, but for how densely 500 points lie.
    assert distance.max() >= 0.99 * volume.radius


def _arm(joint="type='hinge' axis='0 1 0'", target="0.7 0 0", extra=""):
    """A capsule from the origin to 0.4 m, of radius 0.05, and a ball of radius 0.05."""
    return mujoco.MjModel.from_xml_string(f"""
    <mujoco><compiler angle="radian"/>
      <worldbody>
        <geom name="ball" size="0.05" pos="{target}" {extra}/>
        <body pos="0 0 0"><joint {joint}/><geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.05"/></body>
      </worldbody>
    </mujoco>""")


@pytest.mark.parametrize(
    ("joint", "target", "distance"),
    [
        # The tip sweeps a circle of radius 0.4 about the axis: 0.7 - 0.4 - 2 · 0.05.
        ("type='hinge' axis='0 1 0'", "0 0 0.7", 0.2),
        # The same circle in the plane y = 0, the ball 0.3 in front of its rim.
        ("type='hinge' axis='0 1 0'", "0.4 0.3 0", 0.2),
        # With the joint at the capsule's middle only 0.2 reach out of (0.2, 0, 0).
        ("type='hinge' axis='0 1 0' pos='0.2 0 0'", "0.2 0 0.6", 0.3),
        ("type='ball'", "0 0 0.7", 0.2),
    ],
)
def test_an_arm_that_turns_all_round_is_proven_apart_from_what_it_cannot_reach(joint, target, distance):
    model = _arm(joint, target)
    assert distance - 1e-2 <= proven_distance(model, 0, 1, at_least=distance - 1e-2) <= distance + 1e-9
    assert proven_distance(model, 0, 1, at_least=distance + 1e-6) is None
    assert proven_distance(model, 1, 0, at_least=distance - 1e-2) is not None


@pytest.mark.parametrize(
    ("joint", "target", "excess", "distance"),
    [
        # From −0.5 to 0.5 rad, 0.1 more trusted; at 0.6 rad the ball above is 0.6 cos 0.6 from the capsule's line.
        ("type='hinge' axis='0 -1 0' limited='true' range='-0.5 0.5'", "0 0 0.6", 0.1,
         0.6 * np.cos(0.6) - 0.1),
        ("type='slide' axis='1 0 0' limited='true' range='-0.5 0.1'", "0.8 0 0", 0.02, 0.8 - 0.4 - 0.12 - 0.1),
        # qpos counts from ref, the placement of the file, so the range leaves 0.1 to go.
        ("type='slide' axis='1 0 0' limited='true' range='-0.5 0.3' ref='0.2'", "0.8 0 0", 0.0, 0.8 - 0.4 - 0.1 - 0.1),
    ],
)  # fmt: skip
def test_limits_count_only_when_trusted_and_as_far_as_trusted(joint, target, excess, distance):
    model = _arm(joint, target)
    assert distance - 1e-3 <= proven_distance(model, 0, 1, at_least=distance - 1e-3, beyond_limits=excess)
    assert proven_distance(model, 0, 1, at_least=distance + 1e-6, beyond_limits=excess) is None
    assert proven_distance(model, 0, 1, at_least=distance - 1e-3) is None


def test_a_plane_is_met_where_the_lowest_point_of_the_sweep_is():
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody>
      <geom type="plane" size="1 1 1" pos="0 0 -0.6"/>
      <body><joint type="hinge" axis="1 1 0"/><geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.05"/></body>
    </worldbody></mujoco>""")
    # The tip is 0.4 sin 45° from the axis: 0.6 - 0.4 / √2 - 0.05.
    distance = 0.6 - 0.4 / np.sqrt(2) - 0.05
    assert distance - 1e-3 <= proven_distance(model, 0, 1, at_least=distance - 1e-3) <= distance
    assert proven_distance(model, 0, 1, at_least=distance + 1e-6) is None


@pytest.mark.parametrize("joint", ["type='free'", "type='slide' axis='0 1 0'"])
def test_nothing_is_proven_of_what_moves_without_bound(joint):
    assert proven_distance(_arm(joint, "100 0 0"), 0, 1, at_least=0.0, beyond_limits=0.0) is None


def test_nothing_is_proven_of_a_mocap_body():
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody>
      <body mocap="true" pos="9 0 0"><geom size="0.1"/></body>
      <body><joint type="hinge"/><geom size="0.1"/></body>
    </worldbody></mujoco>""")
    assert proven_distance(model, 0, 1, at_least=0.0) is None


def test_disabled_limits_are_not_trusted():
    model = _arm("type='hinge' axis='0 -1 0' limited='true' range='-0.1 0.1'", "0 0 0.45")
    assert proven_distance(model, 0, 1, at_least=0.1, beyond_limits=0.0) is not None
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    assert proven_distance(model, 0, 1, at_least=0.1, beyond_limits=0.0) is None


def test_what_moves_along_with_both_has_no_part_in_it():
    """Two arms of one free body: only their own hinges matter."""
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody><body><freejoint/><geom size="0.01" contype="0" conaffinity="0"/>
      <body pos="0.5 0 0"><joint type="hinge"/><geom name="a" type="capsule" fromto="0 0 0 0.2 0 0" size="0.05"/></body>
      <body pos="-0.5 0 0"><joint type="hinge"/><geom name="b" type="capsule" fromto="0 0 0 0.2 0 0" size="0.05"/></body>
    </body></worldbody></mujoco>""")
    a, b = model.geom("a").id, model.geom("b").id
    # 1 m apart, each reaches 0.25 towards the other.
    assert proven_distance(model, a, b, at_least=0.49) == pytest.approx(0.495, abs=0.005)
    assert proven_distance(model, a, b, at_least=0.5001) is None


def _crowd(count):
    bodies = "".join(f"<body pos='{i} 0 0'><freejoint/><geom size='.1'/></body>" for i in range(count))
    return mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody><geom type='plane' size='1 1 1'/>{bodies}</worldbody></mujoco>"
    )


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_masks_keep_the_pairs_that_are_to_be_kept_in_their_order(share):
    model, rng = _crowd(15), np.random.default_rng(3)
    everything = contact_pairs(model)
    kept = tuple(pair for pair in everything if rng.random() < share)
    keep_pairs(model, kept)
    assert contact_pairs(model) == kept


def test_more_masks_than_bits_are_refused():
    """A chain of 65 geoms, each against the next: no bit settles more than the two pairs of one geom."""
    model = _crowd(64)
    chain = [pair for pair in contact_pairs(model) if abs(pair.geom1 - pair.geom2) == 1]
    with pytest.raises(TooManyMasksError, match="31 bits"):
        keep_pairs(model, chain)
    shorter = [pair for pair in chain if max(pair.geom1, pair.geom2) <= 62]
    keep_pairs(model, shorter)
    assert contact_pairs(model) == tuple(shorter)
