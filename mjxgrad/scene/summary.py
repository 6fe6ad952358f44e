"""A scene described for a human."""

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

import jax
import mujoco
import numpy as np

from mjxgrad.contact.parameters import ContactParameters
from mjxgrad.scene.contact_check import contact_differences, format_number, name_pairs

if TYPE_CHECKING:
    from mjxgrad.scene.scene import Scene

_WIDTH = 118  # characters; what a laptop's terminal shows


def summarise(scene: "Scene") -> str:
    """Describe a scene; see `Scene.summary`."""
    solref = scene.model.geom_solref
    if isinstance(solref, jax.core.Tracer) or np.ndim(solref) != 2:
        raise ValueError("summary needs one scene with known values, got a batched or traced one")
    sections = [
        _heading(scene),
        _contacts(scene),
        _table("Converted", [(c.what, f"{c.given} → {c.used}", c.reason + _note(c.exact))
                             for c in scene.conversions]),
        _table("Left out", [(o.what, o.reason) for o in scene.omissions]),
        _bullets("Contacts unlike C MuJoCo", contact_differences(scene.mj_model, scene.pairs)),
        _bullets("Warnings", scene.warnings()),
    ]  # fmt: skip
    return "\n\n".join(section for section in sections if section)


def _note(exact: bool) -> str:
    return "" if exact else " (moves differently from C MuJoCo)"


def _heading(scene: "Scene") -> str:
    model, opt = scene.mj_model, scene.model.opt
    sizes = (
        (model.nbody - 1, "body", "bodies"),
        (model.nv, "degree of freedom", "degrees of freedom"),
        (model.ngeom, "geom", "geoms"),
        (model.nu, "control", "controls"),
        (model.na, "activation", "activations"),
        (model.nmocap, "mocap body", "mocap bodies"),
        (model.neq, "equality", "equalities"),
        (model.ntendon, "tendon", "tendons"),
        (int(model.jnt_limited.sum()), "joint limit", "joint limits"),
        (model.nsensor, "sensor", "sensors"),
    )
    counted = [f"{n} {one if n == 1 else many}" for n, one, many in sizes if n]
    integrator = mujoco.mjtIntegrator(opt.integrator).name.removeprefix("mjINT_")
    cone = mujoco.mjtCone(opt.cone).name.removeprefix("mjCONE_").lower()
    gravity = np.linalg.norm(np.asarray(opt.gravity))
    options = (
        f"time step {1e3 * float(opt.timestep):g} ms",
        integrator if integrator == "RK4" else integrator.capitalize(),
        f"{cone} cones" + (f", impratio {float(opt.impratio):g}" if opt.impratio != 1 else ""),
        f"Newton to {format_number(float(opt.tolerance))} in {opt.iterations} iterations",
        f"gravity {gravity:.3g} m/s²",
        str(scene.data.qpos.dtype),
    )
    return "\n".join([scene.name, "  " + ", ".join(counted), "  " + ", ".join(options)])


_COLUMNS = (
    ("pair", "condim", "solref", "k", "b", "ω₀", "τ", "ζ", "impedance", "width", "h²k+2hb",
     "friction", "margin"),
    ("", "", "", "1/s²", "1/s", "rad/s", "ms", "", "", "mm", "", "", "mm"),
)  # fmt: skip


def _contacts(scene: "Scene") -> str:
    """One line for all pairs with the same parameters."""
    if not scene.pairs:
        return ""
    groups: dict[tuple[str, ...], list] = {}
    for pair, cells in zip(scene.pairs, _contact_cells(scene), strict=True):
        groups.setdefault(cells, []).append(pair)
    rows = [(name_pairs(pairs), *cells) for cells, pairs in groups.items()]
    has_rest = len(rows[0]) > len(_COLUMNS[0])
    count = len(scene.pairs)
    title = f"Contact: {count} pair{'s' * (count > 1)} of geoms can touch"
    is_euler = scene.model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4
    legend = "effective k = ω₀², b = 2ζω₀ = 2/τ, per mass of the contact" + (
        "; stable while h²k + 2hb < 4" if is_euler else ""
    )
    columns = _COLUMNS
    if has_rest:
        columns = tuple((*column, cell) for column, cell in zip(_COLUMNS, ("at rest", "mm"), strict=True))
        legend += "\n  at rest: distance under gravity, negative for a depth"
    return _table(title, [*columns, *rows], is_numeric=True) + f"\n  {legend}"


