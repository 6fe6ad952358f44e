"""Warnings about contact parameters that MuJoCo alters, that are unstable, that let bodies hover, or that have no effect."""

from collections.abc import Iterable, Iterator

import jax
import mujoco
import numpy as np
from jaxtyping import Float

from mjxgrad._arrays import is_known
from mjxgrad._mjx import mjx
from mjxgrad._text import format_number, name_pairs
from mjxgrad.contact.parameters import ContactPair, Pairs, contact_pairs, contact_parameters
from mjxgrad.contact.softness import Softness

_ABOVE_NOTHING = 1e-6  # m; bodies that hover by less are taken to touch


def largest_stable_step(damping_ratio: float, integrator: mujoco.mjtIntegrator) -> float:
    r"""Return the largest $h \omega_0$ at which a contact at full impedance does not gain energy."""
    # The oscillator $\ddot r = -k r - b \dot r$ has $\omega_0 = \sqrt k$ and $\zeta = b / (2 \omega_0)$. Semi-implicit
    # Euler is stable while $h^2 k + 2 h b < 4$, that is up to $2 (\sqrt{1 + \zeta^2} - \zeta)$; `implicitfast` treats
    # contact in the same way. RK4 is stable while its amplification factor at both eigenvalues is at most 1. The
    # limit of $h b$ is $2 \zeta$ times the result.
    if integrator != mujoco.mjtIntegrator.mjINT_RK4:
        # The difference of two large numbers, in a form that does not cancel.
        return 2.0 / (np.sqrt(1.0 + damping_ratio**2) + damping_ratio)
    root = np.emath.sqrt(damping_ratio**2 - 1.0)
    stable, unstable = 0.0, 3.0
    for _ in range(50):
        middle = (stable + unstable) / 2
        z = middle * np.array([-damping_ratio + root, -damping_ratio - root])
        is_stable = np.abs(1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24).max() <= 1.0
        stable, unstable = (middle, unstable) if is_stable else (stable, middle)
    return stable


def contact_warnings(model: mjx.Model, pairs: Pairs) -> list[str]:
    """Return warnings about contacts that `refsafe` alters or that are too stiff for the time step; values must be known."""
    if not pairs:
        return []
    # Inside jit, operations on known values would be traced, too.
    with jax.ensure_compile_time_eval():
        parameters = contact_parameters(model, pairs)
    names = ("solref", "stiffness", "damping", "impedance", "width")
    solref, stiffness, damping, impedance, width = (np.asarray(getattr(parameters, x), float) for x in names)
    timestep = float(model.opt.timestep)
    integrator = mujoco.mjtIntegrator(int(model.opt.integrator))

    found, remedy = [], "Softness, which writes the format that refsafe leaves alone"
    for pair, first, k, b, bounds, over in zip(pairs, solref[:, 0], stiffness, damping, impedance, width, strict=True):
        altered = altered_by_refsafe(first, b, timestep, remedy)
        unstable = beyond_stability(*steepest(k, b, bounds, over), timestep, integrator)
        found += [(pair, message) for message in (altered, unstable) if message]
    return _grouped(found)


def steepest(
    stiffness: float, damping: float, impedance: Float[np.ndarray, "2"] | tuple[float, float], width: float
) -> tuple[float, float]:
    r"""Return stiffness and damping at the largest impedance, which is at first touch if it falls with depth."""
    # The arguments hold at full depth (1/s², 1/s). The force is the share $d(r)$ of the reference acceleration, so stiffness
    # scales with the square of the impedance and damping with the impedance. Without a width the impedance is $d_w$ everywhere.
    share = max(1.0, float(impedance[0] / impedance[1])) if width > mujoco.mjMINVAL else 1.0
    return float(share**2 * stiffness), float(share * damping)


def altered_by_refsafe(time_constant: float, damping: float, timestep: float, remedy: str) -> str | None:
    """Return the end of a sentence if `refsafe` replaces a time constant (s; negative for the direct format)."""
    # A relative margin, because float32 rounds a time constant of exactly two steps.
    if time_constant <= 0 or 2.0 / damping <= time_constant * (1 + 1e-5):
        return None
    return (
        f"its time constant {time_constant:g} s is below two time steps, so refsafe replaces it by "
        f"{2 * timestep:g} s and smaller values have no effect; use a time step of at most "
        f"{time_constant / 2:g} s, or {remedy}"
    )


def beyond_stability(stiffness: float, damping: float, timestep: float, integrator: mujoco.mjtIntegrator) -> str | None:
    """Return the end of a sentence if a spring and damper gains energy at a time step (1/s², 1/s, s)."""
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


def softness_warnings(softness: Softness, model: mjx.Model) -> list[str]:
    """Return warnings about parts of a softness without effect, and about bodies that hover; not of traced parts."""
    if not contact_pairs(model):
        return ["softness has no effect: no two geoms of the scene can touch"]
    low, high = mujoco.mjMINIMP, mujoco.mjMAXIMP
    messages = []
    if is_known(softness.impedance):
        for value in np.unique(np.asarray(softness.impedance)):
            if not low <= value <= high:
                messages.append(
                    f"impedance {value:g} has the effect of {np.clip(value, low, high):g}: "
                    f"MuJoCo keeps it between {low:g} and {high:g}"
                )
    leaves = (softness.margin, model.geom_margin, model.pair_margin, model.geom_solref, model.opt.gravity)
    if all(is_known(leaf) for leaf in leaves):
        # Inside jit, operations on known values would be traced, too.
        with jax.ensure_compile_time_eval():
            messages += _grouped(_hovering(softness, model, softness.selected(model)))
    return messages


def _hovering(softness: Softness, model: mjx.Model, pairs: Pairs) -> Iterator[tuple[ContactPair, str]]:
    gravity = float(np.linalg.norm(np.asarray(model.opt.gravity)))
    parameters = contact_parameters(model, pairs)
    is_single = np.asarray(parameters.margin).ndim == 1 and np.all(np.asarray(parameters.stiffness) > 0)
    if gravity == 0 or softness.rest_acceleration is not None or not is_single:
        return
    distances = np.asarray(parameters.rest_distance(gravity), float)
    for pair, distance, margin in zip(pairs, distances, np.asarray(parameters.margin, float), strict=True):
        if margin > 0 and distance > _ABOVE_NOTHING:
            yield (
                pair,
                f"with a margin of {margin:.3g} m bodies at rest under gravity hover {distance:.3g} m above each other; "
                f"rest_acceleration={gravity:.3g} keeps their height, by a softer contact",
            )


def _grouped(found: Iterable[tuple[ContactPair, str]]) -> list[str]:
    messages: dict[str, list[ContactPair]] = {}
    for pair, text in found:
        messages.setdefault(text, []).append(pair)
    return [f"contact of {name_pairs(same)}: {text}" for text, same in messages.items()]
