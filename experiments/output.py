"""Output folders that are complete or absent, never half-written."""

import contextlib
import csv
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from experiments.config import ExperimentError


@contextlib.contextmanager
def building(folder: Path) -> Iterator[Path]:
    """Build an output folder beside its place, and put it there only once it is complete.

    If the block raises, what it wrote is removed and the folder's former content stays.
    """
    partial = folder.with_name(f".{folder.name}.partial-{os.getpid()}")
    previous = folder.with_name(f".{folder.name}.previous")
    with writing(folder):
        _recover(folder, previous)
        partial.mkdir(parents=True)
    try:
        yield partial
        with writing(folder):
            _replace(folder, partial, previous)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


@contextlib.contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Turn an operating system's refusal into an `ExperimentError` that names the folder, the cause and the remedy."""
    try:
        yield
    except OSError as error:
        cause = (error.strerror or str(error)).lower()
        at = f" ({error.filename})" if error.filename and Path(error.filename) != folder else ""
        raise ExperimentError(
            f"cannot write the results to {folder}: {cause}{at}; "
            "free it, or name another folder with --output FOLDER. Earlier results are as they were."
        ) from error


def write_text(path: Path, text: str) -> None:
    """Write a file that is complete or absent."""
    partial = path.with_name(f".{path.name}.partial-{os.getpid()}")
    try:
        partial.write_text(text, encoding="utf-8")
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def write_csv(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write rows as CSV; what a row has nothing to say about is empty."""
    rows = list(rows)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(dict.fromkeys(key for row in rows for key in row)))
        writer.writeheader()
        writer.writerows(rows)


def write_toml(path: Path, table: Mapping[str, Any], header: str) -> None:
    """Write nested tables as TOML under a comment; None is left out."""
    lines = [f"# {line}" for line in header.splitlines()] + _toml_lines(table)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _toml_lines(table: Mapping[str, Any], prefix: str = "") -> list[str]:
    # JSON's strings, numbers and arrays are TOML's too, and so are its true and false.
    plain = {key: value for key, value in table.items() if value is not None and not isinstance(value, Mapping)}
    lines = [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in plain.items()]
    for key, value in table.items():
        if isinstance(value, Mapping):
            lines += ["", f"[{prefix}{key}]", *_toml_lines(value, f"{prefix}{key}.")]
    return lines


def keeping(folder: Path, fingerprint: str) -> Path:
    """Name a folder beside an output folder for what is finished of a run, by all that decides its result."""
    return folder.with_name(f".{folder.name}.kept-{fingerprint[:16]}")


def forget(folder: Path) -> None:
    """Remove what was kept of interrupted runs, once one has come to its end."""
    for kept in folder.parent.glob(f".{folder.name}.kept-*"):
        shutil.rmtree(kept, ignore_errors=True)


def _recover(folder: Path, previous: Path) -> None:
    """Clear up after a run that was killed: its remains go, and a result it had set aside comes back."""
    if previous.exists() and not folder.exists():
        previous.rename(folder)
    shutil.rmtree(previous, ignore_errors=True)
    for remains in folder.parent.glob(f".{folder.name}.partial-*"):
        process = int(remains.name.rpartition("-")[2])
        if not _is_running(process):
            shutil.rmtree(remains, ignore_errors=True)


def _replace(folder: Path, complete: Path, previous: Path) -> None:
    # A folder cannot be renamed onto a full one, so the old one steps aside for the moment between two renames.
    if folder.exists():
        folder.rename(previous)
    try:
        complete.rename(folder)
    except OSError:
        if previous.exists():
            previous.rename(folder)
        raise
    shutil.rmtree(previous, ignore_errors=True)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except OSError as error:
        return not isinstance(error, ProcessLookupError)
    return True