def _contact_cells(scene: "Scene") -> list[tuple[str, ...]]:
    """What the table says of each pair, without its names."""
    parameters = scene.contact_parameters()
    columns = (
        [str(pair.condim) for pair in scene.pairs],
        [" ".join(format_number(x) for x in row) for row in np.asarray(parameters.solref).tolist()],
        _numbers(parameters.stiffness),
        _numbers(parameters.damping),
        _numbers(parameters.natural_frequency),
        _numbers(1e3 * parameters.time_constant),
        _numbers(parameters.damping_ratio),
        [_range(row) for row in np.asarray(parameters.impedance)],
        _numbers(1e3 * parameters.width),
        _numbers(parameters.stability),
        [_friction(pair.condim, row)
         for pair, row in zip(scene.pairs, np.asarray(parameters.friction).tolist(), strict=True)],
        _numbers(1e3 * parameters.margin),
        *_rest_column(scene, parameters),
    )  # fmt: skip
    return list(zip(*columns, strict=True))


def _rest_column(scene: "Scene", parameters: ContactParameters) -> list[list[str]]:
    """Where bodies rest under gravity, if some margin makes it worth a column."""
    gravity = float(np.linalg.norm(np.asarray(scene.model.opt.gravity)))
    if gravity == 0 or not np.any(parameters.margin) or not np.all(parameters.stiffness > 0):
        return []
    return [_numbers(1e3 * parameters.rest_distance(gravity))]


def _numbers(values) -> list[str]:
    return [format_number(x) for x in np.asarray(values).tolist()]


def _friction(condim: int, friction: Sequence[float]) -> str:
    """Sliding, torsional and rolling coefficients, as far as the contact has them."""
    if condim == 1:
        return "none"
    sliding = [format_number(x) for x in friction[:2]]
    cells = sliding[:1] if sliding[0] == sliding[1] else sliding
    cells += [format_number(x) for x in friction[2:3]] if condim >= 4 else []
    if condim == 6:
        rolling = [format_number(x) for x in friction[3:]]
        cells += rolling[:1] if rolling[0] == rolling[1] else rolling
    return " ".join(cells)


def _range(pair: np.ndarray) -> str:
    low, high = (f"{x:.4g}" for x in pair)
    return low if low == high else f"{low}–{high}"


def _table(title: str, rows: Sequence[tuple[str, ...]], *, is_numeric: bool = False) -> str:
    """A title and aligned columns, the first to the left; nothing without rows."""
    if not rows:
        return ""
    widths = [max(len(cell) for cell in column) for column in zip(*rows, strict=True)]
    align = str.rjust if is_numeric else str.ljust
    lines = []
    for first, *others in rows:
        cells = [align(cell, width) for cell, width in zip(others, widths[1:], strict=True)]
        line = "  " + "  ".join([first.ljust(widths[0]), *cells]).rstrip()
        if not is_numeric and len(line) > _WIDTH:
            # Only sentences wrap: a broken row of numbers could not be read.
            line = textwrap.fill(line.strip(), _WIDTH, initial_indent="  ", subsequent_indent="      ")
        lines.append(line)
    return "\n".join([title, *lines])


def _bullets(title: str, sentences: Sequence[str]) -> str:
    if not sentences:
        return ""
    wrapped = (textwrap.fill(sentence, _WIDTH, initial_indent="  ", subsequent_indent="    ") for sentence in sentences)
    return "\n".join([title, *wrapped])
