"""What is put back is at work, changes no result, and is told."""

import pytest

from experiments import ablation
from experiments.ablation import Cost, Outcome, Settings, Sizes, answer, drawings, findings, tables, verdict
from experiments.problems import left_out
from experiments.problems.left_out import ONLY_GRADIENT, PARTS, file_of, is_left_out, program, starts_of

_SIZES = Sizes(scenes={"hopper": ("values",)}, batch=2, few=2, horizon=3, repeats=2)
_SETTINGS = Settings(experiment="ablation", sizes=_SIZES)


def _starts(name):
    return starts_of(file_of(name).compile(), 2, 3, 0)


@pytest.mark.parametrize(
    ("name", "work", "keys"),
    [
        ("cartpole", "forward", ["rows", "forces", "record", "carry", "numbers"]),
        pytest.param("cartpole", "gradient", ["values"], marks=pytest.mark.slow),
        ("sensing_arm", "forward", ["storage", "cold", "columns"]),
        pytest.param("ball_wall", "forward", ["damping"], marks=pytest.mark.slow),
    ],
)
def test_each_part_put_back_makes_another_program(name, work, keys):
    """Equal text would be a part that is not put back, and a measured factor of nothing."""
    parts = [[], *([PARTS[key]] for key in keys)]
    texts = [program(name, one, "mjx", work, _starts(name)).lowered.as_text() for one in parts]
    assert len(set(texts)) == len(texts)


def test_c_mujoco_gives_the_same_gradient_with_parts_put_back(monkeypatch):
    """Columns by velocity that compute every stage are differences of one side, of the same width: equal to rounding over it."""
    begun = []
    monkeypatch.setattr(left_out, "_BEGIN", lambda *a, own=left_out._BEGIN: begun.append(1) or own(*a))
    keys = [key for key in PARTS if key in ONLY_GRADIENT and is_left_out(key, "sensing_arm", "mujoco")]
    assert keys == ["solution", "stages", "geoms"]
    costs = ablation._compare(
        "sensing_arm", "mujoco", "gradient", {"": []} | {k: [PARTS[k]] for k in keys}, _starts("sensing_arm"), 2
    )
    assert begun
    differences = {cost.part: cost.difference for cost in costs}
    assert differences["geoms"] == 0.0
    assert differences["stages"] < 1e-7
    assert 0.0 < differences["solution"] < 1e-4


def test_runge_and_kutta_have_no_inverse_to_leave_out():
    assert not any(is_left_out(key, "hopper", "mujoco") for key in ONLY_GRADIENT)


def test_inert_parts_are_what_a_step_cannot_know_to_be_inert():
    rows, forces = file_of("cartpole"), file_of("cartpole")
    PARTS["rows"].edit(rows)
    PARTS["forces"].edit(forces)
    model, other = rows.compile(), forces.compile()
    assert model.jnt_limited.all()
    assert (model.dof_frictionloss > 0).all()
    assert (model.neq, other.nu, other.ntendon, other.ngravcomp) == (1, 2, 1, 1)


def test_a_pair_is_put_back_that_only_masks_keep_apart():
    """Of the arm's three pairs the floor and the lower link touch, and the two links are parent and child."""
    file = file_of("falling_arm")
    assert PARTS["pairs"].edit(file)
    (pair,) = file.pairs
    assert {pair.geomname1, pair.geomname2} == {"floor", "geom 1"}


def _outcome():
    def cost(part, work, factor, difference, engine="mjx"):
        time = (0.9 * factor, factor, 1.1 * factor)
        return Cost("hopper", engine, part, work, time, 2 * factor, 1.0, 1e-3, 1e3, 1.0, difference, 1e-16)

    costs = [
        cost("values", "gradient", 0.5, 0.0),
        cost("columns", "forward", 3.0, 1e-16),
        cost("cold", "forward", 1.5, 1e-6),
    ]
    costs += [cost("all", work, 4.0, 0.0, engine) for work in ("forward", "gradient") for engine in ("mjx", "mujoco")]
    return Outcome(_SETTINGS, costs)


def test_the_page_names_the_largest_factors_and_what_hurts():
    outcome = _outcome()
    assert answer(outcome) == "columns of contacts: 6× memory (hopper); columns of contacts: 3× time (hopper)."
    assert len(answer(outcome).split()) <= 15
    assert "Faster with than without: values within steps on hopper." in verdict(outcome)
    assert "cold start of solves: results differ on hopper" in findings(outcome)[0]
    by_mjx = tables(outcome)[0]
    assert by_mjx.emphasised == {(0, 4), (1, 4), (3, 4), (4, 4)}


def test_the_figure_has_a_panel_for_each_scene_and_engine():
    figure, _, _ = drawings(_outcome())["factors"]
    assert len(figure.axes) == 2
