"""Sentences about all that is wrong with a table of settings."""

import json
import types
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from experiments.failure import suggest


def mistakes_of(settings: type[BaseModel], error: ValidationError, swept: set[str]) -> list[str]:
    """Give one sentence per mistake.

    Args:
        settings: that a table was checked against.
        error: what that found.
        swept: dotted keys whose value came from the `[sweep]` table, for the paths in the answer.

    Returns:
        In the order in which they were found.
    """
    return [_sentence(settings, detail, swept) for detail in error.errors() if not _follows(detail, error)]


def _follows(detail: ErrorDetails, error: ValidationError) -> bool:
    """Tell whether an array is only too short for the mistakes within it, which are reported themselves."""
    place = detail["loc"]
    inner = (other["loc"][: len(place)] for other in error.errors() if len(other["loc"]) > len(place))
    return detail["type"] == "too_short" and place in inner


def _sentence(settings: type[BaseModel], detail: ErrorDetails, swept: set[str]) -> str:
    # Pydantic puts a union's branch into the path too; only names of settings and positions in arrays help a reader.
    parts, owner = _walk(settings, detail["loc"])
    path = ".".join(parts)
    swept_path = f"sweep.{path}" if path in swept else path
    given = json.dumps(detail.get("input"), ensure_ascii=False)
    match detail["type"]:
        case "extra_forbidden":
            return f"{swept_path}: unknown key; {suggest(parts[-1], owner.model_fields)}"
        case "missing":
            return f"{swept_path}: required, and missing"
        case "literal_error":
            expected = detail.get("ctx", {}).get("expected", "").replace("'", "")
            choices = expected.replace(" or ", ", ").split(", ")
            return f"{swept_path}: there is no {given}; {suggest(str(detail.get('input')), choices)}"
        case "too_short":
            return f"{swept_path}: must hold at least {detail.get('ctx', {}).get('min_length')}, got {given}"
        case "value_error":
            reason = detail["msg"].removeprefix("Value error, ")
            return f"{swept_path}: {reason}" if path else reason
    reason = detail["msg"].removeprefix("Input should be ").removeprefix("a valid ")
    return f"{swept_path}: must be {reason}, got {given}"


def _walk(settings: type[BaseModel], location: tuple[int | str, ...]) -> tuple[list[str], type[BaseModel]]:
    """Follow an error's location through nested settings: its readable parts, and the last table on its way."""
    owner, table, parts = settings, settings, []
    for step in location:
        if isinstance(step, int):
            parts[-1] = f"{parts[-1]}[{step}]"
            continue
        if not parts or table is not None:
            parts.append(step)
            owner = table or owner
            field = owner.model_fields.get(step)
            table = _nested(field.annotation) if field else None
    return parts, owner


def _nested(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and not isinstance(annotation, types.GenericAlias):
        return annotation if issubclass(annotation, BaseModel) else None
    return next((found for argument in get_args(annotation) if (found := _nested(argument))), None)
