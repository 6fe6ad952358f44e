"""How often a robot can be planned for: `make rates`.

An arm of eight joints pushes a box to a goal 16 cm away. Other robots are to stay at their first pose: `planning.Controller`
takes one iteration in each decision, by MJX and by C MuJoCo, whose derivatives take all cores. Beside it is a plain iLQR on
`mjd_transitionFD` in NumPy, of the same cost, horizon and step lengths.
"""

import statistics
import time
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import mjxgrad as mg
from experiments.benchmarks import announce
from experiments.problems import ASSETS
from mjxgrad import planning
from mjxgrad.tasks import scene_path

# The file; the time step (s), how many of them are a step of the plan, and its steps.
_ROBOTS = {
    "cartpole": (ASSETS / "inverted_pendulum.xml", 0.02, 2, 25),
    "hopper": (ASSETS / "hopper.xml", 0.005, 4, 20),
    "quadruped": (scene_path("quadruped"), 0.01, 1, 20),
}
_SPEED, _TERMINAL, _CONTROL = 0.01, 10.0, 0.01  # weights of speeds, of the end, and of controls; of positions it is 1
_LENGTHS = (1.0, 0.6, 0.3, 0.1, 0.03)
_ARM, _HELD, _NODES, _DECISIONS, _NEAR = Path(__file__).parent / "problems" / "arm_and_box.xml", 20, 10, 125, 0.02


class Push(planning.LeastSquares):
    """The box is to be at its goal, and the tip behind the box."""

    goal: jax.Array
    home: jax.Array
    tip: int = eqx.field(static=True)

    def terminal_residuals(self, system, state):
        return 3 * self._places(system, state)

    def residuals(self, system, state, control):
        return jnp.concatenate([self._places(system, state), 0.045 * (control - self.home), 0.05 * state[15:23]])

    def _places(self, system: planning.System, state: jax.Array) -> jax.Array:
        assert isinstance(system, planning.SceneSystem)
        tip, away = system.placed(state).site_xpos[self.tip], self.goal - state[8:10]
        far = jnp.sqrt(away @ away + 1e-3)
        behind = jnp.append(state[8:10] - 0.07 * away / far, 0.04)
        # At the goal there is nothing left to push.
        nearness = jnp.sqrt(0.2 + 0.8 * far / (far + 0.02)) * (tip - behind)
        return jnp.concatenate([5 * away, nearness, 0.2 * state[23:25]])


def push(*, starts: int = 10, deadline: float | None = 0.04) -> None:
    """Push a box from several starts, in C MuJoCo."""
    model, rng = mujoco.MjModel.from_xml_path(str(_ARM)), np.random.default_rng(0)
    goal, home = model.site("goal").pos[:2], model.key_ctrl[0]
    system = planning.SceneSystem(scene=mg.load_scene(model, engine="mujoco"), num_substeps=_HELD)  # pyright: ignore
    cost = Push(goal=jnp.asarray(goal), home=jnp.asarray(home), tip=model.site("tcp").id)
    controller = planning.Controller(
        system, cost, np.tile(home, (_NODES, 1)), num_samples=12, stddev=0.1, deadline=deadline
    )
    print(controller)
    for _ in range(starts):
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        place = rng.uniform([0.56, -0.1, -0.5], [0.66, 0.1, 0.5])
        data.qpos[8:10], turn = place[:2], place[2]
        data.qpos[11:15] = np.cos(turn / 2), 0, 0, np.sin(turn / 2)
        controller.reset()
        for _ in range(_DECISIONS):
            data.ctrl[:] = controller(data)
            mujoco.mj_step(model, data, _HELD)
        off = np.linalg.norm(data.qpos[8:10] - goal)
        told = "there" if off < _NEAR else "not there"
        print(f"{told}, {1e3 * off:.0f} mm off; {str(controller).split('. ')[0]}", flush=True)


def rates(*, decisions: int = 50) -> None:
    """Measure the rate of decisions: an arm's; ours on both engines, and a plain iLQR's."""
    mg.keep_compiled()
    push()
    announce(f"{decisions} decisions of one iteration, float32")
    for name, (path, timestep, num_substeps, horizon) in _ROBOTS.items():
        model = mujoco.MjModel.from_xml_path(str(path))
        model.opt.timestep, model.opt.integrator = timestep, mujoco.mjtIntegrator.mjINT_EULER
        goal, weight = np.concatenate([model.qpos0, np.zeros(model.nv)]), np.repeat([1.0, _SPEED], model.nv)
        scene = mg.load_scene(model)
        chosen: dict[str, Callable] = {"plain iLQR": _Plain(model, goal, weight, horizon, num_substeps)}
        for engine in ("mjx", "mujoco"):
            system = planning.SceneSystem(scene=scene.with_engine(engine), num_substeps=num_substeps)  # pyright: ignore
            cost = planning.GoalCost(jnp.asarray(goal), weight, _TERMINAL * weight, _CONTROL)
            ours = planning.Controller(system, cost, np.zeros((horizon, model.nu)), num_samples=0)
            chosen[f"{engine}, compiled in {ours.compile_seconds:.0f} s"] = ours
        for method, controller in chosen.items():
            rate, off = _run(model, controller, decisions, num_substeps)
            print(f"{name:10} {method:26} {rate:7.1f} Hz, {off:.3f} off in the end", flush=True)


