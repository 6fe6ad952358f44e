"""What experiments/README says that there is, there is: each call, command and result that its table names."""

import re
import tomllib
from pathlib import Path

import pytest

import mjxgrad as mg
from mjxgrad.cli import app

_ROOT = Path(__file__).parents[2]
_PAGE = (_ROOT / "experiments/README.md").read_text(encoding="utf-8").split("## What there is, and what shows it")[1]
_ROWS = [line.strip("| ").split(" | ") for line in _PAGE.split("\n## ")[0].splitlines() if line.startswith("| ")][1:]
_TARGETS = set(re.findall(r"^([a-z_0-9-]+):", (_ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE))
_TARGETS |= {path.stem for path in (_ROOT / "experiments").glob("*.toml")}


def _exists(named: str) -> bool:
    kind, _, rest = named.partition(" ")
    if kind == "make":
        return rest.split()[0] in _TARGETS
    if kind == "mjxgrad":
        return rest.split()[0] in set(app)
    if named.startswith("tests/"):
        return (_ROOT / named).exists()
    found = mg
    for part in named.removeprefix("mg.").split("."):
        if not hasattr(found, part):
            return False
        found = getattr(found, part)
    return True


def _anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    titles = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("row", _ROWS, ids=lambda row: row[0])
def test_every_call_command_and_result_of_the_table_exists(row):
    _, shown, result = row
    named = re.findall(r"`([^`]+)`", shown)
    assert named
    assert [one for one in named if not _exists(one)] == []
    page, _, anchor = re.fullmatch(r"\[.*\]\((.*)\)", result).group(1).partition("#")
    assert anchor in _anchors(_ROOT / "experiments" / page)


def test_every_experiment_is_in_a_table():
    page = (_ROOT / "experiments/README.md").read_text(encoding="utf-8")
    names = {path.stem for path in (_ROOT / "experiments").glob("*.toml") if tomllib.loads(path.read_text("utf-8"))}
    assert {name for name in names if f"`{name}`" not in page} == set()
