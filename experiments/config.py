"""A run's configuration: a TOML file, checked as a whole before anything heavy is imported."""

import importlib
import itertools
import json
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from experiments.failure import ConfigurationError, suggest
from experiments.mistakes import mistakes_of
from experiments.settings import RunSettings

FOLDER = Path(__file__).parent


@dataclass(frozen=True)
class Run:
    """One run, ready to start.

    Attributes:
        name: of the output folder; a combination of a sweep adds its own folder to it.
        settings: validated, defaults filled in.
        question: what the run answers, from the comment that opens the file.
        expected: the answer its author expects, from the same comment; may be empty.
        varied: the settings that set this run apart within its sweep, by dotted key.
    """

    name: str
    settings: RunSettings
    question: str
    expected: str
    varied: dict[str, Any]


def load_runs(file: str, overrides: list[str]) -> list[Run]:
    """Read a configuration: one run, or one per combination of its `[sweep]` table.

    Args:
        file: a path to a TOML file, or the name of one in `experiments/`.
        overrides: `key=value` in TOML syntax, dotted keys included. A key that the file sweeps is no longer swept.

    Returns:
        The runs in the order of the sweep, its last key changing fastest.

    Raises:
        ConfigurationError: naming every mistake in the file and the overrides.
    """
    path = find_file(file)
    text = path.read_text(encoding="utf-8")
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(path.name, [f"not TOML: {error}"]) from None
    problems = [problem for item in overrides if (problem := _apply(table, item))]
    sweep, sweep_problems = _take_sweep(table)
    combinations = [dict(zip(sweep, values, strict=True)) for values in itertools.product(*sweep.values())]
    question, expected = read_header(text)
    runs = []
    for varied in combinations:
        candidate = json.loads(json.dumps(table, default=str))
        for key, value in varied.items():
            _assign(candidate, key.split("."), value)
        _choose_size(candidate)
        settings, found = _validate(candidate, swept=set(sweep))
        problems += found
        runs.append(Run(path.stem, settings, question or path.stem, expected, varied))
    if problems or sweep_problems:
        raise ConfigurationError(path.name, problems + sweep_problems)
    return runs


def find_file(file: str) -> Path:
    """Find a configuration by path or by name.

    Args:
        file: a path to a TOML file, or the name of one in `experiments/`.

    Returns:
        The path of a file that exists.

    Raises:
        ConfigurationError: answering an unknown name with those there are.
    """
    path = Path(file)
    if path.is_file():
        return path
    if (FOLDER / f"{file}.toml").is_file():
        return FOLDER / f"{file}.toml"
    names = [known.stem for known in FOLDER.glob("*.toml")]
    raise ConfigurationError(file, [f"there is no such file; {suggest(path.stem, names)}"])


def read_header(text: str) -> tuple[str, str]:
    """Read the comment that opens a configuration.

    Args:
        text: of the TOML file.

    Returns:
        The question it asks, and what is expected (after the word "Expected:"); empty if there is none.
    """
    lines = itertools.takewhile(lambda line: line.startswith("#"), text.splitlines())
    comment = " ".join(line.lstrip("# ").strip() for line in lines)
    question, _, expected = comment.partition("Expected:")
    return question.strip(), expected.strip()


def kinds() -> list[str]:
    """List the kinds of experiment: the folders that hold settings."""
    return sorted(path.parent.name for path in FOLDER.glob("*/settings.py"))


def _choose_size(table: dict[str, Any]) -> None:
    """Put the one of the tables `[sizes.*]` that `size` names in the place of all; single values in `[sizes]` win over it."""
    sizes = table.get("sizes")
    if not isinstance(sizes, dict):
        return
    named = {key: value for key, value in sizes.items() if isinstance(value, dict)}
    if named:
        # A size that is not there is answered when the settings are checked, with those there are.
        chosen = named.get(str(table.get("size", "default")), next(iter(named.values())))
        table["sizes"] = chosen | {key: value for key, value in sizes.items() if key not in named}


def _validate(table: dict[str, Any], swept: set[str]) -> tuple[Any, list[str]]:
    """Check a table against the settings of its kind: these or None, and one sentence per mistake."""
    kind = table.get("experiment")
    if kind not in kinds():
        named = f'there is no experiment "{kind}"; ' if kind is not None else "required, and missing; "
        return None, [f"experiment: {named}{suggest(str(kind), kinds())}"]
    settings = importlib.import_module(f"experiments.{kind}.settings").Settings
    try:
        # Through JSON, where a strict model takes an array for a tuple; TOML's dates become strings and are refused.
        return settings.model_validate_json(json.dumps(table, default=str), strict=True), []
    except ValidationError as error:
        return None, mistakes_of(settings, error, swept)


def _apply(table: dict[str, Any], override: str) -> str | None:
    """Write one `key=value` into a table; returns what is wrong with it."""
    key, equals, value = override.partition("=")
    key, value = key.strip(), value.strip()
    if not equals or not re.fullmatch(r"[A-Za-z0-9_-]+(\.[A-Za-z0-9_-]+)*", key):
        return f'{override}: not an override; write key=value, such as seed=1 or softness.stiffness="[1e3, 1e4]"'
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        # A shell eats the quotes of a TOML string, so a bare word stands for one, alone or in a list.
        words = value[1:-1].split(",") if value.startswith("[") and value.endswith("]") else [value]
        words = [word.strip() for word in words]
        if not all(re.fullmatch(r"[A-Za-z_][\w./-]*", word) for word in words):
            return f"{override}: {value or 'nothing'} is not a TOML value"
        parsed = words if value.startswith("[") else value
    if isinstance(table.get("sweep"), dict):
        table["sweep"].pop(key, None)
    return _assign(table, key.split("."), parsed)


def _assign(table: dict[str, Any], keys: list[str], value: object) -> str | None:
    *parents, last = keys
    for parent in parents:
        table = table.setdefault(parent, {})
        if not isinstance(table, dict):
            return f"{'.'.join(keys)}: {parent} is a value, not a table"
    table[last] = value
    return None


def _take_sweep(table: dict[str, Any]) -> tuple[dict[str, list[Any]], list[str]]:
    """Take the `[sweep]` table out of a configuration: dotted key -> the values it takes."""
    sweep, problems = table.pop("sweep", {}), []
    if not isinstance(sweep, dict):
        return {}, [f"sweep: must be a table of arrays, got {sweep!r}"]
    flat = _flatten(sweep)
    for key in [key for key, values in flat.items() if not isinstance(values, list) or not values]:
        problems.append(f"sweep.{key}: must be an array of at least one value, got {flat.pop(key)!r}")
    return flat, problems


def _flatten(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in table.items():
        flat |= _flatten(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat
