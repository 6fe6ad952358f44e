"""Unitree's G1 and Go1 of mjlab, downloaded on first use: on a floor, with position servos, their real masses and torques."""

import mujoco

_WHEEL, _FOLDER = "mjlab==1.6.0", "mjlab/asset_zoo/robots"
_SUN = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
Joints = dict[str, tuple[float, float, float]]
# By parts of a joint's name: angle at rest (rad), stiffness (N m/rad), most torque (N m).
_G1: Joints = {
    "left_shoulder_roll": (0.2, 40.0, 25.0), "right_shoulder_roll": (-0.2, 40.0, 25.0),
    "shoulder_pitch": (0.2, 40.0, 25.0), "ankle_pitch": (-0.36, 40.0, 50.0),
    "hip_pitch": (-0.31, 100.0, 88.0), "hip_roll": (0.0, 100.0, 88.0), "hip_yaw": (0.0, 100.0, 88.0),
    "knee": (0.67, 150.0, 139.0), "ankle": (0.0, 40.0, 50.0), "waist": (0.0, 100.0, 50.0),
    "shoulder": (0.0, 40.0, 25.0), "elbow": (0.6, 40.0, 25.0), "wrist": (0.0, 20.0, 5.0),
}  # fmt: skip
_GO1: Joints = {"hip": (0.0, 35.0, 23.7), "thigh": (0.9, 35.0, 23.7), "calf": (-1.8, 35.0, 35.55)}


def g1() -> mujoco.MjModel:
    """Return the humanoid of 29 joints, its key frame a pose of bent knees; a time step is 5 ms."""
    return _on_floor("unitree_g1/xmls/g1.xml", "pelvis", _G1, 0.755, servo_damping=0.05, armature=0.02)


def go1() -> mujoco.MjModel:
    """Return the quadruped, its key frame a stance; it touches the floor alone, and a time step is 4 ms."""
    model = _on_floor("unitree_go1/xmls/go1.xml", "trunk", _GO1, 0.288, joint_damping=0.03, armature=0.005)
    model.opt.timestep, model.opt.integrator = 0.004, mujoco.mjtIntegrator.mjINT_EULER
    return touching_the_floor_alone(model)


def touching_the_floor_alone(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return the model, of which no two parts of the robot touch any more."""
    is_floor, touches = model.geom_bodyid == 0, (model.geom_contype | model.geom_conaffinity) > 0
    model.geom_contype[:], model.geom_conaffinity[:] = is_floor & touches, ~is_floor & touches
    return model


def _on_floor(
    file: str,
    base: str,
    joints: Joints,
    height: float,
    *,
    servo_damping: float = 0.0,
    joint_damping: float = 0.0,
    armature: float,
) -> mujoco.MjModel:
    """Return a robot with a servo for each joint; damping is in s, times the stiffness."""
    # Imported here: it brings pandas.
    from experiments.robots import fetched

    spec = mujoco.MjSpec.from_file(str(fetched(_WHEEL) / _FOLDER / file))
    _furnish(spec, base)
    spec.option.timestep, spec.option.integrator = 0.005, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    rest = [0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0]
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
            angle, stiffness, torque = next(x for name, x in joints.items() if name in joint.name)
            rest.append(angle)
            joint.armature, joint.damping = armature, [joint_damping * stiffness, 0, 0]
            servo = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            servo.set_to_position(kp=stiffness, kv=servo_damping * stiffness)
            servo.forcerange = [-torque, torque]
    spec.add_key(name="rest", qpos=rest, ctrl=rest[7:])
    return spec.compile()


def _furnish(spec: mujoco.MjSpec, base: str) -> None:
    """Add a chequered floor, a sky, a light, and a camera that follows the base."""
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1], material="floor")
    follows = {"mode": mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM, "xyaxes": [0.55, 0.83, 0, -0.15, 0.1, 1]}
    spec.body(base).add_camera(name="track", pos=[2.4, -1.6, 0.3], **follows)
    spec.worldbody.add_light(pos=[0, 0, 4], dir=[0.2, 0.3, -1], diffuse=[0.3] * 3, castshadow=False, type=_SUN)
    sky = {"type": mujoco.mjtTexture.mjTEXTURE_SKYBOX, "builtin": mujoco.mjtBuiltin.mjBUILTIN_GRADIENT}
    spec.add_texture(name="sky", **sky, rgb1=[0.85, 0.9, 0.95], rgb2=[1, 1, 1], width=32, height=32)
    checks = {"type": mujoco.mjtTexture.mjTEXTURE_2D, "builtin": mujoco.mjtBuiltin.mjBUILTIN_CHECKER}
    spec.add_texture(name="checks", **checks, rgb1=[0.75, 0.75, 0.75], rgb2=[0.82, 0.82, 0.82], width=64, height=64)
    floor = spec.add_material(name="floor", texrepeat=[2, 2], texuniform=True)
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "checks"
