r"""Stability of a scene's contacts, limits and equalities at its time step, each seen as a spring and damper.

Contacts, limits and equalities follow one law: at full impedance $\ddot r = -k r - b \dot r$, with $k$ and $b$ per unit of
the row's effective mass. Semi-implicit Euler gains no energy while $h^2 k + 2 h b < 4$. In MuJoCo's standard format this is
$h / t_c < 2 \zeta (\sqrt{1 + \zeta^2} - \zeta)$, $t_c = 2 / b$.

This holds for one row alone, at the impedance $d_w$. Where the impedance falls with depth, stiffness and damping are largest
at first touch. The n contacts of a box that lands flat have the joint impedance
$n d / (1 + (n - 1) d)$, and act with $n / (1 + (n - 1) d_w)$ times $k$ and $b$. Contacts with other bodies add up to
$1 / d_w$ times these, where a row gets the whole acceleration that it asks for.
"""

import math
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import mujoco
import numpy as np

from mjxgrad._arrays import positive
from mjxgrad._programs import is_traced
from mjxgrad._text import Printed, aligned, format_number, format_range, name_pairs
from mjxgrad.contact.collision import most_contacts
from mjxgrad.contact.law import stiffness_damping
from mjxgrad.contact.warnings import altered_by_refsafe, beyond_stability, largest_stable_step, steepest
from mjxgrad.engines.state import check_scene
from mjxgrad.scene import Scene

_LEAST_FRICTION = 0.01  # of pyramids in single precision
_STEPS_IN_CONTACT = 6.0  # fewest time steps in a bounce for the slope at MuJoCo's motion
_WIDTH = 118  # characters in a laptop's terminal
_COLUMNS = (
    ("", "k", "b", "ω₀", "ζ", "t_c", "t_c in file", "impedance", "step over", "with all", "bounce", "bounce", "force rises"),
    ("", "1/s²", "1/s", "rad/s", "", "ms", "ms", "", "stable", "contacts", "in steps", "deep", "in steps"),
)  # fmt: skip
_LEGEND = "Step over stable: unstable from 1 on; with all contacts of the pair at once. t_c in file: where refsafe replaces it."

# Fewest steps that resolve the rise of the impedance, and the largest first impedance that counts as continuous.
_STEPS_NEEDED, _LARGEST_JUMP = 2.0, 0.01


@dataclass(frozen=True)
class Spring:
    r"""A contact pair, joint limit, tendon limit or equality as a spring and damper.

    Attributes:
        kind: "contact", "joint limit", "tendon limit" or "equality".
        name: name of the pair, joint, tendon or equality.
        stiffness: effective $k$, in 1/s².
        damping: effective $b$, in 1/s.
        impedance: $d_0$ and $d_w$.
        width: depth over which the impedance rises, in m (rad for hinges).
        replaced: time constant in the file that `refsafe` replaces, in s; None where none is.
        timestep: $h$, in s.
        integrator: integrator of the model.
        size: largest travel in one step that is detected: the bodies' thickness (m); infinite for planes and limits.
        num_rows: largest number of contacts of the pair at once.
        pyramid: sliding friction μ of a pyramidal contact in single precision; None for all others.
        speed: assumed speed of approach of a contact, in m/s; None for none.
    """

    kind: str
    name: str
    stiffness: float
    damping: float
    impedance: tuple[float, float]
    width: float
    replaced: float | None
    timestep: float
    integrator: mujoco.mjtIntegrator
    size: float = math.inf
    num_rows: int = 1
    pyramid: float | None = None
    speed: float | None = None

    def __str__(self) -> str:
        return self.name

    @property
    def damping_ratio(self) -> float:
        r"""$b / (2 \sqrt k)$; infinite without stiffness."""
        return self.damping / (2 * np.sqrt(self.stiffness)) if self.stiffness > 0 else np.inf

    @property
    def time_constant(self) -> float:
        """$2 / b$, in s; infinite without damping."""
        return 2 / self.damping if self.damping > 0 else np.inf

    @property
    def load(self) -> float:
        """The time step as a share of the largest stable one: unstable from 1 on."""
        return self._load(1.0)

    @property
    def coupled_load(self) -> float:
        """The load where all contacts of the pair hold the body at once; never below `load`."""
        return self._load(self.num_rows / (1 + (self.num_rows - 1) * max(self.impedance)))

    @property
    def steepest(self) -> tuple[float, float]:
        """Stiffness (1/s²) and damping (1/s) where the impedance is largest."""
        return steepest(self.stiffness, self.damping, self.impedance, self.width)

    def _load(self, factor: float) -> float:
        stiffness, damping = (factor * value for value in self.steepest)
        if stiffness <= 0:
            # A damper alone: h b < 2 for Euler, the real axis of RK4's region of stability.
            limit = 2.785 if self.integrator == mujoco.mjtIntegrator.mjINT_RK4 else 2.0
            return self.timestep * damping / limit
        frequency = np.sqrt(stiffness)
        return self.timestep * frequency / largest_stable_step(damping / (2 * frequency), self.integrator)

    @property
    def num_steps(self) -> float:
        """Number of time steps in a single bounce, at any speed; infinite without stiffness."""
        if self.stiffness <= 0:
            return np.inf
        return 2 * bounce_angle(max(self.damping_ratio, 0.0)) / np.sqrt(self.stiffness) / self.timestep

    def depth(self, speed: float) -> float:
        r"""Return the depth in m of a bounce at a speed of approach, $v \sqrt e / \omega_0$, restitution $e$."""
        if self.stiffness <= 0:
            return np.inf
        return speed * np.sqrt(restitution(max(self.damping_ratio, 0.0)) / self.stiffness)

    def rise_steps(self, speed: float) -> float:
        """Return the number of steps in which the impedance rises at a speed of approach; infinite if it does not rise."""
        first, last = self.impedance
        return self.width / (speed * self.timestep) if first != last and speed > 0 else np.inf


