"""The line that opens each report, from numbers whose answer is known."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from experiments.config import ExperimentError, Run, kinds, part
from experiments.report import MOST_WORDS
from experiments.runner import _call
from experiments.settings import RunSettings
from experiments.words import capitalised, merged, named
from experiments.workspace import Workspace
from mjxgrad.diagnostics import Crossover


def say(kind, outcome):
    return part(kind, "report").answer(outcome)


def throws(task, biased, zeroth=0.0, noisy=0):
    """First order is biased, or too noisy, at some stiffnesses; zeroth order is off by some half widths at the first."""
    stiffness, zero = [10.0, 100.0, 1e4], np.zeros((3, 2))
    off = zero.copy()
    off[0, 0] = zeroth
    cells = {
        "is_biased": np.array(biased)[:, None] & np.ones((3, 2), bool),
        "zeroth_is_off": abs(off) > 2,
    }
    cells |= {"reference": zero + 1, "bias_low": zero - 0.1, "bias_high": zero + 0.1 + np.array([[0], [noisy], [0]])}
    swept = xr.Dataset(
        {name: (("stiffness", "angle"), value) for name, value in cells.items()}, {"stiffness": stiffness}
    )
    return SimpleNamespace(swept=swept, settings=SimpleNamespace(problem=task))


def estimated(problem, biased, errors=None, num_outlying=(5, 0)):
    """Some estimators with their biases in the end; errors of first and zeroth order from the softest to the stiffest."""
    last = xr.DataArray([list(biased.values())] * 2, {"estimator": list(biased)}, ("setting", "estimator"))
    table = None
    if errors:
        table = xr.Dataset({"rmse": (("setting", "estimator"), errors)}, {"estimator": ["first order", "zeroth order"]})
    hits = [(0.1, SimpleNamespace(num_outlying=count)) for count in num_outlying]
    settings = SimpleNamespace(problem=problem, stiffness=(10.0, 1e4))
    return SimpleNamespace(is_biased=last, by_stiffness=table, settings=settings, hits=hits)


def long(*problems):
    """Problems with a crossing (s), up to 2 s, and errors by windows of two lengths and the whole, zeroth order at 0.5."""

    def errors(*values):
        return SimpleNamespace(error=np.array(values))

    return SimpleNamespace(
        found={
            title: SimpleNamespace(
                title=title,
                times=np.array([0.1, 1.0, 2.0]),
                crossovers={
                    "first order, discrete": Crossover(0.1, 0.1, 0.1, np.zeros(3)),
                    "first order, onset": Crossover(crossing, crossing, crossing, np.zeros(3)),
                },
                windows=SimpleNamespace(errors={("x", "y"): errors(0.9, window, 0.8)}, zeroth=errors(0.5)),
            )
            for title, crossing, window in problems
        }
    )


def stroke(**ends):
    """Descents by name: below one the stroke is found."""
    runs = [
        SimpleNamespace(
            method=SimpleNamespace(label=label.replace("_", " ")), touches_at_start=end < 0, is_solved=end < 1
        )
        for label, end in ends.items()
    ]
    return SimpleNamespace(runs=runs)


def rolled(**ends):
    """Descents by name, each with its final cost: below 0.1 the bed is found."""
    descents = [SimpleNamespace(label=label.replace("_", " "), costs=[1.0, end]) for label, end in ends.items()]
    return SimpleNamespace(descents=descents, is_solved=lambda one: one.costs[-1] < 0.1)


def noise(deviation):
    names = {"gaussian": (True, 1.0), "logistic": (True, 1.0), "margin": (True, 0.0), "impedance": (False, np.nan)}
    found = {name: SimpleNamespace(is_noise=is_noise, stddev=stddev) for name, (is_noise, stddev) in names.items()}
    linear = xr.Dataset({"deviation": (("way", "entry"), [deviation])}, {"way": ["zeroth order"]})
    return SimpleNamespace(noise=found, linear=linear)


def planned(**moved):
    """Attempts by model: what share of the way the rod comes in each; 1 is its goal."""
    attempts = [SimpleNamespace(model=model, share=share) for model, shares in moved.items() for share in shares]
    return SimpleNamespace(
        attempts=attempts,
        of=lambda model: [one for one in attempts if one.model == model],
        is_solved=lambda one: one.share == 1,
        moved=lambda one: one.share,
    )


def toss(**seconds):
    """By contact, the seconds of an slope at MuJoCo's motion that is right, or of one that is not."""
    from experiments.cube_toss import Course, Point

    reference = np.array([0.5, 0.5])
    return SimpleNamespace(
        courses=[
            Course(contact, reference, (Point("slope", 1e-3, reference * (1 if s > 0 else 2), s, 1.0, 10.0, False),))
            for contact, s in seconds.items()
        ]
    )


