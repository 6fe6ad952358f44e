r"""Contacts that MuJoCo alters without a word, or that the time step cannot follow."""

from collections.abc import Sequence

import jax
import mujoco
import numpy as np
from jaxtyping import Float

from mjxgrad._mjx import mjx
from mjxgrad.contact.parameters import ContactPair, contact_parameters


def largest_stable_step(damping_ratio: float, integrator: mujoco.mjtIntegrator) -> float:
    r"""Largest $h \omega_0$ at which a contact at full impedance does not gain energy.

    The oscillator $\ddot r = -k r - b \dot r$ has $\omega_0 = \sqrt k$ and
    $\zeta = b / (2 \omega_0)$. Semi-implicit Euler, as which `implicitfast` treats contact too,
    is stable while $h^2 k + 2 h b < 4$, that is up to $2 (\sqrt{1 + \zeta^2} - \zeta)$. RK4 is
    stable while its amplification factor at both eigenvalues is at most 1.

    Args:
        damping_ratio: $\zeta$.
        integrator: of the model.

    Returns:
        The limit of $h \omega_0$; the limit of $h b$ is $2 \zeta$ times this.
    """
    if integrator != mujoco.mjtIntegrator.mjINT_RK4:
        # The difference of two large numbers, in a form that does not cancel.
        return 2.0 / (np.sqrt(1.0 + damping_ratio**2) + damping_ratio)
    stable, unstable = 0.0, 3.0
    for _ in range(50):
        middle = (stable + unstable) / 2
        if _runge_kutta_growth(middle, damping_ratio) <= 1.0:
            stable = middle
        else:
            unstable = middle
    return stable


def _runge_kutta_growth(step: float, damping_ratio: float) -> float:
    root = np.emath.sqrt(damping_ratio**2 - 1.0)
    z = step * np.array([-damping_ratio + root, -damping_ratio - root])
    return float(np.abs(1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24).max())


def contact_warnings(model: mjx.Model, pairs: tuple[ContactPair, ...]) -> list[str]:
    """Say which contacts are altered by `refsafe` or too stiff for the time step.

    Args:
        model: of MJX, with known values.
        pairs: its pairs that can touch.

    Returns:
        Sentences, one for all pairs that have the same parameters.
    """
    if not pairs:
        return []
    # Inside jit, operations on known values would be traced, too.
    with jax.ensure_compile_time_eval():
        parameters = contact_parameters(model, pairs)
    solref, stiffness, damping, impedance, width = (
        np.asarray(getattr(parameters, name), dtype=float)
        for name in ("solref", "stiffness", "damping", "impedance", "width")
    )
    springs = [steepest(*one) for one in zip(stiffness, damping, impedance, width, strict=True)]
    timestep = float(model.opt.timestep)
    integrator = mujoco.mjtIntegrator(int(model.opt.integrator))
    messages: dict[str, list[ContactPair]] = {}
    for pair, first, b, spring in zip(pairs, solref[:, 0], damping, springs, strict=True):
        for message in (
            altered_by_refsafe(first, b, timestep, "Softness, which writes the format that refsafe leaves alone"),
            beyond_stability(*spring, timestep, integrator),
        ):
            if message:
                messages.setdefault(message, []).append(pair)
    return [f"contact of {name_pairs(same)}: {text}" for text, same in messages.items()]


def contact_differences(model: mujoco.MjModel, pairs: tuple[ContactPair, ...]) -> list[str]:
    """Say where MJX finds other contact points than C MuJoCo does.

    Args:
        model: of C MuJoCo.
        pairs: its pairs that can touch.

    Returns:
        One sentence per kind of difference that the scene can meet.
    """
    geom = mujoco.mjtGeom
    kinds = {frozenset(geom(t) for t in model.geom_type[[p.geom1, p.geom2]]) for p in pairs}
    messages = []
    if frozenset((geom.mjGEOM_PLANE, geom.mjGEOM_MESH)) in kinds:
        messages.append("mesh on plane: MJX keeps only corners within 1 mm of the deepest one")
    if frozenset((geom.mjGEOM_CAPSULE,)) in kinds:
        messages.append("parallel capsules: MJX makes one contact, C MuJoCo two")
    return messages


