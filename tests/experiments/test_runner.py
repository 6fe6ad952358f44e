"""A run from its file to its folder, on the task that compiles in seconds."""

import csv
import json
import re
import shutil
import signal
import subprocess
import sys
import tomllib

import jax
import numpy as np
import pytest

import experiments
import mjxgrad as mg
from experiments import config, runner
from experiments.__main__ import main
from experiments.bias_variance import measure
from experiments.report import Report

SETTINGS = """\
# Does a <steep> step mislead?
# Expected: yes.
experiment = "bias_variance"
task = "ramp"
stddev = 0.1
angles = [0.05, 0.12]
stiffness = [1e1, 1e5]
num_samples = 64
reference_samples = 500
"""


def run(path, folder, *arguments):
    return main(["run", str(path), "--output", str(folder), *arguments])


def _raise(monkeypatch, error):
    """Let every run that begins to measure end with an error."""

    def fail(*_):
        raise error

    monkeypatch.setattr(measure, "measure", fail)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """One run, and what it printed; copied by whoever changes it."""
    folder = tmp_path_factory.mktemp("experiment")
    (folder / "steep.toml").write_text(SETTINGS)
    assert run(folder / "steep.toml", folder / "runs") == 0
    return folder


@pytest.fixture
def copied(finished, tmp_path):
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    return tmp_path


def test_the_folder_holds_all_that_was_promised(finished):
    folder = finished / "runs" / "steep"
    assert sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()) == [
        "config.toml", "environment.json",
        "figures/bias_variance.svg", "figures/choice.svg", "figures/gradient.svg", "figures/landscape.svg",
        "metrics.csv", "report.html", "summary.json",
    ]  # fmt: skip


def test_the_resolved_configuration_is_an_unchanged_run_which_says_where_its_report_is(finished, capsys):
    folder = finished / "runs" / "steep"
    settings = tomllib.loads((folder / "config.toml").read_text())
    assert settings["num_samples"] == 64
    assert settings["confidence"] == 0.95
    # Named otherwise it would be another run: so a copy of it stands in for the file.
    again = finished / "again" / "steep.toml"
    again.parent.mkdir()
    again.write_text((folder / "config.toml").read_text())
    assert run(again, finished / "runs") == 0
    out = capsys.readouterr().out
    assert out.startswith(f"unchanged: {folder / 'report.html'}")
    assert out.count("\n") == 1


