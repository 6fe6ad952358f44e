"""Ctrl-C ends a run within a second and keeps what was found; a long run says at once what it will take."""

import os
import signal
import sys
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad import _interrupts, cli
from mjxgrad.loop import Method, run

PAUSE = 0.1  # s


class Slow(Method):
    """A count, each step of which takes a tenth of a second in a thread of C++."""

    def init(self, start):
        return start

    def step(self, carry, index):
        def wait(x):
            time.sleep(PAUSE)
            return np.asarray(x)

        after = jax.pure_callback(wait, jax.ShapeDtypeStruct((), carry.dtype), carry + 1)
        return after, {"count": after}


def test_ctrl_c_keeps_the_steps_done_and_a_price_was_told(tmp_path, capfd):
    """A thousand steps of 0.1 s are 100 s, which is foretold to a factor of two from the steps of the first second."""
    path, sent = tmp_path / "run.npz", []

    def stop():
        sent.append(time.perf_counter())
        os.kill(os.getpid(), signal.SIGINT)

    threading.Timer(2.5, stop).start()
    done = run(Slow(), jnp.zeros(()), num_steps=1000, segment=50, checkpoint=path)
    assert time.perf_counter() - sent[0] < 1.0
    assert done.is_interrupted
    np.testing.assert_array_equal(done.found["count"], 1 + np.arange(done.num_steps))
    assert 5 <= done.num_steps <= 2.5 / PAUSE
    told = capfd.readouterr().err
    foretold = float(told.partition("about ")[2].split()[0])
    assert "a step" in told
    assert "min for 1000" in told
    assert 50 < 60 * foretold < 200
    again = run(Slow(), jnp.zeros(()), num_steps=done.num_steps + 1, segment=50, checkpoint=path)
    assert (again.num_steps, again.is_interrupted) == (done.num_steps + 1, False)


def test_ctrl_c_before_any_step_is_one():
    threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        run(Slow(), jnp.zeros(()), num_steps=1000, segment=50)


class SlowAtFirst(Method):
    """A count, whose first step takes 1.2 s and the others 20 ms."""

    def init(self, start):
        return start

    def step(self, carry, index):
        def wait(x):
            time.sleep(1.2 if x == 1 else 0.02)
            return np.asarray(x)

        after = jax.pure_callback(wait, jax.ShapeDtypeStruct((), carry.dtype), carry + 1)
        return after, {"count": after}


def test_a_price_by_a_slow_first_step_is_told_anew(capfd):
    """After the first step it is 1.2 s a step, then 20 ms, or more on a busy machine."""
    run(SlowAtFirst(), jnp.zeros(()), num_steps=60, segment=60, log=lambda *_: None)
    told = [float(line.split()[1]) for line in capfd.readouterr().err.splitlines() if "for 60" in line]
    assert told[0] >= 1.2
    assert told[-1] < told[0] / 2


def test_a_short_run_says_nothing(capfd):
    run(Slow(), jnp.zeros(()), num_steps=3, segment=2)
    assert capfd.readouterr().err == ""


class Lost:
    def __del__(self):
        raise KeyboardInterrupt


@pytest.mark.parametrize("within_command", [False, True])
def test_ctrl_c_that_python_ignores_comes_again(monkeypatch, within_command, capfd):
    """As in JAX's function that garbage collection calls: a run of learning went on for ever."""
    monkeypatch.setattr(sys, "unraisablehook", sys.__unraisablehook__)
    _interrupts.lose_none()

    def work():
        del [Lost()][0]
        time.sleep(5)

    began = time.perf_counter()
    if within_command:
        monkeypatch.setattr(cli, "app", lambda *_, **__: work())
        assert cli.main([]) == 130
    else:
        with pytest.raises(KeyboardInterrupt):
            work()
    assert time.perf_counter() - began < 2
    assert "ignored" not in capfd.readouterr().err


@jax.jit
def _counted(x):
    """One more, by two calls back of 0.05 s."""

    def wait(x):
        time.sleep(PAUSE / 2)
        return np.asarray(x) + 0.5

    call = lambda x: jax.pure_callback(wait, jax.ShapeDtypeStruct((), x.dtype), x)  # noqa: E731
    return call(jnp.sin(call(x)) * 0 + x + 0.5)


@pytest.mark.parametrize("after", [0.22, 0.27, 0.31])
def test_ctrl_c_ends_ones_own_loop_after_a_step_and_not_within(after):
    """XLA makes its own error of an interruption in a function that it calls back. A second Ctrl-C comes at once."""
    _interrupts.wait_for_programs()
    _counted(jnp.zeros(())).block_until_ready()
    x, num = jnp.zeros(()), 0
    threading.Timer(after, os.kill, (os.getpid(), signal.SIGINT)).start()
    began = time.perf_counter()
    try:
        while time.perf_counter() < began + 10:
            x = _counted(x).block_until_ready()
            num += 1
        pytest.fail("Ctrl-C was not heard")
    except KeyboardInterrupt:
        pass
    assert time.perf_counter() - began < 2
    assert float(x) in (num, num + 1)
    time.sleep(0.05)  # no second one comes


def test_a_second_ctrl_c_comes_at_once():
    """Within a function that takes 5 s, of which XLA then makes its own error."""

    def wait(x):
        time.sleep(5)
        return np.asarray(x)

    _interrupts.wait_for_programs()
    slow = jax.jit(lambda x: jax.pure_callback(wait, jax.ShapeDtypeStruct((), x.dtype), x)).lower(0.0).compile()
    for after in (0.3, 0.6):
        threading.Timer(after, os.kill, (os.getpid(), signal.SIGINT)).start()
    began = time.perf_counter()
    with pytest.raises((jax.errors.JaxRuntimeError, ValueError, KeyboardInterrupt)):
        slow(0.0).block_until_ready()
    assert 0.5 < time.perf_counter() - began < 2
