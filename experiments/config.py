"""A run's configuration: a TOML file, checked as a whole before anything heavy is imported."""

import copy
import difflib
import importlib
import itertools
import json
import re
import tomllib
import types
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from experiments.settings import RunSettings

FOLDER = Path(__file__).parent
_MOST_SHOWN = 20


class ExperimentError(Exception):
    """A run that cannot go on, for a reason that one sentence explains: shown without a traceback."""


class ConfigurationError(ExperimentError):
    """Mistakes in a configuration, all of them at once: one sentence each, opened by the dotted path of its setting."""

    def __init__(self, source: str, mistakes: Iterable[str]):
        self.source = source
        self.mistakes = tuple(dict.fromkeys(mistakes))
        count = "a mistake" if len(self.mistakes) == 1 else f"{len(self.mistakes)} mistakes"
        more = [f"and {len(self.mistakes) - _MOST_SHOWN} more"] if len(self.mistakes) > _MOST_SHOWN else []
        super().__init__("\n  ".join([f"{source} has {count}:", *self.mistakes[:_MOST_SHOWN], *more]))


def suggest(given: str, choices: Iterable[str]) -> str:
    """Answer a wrong choice with the nearest one, or with all: the end of a sentence, such as `did you mean "seed"?`."""
    choices = list(choices)
    near = difflib.get_close_matches(given, choices, n=1, cutoff=0.6)
    return f'did you mean "{near[0]}"?' if near else f"choose one of {', '.join(sorted(choices))}"


@dataclass(frozen=True)
class Run:
    """One run, ready to start."""

    name: str  # of the output folder; a combination of a sweep adds its own folder to it
    settings: RunSettings  # validated, defaults filled in
    question: str  # what the run answers, from the comment that opens the file
    expected: str  # the answer its author expects, from the same comment; may be empty
    varied: dict[str, Any]  # the settings that set this run apart within its sweep, by dotted key


def load_runs(file: str, overrides: list[str]) -> list[Run]:
    """Read a configuration: one run, or one per combination of its `[sweep]` table, its last key changing fastest.

    Overrides are `key=value` in TOML syntax, dotted keys included; a key that the file sweeps is no longer swept. A
    `ConfigurationError` names every mistake in both.
    """
    path = find_file(file)
    try:
        # Windows' editors begin a file with a mark that TOML has no place for.
        text = path.read_text(encoding="utf-8-sig")
        return _load(path, text, tomllib.loads(text), overrides)
    except UnicodeDecodeError as error:
        raise ConfigurationError(path.name, [f"not UTF-8, at byte {error.start}; save it as UTF-8"]) from None
    # tomllib's own error, and Python's on a number of too many digits.
    except ValueError as error:
        told = str(error).replace("Cannot overwrite a value", "a key is given twice")
        told = told.replace("Invalid value", "invalid value, words need quotes")
        told = told.replace("Illegal character '\\n'", "a quote is not closed")
        raise ConfigurationError(path.name, [f"not TOML: {told}"]) from None


def _load(path: Path, text: str, table: dict[str, Any], overrides: list[str]) -> list[Run]:
    keys = [item.partition("=")[0].strip() for item in overrides]
    problems = [f"{key}: given twice" for i, key in enumerate(keys) if key in keys[:i]]
    problems += [problem for item in overrides if (problem := _apply(table, item))]
    sweep, sweep_problems = _take_sweep(table)
    question, expected = read_header(text)
    runs = []
    for values in itertools.product(*sweep.values()):
        varied, candidate = dict(zip(sweep, values, strict=True)), copy.deepcopy(table)
        wrong = [_assign(candidate, key.split("."), value) for key, value in varied.items()]
        problems += [f"sweep.{one}" for one in wrong if one]
        _choose_size(candidate)
        settings, found = _validate(candidate, swept=set(sweep))
        problems += found
        runs.append(Run(path.stem, settings, question or path.stem, expected, varied))
    if problems or sweep_problems:
        raise ConfigurationError(path.name, problems + sweep_problems)
    return runs


def find_file(file: str) -> Path:
    """Find a configuration by path or by name; an unknown one is answered with those there are."""
    path = Path(file)
    if path.is_file():
        return path
    if (FOLDER / f"{file}.toml").is_file():
        return FOLDER / f"{file}.toml"
    names = [known.stem for known in FOLDER.glob("*.toml")]
    raise ConfigurationError(file, [f"there is no such file; {suggest(path.stem, names)}"])


def read_header(text: str) -> tuple[str, str]:
    """Read the comment that opens a configuration: its question, and what is expected, after the word "Expected:"."""
    lines = itertools.takewhile(lambda line: line.startswith("#"), text.splitlines())
    comment = " ".join(line.lstrip("# ").strip() for line in lines)
    question, _, expected = comment.partition("Expected:")
    return question.strip(), expected.strip()


