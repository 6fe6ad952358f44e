"""The examples of the README and of the library's own page run as printed."""

import importlib.util
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

_ROOT = Path(__file__).parents[1]


def _examples(page):
    return re.findall(r"```python\n(.*?)```", (_ROOT / page).read_text(), flags=re.DOTALL)


def _run(page, names):
    for example in _examples(page):
        exec(compile(example, page, "exec"), names)
    return names


def _moves_and_is_filmed(names):
    assert Path("cart.mp4").stat().st_size > 1000


def _finds_the_parameters(names):
    """Those that the recorded motion was made with, within twice the half width of their intervals."""
    result = names["result"]
    for name, true in {"friction": 0.7, "mass": 1.3, "damping": 1.5}.items():
        assert result.half_width[name] < 0.1 * true
        assert abs(result.values[name] - true) < 2 * result.half_width[name]


def _stands(names):
    """All 100 actions upright and near the origin earn 100 less a few; a pole that falls ends its episode before."""
    assert names["judged"].returns.mean() > 90
    obs = np.linspace(-0.3, 0.3, 6)
    np.testing.assert_allclose(names["act"](obs), names["learned"].policy(jnp.asarray(obs)), atol=1e-5)
    assert Path("balance.mp4").stat().st_size > 1000


def _pushes_the_ball_to_its_place(names):
    assert abs(names["data"].qpos[1] - 0.2) < 0.05


def _balances(names):
    """Upright, at 60 decisions a second and more."""
    assert abs(names["env"].unwrapped.data.qpos[1]) < 0.01
    assert np.median(names["balance"].seconds) < 1 / 60


def _reaches(names):
    """The hand is at the second place, 0.6 m from the first."""
    np.testing.assert_allclose(names["hand"](names["data"].qpos), [-0.3, 0.4], atol=0.02)


def _holds_and_learns(names):
    """Knocked to more than 0.05 rad, the pole stands again; the network's cost falls by half and more."""
    tilt = np.abs(names["knocked"].qpos[:, 1])
    assert tilt.max() > 0.05
    assert tilt[-1] < 0.01
    assert names["costs"][-1] < 0.5 * names["costs"][0]


def _descends_by_pytorch(names):
    """The throw begins 0.19 m short. The slope along it is the difference over 10 cm/s, within 2 %."""
    torch, apply = names["torch"], names["Miss"].apply
    assert names["loss"] < 1e-3
    start = torch.tensor([1.0, 0.0, -1.0], requires_grad=True)
    apply(start).backward()
    step = torch.tensor([0.05, 0.0, 0.0])
    slope = (apply(start.detach() + step) - apply(start.detach() - step)) / 0.1
    np.testing.assert_allclose(start.grad[0], slope, rtol=0.02)


def _rises(names):
    assert np.isfinite(names["result"].history.cost).all()
    assert isinstance(names["result"].params, type(names["network"]))


def _falls_and_swings(names):
    """One step of 2 ms under gravity; and sixteen copies of a cart-pole."""
    assert names["seen"].shape == (16, 5)
    np.testing.assert_allclose(names["data"].qvel[2], -9.81 * 0.002, rtol=1e-6)


def _tells_which_gradient_holds(names):
    """A block 2 mm before a wall gets farther with a push. The time step does not hold 1e6 1/s²: first order is biased there."""
    table = names["found"].result.table()
    assert (table["truth"][:3] > 0.2).all()
    assert "h²k" in str(names["found"])
    assert "<svg" in Path("sweep.html").read_text()


def _goes_less_far(names):
    """Under a force of 1 for T = 0.4 s with mass m and damping c: x = T/c − m (1 − exp(−cT/m)) / c², in steps of 2 ms."""
    way = lambda m, c: 0.4 / c - m * (1 - np.exp(-c * 0.4 / m)) / c**2  # noqa: E731
    width = 1e-4
    np.testing.assert_allclose(
        names["gradient"]["mass"], (way(1 + width, 1) - way(1 - width, 1)) / (2 * width), rtol=0.02
    )
    np.testing.assert_allclose(
        names["gradient"]["damping"], (way(1, 1 + width) - way(1, 1 - width)) / (2 * width), rtol=0.02
    )


# What is looked at after each how-to, and the object that its cell shows in a notebook.
_CHECKS = {
    _moves_and_is_filmed: "mg.check(scene, derivatives=False)",
    _finds_the_parameters: "result",
    _goes_less_far: "scene",
    _stands: "learned",
    _pushes_the_ball_to_its_place: "pusher",
    _balances: "balance",
    _reaches: "arm",
    _holds_and_learns: "",
    _descends_by_pytorch: "",
    _rises: "result",
    _falls_and_swings: "",
    _tells_which_gradient_holds: "found.result",
}


@pytest.mark.slow
@pytest.mark.parametrize(("number", "check"), list(enumerate(_CHECKS)), ids=[check.__name__[1:] for check in _CHECKS])
def test_how_tos_run_and_do_their_job(number, check, tmp_path, monkeypatch):
    if check is _descends_by_pytorch:
        pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    names = {}
    with jax.enable_x64(False):
        exec(compile(_examples("mjxgrad/HOWTO.md")[number], "HOWTO.md", "exec"), names)
    check(names)


@pytest.mark.slow
def test_the_how_tos_run_as_a_notebook_whose_cells_show_what_print_shows(tmp_path):
    """In one kernel. A cell that ends in an object shows lines of text, and not its arrays."""
    notebook, run, _ = map(pytest.importorskip, ("nbformat.v4", "nbclient", "ipykernel"))
    cells = []
    for code, last in zip(_examples("mjxgrad/HOWTO.md"), _CHECKS.values(), strict=True):
        if "import torch" not in code or importlib.util.find_spec("torch"):
            cells += map(notebook.new_code_cell, (code, f"print({last})\n{last}"))
    run.execute(notebook.new_notebook(cells=cells), cwd=tmp_path, timeout=600)
    for outputs in (cell.outputs for cell in cells[1::2]):
        printed = "".join(output.text for output in outputs if output.get("name") == "stdout").strip()
        shown = [output.data["text/plain"] for output in outputs if output.output_type == "execute_result"]
        assert shown == ([printed] if printed else [])
        assert "f32[" not in printed


def test_every_how_to_is_checked():
    assert len(_examples("mjxgrad/HOWTO.md")) == len(_CHECKS)


def test_the_readmes_examples_run_and_their_derivative_is_the_slope(capsys):
    """The slope of the throw over 10 cm/s, to a tenth; then a throw that clears the wall, which starts at 0.65 rad."""
    names = _run("README.md", {})
    steps = 0.05 * jnp.concatenate([jnp.eye(3), -jnp.eye(3)])
    ends = jax.jit(jax.vmap(names["distance"]))(names["velocity"] + steps)
    slopes = (ends[:3] - ends[3:]) / 0.1
    np.testing.assert_allclose(names["slope"], slopes, atol=0.1 * np.abs(slopes).max())
    assert names["result"].best_params > 0.65
    assert float(re.search(r"rad, cost (\S+) m²", capsys.readouterr().out)[1]) < 0.01
