"""Drake's MultibodyPlant with AutoDiffXd: forward mode, whose time grows with the count of numbers, one here."""

# pyright: reportMissingImports=false

from typing import Any

import numpy as np
import pydrake.all as drake
from protocol import Pair, Scene, UnsupportedError, serve
from pydrake.autodiffutils import AutoDiffXd

_DEPTH = 0.02  # m, at which damping by Hunt and Crossley is that of the scene's spring


def _touchable(plant: Any, scene: Scene, body: Any, place: Any, shape: Any) -> None:
    # Two equal springs in a row are half as stiff, so each has twice the scene's stiffness.
    look, ratio = drake.ProximityProperties(), scene["damping"] / scene["stiffness"]
    stiffness, grip = 2 * scene["stiffness"] * scene["mass"], drake.CoulombFriction(*[scene["friction"]] * 2)
    drake.AddContactMaterial(properties=look, point_stiffness=stiffness, dissipation=ratio / _DEPTH, friction=grip)
    look.AddProperty("material", "relaxation_time", ratio)
    name = f"geometry{plant.num_collision_geometries()}"
    plant.RegisterCollisionGeometry(body, drake.RigidTransform(np.array(place, float)), shape, name, look)


def _build(scene: Scene, law: str) -> Any:
    builder = drake.DiagramBuilder()
    config = drake.MultibodyPlantConfig(time_step=scene["timestep"], discrete_contact_approximation=law)
    plant, _ = drake.AddMultibodyPlant(config, builder)
    inertia = drake.UnitInertia.TriaxiallySymmetric(scene["inertia"] / scene["mass"])
    for i, start in enumerate(scene["starts"]):
        body = plant.AddRigidBody(f"body{i}", drake.SpatialInertia(scene["mass"], np.zeros(3), inertia))
        for place in scene["balls"]:
            _touchable(plant, scene, body, place, drake.Sphere(scene["radius"]))
        if scene["name"] == "push":
            pose = drake.RigidTransform(np.array(start, float))
            frame = plant.AddFrame(drake.FixedOffsetFrame(f"frame{i}", plant.world_frame(), pose))
            plant.AddJoint(drake.PrismaticJoint(f"joint{i}", frame, body.body_frame(), np.eye(3)[0]))
    if scene["name"] == "push":
        plant.AddJointActuator("force", plant.GetJointByName("joint0"))
        plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    fixed = [(place, drake.Sphere(size)) for place, size in scene["sides"]]
    for place, shape in fixed + [((0, 0, 0), drake.HalfSpace())] * scene["floor"]:
        _touchable(plant, scene, plant.world_body(), place, shape)
    plant.Finalize()
    return builder.Build()


def make(scene: Scene, variant: str) -> Pair:
    """Advance the plant by a contact approximation, with numbers or with their derivatives."""
    if "balls" not in scene:
        raise UnsupportedError("AutoDiffXd has no contact of capsules with a floor")
    plain, (kind, index) = _build(scene, variant), scene["vary"]
    simulators = drake.Simulator(plain), drake.Simulator_[AutoDiffXd](plain.ToAutoDiffXd())
    skipped = {"qpos": 4, "qvel": 3, "ctrl": 0}  # of a free body, quaternion and angular velocity come first

    def run(value: Any, simulator: Any) -> Any:
        plant, root = simulator.get_system().GetSubsystemByName("plant"), simulator.get_mutable_context()
        context = plant.GetMyMutableContextFromRoot(root)
        sizes = {"qpos": plant.num_positions(), "qvel": plant.num_velocities(), "ctrl": 1}
        state = {key: np.array([type(value)(0.0)] * size) for key, size in sizes.items()}
        if scene["name"] != "push":
            state["qpos"][[0, 4, 5, 6]] = [type(value)(float(x)) for x in (1, *scene["starts"][0])]
        state[kind][index + skipped[kind]] += value
        root.SetTime(0.0)
        plant.SetPositions(context, state["qpos"])
        plant.SetVelocities(context, state["qvel"])
        if scene["name"] == "push":
            plant.get_actuation_input_port().FixValue(context, state["ctrl"])
        simulator.Initialize()
        simulator.AdvanceTo(scene["duration"])
        return plant.GetPositions(context)[scene["read"] + 4 * (scene["name"] != "push")]

    def gradient(value: float) -> tuple[float, float]:
        found = run(AutoDiffXd(value, np.ones(1)), simulators[1])
        return found.value(), float(sum(found.derivatives()))

    return gradient, lambda value: float(run(float(value), simulators[0]))


if __name__ == "__main__":
    serve(make)