def test_the_metrics_agree_with_the_closed_form_of_the_ramp(finished):
    """With slope s = 10 and noise 0.1 it is s (Φ((1/s − θ)/0.1) − Φ((−1/s − θ)/0.1)) + 2θ; here Φ(½) and Φ(1½)."""
    with (finished / "runs" / "steep" / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4
    row = rows[0]
    exact = 10 * (0.691462 + 0.933193 - 1) + 2 * 0.05
    assert float(row["reference"]) == pytest.approx(exact, rel=2e-3)
    for name in ("first_order", "zeroth_order"):
        assert float(row[f"{name}_low"]) < exact < float(row[f"{name}_high"])


def test_the_report_needs_nothing_beside_it(finished):
    text = (finished / "runs" / "steep" / "report.html").read_text()
    assert text.count("<svg") == 4
    assert all(source.startswith(("#", "data:image/png")) for source in re.findall(r'(?:src|href)="([^"]{0,20})', text))
    assert not re.search(r"https?://|@import|url\((?!#)|<script|<link", text)


def test_the_report_shows_question_verdict_and_settings_as_text(finished):
    text = (finished / "runs" / "steep" / "report.html").read_text()
    verdict = json.loads((finished / "runs" / "steep" / "summary.json").read_text())["verdict"]
    assert "Does a &lt;steep&gt; step mislead?</p>" in text
    assert verdict in text
    assert "first order only up to slope 10." in text
    assert not re.search(r"throw|wall|stiffness of|1/s²|m²", re.sub(r'"data:[^"]*"', "", text)), "it is a ramp"
    assert "\nreference_samples = 500\n" in text
    assert str(finished) not in verdict


def test_a_change_of_settings_or_source_or_force_or_a_damaged_record_runs_again(copied, monkeypatch):
    """A run that is reached raises here, and leaves the former result."""
    _raise(monkeypatch, ValueError("reached"))
    assert run(copied / "steep.toml", copied / "runs") == 0
    assert run(copied / "steep.toml", copied / "runs", "seed=1") == 2
    assert run(copied / "steep.toml", copied / "runs", "--force") == 2
    (copied / "runs" / "steep" / "report.html").rename(copied / "gone.html")
    assert run(copied / "steep.toml", copied / "runs") == 2
    (copied / "gone.html").rename(copied / "runs" / "steep" / "report.html")
    record = copied / "runs" / "steep" / "environment.json"
    told = record.read_text()
    for damaged in ("[]", "{", '{"fingerprint": 1}'):
        record.write_text(damaged)
        assert run(copied / "steep.toml", copied / "runs") == 2
    record.write_text(told)
    assert run(copied / "steep.toml", copied / "runs") == 0
    monkeypatch.setattr(runner, "ROOT", copied)
    assert run(copied / "steep.toml", copied / "runs") == 2
    assert (copied / "runs" / "steep" / "metrics.csv").is_file()
    assert [path.name for path in (copied / "runs").iterdir()] == ["steep"]


@pytest.mark.parametrize(
    ("error", "status", "sentence"),
    [
        (mg.DivergedError("the rollout diverged at step 3"), 2, "the rollout diverged at step 3"),
        (KeyboardInterrupt(), 130, "earlier results are as they were"),
        (jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory."), 2, "take fewer samples (RES"),
        (np._core._exceptions._ArrayMemoryError((10**13,), np.dtype(float)), 2, "Unable to allocate"),
    ],
)
def test_what_ends_a_run_is_a_sentence_and_the_former_result_stays(
    copied, monkeypatch, capsys, error, status, sentence
):
    _raise(monkeypatch, error)
    assert run(copied / "steep.toml", copied / "runs", "--force") == status
    assert sentence in capsys.readouterr().err
    assert (copied / "runs" / "steep" / "report.html").is_file()


@pytest.mark.parametrize(
    ("error", "debug"), [(mg.DivergedError("at step 3"), ["--debug"]), (RuntimeError("wrong"), [])]
)
def test_a_traceback_is_shown_of_mistakes_in_the_program_and_where_it_is_asked_for(copied, monkeypatch, error, debug):
    _raise(monkeypatch, error)
    with pytest.raises(type(error)):
        run(copied / "steep.toml", copied / "runs", "--force", *debug)


def test_the_terminal_says_why_there_is_no_video(copied, monkeypatch, capsys):
    report = Report("It is so.", "Surely.", [], [], [], video_caption="install libosmesa6")
    monkeypatch.setattr(runner, "_call", lambda *_: report)
    assert run(copied / "steep.toml", copied / "runs", "--force") == 0
    assert "no video: install libosmesa6" in capsys.readouterr().err


def test_rollouts_that_are_all_nan_are_a_sentence_that_names_the_stiffness(copied, capsys):
    """A slope of 1e200 times an angle that overflows: the cost is finite nowhere that counts."""
    (copied / "nan.toml").write_text(SETTINGS.replace("angles = [0.05, 0.12]", "angles = [1e160, 2e160]"))
    assert run(copied / "nan.toml", copied / "runs") == 2
    err = capsys.readouterr().err
    assert "gives no estimate" in err
    assert "smaller angles" in err
    assert not re.search("time step|stiffness", err), "a ramp has none"
    assert not (copied / "runs" / "nan").exists()


def test_an_output_that_cannot_be_written_is_refused_before_anything_runs(finished, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert run(finished / "steep.toml", tmp_path / "file") == 2
    assert "not a directory" in capsys.readouterr().err


def test_a_sweep_leads_to_its_runs_and_goes_on_where_it_stopped(tmp_path, monkeypatch, capsys):
    (tmp_path / "both.toml").write_text(SETTINGS + "[sweep]\nseed = [0, 1]\n")
    assert run(tmp_path / "both.toml", tmp_path / "runs") == 0
    capsys.readouterr()
    top = tmp_path / "runs" / "both-sweep"
    assert sorted(path.name for path in top.iterdir()) == ["report.html", "seed=0", "seed=1", "summary.json"]
    text = (top / "report.html").read_text()
    assert re.findall(r'href="([^"]*)"', text) == ["seed=0/report.html", "seed=1/report.html"]
    answer = json.loads((top / "seed=0" / "summary.json").read_text())["answer"]
    assert f"<td>{answer}</td>" in text
    assert main(["gallery", "--output", str(tmp_path / "runs")]) == 0
    cards = (tmp_path / "runs" / "index.html").read_text()
    assert re.findall(r'href="([^"]*)"', cards) == ["both-sweep/report.html"], "one card for all combinations"
    shutil.rmtree(top / "seed=1")
    capsys.readouterr()
    _raise(monkeypatch, ValueError("reached"))
    assert run(tmp_path / "both.toml", tmp_path / "runs") == 2
    told = capsys.readouterr()
    assert told.out.count("unchanged: ") == 1
    assert told.err.endswith("reached\n")


def test_a_gallery_shows_each_result_by_its_answer_and_picture_and_names_what_it_leaves_out(copied, capsys):
    top = copied / "runs"
    moving = {"name": "moving", "question": "Does it <move>?", "answer": "Yes.", "figure": None, "video": "video.mp4"}
    for name, summary in (("moving", moving), ("old", {"verdict": "Of an earlier version."})):
        (top / name).mkdir()
        (top / name / "summary.json").write_text(json.dumps(summary))
    assert main(["gallery", "--output", str(top)]) == 0
    assert "old" in capsys.readouterr().err
    assert main(["gallery", "--output", str(top / "steep")]) == main(["gallery", "--output", ""]) == 2
    assert re.search("make demo(.|\n)*must name a folder", capsys.readouterr().err)
    first, second = re.findall(r'<a class="card".*?</a>', (top / "index.html").read_text(), re.DOTALL)
    assert 'href="moving/report.html"' in first
    assert '<video loop muted autoplay playsinline src="moving/video.mp4">' in first
    assert "Does it &lt;move&gt;?" in first
    assert json.loads((top / "steep" / "summary.json").read_text())["answer"] in second
    picture = re.search(r'<img src="([^"]*)"', second)
    assert picture is not None
    assert (top / picture[1]).is_file()


# A whole kind, of two parts, that kills itself in the second one, once; `warnings` is a module here, and no sentence.
IN_PARTS = """
import os
import signal
import warnings
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp

from experiments.report import Table
from experiments.settings import RunSettings

LOG = Path(__file__).with_name("log")


class Settings(RunSettings):
    number: float


@dataclass
class Outcome:
    double: float

    def rows(self):
        return [{"double": self.double}]


def measure(settings, workspace):
    def part(number):
        with LOG.open("a") as file:
            file.write(f"{number} ")
        warnings.warn(f"part {number}")
        if LOG.read_text() == "0 1 ":
            os.kill(os.getpid(), signal.SIGKILL)
        return number + jnp.asarray(settings.number)

    found = [workspace.once(f"part/{number}", lambda number=number: part(number)) for number in range(2)]
    return Outcome(float(sum(found)))


answer = verdict = lambda outcome: f"Twice the number is {outcome.double}."
tables = lambda outcome: [Table(["double"], [[str(outcome.double)]], "All.")]
drawings = lambda outcome: {}
"""


def test_after_a_kill_a_run_goes_on_from_its_last_finished_part(tmp_path, monkeypatch, capsys):
    """0.1 + 1.1 by a process that is killed in the second part, and one that follows."""
    (tmp_path / "in_parts.py").write_text(IN_PARTS)
    (tmp_path / "trial.toml").write_text('# How much?\nexperiment = "in_parts"\nnumber = 0.1\n')
    begin = (
        "import sys, pathlib, experiments, experiments.__main__ as command; from experiments import config; "
        "config.FOLDER = pathlib.Path(sys.argv[1]); experiments.__path__.append(sys.argv[1]); command.main(sys.argv[2:])"
    )
    arguments = ["run", str(tmp_path / "trial.toml"), "--output", str(tmp_path / "runs")]
    killed = subprocess.run([sys.executable, "-c", begin, str(tmp_path), *arguments], cwd=runner.ROOT, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert not (tmp_path / "runs" / "trial").exists()
    monkeypatch.setattr(config, "FOLDER", tmp_path)
    monkeypatch.setattr(experiments, "__path__", [*experiments.__path__, str(tmp_path)])
    assert main(arguments) == 0
    assert (tmp_path / "log").read_text() == "0 1 1 ", "the first part was not done again"
    assert "Twice the number is 1.2" in capsys.readouterr().out
    text = (tmp_path / "runs" / "trial" / "report.html").read_text()
    assert "part 0" in text, "what it warned of is told again"
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["trial"]
    # In float32 the number would be 0.10000000149: float64 was chosen in time.
    assert (tmp_path / "runs" / "trial" / "metrics.csv").read_text().startswith("double\n1.20000000000000")