def kinds() -> list[str]:
    """List the kinds of experiment: the folders and the files that hold settings."""
    files = (path.stem for path in FOLDER.glob("*.py") if "\nclass Settings(" in path.read_text(encoding="utf-8"))
    return sorted([*files, *(path.parent.name for path in FOLDER.glob("*/settings.py"))])


def part(kind: str, name: str) -> types.ModuleType:
    """Import a kind's settings, measure, report or figures; a folder's figures may be in its report, and all in one file."""
    places = (f"{kind}.{name}", f"{kind}.report", kind)
    found = next(place for place in places if (FOLDER / f"{place.replace('.', '/')}.py").is_file())
    return importlib.import_module(f"experiments.{found}")


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
    if "experiment" not in table:
        return None, [f"experiment: required, and missing; choose one of {', '.join(kinds())}"]
    if (kind := table["experiment"]) not in kinds():
        return None, [f"experiment: there is no experiment {_shown(kind)}; {suggest(str(kind)[:100], kinds())}"]
    settings = part(kind, "settings").Settings
    try:
        # Through JSON, where a strict model takes an array for a tuple; TOML's dates become strings and are refused.
        return settings.model_validate_json(json.dumps(table, default=str), strict=True), []
    except ValidationError as error:
        details = error.errors()
        # An array that is only too short for the mistakes within it, which are reported themselves, is none.
        inner = {detail["loc"][:depth] for detail in details for depth in range(1, len(detail["loc"]))}
        details = [detail for detail in details if detail["type"] != "too_short" or detail["loc"] not in inner]
        # The search for the nearest key takes minutes for a hundred thousand; those that are not shown are counted alone.
        rest = [str(detail["loc"]) for detail in details[_MOST_SHOWN:]]
        return None, [*(_sentence(settings, detail, swept) for detail in details[:_MOST_SHOWN]), *rest]


def _sentence(settings: type[BaseModel], detail: ErrorDetails, swept: set[str]) -> str:
    path, owner = "", settings
    for step in detail["loc"]:
        owner = _table(owner, path) or owner
        path += f"[{step}]" if isinstance(step, int) else "." * bool(path) + (step or '""')
    shown = f"sweep.{path}" if path in swept else path
    context, given = detail.get("ctx", {}), _shown(detail.get("input"))
    match detail["type"]:
        case "extra_forbidden":
            return f"{shown}: unknown key; {suggest(str(detail['loc'][-1]), owner.model_fields)}"
        case "missing":
            return f"{shown}: required, and missing"
        case "literal_error":
            choices = context["expected"].replace("'", "").replace(" or ", ", ").split(", ")
            return f"{shown}: there is no {given}; {suggest(str(detail['input']), choices)}"
        case "too_short":
            return f"{shown}: must hold at least {context['min_length']}, got {given}"
        case "value_error":
            return f"{shown}: {context['error']}" if path else str(context["error"])
    reason = detail["msg"].removeprefix("Input should be ").removeprefix("a valid ")
    return f"{shown}: must be {reason}, got {given}"


def _shown(value: object) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 200 else f"{text[:200]}..."


def _table(owner: type[BaseModel], path: str) -> type[BaseModel] | None:
    """Return the table of settings within a field of another, by the end of its path; None if it is a value."""
    field = owner.model_fields.get(re.sub(r"\[\d+\]", "", path).rpartition(".")[2])
    inside = [field.annotation] if field else []
    for one in inside:
        if isinstance(one, type) and issubclass(one, BaseModel):
            return one
        inside += get_args(one)
    return None


def _apply(table: dict[str, Any], override: str) -> str | None:
    """Write one `key=value` into a table; returns what is wrong with it."""
    key, equals, value = override.partition("=")
    key, value = key.strip(), value.strip()
    if not equals or not re.fullmatch(r"[A-Za-z0-9_-]+(\.[A-Za-z0-9_-]+)*", key):
        return f'{override}: not an override; write key=value, such as seed=1 or softness.stiffness="[1e3, 1e4]"'
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except ValueError:
        # A shell eats the quotes of a TOML string, so what begins as a word or a path stands for one, alone or in a list.
        words = value[1:-1].split(",") if value.startswith("[") and value.endswith("]") else [value]
        words = [word.strip() for word in words]
        if not all(re.fullmatch(r"(\.{0,2}/)?[^\W\d].*", word) for word in words):
            return f"{override}: {value or 'nothing'} is not a TOML value; write a text as '{key}=\"text\"'"
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
    flat = flatten(sweep)
    for key in [key for key, values in flat.items() if not isinstance(values, list) or not values]:
        problems.append(f"sweep.{key}: must be an array of at least one value, got {flat.pop(key)!r}")
    for key, values in flat.items():
        # The second would be the first one's folder, and an answer more.
        if len({json.dumps(value, default=str) for value in values}) < len(values):
            problems.append(f"sweep.{key}: must differ, got a value more than once")
    return flat, problems


def flatten(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Give the values of nested tables by dotted key."""
    flat: dict[str, Any] = {}
    for key, value in table.items():
        flat |= flatten(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat
