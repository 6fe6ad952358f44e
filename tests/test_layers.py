"""The library's parts import in one direction, and any of them can be imported first."""

import ast
import builtins
import dis
import graphlib
import importlib
import pkgutil
import re
import types
from collections.abc import Iterator
from pathlib import Path

import experiments
import mjxgrad

ROOT = Path(mjxgrad.__file__).parent
# Each line may import those above it; parts of one line do not know each other.
ORDER = (
    ("_arrays", "_interrupts", "_mjx", "_text", "_warnings", "report"),
    ("_programs",),
    ("batched",),
    ("bodies",),
    ("contact", "solver"),
    ("stepping",),
    ("scene",),
    ("engines",),
    ("rollouts",),
    ("objective",),
    ("estimators",),
    ("loop",),
    ("baselines",),
    ("diagnostics", "identification", "planning"),
    ("tasks",),
    ("checking", "envs"),
    ("learning",),
    ("cli",),
    ("__main__",),
)
LINE = {part: i for i, line in enumerate(ORDER) for part in line}
MODULES = {
    ".".join(("mjxgrad", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__"): path
    for path in ROOT.rglob("*.py")
}


def _imported(module: str, *, only_on_loading: bool = False) -> Iterator[str]:
    """The modules that a module names in its import lines."""
    tree = ast.parse(MODULES[module].read_text())
    for node in tree.body if only_on_loading else ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if inner in MODULES else node.module
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def test_each_part_imports_only_what_stands_before_it():
    parts = [module for module in MODULES if module != "mjxgrad"]
    lines = [(m, t) for m in parts for t in _imported(m) if t in MODULES and t.split(".")[1:2] != m.split(".")[1:2]]
    backwards = [(m, t) for m, t in lines if t == "mjxgrad" or LINE[t.split(".")[1]] >= LINE[m.split(".")[1]]]
    assert not backwards


def test_one_file_asks_which_device():
    question = re.compile(r"default_backend|platform_dependent|register_lowering|\bjax\.(local_)?device(s|_count)\(")
    asking = {path.relative_to(ROOT).as_posix() for path in MODULES.values() if question.search(path.read_text())}
    assert asking == {"batched/device.py"}


def test_three_files_beside_the_engines_name_one():
    """A further engine is a file in `engines` and a line: names are chosen in a contact's records, a scene and its loader."""
    others = {
        "_mjx.py",
        "checking/check.py",
        "envs/brax.py",
        "tasks.py",
    }  # a module, an argument, brax's word, a folder
    naming = set()
    for path in MODULES.values():
        words = {node.value for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Constant)}
        naming |= {path.relative_to(ROOT).as_posix()} if words & {"mjx", "mujoco"} else set()
    naming = {name for name in naming if not name.startswith("engines/")}
    assert naming - others == {"scene/load.py", "scene/scene.py", "stepping/contact.py"}


def test_any_part_can_be_imported_first():
    """Python runs the packages around an imported module, too; only those that are already running it skips."""
    graph = {m: {t for t in _imported(m, only_on_loading=True) if t in MODULES} - {m} for m in MODULES}
    for module, targets in graph.items():
        around = {t.rsplit(".", i)[0] for t in targets for i in range(1, t.count(".") + 1)}
        targets |= {a for a in around if not f"{module}.".startswith(f"{a}.")}
    graphlib.TopologicalSorter(graph).prepare()


def _codes(code: types.CodeType) -> Iterator[types.CodeType]:
    yield code
    for part in code.co_consts:
        if isinstance(part, types.CodeType):
            yield from _codes(part)


def test_every_name_that_a_function_takes_from_its_module_is_there():
    """Linters leave undefined names to this test: shapes in annotations look like names to them."""
    missing = []
    for package in (mjxgrad, experiments):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if found.name.endswith((".brax", ".__main__")):  # an extra, and programs that would run
                continue
            module = importlib.import_module(found.name)
            for code in _codes(compile(Path(str(module.__file__)).read_text(), found.name, "exec")):
                names = {step.argval for step in dis.get_instructions(code) if step.opname == "LOAD_GLOBAL"}
                missing += [(found.name, name) for name in names - vars(module).keys() - vars(builtins).keys()]
    assert not missing
