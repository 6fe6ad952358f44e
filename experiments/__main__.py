"""The command line: `python -m experiments run FILE.toml [key=value ...]`, `list` and `gallery`."""

import argparse
import signal
import sys
import tomllib
from pathlib import Path

from experiments.config import FOLDER, ExperimentError, read_header
from experiments.runner import run_file, write_gallery


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; the exit status is 0, 2 for a refusal that was explained, or 130 for an interruption."""
    options = _parse(arguments)
    # A run that is asked to stop clears up as it does for Ctrl-C.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        if options.command == "list":
            return _list()
        if options.command == "gallery":
            write_gallery(options.output)
            return 0
        run_file(options.file, options.overrides, output=options.output, force=options.force)
    except KeyboardInterrupt:
        print("\ninterrupted; earlier results are as they were", file=sys.stderr)
        return 130
    # What the library refuses, it refuses with these and in a sentence; anything else is a mistake in the program.
    except (ExperimentError, ValueError, FloatingPointError, MemoryError) as error:
        if options.debug:
            raise
        print(str(error) or type(error).__name__, file=sys.stderr)
        return 2
    except RuntimeError as error:
        first = str(error).partition("\n")[0]
        # JAX's word for what NumPy says by a MemoryError, and MuJoCo's when it refuses to be imported.
        told = {
            "RESOURCE_EXHAUSTED": f"not enough memory; take fewer samples ({first})",
            "invalid value for environment variable MUJOCO_GL": f'{first}; unset it, or take "egl", "osmesa" or "glfw"',
        }
        known = next((said for word, said in told.items() if first.startswith(word)), None)
        if options.debug or known is None:
            raise
        print(known, file=sys.stderr)
        return 2
    return 0


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m experiments", description="Run experiments on mjxgrad.")
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run", help="run one configuration, or each combination of its sweep")
    run.add_argument("file", help="a TOML file, or the name of one in experiments/")
    run.add_argument("overrides", nargs="*", metavar="key=value", help="settings to change, in TOML syntax")
    run.add_argument("--output", type=_folder, default=Path("runs"), help="folder for results (default: runs)")
    run.add_argument("--force", action="store_true", help="run even if nothing has changed")
    run.add_argument("--debug", action="store_true", help="show tracebacks")
    commands.add_parser("list", help="list the configurations there are").set_defaults(debug=False)
    gallery = commands.add_parser("gallery", help="write one page over all results, index.html")
    gallery.add_argument("--output", type=_folder, default=Path("runs"), help="folder of results (default: runs)")
    gallery.set_defaults(debug=False)
    options, rest = parser.parse_known_args(arguments)
    # argparse takes overrides on one side of an option only; those on its other side are left over.
    if options.command != "run" or any(item.startswith("-") for item in rest):
        if rest:
            parser.error(f"unrecognised arguments: {' '.join(rest)}")
    else:
        options.overrides += rest
    return options


def _folder(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError("must name a folder, got ''")
    return Path(text)


def _list() -> int:
    for path in sorted(FOLDER.glob("*.toml")):
        text = path.read_text(encoding="utf-8")
        kind = tomllib.loads(text).get("experiment", "?")
        print(f"{path.stem:<16} {kind:<14} {read_header(text)[0]}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
