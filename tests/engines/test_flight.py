"""Pairs of motions: when the derivative along the motion takes over, and what becomes of them where slots lack."""

import mujoco
import numpy as np

from mjxgrad.engines import flight as flights
from mjxgrad.engines.flight import NUM_SLOTS, Begun, Course, Flight, advance, begin, fly
from mjxgrad.engines.layout import Layout
from mjxgrad.stepping import slope

# One slide without forces: a state is a place and a speed, and a step of a pair is whatever a test says.
MODEL = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><body><joint type='slide'/><geom size='.1'/></body></worldbody></mujoco>"
)
LAYOUT = Layout(MODEL)
WIDTH, NOTHING = 2.0, np.zeros((2, 1))


def _nothing():
    return Flight.unpacked(
        np.zeros((1, flights.NUM_SLOTS, 2 * LAYOUT.num_changes + 3)), LAYOUT, np.zeros((1, LAYOUT.size))
    )


def _flown(matrices, begun, factors):
    """Return what is found of a motion at rest, whose pairs are `factors` times as far apart after each step."""
    steps, slots = len(matrices), flights.NUM_SLOTS
    rows, state = np.zeros((1, steps, LAYOUT.size)), np.array(matrices, float)[None]
    course = Course(
        rows,
        state,
        {(0, t): one for t, one in begun.items()},
        lambda *_: MODEL,
        np.ones((1, steps), bool),
    )
    shapes = {"felt": (steps, 1, 2), "slot": (steps, 1), "apart": (steps, 2, slots), "stays": (steps, slots)}
    shapes |= {"size": (steps, 2, 2), "felt size": (steps, 1, 2)}
    found = {
        name: np.zeros((1, *shape)) for name, shape in {**shapes, "before": (2, slots), "enters": (slots,)}.items()
    }
    times = iter(factors)

    def step(states, models):
        ends = states.copy()
        ends[:, LAYOUT.motion] *= next(times)
        return ends

    pairs = _nothing()
    fly(pairs, course, LAYOUT, np.array([1.0, 0.1 * slope.TRAVEL]), step, found)
    return {name: value[0] for name, value in found.items()} | {"state": state[0]}


def _begun(apart, felt=(1.0, 0.0), **more):
    apart = np.array([apart], float)
    ends = np.stack([apart, -apart], axis=1) * WIDTH / 2
    return Begun(np.array([felt]), ends, np.array([WIDTH]), apart, NOTHING, **more)


def _lasted(found):
    """Return for how many steps the first slot was in flight, that in which its pair began among them."""
    return 1 + int(np.argmin(np.append(found["stays"][:, 0], 0.0)))


HALF = 0.5 * np.eye(2)


def test_a_pair_is_let_go_once_three_steps_in_a_row_are_explained_to_a_twentieth():
    """Off by a fifteenth begins the count anew."""
    factors = [0.5, 0.5 * 1.03, 0.5 * 1.07, 0.5, 0.5, 0.5 * 0.96, *[0.5] * 20]
    assert _lasted(_flown([HALF] * 20, {0: _begun([1.0, 0.0])}, factors)) == 7


def test_a_pair_that_is_explained_goes_on_while_it_is_far_apart():
    """Eleven times as far as at first, then half of it."""
    same, half = np.eye(2), HALF
    found = _flown([same] * 5 + [half] * 5, {0: _begun([11.0, 0.0])}, [1.0] * 4 + [0.5] * 9)
    assert _lasted(found) == 6


def test_a_pair_whose_derivative_never_explains_it_is_let_go():
    assert _lasted(_flown([0 * HALF] * 130, {0: _begun([1.0, 0.0])}, [1.0] * 130)) == 100


def test_an_event_lets_go_what_is_less_apart_than_its_window():
    """Known but far apart, 11 over 2 m: an event in 4 whose window is 30 m wide takes it, one of 20 m does not."""
    for width, lasts in ((30.0, 4), (20.0, 9)):
        event = Begun(np.array([[1.0, 0.0]]), np.zeros((1, 2, 2)), np.array([width]), np.zeros((1, 2)), NOTHING)
        found = _flown([np.eye(2)] * 8, {0: _begun([11.0, 0.0]), 4: event}, [1.0] * 8)
        assert _lasted(found) == lasts


