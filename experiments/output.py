"""Output folders that are complete or absent, never half-written."""

import contextlib
import csv
import errno
import fcntl
import glob
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TextIO

from experiments.config import ExperimentError


@contextlib.contextmanager
def building(folder: Path) -> Iterator[Path]:
    """Build an output folder beside its place, and put it there only once it is complete.

    If the block raises, what it wrote is removed and the folder's former content stays. Another run that is at work on the same
    folder is an `ExperimentError`.
    """
    partial = folder.with_name(f".{folder.name}.partial-{os.getpid()}")
    with _alone(folder):
        with writing(folder):
            partial.mkdir()
        try:
            yield partial
            with writing(folder):
                _replace(folder, partial, _previous(folder))
        finally:
            shutil.rmtree(partial, ignore_errors=True)
        # What was kept of interrupted runs has served once one has come to its end.
        for kept in _beside(folder, "kept-*"):
            shutil.rmtree(kept, ignore_errors=True)


def recover(folder: Path) -> None:
    """Clear up after a run that was killed: its remains go, and a result it had set aside comes back.

    Where another run is at work, or nothing may be written, all stays as it is.
    """
    if _previous(folder).exists() or any(_beside(folder, "partial-*")):
        with contextlib.suppress(ExperimentError), _alone(folder):
            pass


@contextlib.contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Turn an operating system's refusal into an `ExperimentError` that names the folder, the cause and the remedy."""
    try:
        yield
    except OSError as error:
        # A folder to be made where there is a file: "file exists" would puzzle whoever means the folder.
        cause = "not a directory" if isinstance(error, FileExistsError) else (error.strerror or str(error)).lower()
        remedy = "free some space, or name" if error.errno in (errno.ENOSPC, errno.EDQUOT) else "name"
        at = f" ({error.filename})" if error.filename and Path(error.filename) != folder else ""
        raise ExperimentError(
            f"cannot write the results to {folder}: {cause}{at}; "
            f"{remedy} another folder with --output FOLDER. Earlier results are as they were."
        ) from error


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file that is complete or absent."""
    partial = path.with_name(f".{path.name}.partial-{os.getpid()}")
    try:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)
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
    plain = {key: value for key, value in table.items() if value is not None and not isinstance(value, Mapping)}
    lines = [f"{key} = {_toml(value)}" for key, value in plain.items()]
    for key, value in table.items():
        if isinstance(value, Mapping):
            lines += ["", f"[{prefix}{key}]", *_toml_lines(value, f"{prefix}{key}.")]
    return lines


def _toml(value: Any) -> str:
    """Write a value as TOML, each of several tables on a line of its own."""
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{key} = {_toml(one)}' for key, one in value.items() if one is not None)} }}"
    if isinstance(value, list):
        lines, has_tables = [_toml(one) for one in value], any(isinstance(one, Mapping) for one in value)
        return "[\n    " + ",\n    ".join(lines) + ",\n]" if has_tables else f"[{', '.join(lines)}]"
    # JSON's strings and numbers are TOML's too, and so are its true and false.
    return json.dumps(value, ensure_ascii=False)


def keeping(folder: Path, fingerprint: str) -> Path:
    """Name a folder beside an output folder for what is finished of a run, by all that decides its result."""
    return folder.with_name(f".{folder.name}.kept-{fingerprint[:16]}")


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold an output folder against other runs, and begin by clearing up after one that was killed."""
    lock = folder.with_name(f".{folder.name}.lock")
    with writing(folder):
        lock.parent.mkdir(parents=True, exist_ok=True)
        file = _locked(lock, folder)
    try:
        with writing(folder):
            _clear_up(folder)
        yield
    finally:
        lock.unlink(missing_ok=True)
        file.close()


def _locked(lock: Path, folder: Path) -> TextIO:
    """Lock a file. The system frees it with its process, however that ends: nothing has to be guessed of numbers of processes."""
    while True:
        file = lock.open("a+", encoding="utf-8")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            with file:
                raise ExperimentError(
                    f"another run (process {file.read() or 'unknown'}) is writing to {folder}; wait until it ends, or name "
                    "another folder with --output FOLDER"
                ) from None
        # The run that held it may have removed it in between; the name is then another file's, or none's.
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), lock.stat()):
                file.truncate(0)
                file.write(str(os.getpid()))
                file.flush()
                return file
        file.close()


def _clear_up(folder: Path) -> None:
    previous = _previous(folder)
    if previous.exists() and not folder.exists():
        previous.rename(folder)
    shutil.rmtree(previous, ignore_errors=True)
    for remains in _beside(folder, "partial-*"):
        # A run's ends in the number of its process; another name is somebody's own.
        if remains.name.removeprefix(f".{folder.name}.partial-").isdigit():
            shutil.rmtree(remains, ignore_errors=True)


def _previous(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.previous")


def _beside(folder: Path, pattern: str) -> list[Path]:
    return list(folder.parent.glob(f".{glob.escape(folder.name)}.{pattern}"))


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
