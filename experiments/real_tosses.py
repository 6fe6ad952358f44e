"""Real cube tosses: side, friction and contact softness from recorded motions, judged on tosses that were held out."""

import functools
import pickle
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, BinaryIO

import mujoco
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

import mjxgrad as mg
from experiments.config import ExperimentError
from experiments.report import Table, tabulated
from experiments.settings import Positive, RunSettings, SettingsTable
from experiments.theme import FIRST, MUTED, ONSET, REFERENCE, ZEROTH, Drawings, legend_below, plain, subplots
from experiments.words import joined, quantity
from experiments.workspace import Workspace
from mjxgrad import identification
from mjxgrad._mjx import mjx
from mjxgrad.identification import Parameter, Recording, Stopped


class StartSettings(SettingsTable):
    """Where a search begins."""

    side: Positive  # of the cube, in m
    radius: Positive  # of its corners, in m
    friction: Positive  # with the floor
    stiffness: Positive  # of the contact, in 1/s²
    damping_ratio: Positive  # of the contact


class Settings(RunSettings):
    """Parameters of a cube from recorded tosses, and what they are worth on others."""

    folder: str  # with the tosses of ContactNets, `0.pt` and so on
    num_training: Annotated[int, Field(ge=1)]  # tosses to fit
    num_held_out: Annotated[int, Field(ge=1)]  # tosses to judge by
    window: Annotated[int, Field(ge=2)]  # steps of the recording that are simulated at a time
    num_windows: Annotated[int, Field(ge=1)]  # at most, of a toss, from shortly before it touches the floor
    substeps: Annotated[int, Field(ge=1)]  # time steps of the simulation for each of the recording
    noise: Positive  # of positions, in m; of turns it is over half a side
    max_steps: Annotated[int, Field(ge=1)]  # of a search
    start: StartSettings  # of all searches


# The block of Pfrommer, Halm, Posa, ContactNets, CoRL 2020, arXiv:2009.11193. Its repository, DAIRLab/contact-nets, has lengths
# in half sides (README.md), mass, inertia and friction (data/params_processed/experiment.json), and the rate of the recording.
HALF_SIDE = 0.0524  # m
SIDE = 2 * HALF_SIDE
RATE = 148.0  # Hz
_MASS, _INERTIA = 0.37, 8.1e-4  # kg, kg m²
_SHARP = 1e-4  # m, radius of a corner that is none
# With MuJoCo's default contact, solref = (0.02, 1), written as stiffness and damping ratio.
NOMINAL = {"side": SIDE, "radius": _SHARP, "friction": 0.18, "stiffness": (0.95 * 0.02) ** -2, "damping_ratio": 1.0}
# Of the MuJoCo model that Acosta, Yang, Posa fitted to these tosses without derivatives (Validating Robotics Simulators on
# Real-World Impacts, RA-L 2022, arXiv:2110.00541): DAIRLab/dairlib, mujoco_2021_09_12_10_27_10.json.
PUBLISHED = NOMINAL | {"friction": 0.2307, "stiffness": 3852.0, "damping_ratio": 63.195 / (2 * 3852.0**0.5)}
BAND = 0.05  # about as near DiffMJX came to the side, from 550 tosses (arXiv:2506.14186)


@dataclass(frozen=True)
class Toss:
    """A recorded motion: a row every 1/148 s, in MuJoCo's coordinates of a free joint (m, unit quaternion, m/s, rad/s)."""

    number: int
    qpos: Float[np.ndarray, "rows 7"]
    qvel: Float[np.ndarray, "rows 6"]


def read_toss(path: Path) -> Toss:
    """Read a toss of ContactNets.

    A row is position and quaternion (real part first), velocity, turning velocity in the frame of the cube, and controls that are
    zero; lengths are in half sides. Velocities are differences to the row before, so that they hold half a step earlier: the mean
    with those of the next row holds at the row itself, exactly in free flight.
    """
    with path.open("rb") as file:
        rows = _tensor(file, path).reshape(-1, 19)
    scale = np.repeat([HALF_SIDE, 1.0], 3)
    velocity = rows[:, 7:13] * scale
    velocity[:-1] = (velocity[:-1] + velocity[1:]) / 2
    return Toss(int(path.stem), np.hstack([rows[:, :3] * HALF_SIDE, rows[:, 3:7]]), velocity)


