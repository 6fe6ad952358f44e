"""A run from its file to its folder, on the task that compiles in seconds."""

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tomllib

import jax
import mujoco
import numpy as np
import pytest

import experiments
import mjxgrad as mg
from experiments import config, runner, video
from experiments.__main__ import main
from experiments.bias_variance import measure
from experiments.report import Report
from experiments.settings import VideoSettings
from experiments.workspace import Workspace
from mjxgrad.rollouts.render import RenderingUnavailableError

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


# A whole kind; `warnings` is a module here, and no sentence of the report.
ONE_FILE = """\
import warnings
from dataclasses import dataclass

import jax.numpy as jnp

from experiments.report import Table
from experiments.settings import RunSettings


class Settings(RunSettings):
    number: float


@dataclass
class Outcome:
    double: float

    def rows(self):
        return [{"double": self.double}]


def measure(settings, workspace):
    return Outcome(float(2 * jnp.asarray(settings.number)))


def answer(outcome):
    return f"It is {outcome.double}."


def verdict(outcome):
    return f"Twice the number is {outcome.double}."


def tables(outcome):
    return [Table(["double"], [[str(outcome.double)]], "All.")]


def drawings(outcome):
    return {}
"""


def run(path, folder, *arguments):
    return main(["run", str(path), "--output", str(folder), *arguments])


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


def test_the_resolved_configuration_runs_again_as_the_same(finished, capsys):
    folder = finished / "runs" / "steep"
    settings = tomllib.loads((folder / "config.toml").read_text())
    assert settings["num_samples"] == 64
    assert settings["confidence"] == 0.95
    # Named otherwise it would be another run: so a copy of it stands in for the file.
    again = finished / "again" / "steep.toml"
    again.parent.mkdir()
    again.write_text((folder / "config.toml").read_text())
    assert run(again, finished / "runs") == 0
    assert capsys.readouterr().out.startswith("unchanged: ")


def test_the_environment_says_what_made_it(finished):
    facts = json.loads((finished / "runs" / "steep" / "environment.json").read_text())
    assert facts["versions"]["mujoco"].startswith("3.17.")
    assert facts["device"]["platform"]
    assert facts["command"].startswith("python -m experiments run ")
    assert facts["seconds"]["total"] >= facts["seconds"]["gradients"] > 0


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
    assert "measurably biased at slope 10⁵" in verdict
    assert not re.search(r"throw|wall|stiffness of|1/s²|m²", re.sub(r'"data:[^"]*"', "", text)), "it is a ramp"
    assert '<td>reference_samples</td><td class="number">500</td>' in text
    assert str(finished) not in verdict


def test_an_unchanged_run_says_so_and_where_its_report_is(copied, capsys):
    before = (copied / "runs" / "steep" / "environment.json").read_text()
    assert run(copied / "steep.toml", copied / "runs") == 0
    out = capsys.readouterr().out
    assert out.startswith(f"unchanged: {copied / 'runs' / 'steep' / 'report.html'}")
    assert out.count("\n") == 1
    assert (copied / "runs" / "steep" / "environment.json").read_text() == before


def test_a_change_of_settings_or_source_or_force_runs_again(copied, monkeypatch):
    """A run that is reached raises here, and leaves the former result."""

    def reached(*_):
        raise ValueError("reached")

    monkeypatch.setattr(measure, "measure", reached)
    assert run(copied / "steep.toml", copied / "runs") == 0
    assert run(copied / "steep.toml", copied / "runs", "seed=1") == 2
    assert run(copied / "steep.toml", copied / "runs", "--force") == 2
    (copied / "runs" / "steep" / "report.html").rename(copied / "gone.html")
    assert run(copied / "steep.toml", copied / "runs") == 2
    (copied / "gone.html").rename(copied / "runs" / "steep" / "report.html")
    monkeypatch.setattr(runner, "ROOT", copied)
    assert run(copied / "steep.toml", copied / "runs") == 2
    assert (copied / "runs" / "steep" / "metrics.csv").is_file()
    assert [path.name for path in (copied / "runs").iterdir()] == ["steep"]


@pytest.mark.parametrize(("can_draw", "status"), [(False, 0), (True, 2)])
def test_a_report_that_lacks_its_video_is_made_again_once_it_can_be_drawn(copied, monkeypatch, can_draw, status):
    """A run that is reached raises here."""

    def reached(*_):
        raise ValueError("reached")

    facts = copied / "runs" / "steep" / "environment.json"
    facts.write_text(facts.read_text().replace('"lacks_video": false', '"lacks_video": true'))
    monkeypatch.setattr(video, "can_draw", lambda: can_draw)
    monkeypatch.setattr(measure, "measure", reached)
    assert run(copied / "steep.toml", copied / "runs") == status


