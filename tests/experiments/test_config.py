"""Configurations are refused as a whole, with every mistake and its remedy."""

import time

import pytest

from experiments.config import FOLDER, ConfigurationError, load_runs

VALID = """\
# Is it so?
# Expected: yes, it
# is.
experiment = "bias_variance"
task = "ramp"
stddev = 0.1
angles = [0.05]
stiffness = [1, 1e2]
num_samples = 10
reference_samples = 100
"""


@pytest.fixture
def write(tmp_path):
    def write(text):
        path = tmp_path / "trial.toml"
        path.write_text(text)
        return str(path)

    return write


def mistakes(path, *overrides):
    with pytest.raises(ConfigurationError) as caught:
        load_runs(path, list(overrides))
    return caught.value.mistakes


def test_a_valid_file_is_one_run_with_its_defaults_filled_in(write):
    (run,) = load_runs(write(VALID), [])
    assert (run.name, run.question, run.expected, run.varied) == ("trial", "Is it so?", "yes, it is.", {})
    assert run.settings.stiffness == (1.0, 100.0)
    assert run.settings.seed == 0


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.toml")), ids=lambda path: path.stem)
def test_every_configuration_is_valid_and_opens_with_its_question(path):
    for run in load_runs(str(path), []):
        assert run.question.endswith("?")
        assert run.expected


def test_all_mistakes_are_told_at_once(write):
    text = VALID.replace("stddev = 0.1", 'stddev = "wide"').replace("num_samples = 10", "num_sampels = 10")
    found = mistakes(write(text), "angles=[]", "video.speed=0", "nonsense", "seed=-1")
    assert {sentence.partition(":")[0] for sentence in found} == {
        "stddev", "num_sampels", "num_samples", "angles", "video.speed", "video.angles", "video.stiffness", "nonsense",
        "seed",
    }  # fmt: skip


def test_an_array_that_is_too_short_for_its_own_mistakes_alone_is_not_called_so():
    assert mistakes("sawtooth", 'cases=["hoper"]') == ('cases[0]: there is no "hoper"; did you mean "hopper"?',)
    assert mistakes("sawtooth", "cases=[]") == ("cases: must hold at least 1, got []",)


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("experiment=bias_varianc", 'experiment: there is no experiment "bias_varianc"; did you mean "bias_variance"?'),
        ("experiment=surfing", 'experiment: there is no experiment "surfing"; choose one of ablation, '),
        ("task=ball_wal", 'task: there is no "ball_wal"; did you mean "ball_wall"?'),
        ("task=juggling", 'task: there is no "juggling"; choose one of ball_wall, ramp'),
        ("seed=1.5", "seed: must be integer, got 1.5"),
        ('num_samples="10"', 'num_samples: must be integer, got "10"'),
        ("num_samples=1", "num_samples: must be greater than or equal to 2, got 1"),
        ("stddev=nan", "stddev: must be a finite number, got NaN"),
        ("angles=[0.1, true]", "angles[1]: must be number, got true"),
        ("sweep.seed=[0, 1, 0]", "sweep.seed: must differ, got a value more than once"),
        ("stddev.x=1", "stddev.x: stddev is a value, not a table"),
        ("seed=2026-01-01", "seed: must be integer"),
        ("seed=[1", "seed=[1: [1 is not a TOML value"),
        ("seed", "seed: not an override; write key=value"),
        ("seed=", "seed=: nothing is not a TOML value"),
        ("seed==1", "seed==1: =1 is not a TOML value; write a text as 'seed=\"text\"'"),
        ("task=/tmp/my scène ☃ #1%.xml", 'task: there is no "/tmp/my scène ☃ #1%.xml"'),
        ("--seed=1", '--seed: unknown key; did you mean "seed"?'),
        ("angles=0.1", "angles: must be array, got 0.1"),
        ("video=true", "video: must be an object, got true"),
        ("video={angles=[0.5], stiffness=[1.0], spede=1.0}", 'video.spede: unknown key; did you mean "speed"?'),
        ("sweep.seed=3", "sweep.seed: must be an array of at least one value, got 3"),
    ],
)
def test_one_mistake_is_one_sentence(write, override, sentence):
    (found,) = mistakes(write(VALID), override)
    assert found.startswith(sentence)


def test_overrides_are_toml_and_a_bare_word_is_a_string(write):
    in_toml = ["stiffness=[1e1, 1e3]", "video.angles=[0.2]", "video.stiffness=[5]", "include_default=false"]
    (run,) = load_runs(write(VALID), [*in_toml, "task=ramp"])
    assert run.settings.stiffness == (10.0, 1000.0)
    assert run.settings.video.angles == (0.2,)
    assert run.settings.include_default is False


def test_a_key_is_overridden_once(write):
    assert mistakes(write(VALID), "seed=1", "seed = 2") == ("seed: given twice",)