class _WithoutTorch(pickle.Unpickler):
    """Reads how a tensor is stored, and calls nothing that a file may name."""

    _KNOWN = ("torch.DoubleStorage", "torch._utils._rebuild_tensor_v2", "collections.OrderedDict")

    def find_class(self, module: str, name: str) -> Any:
        if f"{module}.{name}" not in self._KNOWN:
            raise pickle.UnpicklingError(f"it holds {module}.{name}, and not one tensor of doubles")
        return lambda *arguments: arguments

    def persistent_load(self, pid: Any) -> Any:
        return pid


def _tensor(file: BinaryIO, path: Path) -> Float[np.ndarray, "..."]:
    """Read the one tensor of a file of torch.save before its version 1.6: five pickles, then the numbers."""
    try:
        *_, (_, _, shape, *_), _ = [_WithoutTorch(file).load() for _ in range(5)]
        (count,) = np.frombuffer(file.read(8), "<i8")
        return np.frombuffer(file.read(8 * int(count)), "<f8").reshape(shape)
    except (pickle.UnpicklingError, ValueError, EOFError) as error:
        raise ExperimentError(f"{path} must be a toss of ContactNets as its repository has it: {error}") from error


def find_tosses(folder: str) -> list[Path]:
    """List the files of the tosses by number; an `ExperimentError` says where to have them."""
    found = sorted(Path(folder).expanduser().glob("[0-9]*.pt"), key=lambda path: int(path.stem))
    if not found:
        raise ExperimentError(
            f"folder must hold the tosses of ContactNets, 0.pt and so on, got {folder}: "
            "git clone https://github.com/DAIRLab/contact-nets, and name its data/tosses_processed"
        )
    return found


_SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
_CORNERS = slice(1, 9)  # of the geoms


def cube(
    substeps: int, *, side: float, radius: float, friction: float, stiffness: float, damping_ratio: float
) -> mg.Scene:
    """Load a cube over a floor, whose corners are balls: a box's contact with a plane jumps where corners change.

    Cones are elliptic: edges of a pyramid push a corner that slides as soon as it touches, and derivatives chatter.
    """
    places = (_SIGNS * (side / 2 - radius)).tolist()
    corners = "".join(f'<geom pos="{x} {y} {z}" size="{radius}"/>' for x, y, z in places)
    solref = f"{-stiffness} {-2 * damping_ratio * stiffness**0.5}"
    return mg.load_scene(f"""<mujoco model="cube"><option timestep="{1 / RATE / substeps}" cone="elliptic"/>
      <default><geom solref="{solref}" friction="{friction}"/></default>
      <worldbody><geom name="floor" type="plane" size="5 5 .1"/><body name="cube" pos="0 0 1"><freejoint/>{corners}
      <inertial pos="0 0 0" mass="{_MASS}" diaginertia="{_INERTIA} {_INERTIA} {_INERTIA}"/></body></worldbody></mujoco>""")


def parameters(scene: mg.Scene, names: tuple[str, ...]) -> dict[str, Parameter]:
    """Make the parameters of these names, from where the scene has them."""

    def write_side(model: mjx.Model, side: Array) -> dict[str, Array]:
        centres = _SIGNS * (side / 2 - model.geom_size[_CORNERS, :1])
        return {"geom_pos": model.geom_pos.at[_CORNERS].set(centres)}

    def write_radius(model: mjx.Model, radius: Array) -> dict[str, Array]:
        moved = _SIGNS * (model.geom_size[_CORNERS, :1] - radius)
        size = model.geom_size.at[_CORNERS, 0].set(radius)
        return {"geom_pos": model.geom_pos.at[_CORNERS].add(moved), "geom_size": size}

    radius = float(scene.model.geom_size[1, 0])
    side = 2 * (float(scene.model.geom_pos[8, 0]) + radius)
    soft = functools.partial(identification.softness, scene)
    made = {
        "side": Parameter(side, 0.05, 0.2, write_side, "m"),
        "radius": Parameter(radius, 1e-5, 0.02, write_radius, "m"),
        "friction": identification.friction(scene, bounds=(0.01, 1.0)),
        "stiffness": soft("stiffness", bounds=(1e3, 1e6)),
        "damping_ratio": soft("damping_ratio", bounds=(0.05, 3.0)),
    }
    return {name: made[name] for name in names}


