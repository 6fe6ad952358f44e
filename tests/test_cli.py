"""The command line: what it prints where, its exit codes, and what it writes."""

import contextlib
import functools
import io
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import mjxgrad as mg
from mjxgrad import cli
from tests.processes import python

SCENE = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 .1"/><body name="ball" pos="0 0 .2">
  <joint name="z" type="slide" axis="0 0 1"/><geom size=".05" mass=".2"/></body></worldbody>
  <actuator><motor name="push" joint="z" gear="{gear}" ctrlrange="-1 1"/></actuator></mujoco>"""
COSTS = """import jax.numpy as jnp
def height(trajectory):
    return trajectory.qpos[-1, 0] ** 2
def count(trajectory):
    return jnp.sum(trajectory.qpos > 0)
def root(trajectory):
    return jnp.sqrt(0 * trajectory.qpos[-1, 0])
def wrong(t): return t.pos
def stop(t): raise SystemExit
"""
_IDENTIFY = ["identify", "scene.xml", "motion.csv", "--parameter", "mass:ball"]


@pytest.fixture
def scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # Random motions of half a second in place of two, each step of which is asked for its contacts.
    monkeypatch.setattr("mjxgrad.checking.motions._SECONDS", 0.5)
    Path("scene.xml").write_text(SCENE.format(gear=1))
    return "scene.xml"


@pytest.fixture
def checks_quickly(monkeypatch):
    monkeypatch.setattr(mg, "check", functools.partial(mg.check, derivatives=False))


def test_check_prints_its_verdict_and_says_no_fault_by_its_exit_code(scene, capsys):
    assert cli.main(["check", scene, "--quick"]) == 0
    said = capsys.readouterr()
    assert said.out.startswith("scene.xml: Take contact=mg.Slope() and alpha_order")
    assert "First to touch" in said.err


def test_a_check_measures_over_the_steps_asked_for(scene, capsys):
    """Three are no motion, and a tenth of a second costs none of them."""
    assert cli.main(["check", scene, "--horizon", "3"]) == 2
    assert "horizon must be at least 4, got 3" in capsys.readouterr().err
    assert cli.main(["check", scene, "--horizon", "90", "--budget", "0.1"]) in (0, 1)
    assert "derivatives over 90 steps, 0.18 s" in capsys.readouterr().err


def test_a_fault_is_said_by_the_exit_code_and_the_page(scene, capsys):
    Path(scene).write_text(SCENE.format(gear=0))
    assert cli.main(["check", scene, "--quick", "--html", "page.html"]) == 1
    assert "! No effect: actuator 'push'" in capsys.readouterr().out
    assert Path("page.html").read_text().startswith("<!DOCTYPE html>")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["check", "nowhere.xml"], "there is no file nowhere.xml"),
        (["check", "."], ". is a folder: name a file in it"),
        (["sweep", "."], ". is a folder: name a file in it"),
        (["new", "."], ". is a folder: name a file in it"),
        (["check", "refused.xml"], "got none (nv = 0)"),
        (["check", "scene.xml", "--quick", "--cost", "nowhere:cost"], "cost must be file.py:function, module:function"),
        (
            ["check", "scene.xml", "--quick", "--cost", "costs.py:wrong"],
            "'costs.py:wrong' raised AttributeError: 'Trajectory' object has no attribute 'pos' (costs.py, line 8)\n",
        ),
        (
            ["check", "scene.xml", "--quick", "--cost", "costs.py:stop"],
            "'costs.py:stop' ended the program; put what it",
        ),
        (["check", "scene.xml", "--quick", "--cost", "jax.numpy:sinus"], "no function 'sinus', but sin, "),
        ([*_IDENTIFY, "--max-steps", "1.5"], "invalid literal for int() with base 10: '1.5'"),
        ([*_IDENTIFY, "--noise"], "--noise requires at least 1"),
        ([*_IDENTIFY, "--output", ""], "must be named"),
        ([*_IDENTIFY, "--output", "/proc/found"], "/proc/found"),
        ([*_IDENTIFY[:3], "./motion.csv", *_IDENTIFY[3:]], "each recording must be named once"),
        (["check", "scene.xml", "--quick", "--seed", "1.5"], "invalid literal for int() with base 10: '1.5'"),
        ([*_IDENTIFY, "mass:ball=.1..2"], "--parameter must name each parameter once"),
        ([*_IDENTIFY[:2], "twice.csv", *_IDENTIFY[3:]], "z stands there more than once"),
        (["chek"], 'Did you mean "check"'),
        (["new", "scene.xml", "--output", "costs.py"], "--force"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(scene, capsys, arguments, said):
    Path("refused.xml").write_text("<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>")
    Path("costs.py").write_text(COSTS)
    Path("motion.csv").write_text("time,z,push\n0,0,0\n.1,0,0\n")
    Path("twice.csv").write_text("time,z,z,push\n0,0,0,0\n")
    assert cli.main(arguments) == 2
    told = capsys.readouterr().err
    *_, line = told.splitlines(keepends=True)
    assert said in line
    assert "step 0" not in told  # before the search
    assert len(line) < 500
    assert "Traceback" not in line


@pytest.mark.parametrize(
    ("name", "said"), [("no.xml", "there is no file no.xml\n"), (".", ". is a folder: name a file in it\n")]
)
def test_what_is_no_file_is_said_before_how_long_a_check_takes(scene, capsys, name, said):
    assert cli.main(["check", name]) == 2
    assert capsys.readouterr().err == said


@pytest.mark.parametrize(
    ("cost", "code", "said"),
    [
        ("height", 0, "- The cost is "),
        ("count", 1, "its derivative along a change 0."),
        ("root", 1, "its derivative along a change nan."),
    ],
)
def test_a_quick_check_calls_the_cost_once_with_its_derivative(scene, capsys, cost, code, said):
    Path("costs.py").write_text(COSTS)
    assert cli.main(["check", scene, "--quick", "--cost", f"costs.py:{cost}"]) == code
    assert said in " ".join(capsys.readouterr().out.split())


def test_a_full_disk_costs_neither_the_answer_nor_what_was_there(scene, capsys, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    Path("page.html").write_text("before")
    monkeypatch.setattr(Path, "replace", full)
    assert cli.main(["check", scene, "--quick", "--html", "page.html"]) == 2
    said = capsys.readouterr()
    assert said.out.startswith("scene.xml: Take contact=mg.Slope() and alpha_order")
    assert "page.html could not be written: No space left on device" in said.err
    assert sorted(path.name for path in Path().iterdir()) == ["page.html", "scene.xml"]
    assert Path("page.html").read_text() == "before"


def test_a_reader_who_is_gone_costs_neither_the_page_nor_the_exit_code(scene, capsys, monkeypatch):
    """A closed pipe, closed streams, and a terminal that lacks the signs of the answer."""
    Path(scene).write_text(SCENE.format(gear=0))  # a fault
    read, wrote = os.pipe()
    os.close(read)
    with os.fdopen(wrote, "w") as pipe:
        for stream in (pipe, None):
            with monkeypatch.context() as patch:
                patch.setattr(sys, "stdout", stream)
                patch.setattr(sys, "stderr", stream)
                assert cli.main(["check", scene, "--quick", "--html", "page.html"]) == 1
            Path("page.html").unlink()
    with io.TextIOWrapper(io.BytesIO(), encoding="ascii") as terminal:
        monkeypatch.setattr(sys, "stdout", terminal)
        assert cli.main(["check", scene, "--quick"]) == 1
        assert b"No effect: actuator 'push'" in terminal.buffer.getvalue()


def test_an_interruption_ends_in_one_line(scene, capsys, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(mg, "check", interrupted)
    assert cli.main(["check", scene]) == 130
    assert capsys.readouterr().err.splitlines()[1:] == ["interrupted before there was anything to write"]


_SWEEP = ["sweep", "scene.xml", "--samples", "64", "--horizon", "20", "--engine", "mujoco", "--stiffness", "1e3", "1e5"]


@pytest.mark.parametrize(
    ("arguments", "at", "said"),
    [
        (_SWEEP, "2 of 6", "Interrupted after 33% of the rollouts, at 2 of 3 stiffnesses."),
        (_SWEEP, "3 of 6", "Interrupted after 50% of the rollouts, at 3 of 3 stiffnesses."),
        ([*_IDENTIFY[:4], "gear:push"], "step 1:", "Interrupted, best so far"),
        (
            [*_IDENTIFY[:4], "gear:push"],
            "step 0:",
            "Interrupted before anything was measured; the values are the first ones",
        ),
        (["check", "scene.xml"], "timing gradients", "Derivatives were not measured: it was interrupted."),
        (["check", "scene.xml"], "derivatives over", "Derivatives were not measured: it was interrupted."),
        (["check", "scene.xml", "--mjx"], "compiling a step", "Expected error beside the slope"),
    ],
)
def test_an_interrupted_command_prints_and_writes_what_it_has_measured(
    tmp_path, capsys, monkeypatch, arguments, at, said
):
    """The signal comes when the command tells of its progress."""
    monkeypatch.chdir(tmp_path)
    Path("scene.xml").write_text(SCENE.format(gear=1))
    rows = "".join(f"{0.01 * i},{1e-4 * i * i},1\n" for i in range(20))
    Path("motion.csv").write_text(f"time,z,push\n{rows}")
    monkeypatch.setattr(cli, "_timed", lambda: lambda text: text.startswith(at) and signal.raise_signal(signal.SIGINT))
    assert cli.main(arguments) == 130
    told = capsys.readouterr()
    assert said in told.out
    assert told.err.endswith("interrupted\n")
    assert Path("sweep.html").exists() == (arguments[0] == "sweep")
    assert Path("identified/report.html").exists() == (at == "step 1:")


def test_a_signal_that_is_sent_twice_at_once_is_one(scene, capsys, monkeypatch):
    """`timeout` tells a process and then its group."""

    def check(*_, **__):
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
            time.sleep(0.05)  # Python 3.11 calls the handler a little later
        signal.raise_signal(signal.SIGTERM)
        raise ValueError("what was measured")

    monkeypatch.setattr(mg, "check", check)
    former = signal.getsignal(signal.SIGINT)
    assert cli.main(["check", scene]) == 2
    assert capsys.readouterr().err.endswith("what was measured\n")
    assert signal.getsignal(signal.SIGINT) is former


@pytest.mark.parametrize(
    "signals_sent",
    [
        [signal.SIGINT],
        *(pytest.param(one, marks=pytest.mark.slow) for one in ([signal.SIGTERM], [signal.SIGINT, signal.SIGINT])),
    ],
)
def test_a_signal_within_a_long_computation_ends_the_process_within_a_second_or_two(tmp_path, signals_sent):
    """A sweep that would take many minutes, at its first progress; the answer so far is printed and the page written."""
    (tmp_path / "scene.xml").write_text(SCENE.format(gear=1))
    command = [
        sys.executable,
        "-m",
        "mjxgrad",
        "sweep",
        "scene.xml",
        "--samples",
        "800",
        "--horizon",
        "50",
        "--engine",
        "mujoco",
    ]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, cwd=tmp_path, text=True, **pipes) as process:
        assert process.stderr is not None
        assert process.stdout is not None
        began, first = time.monotonic(), process.stderr.readline()
        assert "moving from the start under noise" in first
        while " s a gradient of 16 rollouts, by C MuJoCo" not in (line := process.stderr.readline()):
            assert line
        assert time.monotonic() - began < 30
        while "parts" not in (line := process.stderr.readline()):
            assert line
        sent = time.monotonic()
        for number in signals_sent:
            process.send_signal(number)
            time.sleep(0.4)
        assert process.wait(20) == 130
        spent, told = time.monotonic() - sent, process.stderr.read()
        assert "Traceback" not in told
        assert told.endswith("interrupted\n")
        if len(signals_sent) == 1:
            assert "Interrupted after" in process.stdout.read()
            assert (tmp_path / "sweep.html").exists()
    assert spent < 15  # a second on an idle core


# On the way to the first module of that name, once; an importer that swallows the interrupt stands for C++ that does.
INTERRUPTED = """
import os, signal, sys
class Importer:
    def find_spec(self, name, *_):
        if name == "{module}":
            sys.meta_path.remove(self)
            try:
                os.kill(os.getpid(), signal.SIGINT)
                sum(range(10**6))
            except KeyboardInterrupt:
                if not {is_lost}: raise
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.meta_path.insert(0, Importer())
"""


@pytest.mark.parametrize("module", ["jax", "optax", "cyclopts"])
def test_a_command_that_is_interrupted_while_it_is_imported_says_so_in_a_word(tmp_path, module):
    name = tmp_path / "mjxgrad"
    name.write_text(INTERRUPTED.format(module=module, is_lost=True) + "from mjxgrad.cli import main\nmain(['--help'])")
    done = python(str(name), PYTHONPATH=str(Path(mg.__file__).parents[1]))
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "interrupted\n")


@pytest.mark.parametrize("is_lost", [True, False])
def test_an_interruption_of_an_import_reaches_the_program_even_if_it_was_swallowed(is_lost):
    code = INTERRUPTED.format(module="optax", is_lost=is_lost)
    told = "try:\n import mjxgrad\nexcept KeyboardInterrupt:\n print('told')"
    done = python("-c", code + told)
    assert done.stdout.splitlines()[0] == "told", done.stderr


@pytest.mark.usefixtures("checks_quickly")
def test_new_says_what_its_program_takes_and_what_its_video_lacks(scene, capsys, monkeypatch):
    assert cli.main(["new", scene]) == 0
    said = capsys.readouterr()
    assert "which takes about" in said.out
    assert "video" not in said.err
    monkeypatch.setattr(cli.importlib.util, "find_spec", lambda name: None)
    assert cli.main(["new", scene, "--force"]) == 0
    assert "pip install 'mjxgrad[render]'" in capsys.readouterr().err


@pytest.mark.usefixtures("checks_quickly")
@pytest.mark.parametrize(("output", "is_absolute"), [("sub/task.py", False), ("task.py", False), ("sub/task.py", True)])
def test_a_new_program_finds_its_scene_and_its_film_from_any_folder(scene, tmp_path, output, is_absolute):
    Path("sub").mkdir()
    assert (
        cli.main(["new", str(tmp_path / scene) if is_absolute else scene, "--output", output, "--horizon", "70"]) == 0
    )
    program = Path(output).read_text()
    (source,) = re.findall(r"load_scene\((.*), engine", program)
    (film,) = re.findall(r"write_video\((.*), mg", program)
    names = {"Path": Path, "__file__": str(tmp_path / output)}
    found, filmed = (Path(eval(one, names)) for one in (source, film))
    assert found.is_absolute()
    assert found.samefile(scene)
    assert filmed == (tmp_path / output).with_suffix(".mp4")
    assert "horizon=70" in program


@pytest.mark.parametrize("name", ["optax", "equinox", "numpy"])
def test_a_file_that_hides_a_library_is_named(tmp_path, name):
    """By the last line of the traceback; Python itself named the attribute alone."""
    (tmp_path / f"{name}.py").write_text("")
    (tmp_path / "program.py").write_text("import mjxgrad")
    ended = subprocess.run([sys.executable, "program.py"], cwd=tmp_path, capture_output=True, text=True)
    assert ended.stderr.endswith(f"ImportError: {tmp_path / name}.py hides the library {name}: rename it\n")


def test_the_library_imports_nothing_heavy_and_its_command_line_says_what_it_lacks():
    """No pictures, nor what only experiments need, also where stdout is closed; then without its own package."""
    heavy = ("cyclopts", "OpenGL", "gymnasium", "brax", "mujoco_playground", "jinja2", "matplotlib", "mediapy")
    code = "import sys; stdout, sys.stdout = sys.stdout, None; import mjxgrad; sys.stdout = stdout; "
    code += f"print([name for name in {heavy} if name in sys.modules])"
    code += "; sys.modules['cyclopts'] = None; import mjxgrad.__main__"
    ran = python("-c", code)
    assert (ran.returncode, ran.stdout.strip()) == (2, "[]")
    assert ran.stderr == "the command line needs cyclopts, not installed: pip install 'mjxgrad[cli]'\n"


@pytest.mark.slow
def test_a_new_program_moves_the_scene_and_films_it(scene):
    assert cli.main(["new", scene]) == 0
    ran = subprocess.run([sys.executable, "task.py"], capture_output=True, text=True, check=True)
    _, reached, _, before = ran.stdout.splitlines()[-1].split()
    assert float(reached) < float(before)
    assert Path("task.mp4").stat().st_size > 1000


_PAGE = "a page needs jinja2, not installed: pip install 'mjxgrad[render]'\n"


@pytest.mark.parametrize(
    ("arguments", "missing", "said"),
    [
        (["check", "scene.xml", "--html", "nowhere/page.html"], "nothing", "cannot be written"),
        (["new", "scene.xml", "--output", "nowhere/task.py"], "nothing", "cannot be written"),
        (
            ["new", "scene.xml", "--output", "task.mp4"],
            "nothing",
            "task.mp4 must be named as a program, such as task.py",
        ),
        (
            ["new", "task.py", "--output", "task.py", "--force"],
            "nothing",
            "task.py would replace task.py, which is read",
        ),
        (
            ["check", "scene.xml", "--html", "./scene.xml"],
            "nothing",
            "scene.xml would replace scene.xml, which is read",
        ),
        (
            ["sweep", "scene.xml", "--cost", "task.py:a", "--html", "task.py"],
            "nothing",
            "task.py would replace task.py",
        ),
        (["identify", "identified.xml", *_IDENTIFY[2:], "--output", "."], "nothing", "would replace identified.xml"),
        ([*_IDENTIFY, "--output", "scene.xml"], "nothing", "cannot be written"),
        (["check", "scene.xml", "--html", "page.html"], "jinja2", _PAGE),
        (["sweep", "scene.xml"], "jinja2", _PAGE),
        (_IDENTIFY, "jinja2", _PAGE),
    ],
)
def test_what_could_not_be_written_is_refused_before_the_work(scene, capsys, monkeypatch, arguments, missing, said):
    for name in ("identified.xml", "task.py"):
        Path(name).write_text("kept")
    monkeypatch.setattr(cli, "_library", lambda: pytest.fail("the work was begun"))
    monkeypatch.setitem(sys.modules, missing, None)
    assert cli.main(arguments) == 2
    assert said in capsys.readouterr().err


@pytest.mark.usefixtures("checks_quickly")
def test_a_program_is_short_starts_at_the_key_frame_and_holds_no_code_of_a_file_name(scene, monkeypatch):
    name = 'q""" + stop + """.xml'
    keyed = SCENE.format(gear=1).replace(
        "</mujoco>", '<keyframe><key name="home" qpos=".1" ctrl=".5"/></keyframe></mujoco>'
    )
    Path(name).write_text(keyed)
    assert cli.main(["new", name]) == 0
    program = Path("task.py").read_text()
    compile(program, "task.py", "exec")
    assert "stop" not in compile(program, "task.py", "exec").co_names
    assert len(program.splitlines()) <= 45
    assert "controls(result.best_params" in program, "the last step may be far worse"
    assert "evaluate=reached" in program
    assert "mg.initial_state(scene, keyframe='home')" in program
    assert "home = scene.mj_model.key('home').ctrl" in program


@pytest.mark.parametrize(
    "command",
    [["-m", "mjxgrad", "check", "scene.xml"], ["-m", "experiments", "run", "ramp"], ["-c", "import mjxgrad"]],
)
def test_a_switch_of_jax_that_is_no_switch_is_said_in_one_line(command):
    *before, line = python(*command, JAX_ENABLE_X64="maybe").stderr.splitlines()
    assert "JAX_ENABLE_X64" in line
    assert line.endswith("JAX's switches are true or false, 1 or 0")
    assert not any("jax/" in one for one in before)
    assert len(before) == 0 or command[0] == "-c"


def test_a_platform_that_is_not_there_is_said_in_one_line(scene):
    done = python("-m", "mjxgrad", "check", str(Path(scene).absolute()), "--quick", JAX_PLATFORMS="cuda")
    if done.returncode != 2:
        pytest.skip("there is a GPU")
    assert done.stderr.splitlines()[-1] == "JAX finds no device of JAX_PLATFORMS=cuda: unset it"