def test_bare_words_in_a_list_are_strings():
    """What is left of scenes=["hopper","reacher"] after a shell."""
    (run,) = load_runs("work_precision", ["scenes=[hopper,cube]"])
    assert run.settings.scenes == ("hopper", "cube")
    (found,) = mistakes("work_precision", "scenes=[hoper]")
    assert found == 'scenes[0]: there is no "hoper"; did you mean "hopper"?'
    assert mistakes("work_precision", "scenes=[hopper,hopper]") == ("scenes: must differ, got hopper more than once",)


def test_a_point_may_have_a_coordinate_twice():
    (run,) = load_runs("planar_push", ["finger=[0.2, 0.2]"])
    assert run.settings.finger == (0.2, 0.2)


def test_a_size_is_one_of_the_tables_of_its_file_and_single_values_win_over_it():
    (run,) = load_runs("work_precision", ["size=quick", "sizes.batch=7"])
    assert (run.settings.sizes.batch, run.settings.sizes.repeats) == (7, 3)
    assert mistakes("work_precision", "size=quik", "sizes.bath=3") == (
        'size: there is no "quik"; did you mean "quick"?',
        'sizes.bath: unknown key; did you mean "batch"?',
    )


def test_a_sweep_is_every_combination_with_its_last_key_changing_fastest(write):
    runs = load_runs(write(VALID + "[sweep]\nseed = [0, 1]\nstddev = [0.1, 0.2, 0.3]\n"), [])
    assert [(run.settings.seed, run.settings.stddev) for run in runs] == [
        (seed, stddev) for seed in (0, 1) for stddev in (0.1, 0.2, 0.3)
    ]
    assert runs[1].varied == {"seed": 0, "stddev": 0.2}


def test_an_override_ends_the_sweep_of_its_key(write):
    runs = load_runs(write(VALID + "[sweep]\nseed = [0, 1]\nstddev = [0.1, 0.2]\n"), ["seed=7"])
    assert [(run.settings.seed, run.varied) for run in runs] == [(7, {"stddev": 0.1}), (7, {"stddev": 0.2})]


def test_a_mistake_in_a_sweep_is_told_once_and_by_its_path(write):
    found = mistakes(write(VALID + '[sweep]\nsede = [0, 1]\nstddev = [0.1, "wide"]\nnum_samples = 5\n'))
    assert set(found) == {
        'sweep.sede: unknown key; did you mean "seed"?',
        'sweep.stddev: must be number, got "wide"',
        "sweep.num_samples: must be an array of at least one value, got 5",
    }


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (b"\xcd # Is it so?", "not UTF-8, at byte 0; save it as UTF-8"),
        (f"seed = {'9' * 5000}".encode(), "not TOML: Exceeds the limit (4300 digits)"),
        (VALID.encode() + b"stddev = 1\n", "not TOML: a key is given twice (at line 11, column 11)"),
        (b"experiment = ['bias_variance']", 'experiment: there is no experiment ["bias_variance"]; did you mean'),
        (b"[experiment]", "experiment: there is no experiment {}; choose one of ablation"),
        (b'experiment = "bias_variance', "not TOML: "),
        (b'experiment = "bias_variance\n', "not TOML: a quote is not closed (at line 1"),
        (b"experiment = bias_variance", "not TOML: invalid value, words need quotes (at line 1, column 14)"),
        (b"<mujoco/>", "not TOML: "),
        (VALID.replace("ramp", "ball_wall").replace("0.05", "45").encode(), "angles: must be in rad, within a turn, got 45"),
        (b"", "experiment: required, and missing; choose one of ablation"),
        (VALID.encode() + b'"" = 1', '"": unknown key'),
        (VALID.replace("10\n", "100000000000\n").encode(), "num_samples: must be below 2^31, got 1e+11"),
        (VALID.replace("0.1", "1e-320").encode(), "stddev: must be greater than or equal to 0.000000001"),
        (VALID.replace("[0.05]", "[0.05, 0.2, 0.05]").encode(), "angles: must differ, got 0.05 more than once"),
        (VALID.replace("1e2", "1.0").encode(), "stiffness: must differ, got 1 more than once"),
    ],
)  # fmt: skip
def test_what_no_hand_should_write_is_a_sentence(tmp_path, text, sentence):
    (tmp_path / "trial.toml").write_bytes(text)
    with pytest.raises(ConfigurationError) as caught:
        load_runs(str(tmp_path / "trial.toml"), [])
    assert sentence in str(caught.value)
    assert len(str(caught.value)) < 2000


def test_a_mark_at_the_beginning_of_a_file_is_overlooked(tmp_path):
    (tmp_path / "trial.toml").write_text(VALID, encoding="utf-8-sig")
    assert load_runs(str(tmp_path / "trial.toml"), [])[0].question == "Is it so?"


def test_of_many_mistakes_the_first_are_shown_and_the_others_counted_in_no_time(write):
    """To compare each with each took a minute."""
    begun = time.process_time()
    with pytest.raises(ConfigurationError) as caught:
        load_runs(write(VALID + "".join(f"key_{i} = 1\n" for i in range(5000))), [])
    assert str(caught.value).endswith("\n  and 4980 more")
    assert time.process_time() - begun < 5
