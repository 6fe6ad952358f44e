"""The README's example runs as printed."""

import re
from pathlib import Path


def test_the_example_runs_as_printed(capsys):
    """Six lines of numbers, finite, after the summary."""
    text = (Path(__file__).parents[1] / "README.md").read_text()
    (example,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    exec(compile(example, "README.md", "exec"), {})
    lines = [line for line in capsys.readouterr().out.splitlines() if "m²/rad" in line]
    assert len(lines) == 6
    assert not any("nan" in line for line in lines)
