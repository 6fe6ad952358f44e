"""Newton's differentiable solvers on a CPU, taped by Warp, in single precision, at the step of its own examples."""

# pyright: reportMissingImports=false

import newton
import warp as wp
from protocol import Pair, Scene, serve

_STEP = 1 / 480  # s
_FRICTION_SLOPE = 100.0  # N s/m; its default of 1000 is unstable for four feet at this step
_SOLVERS = {"semi-implicit": newton.solvers.SolverSemiImplicit, "featherstone": newton.solvers.SolverFeatherstone}
wp.config.quiet = True


@wp.kernel
def _read(poses: wp.array(dtype=wp.transform), body: int, axis: int, out: wp.array(dtype=float)):  # pyright: ignore
    out[0] = wp.transform_get_translation(poses[body])[axis]


def _at(place: list[float]) -> wp.transform:
    return wp.transform(wp.vec3(*map(float, place)), wp.quat_identity())


def _build(scene: Scene) -> newton.ModelBuilder:
    gravity = (0.0, 0.0, 0.0 if scene["name"] == "push" else -9.81)
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=gravity)
    if "balls" not in scene:
        builder.add_mjcf(scene["xml"])
        return builder
    look = newton.ModelBuilder.ShapeConfig(density=0.0, ke=scene["stiffness"], kd=scene["damping"], kf=_FRICTION_SLOPE)
    look.mu, solid = scene["friction"], wp.diag(wp.vec3(*[scene["inertia"]] * 3))
    bodies = [builder.add_body(xform=_at(start), mass=scene["mass"], inertia=solid) for start in scene["starts"]]
    balls = [(body, place, scene["radius"]) for body in bodies for place in scene["balls"]]
    # Of balls that belong to the world its penalties forget the radius; a body without mass stays where it is, too.
    at_rest = {"mass": 0.0, "is_kinematic": True}
    balls += [(builder.add_body(xform=_at(place), **at_rest), (0, 0, 0), size) for place, size in scene["sides"]]
    for body, place, radius in balls:
        builder.add_shape_sphere(body, xform=_at(place), radius=radius, cfg=look)
    if scene["floor"]:
        builder.add_ground_plane(cfg=look)
    return builder


def make(scene: Scene, variant: str) -> Pair:
    """Tape a rollout that finds contacts anew at each step; the states' arrays are kept from call to call."""
    model = _build(scene).finalize(device="cpu", requires_grad=True)
    solver, out = _SOLVERS[variant](model), wp.zeros(1, dtype=float, requires_grad=True, device="cpu")
    states = [model.state() for _ in range(round(scene["duration"] / _STEP) + 1)]
    pipeline = newton.CollisionPipeline(model, broad_phase="explicit", requires_grad=True)
    first, control, contacts = states[0], model.control(), [pipeline.contacts() for _ in states]
    kind, index = scene["vary"]
    varied = {"qpos": first.joint_q, "qvel": first.joint_qd, "ctrl": control.joint_f}[kind]
    base, speeds = varied.numpy().copy(), first.joint_qd.numpy().copy()
    speeds[0] = scene.get("speed", 0.0)

    def run(value: float) -> float:
        start = base.copy()
        start[index] += value
        first.joint_qd.assign(speeds)
        varied.assign(start)
        newton.eval_fk(model, first.joint_q, first.joint_qd, first)
        for before, after, contact in zip(states, states[1:], contacts, strict=False):
            before.clear_forces()
            pipeline.collide(before, contact)
            solver.step(before, after, control, contact, _STEP)
        place = (1, 0) if scene["name"] == "push" else (0, scene["read"])
        wp.launch(_read, dim=1, inputs=[states[-1].body_q, *place, out], device="cpu")
        return float(out.numpy()[0])

    def gradient(value: float) -> tuple[float, float]:
        with wp.Tape() as tape:
            found = run(value)
        tape.backward(out)
        derivative = float(varied.grad.numpy()[index])
        tape.zero()
        return found, derivative

    return gradient, run


if __name__ == "__main__":
    serve(make)
