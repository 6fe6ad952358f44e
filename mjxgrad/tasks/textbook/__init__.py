r"""Costs of one number whose smoothed gradient, and the errors of its estimates, are known.

With $w \sim N(0, \sigma^2)$ the smoothed cost is $F(\theta) = \mathbb{E} f(\theta + w)$. Each problem says what an
estimate of $F'$ should give and how far one sample of it is off: the yardstick for estimators, for diagnostics and for
whoever wants to see in a second what a contact does to a gradient. Points, widths and costs have no units.

All methods are for one point and are traceable: a sweep of points, noise or widths is a `jax.vmap`.

References:
    Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022,
    arXiv:2202.00817, section 3 and figure 2.
"""

from mjxgrad.contact.bounce import Bounce, integrated_restitution
from mjxgrad.tasks.textbook.bounce import bounce_scene
from mjxgrad.tasks.textbook.problem import Textbook
from mjxgrad.tasks.textbook.sine import QuadraticSine, quadratic_sine
from mjxgrad.tasks.textbook.step import Heaviside, SoftHeaviside, heaviside, soft_heaviside
from mjxgrad.tasks.textbook.throw import BallOverWall, ball_over_wall

__all__ = [
    "BallOverWall",
    "Bounce",
    "Heaviside",
    "QuadraticSine",
    "SoftHeaviside",
    "Textbook",
    "ball_over_wall",
    "bounce_scene",
    "heaviside",
    "integrated_restitution",
    "quadratic_sine",
    "soft_heaviside",
]
