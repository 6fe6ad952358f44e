"""The command line: `python -m experiments run FILE.toml [key=value ...]`, `list`, `gallery` and the benchmarks."""

import importlib.metadata
import signal
import sys
import tomllib
from pathlib import Path
from typing import Annotated

import cyclopts

from experiments.config import FOLDER, ExperimentError, read_header
from experiments.runner import run_file, write_gallery

app = cyclopts.App(
    name="python -m experiments",
    help="Run experiments on mjxgrad, and benchmarks of it.",
    version=lambda: importlib.metadata.version("mjxgrad"),
    result_action="return_value",
    suppress_keyboard_interrupt=False,
)
# Named by their place, for they import JAX, which a configuration is checked before.
for _name, (_place, _help) in {
    "bench": ("benchmarks:bench", "Measure speed and memory against mjx.step."),
    "costs": ("benchmarks:costs", "Measure what onset, slope at MuJoCo's motion and smoothing cost."),
    "engines": ("benchmarks:engines", "Measure a gradient by C MuJoCo, by MJX and by hand."),
    "throughput": ("benchmarks:throughput", "Measure a sweep over softness in one program against ten."),
    "rates": ("receding_horizon:rates", "Measure how often a robot can be planned for, beside a plain iLQR."),
    "gradient-audit": ("gradient_audit:gradient_audit", "Measure along which gradients of a policy its return rises."),
    "identify-bench": ("identification_bench:identify", "Measure identification against mujoco.sysid."),
}.items():
    app.command(f"experiments.{_place}", name=_name, help=_help)


def _is_named(_: type, path: Path) -> None:
    if path == Path():
        raise ValueError("must name a folder")


_Folder = Annotated[Path, cyclopts.Parameter(validator=_is_named)]


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; the exit status is 0, 2 for a refusal that was explained, or 130 for an interruption."""
    # A run that is asked to stop clears up as it does for Ctrl-C.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    is_debugged = "--debug" in (sys.argv if arguments is None else arguments)
    try:
        app(arguments, exit_on_error=False, print_error=False)
        return 0
    except KeyboardInterrupt:
        print("\ninterrupted; earlier results are as they were", file=sys.stderr)
        return 130
    except cyclopts.CycloptsError as error:
        print(f"{str(error).rstrip('.')}; python -m experiments --help lists the commands", file=sys.stderr)
        return 2
    # What the library refuses, it refuses with these and in a sentence; anything else is a mistake in the program.
    except (ExperimentError, ValueError, FloatingPointError, MemoryError) as error:
        if is_debugged:
            raise
        print(str(error) or type(error).__name__, file=sys.stderr)
        return 2
    except RuntimeError as error:
        first = str(error).partition("\n")[0]
        # JAX's word for what NumPy says by a MemoryError.
        if is_debugged or not first.startswith("RESOURCE_EXHAUSTED"):
            raise
        print(f"not enough memory; take fewer samples ({first})", file=sys.stderr)
        return 2


@app.command
def run(
    file: str, /, *overrides: str, output: _Folder = Path("runs"), force: bool = False, debug: bool = False
) -> None:
    """Run one configuration, or each combination of its sweep.

    Args:
        file: a TOML file, or the name of one in experiments/.
        overrides: key=value, settings to change, in TOML syntax.
        output: the folder for results.
        force: run even if nothing has changed.
        debug: show tracebacks.
    """
    run_file(file, list(overrides), output=output, force=force)


@app.command
def gallery(*, output: _Folder = Path("runs")) -> None:
    """Write one page over all results, index.html.

    Args:
        output: the folder of results.
    """
    write_gallery(output)


@app.command(name="list")
def list_all() -> None:
    """List the configurations there are."""
    for path in sorted(FOLDER.glob("*.toml")):
        text = path.read_text(encoding="utf-8")
        kind = tomllib.loads(text).get("experiment", "?")
        print(f"{path.stem:<16} {kind:<14} {read_header(text)[0]}")


if __name__ == "__main__":
    sys.exit(main())
