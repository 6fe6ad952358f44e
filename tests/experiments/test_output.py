"""An output folder is complete, or as it was before."""

import os
import subprocess
import sys
import tomllib

import pytest

from experiments.config import ExperimentError
from experiments.output import building, recover, write_csv, write_toml


def listing(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_folder_appears_whole_and_replaces_the_former(tmp_path):
    for content in ("old", "new"):
        with building(tmp_path / "run") as folder:
            (folder / content).write_text(content)
            assert not (tmp_path / "run" / content).exists()
    assert listing(tmp_path) == ["run"]
    assert listing(tmp_path / "run") == ["new"]


@pytest.mark.parametrize("failure", [RuntimeError, KeyboardInterrupt])
def test_a_failure_leaves_the_former_result_and_nothing_else(tmp_path, failure):
    with building(tmp_path / "run") as folder:
        (folder / "old").write_text("old")

    def fail_half_way():
        with building(tmp_path / "run") as folder:
            (folder / "half").write_text("half")
            raise failure

    with pytest.raises(failure):
        fail_half_way()
    assert listing(tmp_path) == ["run"]
    assert listing(tmp_path / "run") == ["old"]


def test_what_a_killed_run_left_behind_is_cleared_and_its_former_result_comes_back(tmp_path):
    """Killed between its two renames: the old result stands aside, and the new one is not in place."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    (tmp_path / ".run.previous").mkdir()
    (tmp_path / ".run.previous" / "old").write_text("old")
    (tmp_path / f".run.partial-{process.pid}").mkdir()
    with pytest.raises(RuntimeError), building(tmp_path / "run"):
        raise RuntimeError
    assert listing(tmp_path) == ["run"]
    assert listing(tmp_path / "run") == ["old"]


def test_a_second_run_into_a_folder_is_refused_by_the_number_of_the_first_and_leaves_it_alone(tmp_path):
    """Where the first ends so does its hold, and what bears no process's number is nobody's remains."""
    (tmp_path / ".run.partial-old").mkdir()
    with building(tmp_path / "run") as folder:
        (folder / "first").write_text("first")
        refused = pytest.raises(
            ExperimentError, match=rf"another run \(process {os.getpid()}\) is writing to .*run; wait"
        )
        with refused, building(tmp_path / "run"):
            pass
        recover(tmp_path / "run")
        assert folder.is_dir()
    assert listing(tmp_path / "run") == ["first"]
    assert listing(tmp_path) == [".run.partial-old", "run"]


def test_settings_survive_their_way_through_toml(tmp_path):
    settings = {
        "text": 'a "quoted" \\ word', "number": 1e-05, "large": 1e16, "count": 3, "flag": True, "none": None,
        "list": [1.0, 2.5], "tables": [{"name": "a", "size": None}, {"name": "b", "size": 2}],
        "table": {"inner": 1, "deeper": {"stddev": 0.1}},
    }  # fmt: skip
    write_toml(tmp_path / "config.toml", settings, "Is it so?\nExpected: yes.")
    text = (tmp_path / "config.toml").read_text()
    del settings["none"], settings["tables"][0]["size"]
    assert tomllib.loads(text) == settings
    assert text.startswith("# Is it so?\n# Expected: yes.\n")


def test_rows_become_csv_with_what_one_lacks_left_empty(tmp_path):
    write_csv(tmp_path / "m.csv", [{"a": 1.5, "b": True}, {"a": -2.0, "c": "x"}])
    assert (tmp_path / "m.csv").read_text().splitlines() == ["a,b,c", "1.5,True,", "-2.0,,x"]