def test_a_pair_to_one_side_of_an_event_is_explained_by_small_differences():
    """The event's own jump would carry it elsewhere. One that may span the event, apart by more than half its window, is not."""
    lost = np.array([[0.5], [0.0]])
    for width, lasts in ((10.0, 4), (1e-3, 10)):
        ends, jump = np.zeros((1, 2, 2)), np.array([[5.0, 0.0]])
        events = {t: Begun(np.array([[1.0, 0.0]]), ends, np.array([width]), jump, lost) for t in range(1, 9)}
        assert _lasted(_flown([0 * HALF] * 9, {0: _begun([1.0, 0.0])} | events, [0.5] * 9)) == lasts


def test_what_pairs_add_is_the_sum_of_their_differences():
    """Against a sum written out; a part of the motion and the rest, with what is in flight between, are the whole."""
    rng = np.random.default_rng(0)
    matrices = rng.normal(size=(6, 2, 2))
    begun = {t: _begun(rng.normal(size=2), rng.normal(size=2)) for t in (0, 1, 2)}
    factors = rng.uniform(2.0, 3.0, 5)
    found = _flown(matrices, begun, factors)
    change, felt, total = np.eye(2), {}, np.eye(2)
    for t in range(6):
        felt |= {t: begun[t].felt[0] @ change} if t in begun else {}
        change = matrices[t] @ change
        total = change + sum(np.outer(begun[k].apart[0] * np.prod(factors[k:t]), felt[k]) for k in felt)
    main, held = begin(np.eye(2), np.zeros((NUM_SLOTS, 2)), {"before": found["before"], "enters": found["enters"]})
    for t in range(6):
        step = {name: found[name][t] for name in ("felt", "slot", "apart", "stays")}
        main, held, ours = advance(np, main, held, step | {"state": matrices[t], "by state": 0.0, "by felt": 0.0})
    np.testing.assert_allclose(ours, total, rtol=1e-12)


def test_where_slots_lack_explained_pairs_make_room_and_other_events_are_those_of_a_discrete_gradient(monkeypatch):
    """By step 4 the pair in the only slot is explained, and far apart."""
    monkeypatch.setattr(flights, "NUM_SLOTS", 1)
    lost, far = np.array([[2.0, 3.0], [0.0, 0.0]]), [[11.0, 0.0], [11.0, 0.0]]
    felt = np.array([[0.0, 1.0], [0.0, 4.0]])
    two = Begun(felt, np.zeros((2, 2, 2)), np.full(2, WIDTH), np.array(far), lost, by_others={"size": np.eye(2)})
    one = two.parted(1)[0]
    found = _flown([np.eye(2)] * 6, {0: _begun(far[0]), 1: one, 4: two}, [1.0] * 5)
    begins = np.abs(found["felt"]).sum(axis=(1, 2))
    np.testing.assert_array_equal(begins > 0, [True, False, False, False, True, False])
    # The second event of step 4, and that of step 1, are left to small differences: `lost felt` is theirs.
    np.testing.assert_array_equal(found["state"][1], [[1.0, 2.0], [0.0, 1.0]])
    np.testing.assert_array_equal(found["state"][4], [[1.0, 12.0], [0.0, 1.0]])
    np.testing.assert_array_equal(found["size"][4], [[0.0, 3.0], [0.0, 0.0]])
    np.testing.assert_array_equal(found["felt size"][4], [[1.0, 0.0]])


def test_a_flight_is_its_numbers():
    """Both ends as changes of the state beside which they are: single precision keeps their distance to 1e-7 of it."""
    rng, pairs = np.random.default_rng(0), _nothing()
    row = rng.normal(size=(1, LAYOUT.size))
    pairs.widths[0, 3], pairs.left[0, 3], pairs.alike[0, 3] = 1e-4, 7, 2
    pairs.ends[0, 3] = row[0, LAYOUT.motion] + 1e-4 * rng.normal(size=(2, 2))
    pairs.apart[0, 3] = (pairs.ends[0, 3, 0] - pairs.ends[0, 3, 1]) / 1e-4
    again = Flight.unpacked(pairs.packed(LAYOUT, row).astype(np.float32).astype(float), LAYOUT, row)
    np.testing.assert_allclose(again.apart[0, 3], pairs.apart[0, 3], rtol=1e-6)
    assert (again.left[0, 3], again.alike[0, 3], again.widths[0].astype(bool).sum()) == (7, 2, 1)
