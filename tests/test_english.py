"""Docstrings are plain English: no line of them begins in the middle of a thought."""

import ast
import re
from pathlib import Path

import mjxgrad

ROOT = Path(mjxgrad.__file__).parent
# "scene: that was checked" sends the reader back for the noun; "scene: the scene that was checked" does not.
DANGLING = re.compile(r"\s*\W{0,2}(\w+: )?(of|that|by|likewise|what)\b(?!:)", re.IGNORECASE)


def test_no_line_of_a_docstring_begins_with_a_dangling_word():
    paths = [*ROOT.rglob("*.py")]
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef)
    nodes = [
        (path, node) for path in paths for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, kinds)
    ]
    lines = [(path.name, line) for path, node in nodes for line in (ast.get_docstring(node) or "").splitlines()]
    assert len(lines) > 1000
    assert not [(name, line) for name, line in lines if DANGLING.match(line)]