def tossed(side, place, turn):
    """A side in m, and the mean errors of two tosses by it."""
    fits = {"rounded corners": SimpleNamespace(values={"side": side})}
    return SimpleNamespace(
        fits=fits, judged={"rounded corners": np.array([[place - 0.01, turn, 0, 0], [place + 0.01, turn, 0, 0]])}
    )


def bounced(judged, **holds):
    shape = {"arm": list(holds), "timestep": [5e-4], "contact": range(4)}
    grid = xr.Dataset(coords=shape)
    grid["holds"] = ("arm", "contact"), [np.arange(4) < count for count in holds.values()]
    grid["judged"] = ("timestep", "contact"), [np.arange(4) < judged]
    return SimpleNamespace(grid=grid.assign(holds=grid.holds.expand_dims(timestep=1)))


def shaken(found, slopes=()):
    """Bodies by name with the largest jump under a gentle contact; slopes are (jump, deviation of first order)."""
    by_shape = {name: [SimpleNamespace(is_lattice="×" in name, worst=lambda _, x=x: x)] for name, x in found.items()}
    slopes = [SimpleNamespace(jump=jump, deviation=[deviation]) for jump, deviation in slopes]
    return SimpleNamespace(by_shape=by_shape, slopes=slopes, settings=SimpleNamespace(threshold=0.05))


def priced(*costs, estimator=None):
    """Scenes by seconds per simulated second of a step that is right; none where the step is wrong."""
    from experiments.work_precision.outcome import MG, Estimate, Knobs, Point, Variant

    names = estimator if isinstance(estimator, tuple) else (estimator,) * len(costs)
    courses = []
    for cost, name in zip(costs, names, strict=True):
        estimates = [Estimate(name, 10, 2e-3, 1.0, 0.01, (0, 0), 0.0, 0.0, 1e-4, (1.0,), 0.0)] if name else []
        points = [Point(Variant(MG), Knobs(2e-3, 1e-8), *((0.001,) if cost else (1.0,)) * 2, (cost or 1.0,))]
        course = SimpleNamespace(estimates=estimates, floor=lambda _: 0.0, in_batch=lambda p=points: p)
        courses.append(course)
    return SimpleNamespace(courses=courses, settings=SimpleNamespace(targets=(0.01,)))


def stable(ours, theirs, derivative, silent=0):
    """Three points: kinds of motion, of C MuJoCo's, of derivatives, and how many failures carry no flag."""
    cells = {"motion": [theirs, ours], "derivative": [[-1] * 3, derivative], "missed": [[False] * 3] * 2}
    cells["silent"] = [[False] * 3, list(np.arange(3) < silent)]
    found = xr.Dataset({name: (("simulator", "point"), value) for name, value in cells.items()})
    found = found.assign_coords(simulator=["C MuJoCo", "float64"])
    return SimpleNamespace(found=found, scenes=[], settings=SimpleNamespace(precisions=("float64",)))


def taught(stiffness=(1.0,), environment="hopper", late=(), **returns):
    """Returns of each seed by method, at the first stiffness; a tenth of them at the last, but for the onset.

    The reward rises from 0 to 1 in the second update, of those that are late in the third.
    """
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


def pushed(*points):
    """Points by whether they hit and miss, and the lowest bias that is not chance of the discrete gradient and the onset's."""
    cells = [
        SimpleNamespace(
            hits_and_misses=jumps,
            judged={name: SimpleNamespace(bias=x, low=x) for name, x in (("discrete", discrete), ("onset", onset))},
        )
        for jumps, discrete, onset in points
    ]
    return SimpleNamespace(cells=cells)


def teeth(smaller):
    """Two readings with an impact before them; at the first the mean derivative is the slope."""
    found = xr.Dataset(
        {"smaller": ("time", [smaller] * 2), "has_impact": ("time", [True] * 2)}, {"arm": ["continuous onset"]}
    )
    return SimpleNamespace(courses=[found.assign(within=(("arm", "time"), [[True, False]]))])


