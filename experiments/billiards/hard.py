r"""The same stroke with hard balls: closed forms that share no code with the simulation.

A driven ball from rest, accelerated by $u$, has to cover the vector $d$ in the time $s$ and arrive at velocity $v$. The
least $\int |u|^2$ for that is $12 |d|^2/s^3 - 12\, d \cdot v/s^2 + 4 |v|^2/s$ (a force linear in time). Then both balls, of
equal mass, exchange what is along the line of centres: the collision is elastic.
"""

import functools

import numpy as np
from numpy.polynomial import Polynomial
from scipy.optimize import minimize

DRIVEN, KNOCKED = np.array([-2.0, -2.0]), np.array([-1.0, -1.0])
CONTACT = 0.4  # m, between the centres
EFFORT = 0.1


@functools.cache
def optimum() -> tuple[float, float, float]:
    """Find the best stroke: its cost (m²), the time of the collision (s) and the speed at it (m/s)."""
    gap = np.linalg.norm(KNOCKED - DRIVEN) - CONTACT
    miss = np.linalg.norm(KNOCKED)

    def cost(x):
        time, speed = x
        effort = 12 * gap**2 / time**3 - 12 * gap * speed / time**2 + 4 * speed**2 / time
        return (miss - (1 - time) * speed) ** 2 + EFFORT * effort

    best = minimize(cost, [0.7, 2.5], method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-14})
    return float(best.fun), float(best.x[0]), float(best.x[1])


def cost(forces: np.ndarray) -> float:
    """Play forces (pieces, 2), in N and constant over pieces of the second, on hard balls; gives the cost (m²)."""
    forces = np.asarray(forces, float)
    piece = 1 / len(forces)
    position, velocity = DRIVEN.copy(), np.zeros(2)
    end = KNOCKED
    for i, force in enumerate(forces):
        way = [Polynomial(along) for along in zip(position - KNOCKED, velocity, force / 2, strict=True)]
        roots = (way[0] ** 2 + way[1] ** 2 - CONTACT**2).roots()
        times = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real >= 0) & (roots.real < piece)]
        if times.size:
            time = times.min()
            normal = -np.array([along(time) for along in way]) / CONTACT
            end = KNOCKED + (1 - i * piece - time) * ((velocity + time * force) @ normal) * normal
            break
        position, velocity = position + piece * velocity + piece**2 / 2 * force, velocity + piece * force
    return float(end @ end + EFFORT * piece * np.sum(forces**2))