def name_pairs(pairs: Sequence[object]) -> str:
    """Two pairs, or whatever else has a name, by name; or the first of them and how many more there are."""
    if len(pairs) == 1 or (len(pairs) == 2 and sum(len(str(pair)) for pair in pairs) < 36):
        return ", ".join(str(pair) for pair in pairs)
    return f"{pairs[0]} + {len(pairs) - 1} more"


def format_number(x: float) -> str:
    """Three digits; whole numbers up to 99999 in full."""
    if np.isinf(x):
        return "∞" if x > 0 else "−∞"
    if 1e3 <= abs(x) < 99999.5:
        return f"{x:.0f}"
    return f"{x + 0.0:.3g}".replace("e+0", "e").replace("e-0", "e-").replace("e+", "e")


def steepest(
    stiffness: float, damping: float, impedance: Float[np.ndarray, "2"] | tuple[float, float], width: float
) -> tuple[float, float]:
    r"""Give stiffness and damping where the impedance is largest, which is at first touch if it falls with depth.

    The force on a body is $d(r)$ of the acceleration $-B \dot r - K d(r) r$ that is asked for, so that stiffness goes as the
    square of the impedance and damping as the impedance.

    Args:
        stiffness: at full depth, $k = K d_w^2$, in 1/s².
        damping: at full depth, $b = B d_w$, in 1/s.
        impedance: $d_0$ and $d_w$.
        width: over which it changes; without one it is $d_w$ everywhere.
    """
    share = max(1.0, float(impedance[0] / impedance[1])) if width > mujoco.mjMINVAL else 1.0
    return float(share**2 * stiffness), float(share * damping)


def altered_by_refsafe(time_constant: float, damping: float, timestep: float, remedy: str) -> str | None:
    """Say that `refsafe` replaces a time constant, if it does.

    Args:
        time_constant: as given, in s; negative for the direct format.
        damping: that it has the effect of, in 1/s.
        timestep: in s.
        remedy: what to do instead of shortening the time step.

    Returns:
        The end of a sentence, or None.
    """
    # A relative margin, because float32 rounds a time constant of exactly two steps.
    if time_constant <= 0 or 2.0 / damping <= time_constant * (1 + 1e-5):
        return None
    return (
        f"its time constant {time_constant:g} s is below two time steps, so refsafe replaces it by "
        f"{2 * timestep:g} s and smaller values have no effect; use a time step of at most "
        f"{time_constant / 2:g} s, or {remedy}"
    )


def beyond_stability(stiffness: float, damping: float, timestep: float, integrator: mujoco.mjtIntegrator) -> str | None:
    """Say that a spring and damper gains energy at a time step, if it does.

    Args:
        stiffness: $k$, in 1/s².
        damping: $b$, in 1/s.
        timestep: in s.
        integrator: of the model.

    Returns:
        The end of a sentence, or None.
    """
    if stiffness <= 0:
        return None
    frequency = np.sqrt(stiffness)
    limit = largest_stable_step(damping / (2 * frequency), integrator)
    if timestep * frequency < limit:
        return None
    is_euler = integrator != mujoco.mjtIntegrator.mjINT_RK4
    measure = timestep**2 * stiffness + 2 * timestep * damping
    criterion = f"h²k + 2hb = {measure:.3g}, stable below 4" if is_euler else "RK4"
    return (
        f"stiffness {format_number(stiffness)} 1/s² and damping {format_number(damping)} 1/s are "
        f"beyond what a time step of {timestep:g} s integrates without gaining energy "
        f"({criterion}); use a time step below {format_number(limit / frequency)} s, or at this "
        f"damping ratio a stiffness below {format_number((limit / timestep) ** 2)} 1/s²"
    )