SEES = {"first order": True, "zeroth order": False, "α-order": False}
CASES = [
    (
        "bias_variance",
        throws("ball_wall", [0, 0, 1]),
        "Zeroth order is right throughout; first order only up to stiffness 100 1/s².",
    ),
    (
        "bias_variance",
        throws("ball_wall", [0, 0, 1], noisy=3),
        "Zeroth order is right throughout; first order only up to stiffness 10 1/s².",
    ),
    (
        "bias_variance",
        throws("ball_wall", [1, 1, 1], 5.0),
        "Zeroth order is right at 5 of 6 points; first order at no contact stiffness.",
    ),
    ("bias_variance", throws("ramp", [0, 0, 0]), "Zeroth order is right throughout; first order shows no bias either."),
    ("textbook", estimated("heaviside", SEES), "All but first order see it."),
    ("textbook", estimated("heaviside", dict.fromkeys(SEES, False)), "All of them see it."),
    ("textbook", estimated("heaviside", SEES | {"α-order": True}), "Zeroth order sees it."),
    (
        "textbook",
        estimated("soft_heaviside", SEES, [[1.0, 2.0], [30.0, 3.0]]),
        "First order's error grows 30×, zeroth order's 1.5×; all samples miss from 1/ν = 10⁴.",
    ),
    (
        "textbook",
        estimated("quadratic_sine", SEES, [[1.0, 2.0], [40.0, 2.0]]),
        "It multiplies first order's error by 40, zeroth order's by 1.",
    ),
    ("kernels", noise([1.0, 2.0]), "Gaussian and logistic noise; sampling agrees in all 2 derivatives."),
    ("kernels", noise([1.0, 9.0]), "Gaussian and logistic noise; sampling agrees in 1 of 2 derivatives."),
    (
        "rolling_pin",
        rolled(first_order=1.0, contact_loss=0.01, larger_pin=0.002),
        "2 of 3 ways find it, best “larger pin”; first order alone does not.",
    ),
    ("rolling_pin", rolled(first_order=1.0), "None of 1 ways finds it."),
    (
        "billiards",
        stroke(first_order=2, event=2, margin=0, kernel=0, noise=0),
        "3 of 5 find it to 1%, but not “first order” or “event”.",
    ),
    ("billiards", stroke(first_order=2, margin=0, touching=-1), "1 of 2 find it to 1%: “margin”."),
    ("billiards", stroke(touching=-1), "Not answered: the balls touch at every start."),
    ("planning", planned(analytic=[1], none=[0]), "Yes, with smoothed models; with plain ones the rod does not move."),
    (
        "planning",
        planned(analytic=[1, 0.2], none=[0, 0.1]),
        "Yes (1 of 2), with smoothed models; with plain ones no (0 of 2).",
    ),
    (
        "planning",
        planned(analytic=[0.5], none=[0]),
        "No, not even with smoothed models; with plain ones the rod does not move.",
    ),
    ("long_horizon", long(("hopper", 0.8, 0.6)), "Better to 0.8 s (hopper); windows do not help."),
    (
        "long_horizon",
        long(("double pendulum", 1.3, 0.1), ("hopper", 0.8, 0.2)),
        "Better to 1.3 s (double pendulum), to 0.8 s (hopper); windows help everywhere.",
    ),
    (
        "long_horizon",
        long(("double pendulum", np.inf, 0.1), ("hopper", 0.1, 0.6)),
        "Better beyond 2 s (double pendulum), nowhere (hopper); windows help the double pendulum.",
    ),
    ("cube_toss", toss(default=-1.0), "None comes within 2%; the nearest, slope at MuJoCo's motion, is 100% off."),
    (
        "cube_toss",
        toss(published=0.052, default=-1.0),
        "Continuous force: 0.052 s, slope at MuJoCo's motion; MuJoCo's default: none within 2%.",
    ),
    (
        "real_tosses",
        tossed(0.1027, 0.13, 15.2),
        "The side is 2.0% short; held-out tosses are off by 13% of it and 15°.",
    ),
    (
        "bounce",
        bounced(0, **{"continuous onset": 0, "slope": 0, "discrete": 0}),
        "At no contact is the slope known well enough: take more phases.",
    ),
    (
        "bounce",
        bounced(4, **{"continuous onset": 4, "slope": 3, "discrete": 1}),
        "Right at 4 (continuous onset), 3 (slope) and 1 (discrete) of 4 settings.",
    ),
    (
        "artificial_discontinuity",
        shaken({"box": 0.4, "ball": 0.0}, [(1.0, 9.0), (1.0, 1.0), (0.0, 9.0)]),
        "Box; first order is biased across 1 of 2 jumps.",
    ),
    ("artificial_discontinuity", shaken({"box": 0.4, "ball": 0.0, "2 × 2 points": 0.9}), "Box and points."),
    ("artificial_discontinuity", shaken(dict.fromkeys(["a b c", "d e f", "g h"], 1.0) | {"ball": 0.0}), "3 of 4."),
    (
        "work_precision",
        priced(5e-4, 2e-3, estimator="first order, onset"),
        "1% error: 0.5–2 ms a simulated second; gradients: first order, onset.",
    ),
    (
        "work_precision",
        priced(5e-4, None, 2e-3, estimator="first order, onset"),
        "1% error: 0.5–2 ms a second on 2 of 3 scenes; gradients: first order, onset.",
    ),
    (
        "work_precision",
        priced(5e-4, 5e-4, estimator=("α-order, onset", "zeroth order")),
        "1% error: 0.5 ms a simulated second; gradients: 2 ways tie.",
    ),
    ("work_precision", priced(None), "No setting is known to reach 1% of the motion."),
    (
        "stability",
        stable([0, 2, 4], [0, 4, 4], [0, 2, 5]),
        "Motion holds at 67% (C MuJoCo: 33%), gradients there at 50%; every failure is flagged.",
    ),
    (
        "stability",
        stable([0, 2, 4], [0, 4, 4], [0, 0, 0], silent=2),
        "Motion holds at 67% (C MuJoCo: 33%), gradients there at 100%; 2 failures are unflagged.",
    ),
    (
        "learning",
        taught(onset=[9.0, 9, 9, 9], zeroth=[1.0, 2, 3, 4], late=("zeroth",)),
        "Soonest and worth most: first order, 9.00.",
    ),
    (
        "learning",
        taught(onset=[9.0, 9, 9, 9], zeroth=[1.0, 2, 3, 4], late=("onset",)),
        "Soonest: zeroth order; worth most: first order, 9.00.",
    ),
    (
        "learning",
        taught(alpha=[9.0, 9, 9], onset=[1.0, 2, 3], late=("onset",)),
        "Soonest and worth most: α-order, 9.00; 3 seeds cannot tell it from first order.",
    ),
    (
        "learning",
        taught(discrete=[9.0, 9, 9], slope=[1.0, 2, 3], late=("discrete",)),
        "Soonest: first order by the slope; worth most: first order without an onset, 9.00 (unproven).",
    ),
    (
        "learning",
        taught(environment="trot", onset=[-24.0]),
        "After 300 steps, 1.50 s, first order returns −24.0 in C MuJoCo.",
    ),
    (
        "learning",
        taught((1.0, 50.0), onset=[9.0], zeroth=[1.0]),
        "With contact 50 times as stiff, first order still earns half.",
    ),
    (
        "optimisation",
        ended(first_order=[float(i) for i in range(8)], zeroth_order=[10.0 + i for i in range(8)]),
        "First order ends lowest (3.50), zeroth order highest (13.5).",
    ),
    (
        "optimisation",
        ended(first_order=[1.0, 1.1, 1.2], zeroth_order=[2.0, 2.1, 2.2], MPPI=[9.0, 9.0, 9.0]),
        "First order ends lowest (1.10; 3 seeds cannot prove it), MPPI highest (9.00).",
    ),
    (
        "optimisation",
        ended(**{"zeroth_order_(zero_noise,_pairs)": [1.0], "zeroth_order_(no_baseline,_pairs)": [2.0]}),
        "Zeroth order (zero noise, pairs) ends lowest (1.00; one seed cannot prove it).",
    ),
    ("optimisation", ended(lone=[1.0, 2.0]), "Lone ends lowest, at 1.50 ± 0.50."),
    ("policy_gradient", pushed((True, 0.5, 0.5)), "It does not see hits and misses: biased at 1 of 1 points."),
    (
        "policy_gradient",
        pushed((False, 0.5, 0.0), (True, 0.5, 0.5)),
        "It cuts the points with a biased gradient from 1 to 0 of 1.",
    ),
    ("policy_gradient", pushed((False, 0.0, 0.0)), "First order is right with and without it, at all 1 points."),
    ("sawtooth", teeth(23.0), "With an onset the sawtooth is 23 times smaller, its mean derivative right at 50%."),
]


