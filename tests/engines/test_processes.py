"""Derivatives that other processes take are those of threads, and nothing is lost where a process ends."""

import mujoco
import numpy as np
import pytest

from mjxgrad.engines import pool as pools
from mjxgrad.engines.jacobians import with_pairs
from mjxgrad.engines.pool import Pool
from mjxgrad.engines.processes import Processes, are_possible
from tests.processes import run_python

BALL = """<mujoco><worldbody><geom type="plane" size="5 5 .1"/><body pos="0 0 .1"><freejoint/><geom size=".1" mass="1"/></body>
    <body name="arm" pos="1 0 1"><joint name="j" axis="0 1 0" damping=".1"/><geom type="capsule" fromto="0 0 0 0 0 -.9"
    size=".05"/></body></worldbody><actuator><motor joint="j"/></actuator>
    <sensor><framepos objtype="body" objname="arm"/></sensor></mujoco>"""
_NUM, _STEPS = 6, 40


@pytest.fixture
def other():
    """Processes of this test's own, which take all that is asked for."""
    with pytest.MonkeyPatch.context() as patch:
        own = Processes(2)
        for name, value in (
            ("_FEWEST", 1),
            ("_SHORT", 0.0),
            ("_LONG", 0.0),
            ("_MANY", 1),
            ("processes", lambda _: own),
        ):
            patch.setattr(pools, name, value)
        yield own
        own.close()


def _maps(gradient, wanted, numbers=None):
    """Balls that are thrown onto the floor."""
    model, random = mujoco.MjModel.from_xml_string(BALL), np.random.default_rng(0)
    pool = Pool(model, num_threads=2)
    start = {"time": np.zeros((_NUM, 1)), "qpos": np.tile(model.qpos0, (_NUM, 1)), "act": np.zeros((_NUM, 0))}
    start["qvel"] = random.normal(size=(_NUM, model.nv))
    inputs = {"ctrl": random.normal(size=(_NUM, _STEPS, 1))}
    before = pool._before(start, pool.run(numbers or {}, start, inputs))
    return pool.maps(numbers or {}, before, inputs, pool.no_flight((_NUM,)), gradient=gradient, wanted=wanted)


@pytest.mark.parametrize(
    ("gradient", "wanted"), [("discrete", ("ctrl",)), ("slope", (*with_pairs(("ctrl", "geom_size")), "flight"))]
)
def test_they_are_those_of_threads(gradient, wanted, other):
    model = mujoco.MjModel.from_xml_string(BALL)
    sizes = np.tile(model.geom_size, (_NUM, 1, 1))
    sizes[:, 1, 0] += np.linspace(0, 0.01, _NUM)  # a model for each
    numbers = {"geom_size": sizes} if gradient == "slope" else {}
    found = _maps(gradient, wanted, numbers)
    assert all(one for one in other.known)  # they were asked
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pools, "are_possible", lambda: False)
        expected = _maps(gradient, wanted, numbers)
    for name, value in expected.items():
        # Rows that are taken together are multiplied in another order.
        np.testing.assert_allclose(found[name], value, rtol=1e-9, atol=1e-9 * np.abs(value).max(), err_msg=name)


def test_readings_have_the_derivatives_of_threads(other, monkeypatch):
    model, random = mujoco.MjModel.from_xml_string(BALL), np.random.default_rng(0)
    states = {"time": np.zeros((_NUM, 3, 1)), "act": np.zeros((_NUM, 3, 0))}
    states |= {"qpos": np.tile(model.qpos0, (_NUM, 3, 1)), "qvel": random.normal(size=(_NUM, 3, model.nv))}
    states["qpos"][..., -1] = random.normal(size=(_NUM, 3))
    both, asked = [], []
    monkeypatch.setattr(other, "_ask", lambda *given, ask=other._ask: (asked.append(given), ask(*given)))
    for is_started in (True, False):
        monkeypatch.setattr(pools, "are_started", lambda is_started=is_started: is_started)
        pool, inputs = Pool(model, num_threads=2), {"ctrl": np.zeros((_NUM, 3, 1))}
        both.append(pool.sense({}, states, inputs, wanted=("state", "ctrl")))
    assert asked
    for name, value in both[1].items():
        np.testing.assert_array_equal(both[0][name], value)
    # The arm's centre is 0.45 m from its joint.
    np.testing.assert_allclose(both[0]["state"][..., 0, 6], -0.45 * np.cos(states["qpos"][..., -1]), atol=1e-9)


def test_where_one_has_ended_threads_go_on(other):
    for child in other.children:
        child.kill()
        child.wait()
    with pytest.warns(UserWarning, match="by one process, which is slower"):
        found = _maps("discrete", ("ctrl",))
    assert np.abs(found["state"]).min(axis=(2, 3)).shape == (_NUM, _STEPS)
    assert np.isfinite(found["state"]).all()
    assert np.abs(found["ctrl"]).max() > 0


def test_what_a_process_says_is_raised(other):
    model = mujoco.MjModel.from_xml_string(BALL)
    with pytest.raises(TypeError, match="missing 5 required"):
        other.share(0, model, 1, {"state": (1,)}, lambda piece: ({},))


def test_one_whose_parent_was_killed_ends_in_silence():
    ask = "import os, pickle; from mjxgrad.engines.processes import Processes; child = Processes(1).children[0]; "
    ask += (
        "pickle.dump((0, None, ('nowhere', {}, slice(0), 'write', ())), child.stdin); child.stdin.flush(); os._exit(0)"
    )
    assert run_python("-c", ask) == ("", "")  # waits until the child has closed its output


def test_one_whose_parent_ends_within_a_question_ends_in_silence():
    """As Ctrl-C does: half a question is no question, and no reason for a traceback."""
    ask = "import os, pickle; from mjxgrad.engines.processes import Processes; child = Processes(1).children[0]; "
    ask += "question = pickle.dumps((0, None, bytes(10**6)), pickle.HIGHEST_PROTOCOL); "
    ask += "child.stdin.write(question[: len(question) // 2]); child.stdin.flush(); os._exit(0)"
    assert run_python("-c", ask) == ("", "")


def test_a_function_of_this_process_in_a_step_keeps_it_here():
    assert are_possible()
    mujoco.set_mjcb_control(lambda model, data: None)
    try:
        assert not are_possible()
    finally:
        mujoco.set_mjcb_control(None)


def test_a_process_imports_no_jax():
    """It would start in seconds, not in a quarter of one."""
    said, _ = run_python(
        "-c",
        "from mjxgrad.engines import processes as p; p._START = p._START.replace('serve()', '') + "
        "'import mjxgrad.engines.pool; sys.stdout.write(str(\"jax\" in sys.modules))'; "
        "own = p.Processes(1); print(own.children[0].stdout.read())",
    )
    assert "False" in said
