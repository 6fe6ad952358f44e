"""The README's examples run as printed."""

import re
from pathlib import Path


def test_the_examples_run_as_printed(capsys):
    """Six lines of numbers, finite, after the summary; then a throw that clears the wall, which starts at 0.65 rad."""
    text = (Path(__file__).parents[1] / "README.md").read_text()
    examples = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    names = {}
    for example in examples:
        exec(compile(example, "README.md", "exec"), names)
    lines = [line for line in capsys.readouterr().out.splitlines() if "m²/rad" in line]
    assert len(lines) == 6
    assert not any("nan" in line for line in lines)
    assert names["result"].params > 0.65
    assert names["task"].cost(names["result"].params) < 0.01