def _run(model: mujoco.MjModel, controller, decisions: int, num_substeps: int) -> tuple[float, float]:
    """Return the median rate (Hz), and how far the worst coordinate is from its goal in the end."""
    data, seconds = mujoco.MjData(model), []
    data.qvel[:] = 0.1 * np.random.default_rng(0).normal(size=model.nv)
    for _ in range(decisions):
        began = time.perf_counter()
        data.ctrl[:] = controller(data)
        seconds.append(time.perf_counter() - began)
        mujoco.mj_step(model, data, num_substeps)
    return 1 / statistics.median(seconds), float(np.abs(data.qpos - model.qpos0).max())


class _Plain:
    """iLQR as one writes it by hand: MuJoCo's differences in a loop, Riccati's recursion, controls clipped to their range."""

    def __init__(self, model: mujoco.MjModel, goal: np.ndarray, weight: np.ndarray, horizon: int, num_substeps: int):
        self.model, self.goal, self.weight, self.num_substeps = model, goal, weight, num_substeps
        self.data, self.controls = mujoco.MjData(model), np.zeros((horizon, model.nu))

    def __call__(self, data: mujoco.MjData) -> np.ndarray:
        start = np.concatenate([data.qpos, data.qvel])
        given = np.concatenate([self.controls[1:], self.controls[-1:]])
        states, given, before = self._follow(start, given)
        law = (states, *self._law(states, given))
        tried = (self._follow(start, given, law, length) for length in _LENGTHS)
        self.controls = next((controls for _, controls, cost in tried if cost < before), given)
        return self.controls[0]

    def _away(self, state: np.ndarray, goal: np.ndarray) -> np.ndarray:
        nq, moved = self.model.nq, np.zeros(self.model.nv)
        mujoco.mj_differentiatePos(self.model, moved, 1.0, goal[:nq], state[:nq])
        return np.concatenate([moved, state[nq:] - goal[nq:]])

    def _follow(self, start, controls, law=None, length=1.0) -> tuple[np.ndarray, np.ndarray, float]:
        model, data, course, done, cost = self.model, self.data, [start], [], 0.0
        for t, control in enumerate(controls):
            if law is not None:
                control = control + length * law[1][t] + law[2][t] @ self._away(course[-1], law[0][t])
            done.append(np.clip(control, *model.actuator_ctrlrange.T))
            cost += 0.5 * (self.weight @ self._away(course[-1], self.goal) ** 2 + _CONTROL * done[-1] @ done[-1])
            data.qpos[:], data.qvel[:] = np.split(course[-1], [model.nq])
            data.ctrl[:] = done[-1]
            mujoco.mj_step(model, data, self.num_substeps)
            course.append(np.concatenate([data.qpos, data.qvel]))
        cost += 0.5 * _TERMINAL * self.weight @ self._away(course[-1], self.goal) ** 2
        return np.array(course), np.array(done), float(cost)

    def _law(self, states: np.ndarray, controls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        model, data, n = self.model, self.data, 2 * self.model.nv
        changes, gains = np.zeros((len(controls), model.nu)), np.zeros((len(controls), model.nu, n))
        slope, curvature = _TERMINAL * self.weight * self._away(states[-1], self.goal), _TERMINAL * np.diag(self.weight)
        A, B = np.zeros((n, n)), np.zeros((n, model.nu))
        for t in reversed(range(len(controls))):
            data.qpos[:], data.qvel[:] = np.split(states[t], [model.nq])
            data.ctrl[:] = controls[t]
            of_state, of_control = np.eye(n), np.zeros((n, model.nu))
            for _ in range(self.num_substeps):
                mujoco.mjd_transitionFD(model, data, 1e-6, True, A, B, None, None)
                of_state, of_control = A @ of_state, A @ of_control + B
                mujoco.mj_step(model, data)
            q_x = self.weight * self._away(states[t], self.goal) + of_state.T @ slope
            q_u = _CONTROL * controls[t] + of_control.T @ slope
            q_ux = of_control.T @ curvature @ of_state
            q_uu = _CONTROL * np.eye(model.nu) + of_control.T @ curvature @ of_control
            changes[t], gains[t] = -np.linalg.solve(q_uu, q_u), -np.linalg.solve(q_uu, q_ux)
            slope = q_x + gains[t].T @ q_u
            curvature = np.diag(self.weight) + of_state.T @ curvature @ of_state + q_ux.T @ gains[t]
        return changes, gains
