"""The six tasks of Suh et al. in the paper's own equations, with its settings and reference results.

Small dynamics in plain JAX, to reproduce published numbers; nothing here is MuJoCo's. Costs are without unit, other
quantities in SI units.

References:
    Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022,
    arXiv:2202.00817, section 5.
"""

from mjxgrad.tasks.published.catalogue import TASKS, friction, lqr, motion_planning, push, tennis
from mjxgrad.tasks.published.dynamics import DynamicsTask, QuadraticCost
from mjxgrad.tasks.published.settings import Published

__all__ = [
    "TASKS",
    "DynamicsTask",
    "Published",
    "QuadraticCost",
    "friction",
    "lqr",
    "motion_planning",
    "push",
    "tennis",
]
