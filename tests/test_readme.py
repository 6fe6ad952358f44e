"""The examples of the README and of the library's own page run as printed."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

_ROOT = Path(__file__).parents[1]


def _run(page, names):
    for example in re.findall(r"```python\n(.*?)```", (_ROOT / page).read_text(), flags=re.DOTALL):
        exec(compile(example, page, "exec"), names)
    return names


def test_the_readmes_examples_run_and_their_derivative_is_the_slope():
    """The slope of the throw over 10 cm/s, to a tenth; then a throw that clears the wall, which starts at 0.65 rad."""
    names = _run("README.md", {})
    distance, velocity = jax.jit(names["distance"]), names["velocity"]
    derivative = jax.jit(jax.grad(names["distance"]))(velocity)
    steps = 0.05 * jnp.eye(3)
    slopes = [(distance(velocity + step) - distance(velocity - step)) / 0.1 for step in steps]
    np.testing.assert_allclose(derivative, slopes, atol=0.1 * np.abs(slopes).max())
    assert names["result"].params > 0.65
    assert names["task"].cost(names["result"].params) < 0.01


def test_the_library_pages_example_prints_both_estimates_finite(capsys):
    """Six lines of numbers after the summary."""
    _run("mjxgrad/README.md", {})
    lines = [line for line in capsys.readouterr().out.splitlines() if "m²/rad" in line]
    assert len(lines) == 6
    assert not any("nan" in line for line in lines)
