"""The referee: its slope is a closed form's, its protocol is kept by any program, and what cannot be had costs its rows alone."""

import dataclasses
import math
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from experiments import referee
from experiments.config import FOLDER, load_runs
from experiments.referee import (
    ENGINES,
    Outcome,
    Settings,
    answer,
    ask,
    cell,
    drawings,
    findings,
    scenes,
    tables,
    verdict,
)
from experiments.workspace import Workspace

# Prints as engines do, knows one scene and not the other; its second variant gets its derivatives wrong, its third NaN.
FAKE = """
import sys
sys.path.insert(0, {folder!r})
print("loading", flush=True)
from protocol import UnsupportedError, serve

def make(scene, variant):
    print("an engine that talks")
    if scene["name"] == "bounce":
        raise UnsupportedError("nothing bounces")
    if variant == "crash":
        raise RuntimeError("out of luck\\nand more")
    factor = {{"right": 1.0, "double": 2.0, "lost": float("nan")}}[variant]
    distance = lambda speed: speed**2 / (2 * scene["friction"] * 9.81)
    return lambda speed: (distance(speed), factor * speed / (scene["friction"] * 9.81)), distance

serve(make)
"""
VARIANTS = ["right", "double", "lost", "crash"]


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    program = tmp_path_factory.mktemp("engine") / "fake.py"
    program.write_text(FAKE.format(folder=str(FOLDER / "referee_engines")), encoding="utf-8")
    asked = {name: scene for name, scene in scenes(64).items() if name in ("slide", "bounce")}
    request = {"scenes": asked, "variants": VARIANTS, "packages": ["pip"], "budget": 1e-12}
    return ask(sys.executable, program, request)


@pytest.fixture(scope="module")
def cells(answers):
    return {one["variant"]: cell("brax", one) for one in answers[1:] if "error" not in one}


def settings_of(*overrides):
    (run,) = load_runs("referee", list(overrides))
    assert isinstance(run.settings, Settings)
    return run.settings


def test_an_engine_answers_by_lines_whatever_it_prints(answers):
    versions, *rest = answers
    assert list(versions) == ["pip"]
    assert [(one["scene"], one["variant"]) for one in rest] == [(s, v) for s in ("bounce", "slide") for v in VARIANTS]
    assert {one.get("error") for one in rest[:4]} == {"nothing bounces"}
    assert rest[-1]["error"] == "RuntimeError: out of luck"
    # Beyond its budget, fewer starts: the fewest of which a slope is known.
    assert len(rest[4]["values"]) == len(rest[4]["outcomes"]) == len(rest[4]["gradient_seconds"]) == 32


def test_the_slope_of_a_slide_is_its_closed_form(cells):
    """From v²/(2 μ g) the slope at the middle of the interval, 1 m/s, is 1/(μ g); a doubled derivative is off by all of it."""
    for found in cells.values():
        assert found.slope == pytest.approx(1 / (0.5 * 9.81), rel=5e-3)
    assert cells["right"].error < 1e-6
    assert cells["right"].is_right
    assert cells["double"].error == pytest.approx(1, rel=1e-3)
    assert not cells["double"].is_right


def test_a_derivative_that_is_not_finite_is_infinitely_wrong(cells):
    lost = cells["lost"]
    assert lost.num_finite == 0
    assert math.isinf(lost.error)
    assert lost.told_error == "not finite"
    assert not lost.is_right


def test_an_outcome_that_does_not_move_has_no_slope_to_be_right_about(answers):
    still = answers[5] | {"outcomes": [0.1] * 32, "derivatives": [0.0] * 32}
    assert cell("brax", still).told_error == "no slope"
    assert not cell("brax", still).is_right


def test_the_sledge_stops_where_coulomb_friction_stops_it():
    """C MuJoCo's friction is soft, and the first step is without it: within 2 %."""
    scene = scenes(32)["slide"]
    model = mujoco.MjModel.from_xml_string(scene["xml"])
    for speed in (0.9, 1.1):
        data = mujoco.MjData(model)
        data.qvel[0] = speed
        for _ in range(round(scene["duration"] / scene["timestep"])):
            mujoco.mj_step(model, data)
        assert data.qpos[0] == pytest.approx(speed**2 / (2 * scene["friction"] * 9.81), rel=0.02)


