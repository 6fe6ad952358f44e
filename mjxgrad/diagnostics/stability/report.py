"""What `check_stability` returns."""

import textwrap
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from mjxgrad.diagnostics.onset import LARGEST_JUMP, STEPS_NEEDED
from mjxgrad.diagnostics.stability.spring import Spring
from mjxgrad.scene.contact_check import altered_by_refsafe, beyond_stability, format_number, name_pairs

LEAST_FRICTION = 0.01
"""Of pyramids, in single precision."""
STEPS_IN_CONTACT = 6.0
"""Time steps below which a bounce is too short for the event gradient, by the experiment `bounce`."""
_WIDTH = 118  # characters; what a laptop's terminal shows
_COLUMNS = ("", "k, 1/s²", "b, 1/s", "ω₀, rad/s", "ζ", "t_c, ms", "asked, ms", "impedance", "load", "coupled", "steps")
_LEGEND = (
    "load: time step over the largest that gains no energy, unstable from 1 on. coupled: the same where all contacts "
    "of the pair act at once. steps: that a bounce lasts. asked: time constant in the file, where refsafe replaces it."
)
_SPEED_COLUMNS = ("depth", "rise, steps")


@dataclass(frozen=True)
class StabilityReport:
    """Every spring of a scene beside its time step.

    Attributes:
        name: of the scene.
        springs: contact pairs, then joint limits, tendon limits and equalities.
        timestep: in s.
        speed: of approach that was asked about, in m/s, or None.
        joint_speed: the same for joints and tendons, in rad/s or m/s.
        precision: "float32" or "float64".
    """

    name: str
    springs: tuple[Spring, ...]
    timestep: float
    speed: float | None = None
    joint_speed: float | None = None
    precision: str = "float64"

    @property
    def largest_load(self) -> float:
        """Time step over the largest stable one, of the worst spring; unstable from 1 on, 0 without springs."""
        return max((spring.load for spring in self.springs), default=0.0)

    @property
    def is_stable(self) -> bool:
        """Whether no spring gains energy, even where all contacts of a pair act at once."""
        return all(spring.coupled_load < 1 for spring in self.springs)

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence per finding, for all springs alike; none if the time step follows everything."""
        rules: tuple[Callable[[Spring], str | None], ...] = (
            _hidden,
            _unstable,
            _unstable_together,
            _short,
            self._passed,
            self._deep,
            self._unresolved,
            self._steep,
        )
        found: dict[tuple[str, str], list[Spring]] = {}
        for spring in self.springs:
            for text in filter(None, (rule(spring) for rule in rules)):
                found.setdefault((spring.kind, text), []).append(spring)
        return tuple(f"{kind} of {name_pairs(same)}: {text}" for (kind, text), same in found.items())

    def summary(self) -> str:
        """Describe it for a human: a line for all springs alike, then the warnings.

        Returns:
            Text of several lines, fit for a terminal about 120 characters wide.
        """
        speeds = "".join(
            f", at {value:g} {unit}"
            for value, unit in ((self.speed, "m/s"), (self.joint_speed, "rad/s at limits"))
            if value is not None
        )
        lines = [f"Stability of {self.name} at a time step of {format_number(1e3 * self.timestep)} ms{speeds}"]
        if not self.springs:
            return "\n".join([*lines, "  nothing to be followed: no contact, limit or equality"])
        lines += _aligned([self._columns, *self._rows()])
        lines += [textwrap.fill(_LEGEND, _WIDTH, initial_indent="  ", subsequent_indent="  ")]
        sentences = self.warnings or ("the time step follows every spring",)
        return "\n".join(
            lines + [textwrap.fill(one, _WIDTH, initial_indent="- ", subsequent_indent="  ") for one in sentences]
        )

    def __str__(self) -> str:
        """The summary."""
        return self.summary()

    @property
    def _columns(self) -> tuple[str, ...]:
        return _COLUMNS + _SPEED_COLUMNS * (self.speed is not None or self.joint_speed is not None)

    def _rows(self) -> Iterator[tuple[str, ...]]:
        groups: dict[tuple[str, ...], list[Spring]] = {}
        for spring in self.springs:
            groups.setdefault((spring.kind, *self._cells(spring)), []).append(spring)
        for (kind, *cells), same in groups.items():
            yield (f"{kind} {name_pairs(same)}", *cells)

    def _cells(self, spring: Spring) -> tuple[str, ...]:
        low, high = (f"{x:.4g}" for x in spring.impedance)
        cells = (
            *map(format_number, (spring.stiffness, spring.damping, np.sqrt(max(spring.stiffness, 0.0)))),
            *map(format_number, (spring.damping_ratio, 1e3 * spring.time_constant)),
            format_number(1e3 * spring.given) if spring.is_hidden and spring.given is not None else "",
            low if low == high else f"{low}–{high}",
            *map(format_number, (spring.load, spring.coupled_load, spring.num_steps)),
        )
        if len(self._columns) == len(_COLUMNS):
            return cells
        speed = self._speed_of(spring)
        if speed is None:
            return (*cells, "", "")
        unit, scale = ("mm", 1e3) if spring.kind == "contact" else ("", 1.0)
        depth = f"{format_number(scale * spring.depth(speed))} {unit}".strip()
        return (*cells, depth, format_number(spring.rise_steps(speed)))

    def _speed_of(self, spring: Spring) -> float | None:
        if spring.kind == "equality":
            return None
        return self.speed if spring.kind == "contact" else self.joint_speed

    def _passed(self, spring: Spring) -> str | None:
        speed = self._speed_of(spring)
        if speed is None or speed * self.timestep < spring.size:
            return None
        return (
            f"at {speed:g} the bodies move {speed * self.timestep:.3g} in one step, more than the {spring.size:.3g} within "
            f"which they are found, and can pass through; use a time step below {spring.size / speed:.2g} s"
        )

    def _deep(self, spring: Spring) -> str | None:
        speed = self._speed_of(spring)
        if speed is None or spring.depth(speed) < spring.size or speed * self.timestep >= spring.size:
            return None
        return (
            f"at {speed:g} a bounce goes {spring.depth(speed):.3g} deep, more than the {spring.size:.3g} from which bodies "
            f"are pushed back the way they came; take a stiffness of at least {format_number(self._needed(spring, speed))} 1/s²"
        )

    def _needed(self, spring: Spring, speed: float) -> float:
        # At the same damping ratio the depth goes as one over the root of the stiffness.
        return spring.stiffness * (spring.depth(speed) / spring.size) ** 2 if spring.stiffness > 0 else np.inf

    def _steep(self, spring: Spring) -> str | None:
        if self.precision == "float64" or spring.pyramid is None or spring.pyramid >= LEAST_FRICTION:
            return None
        return (
            f"a pyramid of friction {spring.pyramid:.2g} weighs its edges by its inverse square, which single precision does not "
            f'resolve; take elliptic cones (<option cone="elliptic"/>), double precision, or at least {LEAST_FRICTION:g}'
        )

    def _unresolved(self, spring: Spring) -> str | None:
        speed = self._speed_of(spring)
        if speed is None:
            return None
        steps, jump = spring.rise_steps(speed), spring.impedance[0]
        reasons = [f"begins with a jump, at an impedance of {jump:.3g}"] * (jump > LARGEST_JUMP)
        if steps < STEPS_NEEDED:
            reasons.append(f"rises within {steps:.2g} time steps")
        if not reasons:
            return None
        return (
            f"at {speed:g} its force {' and '.join(reasons)}, which the derivative of the steps does not see; take "
            "onset=mg.Onset(), as tasks do by default, or an impedance from 0 over a width of at least "
            f"{STEPS_NEEDED * speed * self.timestep:.2g}"
        )


def _hidden(spring: Spring) -> str | None:
    if not spring.is_hidden or spring.given is None:
        return None
    softness = "Softness, which writes the format that refsafe leaves alone"
    direct = "the direct format, a negative solref, which refsafe leaves alone"
    remedy = softness if spring.kind == "contact" else direct
    return altered_by_refsafe(spring.given, spring.damping, spring.timestep, remedy)


def _unstable(spring: Spring) -> str | None:
    if spring.stiffness <= 0:
        return None
    return beyond_stability(*spring.steepest, spring.timestep, spring.integrator)


def _unstable_together(spring: Spring) -> str | None:
    if spring.load >= 1 or spring.coupled_load < 1:
        return None
    return (
        f"stable alone, at {spring.load:.2g} of the largest time step, but not where {spring.num_rows} contacts act at once, "
        f"at {spring.coupled_load:.2g} of it; use a time step below "
        f"{format_number(spring.timestep / spring.coupled_load)} s, or an impedance nearer to 1"
    )


def _short(spring: Spring) -> str | None:
    if spring.kind == "equality" or spring.num_steps >= STEPS_IN_CONTACT or spring.load >= 1:
        return None
    return (
        f"a bounce lasts {spring.num_steps:.2g} time steps, too few for the event gradient, which needs about "
        f"{STEPS_IN_CONTACT:g}; use a time step below {format_number(spring.timestep * spring.num_steps / STEPS_IN_CONTACT)} s, "
        "or a softer contact"
    )


def _aligned(rows: Iterable[tuple[str, ...]]) -> list[str]:
    rows = list(rows)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  " + "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]).rstrip() for row in rows]