def test_the_terminal_says_why_there_is_no_video(copied, monkeypatch, capsys):
    report = Report("It is so.", "Surely.", [], [], [], video_caption="install libosmesa6")
    monkeypatch.setattr(runner, "_call", lambda *_: report)
    assert run(copied / "steep.toml", copied / "runs", "--force") == 0
    assert "no video: install libosmesa6" in capsys.readouterr().err


def test_a_library_refusal_is_a_sentence_and_debug_shows_the_traceback(copied, monkeypatch, capsys):
    def refuse(*_):
        raise mg.DivergedError("the rollout diverged at step 3")

    monkeypatch.setattr(measure, "measure", refuse)
    assert run(copied / "steep.toml", copied / "runs", "--force") == 2
    assert capsys.readouterr().err.endswith("\nthe rollout diverged at step 3\n")
    with pytest.raises(mg.DivergedError):
        run(copied / "steep.toml", copied / "runs", "--force", "--debug")


def test_an_interruption_is_told_and_leaves_the_former_result(copied, monkeypatch, capsys):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(measure, "measure", interrupt)
    assert run(copied / "steep.toml", copied / "runs", "--force") == 130
    assert "earlier results are as they were" in capsys.readouterr().err
    assert (copied / "runs" / "steep" / "report.html").is_file()


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


def test_a_sweep_leads_to_its_runs_and_goes_on_where_it_stopped(tmp_path, capsys):
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
    assert run(tmp_path / "both.toml", tmp_path / "runs") == 0
    out = capsys.readouterr().out
    assert out.count("unchanged: ") == 1
    assert (top / "seed=1" / "report.html").is_file()


def test_a_gallery_shows_each_result_by_its_answer_and_picture_and_names_what_it_leaves_out(copied, capsys):
    top = copied / "runs"
    moving = {"name": "moving", "question": "Does it <move>?", "answer": "Yes.", "figure": None, "video": "video.mp4"}
    for name, summary in (("moving", moving), ("old", {"verdict": "Of an earlier version."})):
        (top / name).mkdir()
        (top / name / "summary.json").write_text(json.dumps(summary))
    assert main(["gallery", "--output", str(top)]) == 0
    assert "old" in capsys.readouterr().err
    first, second = re.findall(r'<a class="card".*?</a>', (top / "index.html").read_text(), re.DOTALL)
    assert 'href="moving/report.html"' in first
    assert '<video loop muted autoplay playsinline src="moving/video.mp4">' in first
    assert "Does it &lt;move&gt;?" in first
    assert json.loads((top / "steep" / "summary.json").read_text())["answer"] in second
    picture = re.search(r'<img src="([^"]*)"', second)
    assert picture is not None
    assert (top / picture[1]).is_file()


def test_a_gallery_of_nothing_says_what_to_do(tmp_path, capsys):
    assert main(["gallery", "--output", str(tmp_path)]) == 2
    assert "make demo" in capsys.readouterr().err


def test_methods_are_listed_by_their_labels_one_a_line():
    shown = runner._shown(config.load_runs("heaviside", [])[0].settings)
    assert shown["estimators"][:3] == [
        "first order",
        "zeroth order",
        "zeroth order (zero noise): baseline = zero_noise",
    ]
    strokes = runner._shown(config.load_runs("billiards", [])[0].settings)
    assert strokes["methods"][1:3] == ["first order, slope: gradient = slope", "first order, margin: margin = 0.4"]
    assert strokes["video.speed"] == "0.5"