@pytest.mark.parametrize("name", ["bounce", "push", "slide", "peg"])
def test_numbers_and_mjcf_of_a_scene_are_the_same_physics(name):
    scene = scenes(32)[name]
    model = mujoco.MjModel.from_xml_string(scene["xml"])
    moved = model.geom_bodyid > 0
    assert model.opt.timestep == scene["timestep"]
    assert model.body_mass[1:] == pytest.approx([scene["mass"]] * len(scene["starts"]))
    assert model.body_inertia[1:] == pytest.approx(np.full((len(scene["starts"]), 3), scene["inertia"]))
    assert model.geom_size[moved, 0] == pytest.approx([scene["radius"]] * moved.sum())
    assert model.geom_pos[moved][: len(scene["balls"])] == pytest.approx(np.array(scene["balls"], float))
    assert model.body_pos[1:] == pytest.approx(np.array(scene["starts"], float))
    assert model.geom_friction[:, 0] == pytest.approx([scene["friction"]] * model.ngeom)
    fixed = [([*model.geom_pos[i]], model.geom_size[i, 0]) for i in np.flatnonzero(~moved) if model.geom_type[i] == 2]
    assert fixed == [([*map(float, place)], size) for place, size in scene["sides"]]
    assert scene["floor"] == (0 in model.geom_type)
    # The standard format: ω = 1/(tc ζ) and 2 ζ ω, of a unit mass.
    time, ratio = model.geom_solref[0]
    assert scene["stiffness"] == pytest.approx(1 / (time * ratio) ** 2)
    assert scene["damping"] == pytest.approx(2 / time)


def test_an_engine_that_cannot_be_installed_costs_its_rows_alone(monkeypatch, tmp_path):
    def refuse(command, **_):
        raise subprocess.CalledProcessError(1, command, stderr="looking\nERROR: No matching distribution found\n")

    monkeypatch.setattr(referee, "_CACHE", tmp_path)
    monkeypatch.setattr(referee.subprocess, "run", refuse)
    settings = settings_of('sizes.engines=["Drake", "jaxsim"]', 'sizes.scenes=["slide"]', "sizes.num_starts=32")
    outcome = referee.measure(settings, Workspace(tmp_path))
    assert outcome.missing == [
        f"{name}: not installed: ERROR: No matching distribution found." for name in ("Drake", "jaxsim")
    ]
    assert answer(outcome) == "Right within 10% and soonest: nobody in 1 of 1 scenes."


def test_the_page_names_the_fastest_of_those_that_are_right(cells):
    settings = settings_of(
        'sizes.scenes=["slide", "bounce"]', 'sizes.engines=["mjxgrad", "MJX-softened", "brax", "Drake"]'
    )
    right = cells["right"]

    def named(engine, variant, seconds, of=right):
        return dataclasses.replace(of, engine=engine, variant=variant, seconds=(seconds, seconds, seconds))

    entries = [
        named("mjxgrad", "mujoco slope", 0.02),
        named("Drake", "sap", 0.01),
        named("brax", "spring", 0.001, cells["double"]),
        named("brax", "generalized", 0.001, cells["lost"]),
        named("MJX-softened", "soft", 0.001),  # right about another motion
    ]
    versions = dict.fromkeys(map(str, settings.sizes.engines), "package 1")
    outcome = Outcome(settings, entries, ["jaxsim soft: no hopper: it loads no MJCF."], versions, "a machine")
    assert answer(outcome) == "Right within 10% and soonest: Drake in 1 and nobody in 1 of 2 scenes."
    assert "slide: Drake sap" in verdict(outcome)
    assert "bounce: nobody" in verdict(outcome)
    assert outcome.missing[0] in findings(outcome)
    short, every = tables(outcome)
    assert len(every.rows) == len(outcome.rows()) == len(entries)
    assert short.emphasised == {(0, 1), (1, 1), (4, 1)}
    figure, _, _ = drawings(outcome)["error_against_time"]
    assert sum(axis.axison for axis in figure.axes) == 2


def test_every_engine_has_a_program_and_pinned_versions():
    for engine in ENGINES.values():
        assert (FOLDER / "referee_engines" / f"{engine['program']}.py").is_file()
        assert all("==" in package for package in engine["requires"])
    assert set(settings_of().sizes.engines) == set(ENGINES)
    assert Path(referee._CACHE).parts[0] == ".cache"
