"""The command line: check and sweep a scene, find its parameters, begin a program."""

import contextlib
import dataclasses
import functools
import importlib
import importlib.util
import io
import os
import shlex
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from mjxgrad._interrupts import COMES_AGAIN, finished
from mjxgrad._text import duration, write

try:
    import cyclopts
except ImportError:
    print("the command line needs cyclopts, not installed: pip install 'mjxgrad[cli]'", file=sys.stderr)
    sys.exit(2)

_ONE = 0.3  # s within which signals are one: `timeout` sends its own twice
Switch = Annotated[bool, cyclopts.Parameter(negative="")]
Whole = Annotated[int, cyclopts.Parameter(converter=lambda _, tokens: int(tokens[0].value))]  # cyclopts would round 1.5
Folder = Annotated[Path, cyclopts.Parameter(converter=lambda _, tokens: _folder(tokens[0].value))]
Several = cyclopts.Parameter(consume_multiple=1, negative="")  # values after one option, at least one


class CommandError(Exception):
    """A request that cannot be carried out; the message is a sentence for the user."""


app = cyclopts.App(
    name="mjxgrad",
    help="Differentiable rollouts on MuJoCo MJX.",
    result_action="return_value",
    suppress_keyboard_interrupt=False,
)

_SHOWN = threading.Event()  # set once a command has printed what it found


def main(arguments: list[str] | None = None) -> int:
    """Run the command line.

    The exit status is 0, 1 for faults that `check` found or values that `identify` did not, 2 for a refusal, 130 for an
    interruption. An interrupted command first prints and writes what it has measured, if anything.
    """
    interruptions: list[float] = []
    COMES_AGAIN.clear()  # of the program that calls a command
    _SHOWN.clear()

    def interrupt(*_: Any) -> None:
        if COMES_AGAIN.is_set():
            COMES_AGAIN.clear()
            raise KeyboardInterrupt
        is_first, now = not interruptions, time.monotonic()
        if not is_first and now - interruptions[0] < _ONE:
            return
        interruptions.append(now)
        with contextlib.suppress(OSError):  # a closed pipe
            os.write(
                2, b"interrupted: writing what there is; once more ends at once\n" if is_first else b"interrupted\n"
            )
        if not is_first:
            os._exit(130)
        raise KeyboardInterrupt

    former = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    if isinstance(sys.stdout, io.TextIOWrapper):  # a terminal without ± costs no result
        sys.stdout.reconfigure(errors="backslashreplace")
    status, warnings.formatwarning = 2, lambda message, *_, **__: f"{message}\n"  # without a line of the library's code
    try:
        status = app(arguments, exit_on_error=False, print_error=False) or 0
        if interruptions:  # the library has returned what was measured
            raise KeyboardInterrupt
    except KeyboardInterrupt:
        _say("interrupted" if _SHOWN.is_set() else "interrupted before there was anything to write")
        status = 130
        if arguments is None:  # as a command: nobody waits for work in other threads
            with contextlib.suppress(AttributeError, BrokenPipeError):  # a closed stdout
                sys.stdout.flush()
            os._exit(status)
    except BrokenPipeError:  # the reader of --help has closed the pipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = 0
    except cyclopts.CycloptsError as error:
        command = " ".join(["mjxgrad", *(error.command_chain or ())])
        _say(f"{str(error).rstrip('.')}; {command} --help lists what there is")
    # The library refuses by these errors, in a sentence; any other error is a bug.
    except (CommandError, ValueError, OSError, FloatingPointError, ImportError, MemoryError, RuntimeError) as error:
        _say(str(error) or type(error).__name__)
    finally:  # for programs that call a command
        for number, handler in former.items():
            signal.signal(number, handler or signal.SIG_DFL)
    return status


