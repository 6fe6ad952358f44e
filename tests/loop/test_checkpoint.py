"""An interrupted run loses nothing, and a file that is not its own is refused."""

import jax
import numpy as np
import optax
import pytest

import mjxgrad as mg
from tests.loop import problems
from tests.loop.problems import START

KEY = jax.random.key(2)


class KilledError(Exception):
    pass


def run(path=None, *, rate=0.05, num_steps=40, **settings):
    settings = {"optimiser": optax.adam(rate), "num_steps": num_steps, **settings}
    return mg.optimise(
        lambda scale: problems.objective.with_stddev(0.1 * scale),
        START,
        settings.pop("key", KEY),
        estimator=problems.noisy,
        annealing=optax.exponential_decay(1.0, 10, 0.5),
        evaluate=problems.bowl,
        checkpoint=path,
        **settings,
    )


def kill_at(step, error):
    def log(done, _):
        if done >= step:
            raise error

    return log


def assert_same(one, other):
    """Bit for bit, the clocks apart."""
    ignored = {"seconds", "compile_seconds"}
    flat = [jax.tree_util.tree_flatten_with_path(result)[0] for result in (one, other)]
    assert len(flat[0]) == len(flat[1]) > 15
    for (path, x), (_, y) in zip(*flat, strict=True):
        if not any(getattr(entry, "name", None) in ignored for entry in path):
            np.testing.assert_array_equal(x, y, err_msg=jax.tree_util.keystr(path))


@pytest.fixture(scope="module")
def uninterrupted():
    return run()


@pytest.mark.parametrize("error", [KilledError, KeyboardInterrupt])
def test_a_run_that_is_killed_and_resumed_is_the_uninterrupted_one(tmp_path, uninterrupted, error):
    """Ctrl-C returns what was found; any other error goes on to the caller."""
    path = tmp_path / "run.npz"
    for step in (7, 35):
        if error is KilledError:
            with pytest.raises(error):
                run(path, log=kill_at(step, error))
        else:
            result = run(path, log=kill_at(step, error))
            assert (result.num_steps, result.stopped) == (step + step % 2, mg.Stopped.interrupted)
    steps = []
    resumed = run(path, log=lambda step, _: steps.append(step))
    assert steps == [38, 40]
    assert_same(resumed, uninterrupted)


def test_a_finished_run_is_read_without_running(tmp_path, uninterrupted):
    path = tmp_path / "run.npz"
    run(path)
    assert_same(run(path, log=kill_at(0, KilledError)), uninterrupted)


def test_a_finished_run_goes_on_with_more_steps(tmp_path, uninterrupted):
    path = tmp_path / "run.npz"
    assert run(path, num_steps=30).stopped == mg.Stopped.finished
    assert_same(run(path), uninterrupted)


def test_a_link_to_a_checkpoint_stays_one(tmp_path, uninterrupted):
    path, link = tmp_path / "disk" / "run.npz", tmp_path / "run.npz"
    path.parent.mkdir()
    link.symlink_to(path)
    run(link)
    assert link.is_symlink()
    assert_same(run(path, log=kill_at(0, KilledError)), uninterrupted)


def test_many_seeds_are_resumed(tmp_path):
    path, keys = tmp_path / "run.npz", jax.random.split(KEY, 3)
    with pytest.raises(KilledError):
        run(path, key=keys, log=kill_at(7, KilledError))
    assert_same(run(path, key=keys), run(key=keys))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("checkpoint") / "run.npz"
    with pytest.raises(KilledError):
        run(path, log=kill_at(7, KilledError))
    return path


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"patience": 8}, "patience was 10 and is 8"),
        ({"rate": 0.06}, "a rate or other number, or the code, of environment, objective, estimator or optimiser"),
        ({"key": jax.random.key(3)}, "params or key"),
    ],
)
def test_a_checkpoint_of_another_run_is_refused(written, settings, sentence):
    with pytest.raises(ValueError, match=sentence):
        run(written, **settings)


def flipped(content):
    place = len(content) // 3
    return content[:place] + bytes([content[place] ^ 0xFF]) + content[place + 1 :]


@pytest.mark.parametrize("damaged", [lambda x: x[: len(x) // 2], flipped, lambda _: b"something else"])
def test_a_damaged_checkpoint_is_refused(tmp_path, written, damaged):
    path = tmp_path / "run.npz"
    path.write_bytes(damaged(written.read_bytes()))
    with pytest.raises(ValueError, match=r"checkpoint must be a file .*; give another path to begin anew") as refused:
        run(path)
    assert "delete" not in str(refused.value), "it may be something else that is worth more"


def test_a_save_that_fails_leaves_the_former_file(tmp_path, written, monkeypatch):
    path, before = tmp_path / "run.npz", written.read_bytes()
    path.write_bytes(before)

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(OSError, match="disk full"):
        run(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["run.npz"]
