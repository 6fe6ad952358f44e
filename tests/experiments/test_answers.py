"""The line that opens each report, from numbers whose answer is known."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from experiments.config import ExperimentError, Run, part
from experiments.report import MOST_WORDS
from experiments.runner import _call
from experiments.settings import RunSettings
from experiments.words import merged, named
from experiments.workspace import Workspace


def throws(task, biased, zeroth=0.0, noisy=0):
    """First order is biased, or too noisy, at some stiffnesses; zeroth order is off by some half widths at the first."""
    stiffness, zero = [10.0, 100.0, 1e4], np.zeros((3, 2))
    off = zero.copy()
    off[0, 0] = zeroth
    cells = {"is_biased": np.array(biased)[:, None] & np.ones((3, 2), bool), "zeroth_is_off": abs(off) > 2}
    cells |= {"reference": zero + 1, "bias_low": zero - 0.1, "bias_high": zero + 0.1 + np.array([[0], [noisy], [0]])}
    swept = xr.Dataset(
        {name: (("stiffness", "angle"), value) for name, value in cells.items()}, {"stiffness": stiffness}
    )
    return SimpleNamespace(swept=swept, settings=SimpleNamespace(problem=task))


def estimated(problem, biased, errors=None):
    """Some estimators with their biases in the end; errors of first and zeroth order from the softest to the stiffest."""
    last = xr.DataArray([list(biased.values())] * 2, {"estimator": list(biased)}, ("setting", "estimator"))
    table = None
    if errors:
        table = xr.Dataset({"rmse": (("setting", "estimator"), errors)}, {"estimator": ["first order", "zeroth order"]})
    return SimpleNamespace(is_biased=last, by_stiffness=table, settings=SimpleNamespace(problem=problem))


def tossed(side, place, turn):
    """A side in m, and the mean errors of two tosses by it."""
    fits = {"rounded corners": SimpleNamespace(values={"side": side})}
    return SimpleNamespace(
        fits=fits, judged={"rounded corners": np.array([[place - 0.01, turn, 0, 0], [place + 0.01, turn, 0, 0]])}
    )


def priced(*costs, estimator=None):
    """Scenes by seconds per simulated second of a step that is right; none where the step is wrong."""
    from experiments.work_precision.measure import MG, Estimate, Point, Variant

    courses = []
    for cost in costs:
        estimates = [Estimate(estimator, 10, 2e-3, 0.01, 0.0, 0.0, 1e-4, (1.0,))] if estimator else []
        points = [Point(Variant(MG), 2e-3, 0.001 if cost else 1.0, (cost or 1.0,))]
        courses.append(SimpleNamespace(estimates=estimates, floor=lambda _: 0.0, points=points))
    return SimpleNamespace(courses=courses, settings=SimpleNamespace(targets=(0.01,)))


def stable(ours, theirs, derivative, silent=0):
    """Three points: kinds of motion, of C MuJoCo's, of derivatives, and how many failures carry no flag."""
    cells = {"motion": [theirs, ours], "derivative": [[-1] * 3, derivative]}
    cells["silent"] = [[False] * 3, list(np.arange(3) < silent)]
    found = xr.Dataset({name: (("simulator", "point"), value) for name, value in cells.items()})
    found = found.assign_coords(simulator=["C MuJoCo", "float64"])
    return SimpleNamespace(found=found, scenes=[], settings=SimpleNamespace(precisions=("float64",)))


def taught(stiffness=(1.0,), environment="hopper", late=(), **returns):
    """Returns of each seed by method, a tenth at the last stiffness but for the onset; rewards rise in update 2 or 3."""
    courses = [
        SimpleNamespace(
            method=method,
            stiffness=k,
            judged=np.array(values) * (1 if k == 1 or method == "onset" else 0.1),
            reward=np.array([[0.0], [0.2 if method in late else 1.0], [1.0]]),
            seconds=0.5,
        )
        for method, values in returns.items()
        for k in stiffness
    ]
    from experiments.learning import Outcome

    sizes = SimpleNamespace(num_updates=3)
    names = {"environment": environment, "sizes": sizes, "num_steps": 100}
    settings = SimpleNamespace(stiffness=stiffness, methods=tuple(returns), **names)
    return Outcome(settings, courses, None)


def ended(**costs):
    runs = [
        SimpleNamespace(
            method=SimpleNamespace(label=label.replace("_", " ")), kept=np.array(c), mean=np.mean(c), spread=np.std(c)
        )
        for label, c in costs.items()
    ]
    return SimpleNamespace(runs=runs, best=min(runs, key=lambda run: run.mean))


def teeth(smaller):
    """Two readings with an impact before them; at the first the mean derivative is the slope."""
    found = xr.Dataset(
        {"smaller": ("time", [smaller] * 2), "has_impact": ("time", [True] * 2)}, {"arm": ["continuous onset"]}
    )
    return SimpleNamespace(courses=[found.assign(right=(("arm", "time"), [[True, False]]))])