def _print(text: str, stream: Any) -> None:
    """Print at once; where the stream or its reader is closed, the work goes on for its exit status and its files."""
    if stream is None:
        return
    try:
        if stream is sys.stdout:
            _SHOWN.set()
        print(text, file=stream, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _say(text: str) -> None:
    _print(text, sys.stderr)


def _timed() -> Callable[[str], None]:
    """Return a function that says what is done, with the seconds since now."""
    started = time.monotonic()
    return lambda text: _say(f"{time.monotonic() - started:4.0f} s  {text}")


@app.command
def check(
    scene: str,
    *,
    cost: str | None = None,
    start: str | None = None,
    horizon: Whole | None = None,
    html: Path | None = None,
    quick: Switch = False,
    mjx: Switch = False,
    budget: float = 12.0,
    seed: Whole = 0,
) -> int:
    """Check whether and how a scene can be differentiated; the exit status is 1 where there are faults.

    Args:
        scene: an MJCF file.
        cost: file.py:function or module:function, from a trajectory to its cost; or height:body and others, see `sweep`.
        start: a key frame by name, about whose controls all motions are; by default all key frames and the reference pose.
        horizon: number of time steps over which derivatives are measured, such as your task's; by default 40 to 300, by first
            touches and the budget.
        html: write a page to this file.
        quick: only fast checks, in seconds: contact, time step, parts without effect, one value and derivative of the cost.
        mjx: compare a step by MJX with C MuJoCo's, too, which takes up to a minute to compile.
        budget: duration in s, about; the report names measurements that are left out.
        seed: seed of all random numbers.
    """
    _existing(scene)
    _writable(html, is_page=True, beside=(scene, _source(cost)))
    if not budget > 0:
        raise CommandError(f"--budget must be positive, got {budget:g}; --quick measures no derivatives")
    log = _timed()
    more = ", or what eight motions of so many steps take" * (horizon is not None and not quick)
    more += ", and a minute to compile" * mjx
    log(f"takes up to {10 if quick else budget + 8:.0f} s{more}; Ctrl-C ends it sooner")
    mg = _library()
    given = {"start": start, "horizon": horizon, "budget": budget, "seed": seed, "log": log}
    verdict = mg.check(scene, cost, derivatives=not quick, mjx=mjx, **given)
    _print(finished(verdict.summary), sys.stdout)
    if html is not None:
        finished(lambda: write(html, verdict.as_html()))
        log(f"wrote {html}")
    return 1 if verdict.faults else 0


@app.command
def sweep(
    scene: str,
    *,
    cost: str | None = None,
    start: str | None = None,
    horizon: Whole | None = None,
    stiffness: Annotated[list[float] | None, Several] = None,
    noise: float = 0.1,
    samples: Whole | None = None,
    gradient: Literal["slope", "discrete"] | None = None,
    engine: str | None = None,
    seed: Whole = 0,
    html: Path = Path("sweep.html"),
) -> None:
    """Measure bias and variance of first, zeroth and α-order gradients of a scene, over contact stiffness.

    Args:
        scene: an MJCF file.
        cost: file.py:function or module:function, from a trajectory to its cost, such as `def cost(course): return
            course.qpos[-1, 0]`; or at the end height:body, speed:body, upright:body, reach:body/site; by default a random
            mix of the heaviest body's final coordinates.
        start: a key frame by name, with its controls, about which the noise is; by default the first, else the reference pose.
        horizon: number of time steps; by default half a second, but 50 to 300 steps.
        stiffness: contact stiffnesses in 1/s², beside the file's own; by default 1e2 to 1e6, as far as the time step allows.
        noise: standard deviation on each control of each step, in halves of its range; without any, on velocities.
        samples: rollouts of each estimate; the truth takes sixteen times as many, without derivatives. By default 256, and by C
            MuJoCo fewer where these take more than two minutes, at least 64.
        gradient: the slope of the outcome, or the discrete one of each step; by default the slope, unless it errs twice as much.
        engine: mjx, or mujoco for C MuJoCo, which compiles nothing, the default on a CPU.
        seed: seed of all random numbers.
        html: the page to write.
    """
    _writable(html, is_page=True, beside=(scene, _source(cost)))
    log = _timed()
    mg = _library()
    given = {} if stiffness is None else {"stiffness": stiffness}
    given |= {"noise": noise, "num_samples": samples, "seed": seed, "log": log}
    given |= {"start": start, "horizon": horizon, "engine": engine}
    given |= {"contact": mg.stepping.own_motion(gradient) if gradient else None}
    found = mg.sweep(_existing(scene), cost, **given)
    _print(finished(lambda: str(found)), sys.stdout)
    finished(lambda: write(html, found.as_html()))
    log(f"wrote {html}")


@app.command
def identify(
    scene: str,
    *recordings: str,
    parameter: Annotated[list[str], Several],
    noise: Annotated[list[str], Several] = [],  # noqa: B006
    held_out: float = 0.2,
    start: str = "noisy",
    max_steps: Whole = 100,
    output: Folder = Path("identified"),
) -> int:
    """Find masses, friction, gains of a scene from recorded motions; the exit status is 1 where a value was not found.

    A recording is a CSV with a line of names, or an NPZ. It has a column time (s). The others are named by joints
    (positions), sensors and actuators (controls), or in full qpos:joint, qvel:joint, sensor:name, ctrl:actuator,
    act:actuator. An element with several numbers takes an index, qpos:root[0], or qpos[7] in the whole. The controls of
    all actuators are needed.

    Args:
        scene: an MJCF file.
        recordings: CSV or NPZ files, before the options.
        parameter: kind:name or kind:name=low..high. Kinds are mass, inertia (bodies), friction, stiffness, damping_ratio,
            width (geoms, geom/geom or nothing for all), damping, armature, friction_loss (joints), gear, gains
            (actuators; kp and kv of a position servo, kv of a velocity servo), delay, and fields of the model:
            jnt_stiffness:knee, body_pos[2]:shin. kind:one,other is one value for both, except an inertia.
        noise: name=standard deviation, of every measured column, or of qpos, qvel and sensors as a whole. Then the answer says
            whether more than noise is left; by default each signal is weighed by how much it varies.
        held_out: share for validation only: every n-th recording, or the end of a single one.
        start: noisy: as the first row says, as noisy as that, and what it lacks is the scene's pose, at rest; exact: this
            pose, at rest; the name of a key frame: exactly that; free: all unknown, to be found, too.
        max_steps: largest number of derivatives; ensembles of many motions are not counted.
        output: folder for params_x_hat.yaml, identified.xml and report.html, which are replaced where they are.
    """
    written = [output / name for name in ("params_x_hat.yaml", "identified.xml", "report.html")]
    for path in written:
        _writable(path, makes_folder=True, is_page=True, beside=(scene, *recordings))
    mg, log = _library(), _timed()
    parts = ("files", "page", "search")
    files, page, search = (importlib.import_module(f"mjxgrad.identification.{name}") for name in parts)
    if not recordings:
        raise CommandError("identify needs a recording: mjxgrad identify scene.xml motion.csv --parameter mass:torso")
    if max_steps < 1:
        raise CommandError(f"--max-steps must be at least 1, got {max_steps}")
    if len({os.path.realpath(path) for path in recordings}) < len(recordings):
        raise CommandError(f"each recording must be named once, got {' '.join(recordings)}")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        loaded = mg.load_scene(_existing(scene), keep_everything=True)
    for one in told:
        if "MJX" not in str(one.message):  # C MuJoCo steps it here
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
    begin = _begin(mg, loaded, start)
    wanted = {text.partition("=")[0]: files.parameter(loaded, text) for text in parameter}
    if len(wanted) < len(parameter):
        raise CommandError(f"--parameter must name each parameter once, got {' '.join(parameter)}")
    motions = []
    sizes, left_out = dict(map(_number, noise)), []
    if len(sizes) < len(noise):
        raise CommandError(f"--noise must name each column once, got {' '.join(noise)}")
    for path in recordings:
        one, unknown = files.recording(loaded, _existing(path), sizes)
        if one.times[-1] > 200 * (len(one.times) - 1) * loaded.mj_model.opt.timestep:  # milliseconds, perhaps
            raise CommandError(f"time of {path} must be in seconds, got rows over 200 time steps of the scene apart")
        if unknown:
            left_out.append(f"\nNot of this scene, and left out of {path}: {', '.join(unknown)}.")
            log(left_out[-1].strip())  # a slip is seen before the search
        motions.append(dataclasses.replace(one, start=begin))
    fitted, judged = files.hold_out(motions, held_out)
    several = lambda many, word: f"{len(many)} {word}{'s' * (len(many) != 1)}"  # noqa: E731
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CommandError(f"{output} cannot be made: {error.strerror}") from error
    log(f"{several(wanted, 'parameter')}, {several(fitted, 'motion')} to fit, {len(judged)} held out")
    if any(path.exists() for path in written):
        log(f"replaces the results in {output} at the end; to keep them name another --output")
    given = {"delay": "delay" if "delay" in wanted else None, "free_start": True if start == "free" else None}
    log(mg.identification.outlook(loaded, wanted, fitted, **given).summary())

    def say(step: int, metrics: dict[str, float]) -> None:
        log(search.as_text(step, metrics, bool(noise)))

    result = mg.identify(loaded, wanted, fitted, held_out=judged, max_steps=max_steps, log=say, **given)
    _print(finished(lambda: "\n".join([result.headline, "", result.summary(), *left_out])), sys.stdout)
    if not result.is_measured:
        return 1
    finished(lambda: result.save(output / "params_x_hat.yaml"))
    finished(lambda: files.write_xml(loaded, result.scene, scene, output / "identified.xml"))
    log(f"wrote {output}/params_x_hat.yaml, identified.xml")
    text = finished(lambda: page.identified_page(Path(scene).name, loaded, result, fitted, judged))
    write(output / "report.html", text)
    log(f"wrote {output}/report.html")
    return 0 if result.is_sound else 1


@app.command
def new(
    scene: str,
    *,
    output: Path = Path("task.py"),
    start: str | None = None,
    horizon: Whole | None = None,
    force: Switch = False,
) -> None:
    """Write a program that optimises a motion of a scene and films it, with the settings that a check recommends.

    Args:
        scene: an MJCF file, with actuators.
        output: the program to write.
        start: a key frame by name, from which its motion begins; by default the first, else the reference pose.
        horizon: number of time steps of its motion; by default half a second, but 50 to 300 steps.
        force: overwrite an existing program.
    """
    if output.suffix != ".py":  # of the same name with .mp4 is its film
        raise CommandError(f"{output} must be named as a program, such as {output.with_suffix('.py')}")
    if output.exists() and not force:
        raise CommandError(f"{output} exists already; name another --output, or replace it with --force")
    _writable(output, beside=(scene,))
    _existing(scene)
    mg, log = _library(), _timed()
    quick = importlib.import_module("mjxgrad.engines").QUICK
    if not mg.load_scene(scene, engine=quick).mj_model.nu:
        raise CommandError(f"{scene} has no actuators; the README's first example varies the start of such a scene")
    log("checks the scene for up to 20 s; Ctrl-C ends that sooner")
    verdict = mg.check(scene, start=start, horizon=horizon, log=log)
    program = importlib.import_module("mjxgrad.checking.check").program
    text, seconds = program(verdict, str(Path(scene)), output)
    write(output, text)
    told = f"write your cost into it, then {shlex.join(['python', str(output)])}, which takes about {duration(10 + seconds)}"
    _print(f"{verdict.headline}\nwrote {output}: {told}", sys.stdout)
    if not all(map(importlib.util.find_spec, ("mediapy", "imageio_ffmpeg"))):
        _say("its video needs packages that are missing: pip install 'mjxgrad[render]'")


@functools.cache
def _library() -> Any:
    """Return mjxgrad in double precision, which distinguishes jumps from slopes."""
    import jax

    from mjxgrad.batched.device import all_devices

    jax.config.update("jax_enable_x64", True)
    try:
        all_devices()
    except (AssertionError, RuntimeError) as error:  # JAX asserts where JAX_PLATFORMS names a missing platform
        asked = os.environ.get("JAX_PLATFORMS")
        of = f" of JAX_PLATFORMS={asked}: unset it" if asked else ":"
        raise CommandError(f"JAX finds no device{of} {error}".rstrip(" :")) from error
    library = importlib.import_module("mjxgrad")
    library.keep_compiled()
    return library


def _begin(mg: Any, scene: Any, start: str) -> Any:
    """Return the state of an exact start; None for one that the recording tells."""
    if start in ("noisy", "free"):
        return None
    keys = [name for i in range(scene.mj_model.nkey) if (name := scene.mj_model.key(i).name)]
    if start not in ("exact", *keys):
        known = ", ".join(keys) or "of which this scene has none"
        raise CommandError(f"--start must be noisy, exact, free or a key frame ({known}), got {start}")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        state = mg.initial_state(scene, keyframe=None if start == "exact" else start)
    for one in told:  # the advice of the library is for Python
        text = str(one.message).replace("give qpos or keyframe", "name a key frame, --start NAME, or start as recorded")
        warnings.warn_explicit(text, one.category, one.filename, one.lineno)
    return state


def _number(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError:
        raise CommandError(f"--noise must be name=number, got {text}") from None


def _folder(name: str) -> Path:
    if not name:
        raise ValueError("it must be named")  # Path('') is the current folder
    return Path(name)


def _existing(path: str) -> str:
    if Path(path).is_dir():
        raise CommandError(f"{path} is a folder: name a file in it")
    if not Path(path).is_file():
        raise CommandError(f"there is no file {path}")
    return path


def _source(cost: str | None) -> str:
    """Return the file of a cost, should it be in one."""
    source = (cost or "").rpartition(":")[0]
    return source if source.endswith(".py") else f"{source.replace('.', '/')}.py"


def _writable(
    path: Path | None, *, makes_folder: bool = False, is_page: bool = False, beside: tuple[str, ...] = ()
) -> None:
    """Refuse in advance an output that cannot be written, would replace an input, or is a page without packages for pages."""
    if path is None:
        return
    if replaced := [one for one in beside if path.exists() and Path(one).exists() and path.samefile(one)]:
        raise CommandError(f"{path} would replace {replaced[0]}, which is read; name another output")
    folders = path.absolute().parents
    there = next(folder for folder in folders if folder.exists()) if makes_folder else folders[0]
    if path.exists() and not path.is_file():
        raise CommandError(f"{path} cannot be written: it is not a file")
    if not there.is_dir() or not os.access(there, os.W_OK):
        raise CommandError(f"{path} cannot be written: {there} must be an existing folder that can be written to")
    if is_page:
        importlib.import_module("mjxgrad.report").require()
