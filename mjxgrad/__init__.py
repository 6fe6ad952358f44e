"""mjxgrad: differentiable rollouts on MuJoCo MJX whose gradients can be trusted, and a measure of how far."""

from mjxgrad import _mjx  # isort: skip
from mjxgrad import _interrupts, baselines, diagnostics, envs, estimators, identification, learning, planning, tasks
from mjxgrad._programs import keep_compiled
from mjxgrad.batched import over_devices
from mjxgrad.bodies import set_const
from mjxgrad.checking import Verdict, check, sweep
from mjxgrad.contact import Softness
from mjxgrad.diagnostics import check_stability
from mjxgrad.engines import SlopeWarning
from mjxgrad.identification import identify
from mjxgrad.loop import History, Optimisation, Stopped, estimated_gradient, optimise
from mjxgrad.objective import Objective, SceneTask, closed_loop, linear_policy, open_loop, parameter_noise
from mjxgrad.rollouts import DivergedError, Linearisation, State, Trajectory, initial_state, linearise, render, rollout
from mjxgrad.scene import Scene, SceneWarning, load_scene, sensor, site_position
from mjxgrad.stepping import Discrete, Onset, Slope, Smoothing, contact_force, forward, solve, step

_mjx.imported()
_interrupts.lose_none()
_interrupts.wait_for_programs()
linearize, optimize = linearise, optimise  # as the field spells them

__all__ = [
    "Discrete", "DivergedError", "History", "Linearisation", "Objective", "Onset", "Optimisation", "Scene", "SceneTask",
    "SceneWarning", "Slope", "SlopeWarning", "Smoothing", "Softness", "State", "Stopped", "Trajectory", "Verdict",
    "baselines", "check", "check_stability", "closed_loop", "contact_force", "diagnostics", "envs", "estimated_gradient",
    "estimators", "forward", "identification", "identify", "initial_state", "keep_compiled", "learning", "linear_policy",
    "linearise", "linearize", "load_scene", "open_loop", "optimise", "optimize", "over_devices", "parameter_noise",
    "planning", "render", "rollout", "sensor", "set_const", "site_position", "solve", "step", "sweep", "tasks",
]  # fmt: skip