def bounce_angle(damping_ratio: float) -> float:
    r"""Return $\arccos\zeta / \sqrt{1 - \zeta^2}$, half the duration of a bounce in units of $1 / \omega_0$.

    It holds under a constant impedance and without gravity: the force acts from $r = 0$ until $\ddot r = 0$.
    """
    if damping_ratio == 1:
        return 1.0
    angle = math.acos(damping_ratio) if damping_ratio < 1 else math.acosh(damping_ratio)
    return angle / math.sqrt(abs((1 - damping_ratio) * (1 + damping_ratio)))


def restitution(damping_ratio: float) -> float:
    r"""Return the share of its speed that a ball keeps in such a bounce; $e^{-2}$ at critical damping."""
    return math.exp(-2 * damping_ratio * bounce_angle(damping_ratio))


@dataclass(frozen=True)
class StabilityReport(Printed):
    """The springs of a scene, judged at its time step.

    Attributes:
        name: name of the scene.
        springs: contact pairs, then joint limits, tendon limits and equalities.
        timestep: time step, in s.
        speed: assumed speed of approach, in m/s, or None.
    """

    name: str
    springs: tuple[Spring, ...]
    timestep: float
    speed: float | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence per finding, shared by equal springs; empty if the time step resolves every spring."""
        found: dict[tuple[str, str], list[Spring]] = {}
        for spring in self.springs:
            at_speed = () if spring.speed is None else _warnings_at(spring.speed, spring)
            for text in (*_warnings_at_rest(spring), *at_speed):
                found.setdefault((spring.kind, text), []).append(spring)
        return tuple(f"{kind} of {name_pairs(same)}: {text}" for (kind, text), same in found.items())

    def summary(self) -> str:
        """Return a report for a terminal of 120 columns: one line per group of equal springs, then the warnings."""
        speed = "" if self.speed is None else f", at {format_number(self.speed)} m/s"
        lines = [f"Stability of {self.name} at a time step of {format_number(1e3 * self.timestep)} ms{speed}"]
        if not self.springs:
            return "\n".join([*lines, "  nothing to check: no contact, limit or equality"])
        columns = [column for column in zip(*_COLUMNS, *self._rows(), strict=True) if any(column[2:])]
        lines += [f"  {line}" for line in aligned(list(zip(*columns, strict=True)))]
        lines += [textwrap.fill(_LEGEND, _WIDTH, initial_indent="  ", subsequent_indent="  ")]
        sentences = self.warnings or ("the time step resolves every spring",)
        lines += [textwrap.fill(one, _WIDTH, initial_indent="- ", subsequent_indent="  ") for one in sentences]
        return "\n".join(lines)

    __str__ = __repr__ = summary

    def _rows(self) -> Iterator[tuple[str, ...]]:
        groups: dict[tuple[str, ...], list[Spring]] = {}
        for spring in self.springs:
            numbers = spring.stiffness, spring.damping, np.sqrt(max(spring.stiffness, 0.0)), spring.damping_ratio
            cells = [*map(format_number, numbers), format_number(1e3 * spring.time_constant)]
            cells += ["" if spring.replaced is None else format_number(1e3 * spring.replaced)]
            cells += [format_range(spring.impedance)]
            cells += map(format_number, (spring.load, spring.coupled_load, spring.num_steps))
            if (speed := spring.speed) is not None:
                cells += [f"{format_number(1e3 * spring.depth(speed))} mm", format_number(spring.rise_steps(speed))]
            cells += [""] * (len(_COLUMNS[0]) - 1 - len(cells))
            groups.setdefault((spring.kind, *cells), []).append(spring)
        for (kind, *cells), same in groups.items():
            yield (f"{kind} {name_pairs(same)}", *cells)


def _warnings_at_rest(spring: Spring) -> Iterator[str]:
    """Yield what is wrong with a spring at its time step, at any speed."""
    step = spring.timestep
    softness, direct = "Softness, which writes the format", "the direct format, a negative solref,"
    remedy = f"{softness if spring.kind == 'contact' else direct} which refsafe leaves alone"
    altered = altered_by_refsafe(spring.replaced or 0.0, spring.damping, step, remedy)
    yield from filter(None, (altered, beyond_stability(*spring.steepest, step, spring.integrator)))
    if spring.load < 1 <= spring.coupled_load:
        yield (
            f"stable alone, at {spring.load:.2g} of the largest time step, but not where {spring.num_rows} contacts act at "
            f"once, at {spring.coupled_load:.2g} of it; use a time step below {format_number(step / spring.coupled_load)} s, "
            "or an impedance nearer to 1"
        )
    if spring.kind != "equality" and spring.num_steps < _STEPS_IN_CONTACT and spring.load < 1:
        needed = format_number(step * spring.num_steps / _STEPS_IN_CONTACT)
        yield (
            f"a bounce lasts {spring.num_steps:.2g} time steps, too few for the slope at MuJoCo's motion, which needs about "
            f"{_STEPS_IN_CONTACT:g}; use a time step below {needed} s, or a softer contact"
        )
    if spring.pyramid is not None and spring.pyramid < _LEAST_FRICTION:
        yield (
            f"a pyramid of friction {spring.pyramid:.2g} weighs its edges by its inverse square, which single precision does "
            f'not resolve; take elliptic cones (<option cone="elliptic"/>), double precision, or at least {_LEAST_FRICTION:g}'
        )


def _warnings_at(speed: float, spring: Spring) -> Iterator[str]:
    """Yield what is wrong with a contact at a speed of approach."""
    travel, depth = speed * spring.timestep, spring.depth(speed)
    if travel >= spring.size:
        yield (
            f"at {speed:.4g} m/s the bodies move {travel:.3g} m in one step, more than the {spring.size:.3g} m within which "
            f"they are found, and can pass through; use a time step below {spring.size / speed:.2g} s"
        )
    elif depth >= spring.size:
        # At a fixed damping ratio the depth is proportional to stiffness^(-1/2).
        needed = spring.stiffness * (depth / spring.size) ** 2 if spring.stiffness > 0 else np.inf
        yield (
            f"at {speed:.4g} m/s a bounce goes {depth:.3g} m deep, more than the {spring.size:.3g} m from which bodies are "
            f"pushed back the way they came; take a stiffness of at least {format_number(needed)} 1/s²"
        )
    steps, jump = spring.rise_steps(speed), spring.impedance[0]
    reasons = [f"begins with a jump, at an impedance of {jump:.3g}"] * (jump > _LARGEST_JUMP)
    reasons += [f"rises within {steps:.2g} time steps"] * (steps < _STEPS_NEEDED)
    if reasons:
        yield (
            f"at {speed:.4g} m/s its force {' and '.join(reasons)}, which the derivative of the steps does not see. "
            f"contact=mg.Slope() sees it, and an impedance from 0 over at least {_STEPS_NEEDED * travel:.2g} m avoids it"
        )


def check_stability(scene: Scene, *, speed: float | None = None) -> StabilityReport:
    """Check whether the time step of a scene resolves its contacts, limits and equalities; `print` the report.

    Nothing is simulated. The limits are those of a single spring and damper, see this module. Passing through, depth and onsets
    depend on the speed at which geoms approach each other (m/s), and are checked only where it is given.

    Raises:
        ValueError: if the speed is not positive, or the scene is batched or traced.
    """
    check_scene(scene)
    if speed is not None:
        positive("speed", speed)
    model = scene.model
    leaves = (model.geom_solref, model.jnt_solref, model.opt.timestep)
    if is_traced(leaves) or np.ndim(model.geom_solref) != 2 or np.ndim(model.opt.timestep) != 0:
        raise ValueError("check_stability needs one scene with known values, got a batched or traced one")
    # Inside jit, even operations on known values would be traced.
    with jax.ensure_compile_time_eval():
        springs = (*_contacts(scene, speed), *_others(scene))
    return StabilityReport(scene.name, springs, float(model.opt.timestep), speed)


def _contacts(scene: Scene, speed: float | None) -> Iterator[Spring]:
    if not scene.pairs:
        return
    present = scene.contact_parameters()
    springiness = (present.stiffness, present.damping, present.solref, present.impedance, present.width)
    rows = zip(*(np.asarray(column, float) for column in springiness), strict=True)
    is_pyramidal = scene.model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL and scene.data.qpos.dtype == np.float32
    for pair, friction, row in zip(scene.pairs, present.friction[:, 0].tolist(), rows, strict=True):
        geoms = [pair.geom1, pair.geom2]
        kinds = tuple(map(mujoco.mjtGeom, scene.mj_model.geom_type[geoms].tolist()))
        pyramid = friction if is_pyramidal and pair.condim > 1 else None
        rest = {"size": _thickness(scene, geoms, kinds), "num_rows": most_contacts(kinds), "pyramid": pyramid}
        yield _spring(scene, "contact", str(pair), *row, **rest, speed=speed)


def _others(scene: Scene) -> Iterator[Spring]:
    """Return the active joint limits, tendon limits and equalities."""
    m, c, flag, of = scene.model, scene.mj_model, mujoco.mjtDisableBit, mujoco.mjtObj
    disabled = int(m.opt.disableflags)
    if disabled & flag.mjDSBL_CONSTRAINT:
        return
    joints = (c.jnt_limited, m.jnt_solref, m.jnt_solimp)
    tendons = (c.tendon_limited, m.tendon_solref_lim, m.tendon_solimp_lim)
    kinds = (
        ("joint limit", flag.mjDSBL_LIMIT, of.mjOBJ_JOINT, *joints),
        ("tendon limit", flag.mjDSBL_LIMIT, of.mjOBJ_TENDON, *tendons),
        ("equality", flag.mjDSBL_EQUALITY, of.mjOBJ_EQUALITY, c.eq_active0, m.eq_solref, m.eq_solimp),
    )
    for kind, off, which, active, solref, solimp in kinds:
        chosen = np.flatnonzero(active)
        if disabled & off or not chosen.size:
            continue
        stiffness, damping = (np.asarray(x, float) for x in stiffness_damping(m, solref))
        for i in chosen:
            name = mujoco.mj_id2name(c, which, i) or f"{kind} {i}"
            impedance = np.clip(np.asarray(solimp[i, :2], float), mujoco.mjMINIMP, mujoco.mjMAXIMP)
            springiness = (stiffness[i], damping[i], np.asarray(solref[i], float), impedance, solimp[i, 2])
            yield _spring(scene, kind, name, *springiness)


def _spring(
    scene: Scene, kind: str, name: str, stiffness: float, damping: float, solref, impedance, width, **rest: Any
) -> Spring:
    # With a relative margin, because float32 rounds a time constant of exactly two steps.
    is_replaced = solref[0] > 0 and damping * solref[0] * (1 + 1e-5) < 2
    return Spring(
        kind=kind,
        name=name,
        stiffness=float(stiffness),
        damping=float(damping),
        impedance=(float(impedance[0]), float(impedance[1])),
        width=max(float(width), mujoco.mjMINVAL),
        replaced=float(solref[0]) if is_replaced else None,
        timestep=float(scene.model.opt.timestep),
        integrator=mujoco.mjtIntegrator(int(scene.model.opt.integrator)),
        **rest,
    )


def _thickness(scene: Scene, geoms: Sequence[int], kinds: Sequence[mujoco.mjtGeom]) -> float:
    """Return the joint thickness of two geoms, the deepest overlap from which they still part the way they came (m)."""
    total, of = 0.0, mujoco.mjtGeom
    for geom, kind in zip(geoms, kinds, strict=True):
        # Half the thickness; everything behind a plane or under a height field is inside, at any depth.
        sizes = np.asarray(scene.model.geom_size[geom], float)
        if kind in (of.mjGEOM_PLANE, of.mjGEOM_HFIELD):
            total = np.inf
        elif kind in (of.mjGEOM_SPHERE, of.mjGEOM_CAPSULE):
            total += sizes[0]
        elif kind == of.mjGEOM_MESH:
            total += scene.mj_model.geom_aabb[geom, 3:].min()  # of its bounding box, in its own axes
        else:
            total += sizes[sizes > 0].min(initial=np.inf)
    return float(total)