SEES = {"first order": True, "zeroth order": False, "α-order": False}
SEEDS, FEW = [9.0, 9, 9, 9], [1.0, 2, 3]
ZEROTH, MANY = [1.0, 2, 3, 4], [float(i) for i in range(8)]
CASES = [
    ("bias_variance", throws("ball_wall", [0, 0, 1]), "right throughout; first order only up to stiffness 100 1/s²"),
    ("bias_variance", throws("ball_wall", [1, 1, 1], 5.0), "right at 5 of 6 points; first order at no contact"),
    ("textbook", estimated("heaviside", SEES), "All but first order see it."),
    ("textbook", estimated("heaviside", SEES | {"α-order": True}), "Zeroth order sees it."),
    ("textbook", estimated("soft_heaviside", SEES, [[1.0, 2.0], [30.0, 3.0]]), "grows 30×, zeroth order's 1.5×"),
    ("textbook", estimated("quadratic_sine", SEES, [[1.0, 2.0], [40.0, 2.0]]), "error by 40, zeroth order's by 1."),
    ("real_tosses", tossed(0.1027, 0.13, 15.2), "2.0% short; held-out tosses are off by 13% of it and 15°"),
    ("work_precision", priced(5e-4, None, estimator="first order, onset"), "1 of 2 scenes; gradients: first order"),
    ("work_precision", priced(None), "No setting"),
    ("stability", stable([0, 1, 2], [0, 2, 2], [0, 2, 5]), "holds at 67% (C MuJoCo: 33%), gradients there at 50%"),
    ("learning", taught(discrete=SEEDS, late=("zeroth",), zeroth=ZEROTH), "Soonest and worth most: first order, 9.00."),
    (
        "learning",
        taught(discrete=SEEDS, late=("discrete",), zeroth=ZEROTH),
        "Soonest: zeroth order; worth most: first order",
    ),
    ("learning", taught(alpha=[9.0] * 3, discrete=FEW, late=("discrete",)), "3 seeds cannot tell it from first order"),
    ("learning", taught(onset=[9.0] * 3, slope=FEW, late=("onset",)), "first order with an onset, 9.00 (unproven)"),
    ("learning", taught(environment="trot", discrete=[-24.0]), "After 300 steps, 1.50 s, first order returns −24.0"),
    (
        "learning",
        taught((1.0, 50.0), onset=[9.0], zeroth=[1.0]),
        "times as stiff, first order with an onset still earns half",
    ),
    ("optimisation", ended(first_order=MANY, zeroth_order=[10 + x for x in MANY]), "zeroth order highest (13.5)."),
    ("optimisation", ended(first_order=[1.0, 1.1, 1.2], MPPI=[9.0] * 3), "(1.10; 3 seeds cannot prove it), MPPI"),
    ("sawtooth", teeth(23.0), "23 times smaller, its mean derivative right at 50%"),
]


@pytest.mark.parametrize(("kind", "outcome", "words"), CASES)
def test_the_answer_is_what_the_numbers_say_in_a_line(kind, outcome, words):
    said = part(kind, "report").answer(outcome)
    assert words in said
    assert len(said.split()) <= MOST_WORDS


def test_the_verdict_on_stability_says_first_what_is_flagged_then_how_it_compares():
    said = part("stability", "report").verdict(stable([0, 1, 2], [0, 0, 0], [0, 2, 5], silent=2))
    assert said.startswith("Rollouts with a number that is not finite, and no flag: 2.")
    assert "2 of 3 motions are as good as C MuJoCo's, 1 worse and none better" in said


def test_a_kind_without_answer_and_drawings_is_refused_before_anything_is_measured(tmp_path, monkeypatch):
    silent = SimpleNamespace(measure=lambda *_: pytest.fail("measured"), verdict=str, tables=list)
    monkeypatch.setattr("experiments.runner.part", lambda *_: silent)
    with pytest.raises(ExperimentError, match="lacks answer and drawings"):
        _call(Run("mute", RunSettings(experiment="mute"), "", "", {}), Workspace(tmp_path))


def test_labels_are_listed_where_there_is_room_and_else_counted():
    assert named(["a", "b c"], 4, words=4) == "a and b c"
    assert named(["a", "b c"], 4, words=3) == "2 of 4"
    assert named(["a", "b c"], 2, words=3) == "all 2"
    assert named([], 2, words=3) == "none"


def test_what_is_said_of_several_scenes_is_said_once():
    assert merged(["ant: too soft", "alone", "hopper: too soft", "ant: too soft", "alone"]) == [
        "ant and hopper: too soft",
        "alone",
    ]
