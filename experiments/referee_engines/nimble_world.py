"""nimblephysics: a complementarity problem each step, differentiated through its active set, at 1 ms, its default."""

# pyright: reportMissingImports=false

from typing import Any

import nimblephysics as nimble
import torch
from protocol import Pair, Scene, UnsupportedError, serve

_STEP, _THICK = 1e-3, 1.0  # s; m, of the box that is the floor


def _touchable(node: Any, scene: Scene, shape: Any, place: Any = (0, 0, 0)) -> None:
    look = node.createShapeNode(shape)
    look.createCollisionAspect()
    look.setRelativeTranslation([float(x) for x in place])
    node.setFrictionCoeff(scene["friction"])
    # Of a pair the product counts.
    node.setRestitutionCoeff(scene["restitution"] ** 0.5)


def _world(scene: Scene) -> Any:
    world, solids = nimble.simulation.World(), nimble.dynamics
    world.setGravity([0.0, 0.0, 0.0 if scene["name"] == "push" else -9.81])
    world.setTimeStep(_STEP)
    for i, _ in enumerate(scene["starts"]):
        (skeleton := solids.Skeleton()).setName(f"body{i}")
        _, node = skeleton.createFreeJointAndBodyNodePair()
        for place in scene["balls"]:
            _touchable(node, scene, solids.SphereShape(scene["radius"]), place)
        node.setMass(scene["mass"])
        node.setMomentOfInertia(*[scene["inertia"]] * 3, 0.0, 0.0, 0.0)
        world.addSkeleton(skeleton)
    fixed = [(place, solids.SphereShape(size)) for place, size in scene["sides"]]
    fixed += [((0, 0, -_THICK / 2), solids.BoxShape([10.0, 10.0, _THICK]))] if scene["floor"] else []
    for place, shape in fixed:
        skeleton = solids.Skeleton()
        _, node = skeleton.createWeldJointAndBodyNodePair()
        _touchable(node, scene, shape, place)
        world.addSkeleton(skeleton)
    return world


def make(scene: Scene, variant: str) -> Pair:
    """Step a world of free bodies under torch's reverse mode."""
    if "balls" not in scene:
        raise UnsupportedError("it loads no MJCF")
    world, steps, (kind, index) = _world(scene), round(scene["duration"] / _STEP), scene["vary"]
    count = world.getNumDofs()
    state, force = (torch.zeros(size, dtype=torch.float64) for size in (2 * count, count))
    for i, start in enumerate(scene["starts"]):  # of a body rotation comes first, then place
        state[6 * i + 3 : 6 * i + 6] = torch.tensor(start, dtype=torch.float64)
    change, push = torch.zeros_like(state), torch.zeros_like(force)
    (push if kind == "ctrl" else change)[3 + index + (count if kind == "qvel" else 0)] = 1.0

    def outcome(value: torch.Tensor) -> torch.Tensor:
        now = state + value * change
        for _ in range(steps):
            now = nimble.timestep(world, now, force + value * push)
        return now[9 if scene["name"] == "push" else 3 + scene["read"]]

    def gradient(value: float) -> tuple[float, float]:
        number = torch.tensor(value, dtype=torch.float64, requires_grad=True)
        found = outcome(number)
        found.backward()
        return found.item(), number.grad.item()  # pyright: ignore[reportOptionalMemberAccess]

    return gradient, lambda value: outcome(torch.tensor(value, dtype=torch.float64)).item()


if __name__ == "__main__":
    serve(make)