@pytest.mark.parametrize(("kind", "outcome", "expected"), CASES)
def test_the_answer_is_what_the_numbers_say_in_a_line(kind, outcome, expected):
    assert say(kind, outcome) == expected
    assert len(expected.split()) <= MOST_WORDS


def test_the_verdict_on_stability_says_first_what_is_flagged_then_how_it_compares():
    assert part("stability", "report").verdict(stable([0, 2, 4], [0, 4, 4], [0, 2, 5])) == (
        "Every rollout with a number that is not finite is flagged. `soundness` tells every gradient that explodes or is not "
        "finite. In float64 2 of 3 motions are as good as C MuJoCo's, none worse and 1 better."
    )
    silent = part("stability", "report").verdict(stable([0, 2, 4], [0, 0, 0], [0, 2, 5], silent=2))
    assert silent.startswith("2 rollouts have a number that is not finite, and no flag.")
    assert silent.endswith("1 worse and none better.")


def test_every_kind_answers():
    assert {kind for kind, *_ in CASES} == set(kinds())


def test_a_kind_without_an_answer_is_refused_before_anything_is_measured(tmp_path, monkeypatch):
    silent = SimpleNamespace(measure=lambda *_: pytest.fail("measured"), verdict=str, tables=list, drawings=dict)
    monkeypatch.setattr("experiments.runner.part", lambda *_: silent)
    with pytest.raises(ExperimentError, match="lacks answer"):
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


def test_a_greek_letter_stays_small_at_the_start_of_a_sentence():
    assert capitalised("α-order wins") == "α-order wins"
    assert capitalised("first order wins") == "First order wins"
