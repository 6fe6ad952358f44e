"""The restitution of a bounce whose impedance varies with depth, by quadrature; `mjxgrad.contact.bounce` has the closed form."""

import mujoco
import numpy as np
from scipy.integrate import solve_ivp


def integrated_restitution(
    time_constant: float, damping_ratio: float, impedance: tuple[float, float, float], speed: float = 1.0
) -> tuple[float, float]:
    r"""Integrate the contact with an impedance that varies with depth, to ten digits.

    Args:
        time_constant: first number of `solref`, in s.
        damping_ratio: second number of `solref`.
        impedance: the first three numbers of `solimp`: $d_0$, $d_w$ and the width in m. The last two are MuJoCo's defaults.
        speed: speed of approach, in m/s.

    Returns:
        The restitution, which is $-dz/dz_0$ after the bounce, and the duration of the force, in s.

    Raises:
        ValueError: if the ball is not released within a hundred time constants.
    """
    lowest, highest = mujoco.mjMINIMP, mujoco.mjMAXIMP
    first, last, width = np.clip(impedance[0], lowest, highest), np.clip(impedance[1], lowest, highest), impedance[2]
    damping, stiffness = 2 / (last * time_constant), 1 / (last * time_constant * damping_ratio) ** 2

    def acceleration(_: float, state: np.ndarray) -> float:
        share = min(abs(state[0]) / width, 1.0)
        # MuJoCo's smooth step of power 2 about the middle, its default.
        rise = 2 * share**2 if share < 0.5 else 1 - 2 * (1 - share) ** 2
        d = first + (last - first) * rise
        return float(d * (-damping * state[1] - stiffness * d * state[0]))

    acceleration.terminal = True  # pyright: ignore[reportFunctionMemberAccess]
    acceleration.direction = -1  # pyright: ignore[reportFunctionMemberAccess]
    found = solve_ivp(
        lambda t, state: (state[1], acceleration(t, state)),
        (0, 100 * time_constant),
        np.array([0.0, -speed]),
        events=acceleration,
        rtol=1e-10,
        atol=1e-14,
        max_step=time_constant / 20,
    )
    if not len(found.t_events[0]):
        raise ValueError(f"the ball must be released within {100 * time_constant} s, got no release: damp it less")
    return float(found.y[1, -1] / speed), float(found.t[-1])