def test_without_opengl_there_is_a_sentence_in_place_of_the_video(tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise RenderingUnavailableError("install libosmesa6")

    monkeypatch.setattr(video, "frames", refuse)
    motion = mujoco.MjModel.from_xml_string("<mujoco/>"), np.ones((2, 0))
    found = video.film(Workspace(tmp_path), [motion], VideoSettings(), camera="side", caption="A motion.")
    assert found == (None, "install libosmesa6")


def test_a_choice_of_opengl_that_mujoco_does_not_know_is_a_sentence(tmp_path):
    """MuJoCo cannot even be imported under it."""
    command = [sys.executable, "-m", "experiments", "run", "ramp", "--output", str(tmp_path)]
    environment = {**os.environ, "MUJOCO_GL": "bogus"}
    result = subprocess.run(command, env=environment, cwd=runner.ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert result.stderr.endswith('MUJOCO_GL: bogus; unset it, or take "egl", "osmesa" or "glfw"\n')


@pytest.mark.slow
def test_the_main_job_completes_without_opengl_and_says_which_package_brings_it(tmp_path):
    small = ["num_samples=8", "reference_samples=100", "stiffness=[1e2,1e4]", "angles=[0.65]"]
    command = [sys.executable, "-m", "experiments", "run", "ball_wall", *small, "--output", str(tmp_path)]
    result = subprocess.run(
        command, env={**os.environ, "MUJOCO_GL": "disable"}, cwd=runner.ROOT, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr
    text = (tmp_path / "ball_wall" / "report.html").read_text()
    assert "<b>No video.</b>" in text
    assert "libosmesa6" in text


@pytest.mark.parametrize("damage", ["[]", "3", "null", "{", '{"fingerprint": 1}'])
def test_a_damaged_record_of_a_run_is_none(copied, monkeypatch, damage):
    (copied / "runs" / "steep" / "environment.json").write_text(damage)
    monkeypatch.setattr(measure, "measure", _reached)
    assert run(copied / "steep.toml", copied / "runs") == 2


def test_an_empty_report_is_none_and_an_unchanged_run_clears_what_a_killed_one_left(copied, monkeypatch):
    monkeypatch.setattr(measure, "measure", _reached)
    remains = copied / "runs" / ".steep.partial-99999999"
    remains.mkdir()
    assert run(copied / "steep.toml", copied / "runs") == 0
    assert not remains.exists()
    (copied / "runs" / "steep" / "report.html").write_text("")
    assert run(copied / "steep.toml", copied / "runs") == 2


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (
            jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 8 bytes."),
            "take fewer samples (RES",
        ),
        (np._core._exceptions._ArrayMemoryError((10**13,), np.dtype(float)), "Unable to allocate"),
    ],
)
def test_too_little_memory_is_a_sentence(copied, monkeypatch, capsys, error, sentence):
    def exhaust(*_):
        raise error

    monkeypatch.setattr(measure, "measure", exhaust)
    assert run(copied / "steep.toml", copied / "runs", "--force") == 2
    assert sentence in capsys.readouterr().err


def test_another_error_of_the_runtime_is_a_mistake_in_the_program(copied, monkeypatch):
    def fail(*_):
        raise RuntimeError("a mistake")

    monkeypatch.setattr(measure, "measure", fail)
    with pytest.raises(RuntimeError, match="a mistake"):
        run(copied / "steep.toml", copied / "runs", "--force")


@pytest.mark.parametrize("command", [["run", "ramp"], ["gallery"]])
def test_an_output_without_a_name_is_refused(capsys, command):
    with pytest.raises(SystemExit):
        main([*command, "--output", ""])
    assert "must name a folder" in capsys.readouterr().err


def _reached(*_):
    raise ValueError("reached")


# A kind of two parts that kills itself in the second one, once.
IN_PARTS = """
import os
import signal
import warnings
from pathlib import Path

LOG = Path(__file__).with_name("log")


def part(number):
    with LOG.open("a") as file:
        file.write(f"{number} ")
    warnings.warn(f"part {number}")
    if LOG.read_text() == "0 1 ":
        os.kill(os.getpid(), signal.SIGKILL)
    return number + jnp.asarray(settings_number)


def measure(settings, workspace):
    global settings_number
    settings_number = settings.number
    found = [workspace.once(f"part/{number}", lambda number=number: part(number)) for number in range(2)]
    return Outcome(float(sum(found)))
"""


def test_after_a_kill_a_run_goes_on_from_its_last_finished_part(tmp_path, monkeypatch, capsys):
    """0.1 + 1.1 by a process that is killed in the second part, and one that follows."""
    head, _, tail = ONE_FILE.partition("def measure(")
    (tmp_path / "in_parts.py").write_text(head + IN_PARTS + tail[tail.index("\n\n\n") :])
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


def test_a_kind_may_be_one_file_that_imports_jax(tmp_path, monkeypatch, capsys):
    (tmp_path / "doubling.py").write_text(ONE_FILE)
    (tmp_path / "trial.toml").write_text('# How much is twice it?\nexperiment = "doubling"\nnumber = 0.1\n')
    monkeypatch.setattr(config, "FOLDER", tmp_path)
    monkeypatch.setattr(experiments, "__path__", [*experiments.__path__, str(tmp_path)])
    assert config.kinds() == ["doubling"]
    assert run(tmp_path / "trial.toml", tmp_path / "runs") == 0
    # In float32 it would be 0.20000000298: float64 was chosen in time.
    assert capsys.readouterr().out.startswith("It is 0.2.\nTwice the number is 0.2.\n")
    assert (tmp_path / "runs" / "trial" / "metrics.csv").read_text().split() == ["double", "0.2"]