def recordings(toss: Toss, settings: Settings) -> list[Recording]:
    """Cut a toss into windows, the first of which begins five rows before the nominal cube touches the floor."""
    begin = max(0, int(np.argmax(lowest(toss.qpos) < 0.004)) - 5)
    qpos, qvel = toss.qpos[begin:], toss.qvel[begin:]
    noise = np.repeat([settings.noise, settings.noise / HALF_SIDE], 3)
    whole = Recording(
        {"qpos": qpos, "qvel": qvel},
        times=np.arange(len(qpos)) / RATE,
        noise={"qpos": noise, "qvel": np.inf},  # they begin windows, and weigh nothing
        name=f"toss {toss.number}",
    )
    return whole.cut(settings.window / RATE, 1 / RATE / settings.substeps)[: settings.num_windows]


def lowest(qpos: Float[np.ndarray, "rows 7"]) -> Float[np.ndarray, " rows"]:
    """Return the height of the lowest corner of the nominal cube, in m."""
    w, x, y, z = qpos[:, 3:].T
    up = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x**2 + y**2)], axis=1)
    return qpos[:, 2] - HALF_SIDE * np.abs(up).sum(axis=1)


def replay(model: mujoco.MjModel, toss: Toss, substeps: int) -> Float[np.ndarray, "rows 7"]:
    """Roll out a toss from its first state in C MuJoCo."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = toss.qpos[0], toss.qvel[0]
    course = [toss.qpos[0]]
    for _ in toss.qpos[1:]:
        mujoco.mj_step(model, data, nstep=substeps)
        course.append(data.qpos.copy())
    return np.array(course)


def angle_between(
    one: Float[np.ndarray, "rows 4"], other: Float[np.ndarray, "rows 4"] | Float[np.ndarray, " 4"]
) -> Float[np.ndarray, " rows"]:
    """Return the angle between orientations, in degrees."""
    return np.degrees(2 * np.arccos(np.abs((one * other).sum(axis=1)).clip(max=1.0)))


def errors(course: Float[np.ndarray, "rows 7"], toss: Toss) -> tuple[float, float]:
    """Return the mean error over a toss as ContactNets has it: of the position over the side, and of the turn in degrees."""
    place = np.linalg.norm(course[:, :3] - toss.qpos[:, :3], axis=1) / SIDE
    return float(place.mean()), float(angle_between(course[:, 3:], toss.qpos[:, 3:]).mean())


CONTACT = ("side", "friction", "stiffness", "damping_ratio")
FITS: dict[str, tuple[tuple[str, ...], bool]] = {
    "side alone": (("side",), True),
    "side and contact": (CONTACT, True),
    "rounded corners": (("radius", *CONTACT), True),
    "rounded corners, no onset": (("radius", *CONTACT), False),
}
BEST = "rounded corners"
GIVEN = {"nominal": NOMINAL, "fitted by Acosta et al.": PUBLISHED}
# What the page calls them, in which unit, and what that is of the SI's.
SHOWN = {
    "side": ("side", " mm", 1e3),
    "radius": ("corner radius", " mm", 1e3),
    "friction": ("friction", "", 1.0),
    "stiffness": ("stiffness", " 10³/s²", 1e-3),
    "damping_ratio": ("damping ratio", "", 1.0),
}


@dataclass(frozen=True)
class Fit:
    """A search: what it found, and how it ended; residuals are in units of the noise."""

    values: dict[str, float]
    half_width: dict[str, float]
    rms: tuple[float, float]
    correlation: float
    stopped: str
    num_steps: int
    seconds: float
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Outcome:
    """All numbers."""

    settings: Settings
    fits: dict[str, Fit]
    # By the name of a fit or of given numbers: `errors` whole, and early.
    judged: dict[str, Float[np.ndarray, "tosses 4"]]
    shown: Toss  # of those held out, one whose error is in the middle
    courses: dict[str, Float[np.ndarray, "rows 7"]]  # of it
    num_windows: int

    def rows(self) -> list[dict[str, Any]]:
        """One row per set of numbers, for metrics.csv."""
        found = []
        for name, values in (GIVEN | {name: fit.values for name, fit in self.fits.items()}).items():
            widths = self.fits[name].half_width if name in self.fits else {}
            ends = {f"{key}_half_width": x for key, x in widths.items()}
            found.append({"name": name, **values, **_means(self.judged[name]), **ends})
        return found


def _means(judged: Float[np.ndarray, "tosses 4"]) -> dict[str, float]:
    place, turn, early_place, early_turn = judged.T
    found = {"position_error": place.mean(), "position_median": np.median(place)}
    found |= {"turn_error_degrees": turn.mean(), "turn_median_degrees": np.median(turn)}
    return found | {"early_position_error": early_place.mean(), "early_turn_error_degrees": early_turn.mean()}


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Fit windows of some tosses, and judge by whole others."""
    paths = find_tosses(settings.folder)
    if len(paths) < settings.num_training + settings.num_held_out:
        raise ExperimentError(
            f"num_training and num_held_out must be at most {len(paths)} together, for so many tosses"
        )
    order = np.random.default_rng(settings.seed).permutation(len(paths))
    tosses = [read_toss(paths[i]) for i in order[: settings.num_training + settings.num_held_out]]
    training, held_out = tosses[: settings.num_training], tosses[settings.num_training :]
    windows = [window for toss in training for window in recordings(toss, settings)]
    searches = {name: functools.partial(_fit, settings, one, windows, onset) for name, (one, onset) in FITS.items()}
    fits = dict(zip(FITS, workspace.each("searches", "fits", searches), strict=True))
    judged, courses = {}, {}
    for name, values in (GIVEN | {name: fit.values for name, fit in fits.items()}).items():
        model = cube(settings.substeps, **values).mj_model
        courses[name] = [replay(model, toss, settings.substeps) for toss in held_out]
        judged[name] = np.array([_judge(*pair) for pair in zip(courses[name], held_out, strict=True)])
    middle = int(np.argsort(judged[BEST][:, 0])[len(held_out) // 2])
    shown = {name: course[middle] for name, course in courses.items()}
    return Outcome(settings, fits, judged, held_out[middle], shown, len(windows))


def _judge(course: Float[np.ndarray, "rows 7"], toss: Toss) -> tuple[float, ...]:
    """Return the errors over the whole toss, and those until 0.1 s after the nominal cube touches the floor."""
    early = slice(0, int(np.argmax(lowest(toss.qpos) < 0)) + round(0.1 * RATE))
    return *errors(course, toss), *errors(course[early], Toss(toss.number, toss.qpos[early], toss.qvel[early]))


def _fit(settings: Settings, names: tuple[str, ...], windows: list[Recording], has_onset: bool) -> Fit:
    begun = time.perf_counter()
    start = settings.start.model_dump()
    # What is not looked for has its nominal value.
    values = {key: start[key] if key in names else value for key, value in NOMINAL.items()}
    scene = cube(settings.substeps, **values)
    found = mg.identify(
        scene,
        parameters(scene, names),
        windows,
        free_start=True,
        contact=mg.Onset() if has_onset else mg.Discrete(),
        max_steps=settings.max_steps,
    )
    if found.stopped is Stopped.INTERRUPTED:
        raise KeyboardInterrupt
    return Fit(
        values={**values, **{name: float(value) for name, value in found.values.items()}},
        half_width={name: float(width) for name, width in found.half_width.items()},
        rms=found.rms,
        correlation=found.correlation,
        stopped=found.stopped.value,
        num_steps=found.num_steps,
        seconds=time.perf_counter() - begun,
        warnings=tuple(found.warnings()),
    )


def off(fit: Fit) -> float:
    """Return by what share the side is off the published one."""
    return fit.values["side"] / SIDE - 1


def _signed(share: float) -> str:
    return f"{100 * share:+.1f}%".replace("-", "−")


def answer(outcome: Outcome) -> str:
    """Say how far the side is off, and what is left on whole tosses that were held out."""
    share, (place, turn) = off(outcome.fits[BEST]), outcome.judged[BEST].mean(axis=0)[:2]
    which = "short" if share < 0 else "long"
    return f"The side is {100 * abs(share):.1f}% {which}; held-out tosses are off by {place:.0%} of it and {turn:.0f}°."


def verdict(outcome: Outcome) -> str:
    """Give the numbers with rounded corners, the errors beside those of given numbers, and what the intervals lack."""
    best = outcome.fits[BEST]
    told = ((name, _quantity(name, best.values[name], best.half_width.get(name))) for name in (*CONTACT, "radius"))
    found = joined(f"{SHOWN[name][0]} {text}{SHOWN[name][1]}" for name, text in told)
    held = "; ".join(f"{name} {_errors(outcome.judged[name])}" for name in (*GIVEN, BEST))
    return (
        f"From {outcome.settings.num_training} tosses: {found}. "
        f"Mean error over {outcome.settings.num_held_out} whole tosses: {held}. "
        f"Residuals follow one another (correlation {best.correlation:.2f}): they are error of the model, which intervals lack."
    )


def warnings(outcome: Outcome) -> list[str]:
    """Tell what the results of the searches warn of."""
    return [f"{name}: {text}" for name, fit in outcome.fits.items() for text in fit.warnings]


def _quantity(name: str, value: float, error: float | None) -> str:
    scale = SHOWN[name][2]
    return quantity(scale * value, scale * error) if error else f"{scale * value:.4g}"


def _errors(judged: Float[np.ndarray, "tosses 4"]) -> str:
    place, turn = judged.mean(axis=0)[:2]
    return f"{100 * place:.1f}% and {turn:.1f}°"


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate what was found, and what it is worth."""
    heads = {name: f"{label} ({unit.strip()})" if unit else label for name, (label, unit, _) in SHOWN.items()}
    numbers = {name: (values, {}) for name, values in GIVEN.items()}
    numbers |= {name: (fit.values, fit.half_width) for name, fit in outcome.fits.items()}
    rows = [
        {"": name} | {head: _quantity(n, values[n], widths.get(n)) for n, head in heads.items()}
        for name, (values, widths) in numbers.items()
    ]
    caption = "Numbers of the cube, with 95% intervals where they were looked for; the others stay nominal."
    found = tabulated(rows, caption)
    ends = [
        {"": name, "side off by": _signed(off(fit)), "rms before": f"{fit.rms[0]:.2f}", "after": f"{fit.rms[1]:.2f}"}
        | {"correlation": f"{fit.correlation:.2f}", "ended": fit.stopped, "steps": str(fit.num_steps)}
        | {"s": f"{fit.seconds:.0f}"}
        for name, fit in outcome.fits.items()
    ]
    units = f"residuals in units of {1e3 * outcome.settings.noise:g} mm"
    searched = tabulated(ends, f"The searches, over {outcome.num_windows} windows; {units}.")
    shown = (
        ("position, mean (%)", "position_error", 100.0),
        ("median (%)", "position_median", 100.0),
        ("mean (mm)", "position_error", 1e3 * SIDE),
        ("turn, mean (°)", "turn_error_degrees", 1.0),
        ("median (°)", "turn_median_degrees", 1.0),
        ("early (mm)", "early_position_error", 1e3 * SIDE),
        ("early (°)", "early_turn_error_degrees", 1.0),
    )
    means = {name: _means(judged) for name, judged in outcome.judged.items()}
    worth = [{"": name} | {head: f"{k * one[key]:.1f}" for head, key, k in shown} for name, one in means.items()]
    caption = (
        f"Error over {outcome.settings.num_held_out} tosses that were held out, rolled out whole from their first state in "
        "C MuJoCo: of the centre, in per cent of the published side, and of the orientation. Early: until 0.1 s after the first "
        "touch. Of Acosta et al. are friction and softness; their cube was a box, with pyramidal cones."
    )
    return [tabulated(worth, caption), found, searched]


_COLOURS: Mapping[str, str] = {"nominal": MUTED, "fitted by Acosta et al.": ZEROTH, BEST: ONSET}


def drawings(outcome: Outcome) -> Drawings:
    """Draw the figures in order of reading."""
    return {"errors": held_out(outcome), "toss": one_toss(outcome)}


def held_out(outcome: Outcome):
    """Side by each way, and errors of all tosses that were held out."""
    figure, axes = subplots(1, 3, height=3.8, width_ratios=[1.1, 1, 1])
    left, *others = axes[0]
    names = list(outcome.fits)
    shares = [100 * off(outcome.fits[name]) for name in names]
    widths = [100 * outcome.fits[name].half_width["side"] / SIDE for name in names]
    left.axvspan(-100 * BAND, 100 * BAND, color=MUTED, alpha=0.18, lw=0, label="DiffMJX, about 5 %")
    left.axvline(0, color=REFERENCE, lw=0.9, label="published side")
    for i, (name, share, width) in enumerate(zip(names, shares, widths, strict=True)):
        left.errorbar(share, i, xerr=width, fmt="o", ms=5, capsize=3, color=ONSET if name == BEST else FIRST)
    left.set(
        yticks=range(len(names)), yticklabels=names, xlabel="off the published side, %", ylim=(len(names) - 0.5, -0.5)
    )
    left.set_xlim(-1.3 * max(5.0, *map(abs, shares)), 1.3 * max(5.0, *map(abs, shares)))
    left.legend(fontsize=8, loc="lower right")
    labels = (("error of the position, % of the side", 100.0), ("error of the turn, °", 1.0))
    for column, (axis, (label, scale)) in enumerate(zip(others, labels, strict=True)):
        for name, colour in _COLOURS.items():
            sizes = np.sort(scale * outcome.judged[name][:, column])
            axis.plot(sizes, np.arange(1, len(sizes) + 1) / len(sizes), color=colour, label=name)
        axis.set(xlabel=label, ylabel="share of tosses below", ylim=(0, 1.02), xscale="log")
        axis.minorticks_off()
        axis.set_xticks([2, 5, 10, 20, 50, 100])
        plain(axis.xaxis)
    handles, texts = others[0].get_legend_handles_labels()
    others[1].legend(handles, texts, fontsize=8, loc="upper left")
    caption = (
        "Left, the side that each search finds, with its 95% interval, which knows of noise alone. Middle and right, the errors "
        "over whole tosses that were held out: a curve further left is better."
    )
    return figure, "Side, and errors of tosses that were held out", caption


def one_toss(outcome: Outcome):
    """Height and turn of a toss in the middle, recorded and rolled out."""
    figure, axes = subplots(1, 2, height=3.6)
    toss = outcome.shown
    times = np.arange(len(toss.qpos)) / RATE
    courses = {"recorded": toss.qpos} | {name: outcome.courses[name] for name in _COLOURS}
    for name, course in courses.items():
        look = {"color": _COLOURS.get(name, REFERENCE), "lw": 2.2 if name == "recorded" else 1.3, "label": name}
        axes[0, 0].plot(times, 1e3 * course[:, 2], **look)
        axes[0, 1].plot(times, angle_between(course[:, 3:], toss.qpos[0, 3:]), **look)
    axes[0, 0].set(xlabel="time, s", ylabel="height of the centre, mm")
    axes[0, 1].set(xlabel="time, s", ylabel="turn since the release, °")
    legend_below(figure, axes[0, 0], 4)
    caption = f"Toss {toss.number}, held out; half of those tosses are foretold better. All begin in its first recorded state."
    return figure, "A toss that was held out", caption
