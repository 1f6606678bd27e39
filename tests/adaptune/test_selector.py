from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import rooms

from adaptune.live.evidence import LiveEvidence
from adaptune.live.hops import HopSquares
from adaptune.live.monitor import Health
from adaptune.live.own_error import OwnError
from adaptune.model import BankRule, BankSettings, ErrorModel
from adaptune.model.ndt import describe
from adaptune.model.registry import ADAPTIVE, STANDBY
from adaptune.model.rules import Costs, SetCost
from adaptune.model.weights import measured_weights
from adaptune.odometry.base import Motions
from adaptune.recording.scan import Scan
from adaptune.selector import MAX_TIMES_PREDICTED, REMEMBERED, Selector
from adaptune.simulation import Course
from adaptune.simulation.record import simulate
from adaptune.space import Float, ParameterSets, ParameterSpace, Selection

SPACE = ParameterSpace({"speed": Float(low=0.0, high=9.0, baseline=1.0)})
SETS = ParameterSets(SPACE, (3, 5), ({"speed": 1.0}, {"speed": 8.0}))
STILL = Motions(np.eye(4), {})
IN_A_BANK = Motions(np.eye(4), {3: np.eye(4), 5: np.eye(4)})


@cache
def drive_cave(sensor, seed):
    course = Course(scenes=("cave",), length=10.0, sensor=sensor, seed=seed)
    return [Scan(s.stamp, s.points) for s in list(simulate(course))[::10]]


@cache
def of_two_caves():
    """Fitted to scans of an HDL-32E."""
    drives = [drive_cave("hdl32e", seed) for seed in (1, 2)]
    trained = [scan for drive in drives for scan in drive]
    return ErrorModel(
        odometry={"name": "gicp"},
        sets=SETS,
        fixed=3,
        length=25.0,
        sequences=["one", "two"],
        blocks={"ndt": 90},
        window=1,
        descriptors=np.stack([describe(scan) for scan in trained]),
        sequence=np.repeat([0, 1], [len(drive) for drive in drives]),
        errors=np.tile(np.float32([1.0, 0.1]), (len(trained), 1)),
        provenance={},
        elevations=[-30.7, -30.7],
        bank=[3, 5],
        vectors=np.zeros((len(trained), 2, 3), np.float32),
    )


def selections(selector, scans, motions=STILL):
    """One selection for every scan."""
    made = []
    for scan in scans:
        selector.observe(scan.stamp, scan, motions)
        made.append(selector.select())
    return made


def test_scans_of_another_sensor_get_the_fixed_set(caplog):
    model = of_two_caves()
    for sensor, familiar in (("hdl32e", True), ("vlp16", False)):
        made = selections(Selector(model, members=()), drive_cave(sensor, 3))
        assert all(s.trial == 3 and (s.similarity > 0.0) == familiar for s in made)
    assert [r.levelname for r in caplog.records] == ["WARNING"]
    assert "-15 degrees, those of training at -31" in caplog.text
    # The published rule has no such doubts.
    made = selections(Selector(model, "paper"), drive_cave("vlp16", 3))
    assert all(s.trial == 5 and s.parameters == {"speed": 8.0} for s in made)


def test_an_incomplete_first_scan_is_of_the_same_sensor(caplog):
    first, *others = drive_cave("hdl32e", 3)
    first = first.select(first.points[:, 2] > 0.0)
    selections(Selector(of_two_caves(), members=()), [first, *others])
    assert not caplog.records


def test_after_a_reset_it_is_as_new():
    scans = drive_cave("hdl32e", 3)
    selector = Selector(replace(of_two_caves(), window=3))
    first = selections(selector, scans, IN_A_BANK)
    assert repr(selections(selector, scans, IN_A_BANK)) != repr(first)
    selector.reset()
    assert repr(selections(selector, scans, IN_A_BANK)) == repr(first)


def test_a_bank_has_the_weights_that_its_rule_gives(monkeypatch):
    found = [(1.0, 0.0), (0.0, 1.0), (0.0, 1.0), (0.5, 0.5), (0.0, 1.0), (0.0, 1.0), (0.0, 1.0)]
    model, left = of_two_caves(), []

    def weigh(*_):
        weights = left.pop(0) if left else (1.0, 0.0)
        of_members = dict(zip((3, 5), weights, strict=True))
        return Selection(3, SETS[3], of_members, 0.2, 1.0, 1.0)

    monkeypatch.setattr(BankRule, "weigh", weigh)
    selector = Selector(model)
    left[:] = found
    made = selections(selector, drive_cave("hdl32e", 3)[: len(found)], IN_A_BANK)
    for one, weights in zip(made, found, strict=True):
        assert tuple(one.weights.values()) == weights
        assert one.trial == (3, 5)[np.argmax(weights)]
        assert one.parameters == SETS[one.trial]
    # Of another sensor's scans the training says nothing, and nothing is measured yet.
    selector.reset()
    left[:] = found[1:3]
    for one in selections(selector, drive_cave("vlp16", 3)[:2], IN_A_BANK):
        assert one.weights == {3: 1.0, 5: 0.0}


class Told:
    """In place of `LiveEvidence`: says what it is told, from the next measurement on."""

    lost = False

    def __init__(self, monkeypatch):
        self.next = self.now = self.error = None
        self.forgotten = 0
        for name in ("squares", "measure", "own_error", "forget"):
            monkeypatch.setattr(
                LiveEvidence, name, lambda _, *args, n=name: getattr(self, n)(*args)
            )

    def squares(self, _members=None):
        return self.now

    def measure(self):
        self.now = self.next

    def own_error(self):
        return self.error

    def forget(self):
        self.error = None
        self.forgotten += 1


def test_what_is_measured_counts_from_the_next_selection_on(monkeypatch):
    told, scans = Told(monkeypatch), drive_cave("hdl32e", 3)
    selector = Selector(of_two_caves())
    (before,) = selections(selector, scans[:1], IN_A_BANK)
    told.next = HopSquares(np.diag([100.0, 1.0]), 0.0, 1000.0)
    selector.observe(scans[1].stamp, scans[1], IN_A_BANK)
    assert selector.select().weights == before.weights
    selector.measure()
    (after,) = selections(selector, scans[2:3], IN_A_BANK)
    # Two of three selections knew nothing of it.
    known = (3.0 * after.weights[5] - 2.0 * before.weights[5]) / 1.0
    assert known > 0.9
    assert before.weights[5] < 0.6


def test_a_sensor_that_was_not_trained_with_gets_weights_by_what_is_measured(monkeypatch):
    told = Told(monkeypatch)
    selector, scans = Selector(of_two_caves()), drive_cave("vlp16", 3)
    told.now = HopSquares(np.diag([100.0, 1.0]), 0.0, 30.0)
    (one,) = selections(selector, scans[:1], IN_A_BANK)
    assert one.weights[5] > 0.8
    assert (one.trial, one.parameters, one.similarity) == (5, SETS[5], 0.0)
    assert list(one.weights.values()) == pytest.approx(measured_weights(2, told.now))
    # A single odometry has nothing to compare with.
    (one,) = selections(Selector(of_two_caves(), members=()), scans[:1])
    assert (one.trial, one.weights) == (3, None)


def with_baseline():
    """Without a bank; the fixed set, of trial 5, is better than the baseline."""
    model = of_two_caves()
    sets = replace(SETS, trials=(0, 3, 5), parameters=({"speed": 4.5}, *SETS.parameters))
    errors = np.column_stack([np.full(len(model.errors), 2.0, np.float32), model.errors])
    vectors = model.vectors[:, :0]
    return replace(model, sets=sets, fixed=5, errors=errors, bank=[], vectors=vectors)


def test_a_single_odometry_leaves_a_set_that_does_worse_than_predicted(monkeypatch):
    told, (scan, *_) = Told(monkeypatch), drive_cave("hdl32e", 1)
    selector = Selector(with_baseline())

    def select(seconds):
        selector.observe(int(seconds * 1e9), scan, STILL)
        return selector.select()

    first = select(0.0)
    assert first.trial == 5
    limit, forgotten = MAX_TIMES_PREDICTED * first.predicted_error, told.forgotten
    told.error = OwnError(9.0, 0.99 * limit, 20.0)  # not surely worse
    assert select(1.0).trial == 5
    assert told.forgotten == forgotten
    # It stays where no other set is predicted to do better than what was measured.
    told.error = OwnError(1.05 * limit, 1.01 * limit, 20.0)
    assert select(1.5).trial == 5
    told.error = OwnError(9.0, 1.01 * limit, 20.0)
    left = select(2.0)
    assert (left.trial, left.parameters) == (0, {"speed": 4.5})
    # The hops were those of the set that it left.
    assert told.forgotten == forgotten + 1
    assert select(REMEMBERED + 1.9).trial == 0
    assert select(REMEMBERED + 2.1).trial == 5
    # After a reset nothing is held against it.
    told.error = OwnError(9.0, 1.01 * limit, 20.0)
    assert select(REMEMBERED + 3.0).trial == 0
    selector.reset()
    assert select(0.0).trial == 5


def test_where_the_fixed_set_does_worse_than_predicted_the_baseline_takes_its_place(monkeypatch):
    told, scans, model = Told(monkeypatch), drive_cave("hdl32e", 1), with_baseline()

    def chosen(scan, *errors):
        """What is selected second by second while so much is measured, in percent."""
        told.error, selector, trials = None, Selector(model), []
        for i, error in enumerate(errors):
            told.error = None if error is None else OwnError(error, 0.8 * error, 1.2 * error)
            selector.observe(i * 10**9, scan, STILL)
            trials.append(selector.select().trial)
        return trials

    assert chosen(scans[0], None, 0.2, 9.0, None) == [5, 5, 0, 0]
    # As bad as the baseline is in training, and no worse than the fixed set where both are bad.
    assert chosen(scans[0], None, 1.5) == [5, 5]
    assert chosen(scans[0], None, 9.0, 8.0, 12.0, None) == [5, 0, 0, 5, 5]
    # So it is with another sensor.
    assert chosen(drive_cave("vlp16", 1)[0], None, 0.2, 9.0, None) == [5, 5, 0, 0]
    # What has not been run on every sequence is no candidate.
    model = replace(
        model, errors=np.where(model.sets.column(0) == np.arange(3), np.nan, model.errors)
    )
    assert chosen(scans[0], None, 9.0) == [5, 5]


def test_a_bank_stands_by_while_the_fixed_set_does_as_predicted(
    monkeypatch,
):
    told = Told(monkeypatch)
    model = of_two_caves()
    keeps = replace(
        model,
        vectors=np.tile(np.float32([[1.0, 0.0, 0.0], [0.0, 0.1, 0.0]]), (len(model.errors), 1, 1)),
    )
    selector = Selector(keeps, STANDBY)
    assert selector.members == (3, 5)
    known, new = drive_cave("hdl32e", 1)[0], drive_cave("vlp16", 1)[0]
    resting, absent = np.eye(4), np.full((4, 4), np.nan)

    def rests(seconds, scan=known, starts=1, fixed=resting):
        motions = Motions(np.eye(4), {3: fixed, 5: resting}, starts)
        selector.observe(round(seconds * 1e9), scan, motions)
        one = selector.select()
        assert one.resting in (frozenset(), {5})
        if one.resting:
            assert (one.trial, one.weights) == (3, {3: 1.0, 5: 0.0})
            assert one.predicted_error == one.predicted_fixed == pytest.approx(1.0)
        return bool(one.resting)

    # The start after the first scan is no failure.
    assert rests(0.0, starts=0)
    assert rests(1.0)
    # The fixed set is surely worse than predicted, until a minute after that.
    told.error = OwnError(4.0, 2.1, 9.0)
    assert not rests(2.0)
    told.error = OwnError(4.0, 1.9, 9.0)
    assert not rests(61.9)
    assert rests(62.0)
    # The odometry has failed, also while nobody rests.
    assert not rests(63.0, starts=2)
    assert not rests(122.0, starts=3)
    assert not rests(181.0, starts=3)
    assert rests(182.0, starts=3)
    # Where the fixed set gives no pose, somebody has to go on.
    assert not rests(183.0, starts=3, fixed=absent)
    # That a place is new is no reason to leave it.
    selector.reset()
    told.error = None
    assert rests(0.0, new)
    selector.reset()  # awake, the member that is better gets the most weight
    told.error = OwnError(4.0, 2.1, 9.0)
    for i in range(20):
        selector.observe(i * 10**9, known, Motions(np.eye(4), {3: resting, 5: resting}))
        one = selector.select()
    assert one.weights[5] > 0.8
    assert Selector(keeps, STANDBY, ()).members == ()  # a single odometry


def with_reserve(model):
    """The same with a third member, the baseline, which is the reserve."""
    sets = replace(SETS, trials=(3, 5, 0), parameters=(*SETS.parameters, {"speed": 4.5}))
    vectors = np.zeros((len(model.errors), 3, 3), np.float32)
    vectors[:, [0, 1, 2], [0, 1, 2]] = 1.0
    return replace(
        model,
        sets=sets,
        errors=np.column_stack([model.errors, np.ones(len(model.errors), np.float32)]),
        bank=[3, 5, 0],
        vectors=vectors,
        bank_settings=BankSettings(reserve=1),
    )


def test_the_reserve_of_a_bank_joins_in_where_training_knows_nothing(monkeypatch):
    told, model = Told(monkeypatch), with_reserve(of_two_caves())
    assert model.reserve == [0]
    selector = Selector(model)
    motions = Motions(np.eye(4), dict.fromkeys((3, 5, 0), np.eye(4)), 1)
    shares = []
    for i in range(20):
        told.error = OwnError(9.0, 8.0, 10.0) if i >= 10 else None
        selector.observe(i * 10**9, drive_cave("hdl32e", 1)[0], motions)
        one = selector.select()
        assert one.resting == ({0} if i < 10 else frozenset())
        shares.append([one.weights[t] for t in (3, 5, 0)])
    # Their errors are as large, and independent.
    np.testing.assert_allclose(shares[9], [0.5, 0.5, 0.0], atol=0.01)
    np.testing.assert_allclose(shares[19], [1 / 3] * 3, atol=0.01)
    # A place that training does not know.
    told.error = None
    for sensor, resting in (("hdl32e", {0}), ("vlp16", frozenset())):
        selector.reset()
        selector.observe(0, drive_cave(sensor, 1)[0], motions)
        assert selector.select().resting == resting


def test_a_bank_keeps_to_the_user_s_budget_in_the_mean_unless_it_is_lost(monkeypatch):
    """In a place that training does not know, where its reserve would work all the time."""
    Told(monkeypatch)
    state = "good"
    monkeypatch.setattr(LiveEvidence, "health", property(lambda _: Health(state)))
    cost = Costs({t: SetCost(ms, 0.0, t) for t, ms in ((3, 10.0), (5, 10.0), (0, 20.0))}, 0.0)
    model = replace(with_reserve(of_two_caves()), costs=cost, milliseconds=25.0)
    motions = Motions(np.eye(4), dict.fromkeys((3, 5, 0), np.eye(4)), 1)
    unknown = drive_cave("vlp16", 1)[0]

    def works(selector, seconds):
        at_work = []
        for second in seconds:
            selector.observe(second * 10**9, unknown, motions)
            at_work.append(not selector.select().resting)
        return np.array(at_work)

    free = works(Selector(replace(model, milliseconds=None)), range(20))
    assert free.all()
    selector = Selector(model)
    share = works(selector, range(700))
    # 20 ms without it, 40 with it: a quarter of the time is what 25 ms allow.
    in_ten_minutes = np.convolve(share, np.ones(600) / 600, "valid")
    assert 0.24 <= in_ten_minutes.min() <= in_ten_minutes.max() <= 0.25 + 1e-9
    state = "lost"
    assert works(selector, range(700, 760)).all()
    # The minutes after pay back.
    state = "good"
    assert not works(selector, range(760, 860)).any()


def test_a_bank_measures_where_members_differ_by_more_than_in_training(monkeypatch):
    measured = []
    monkeypatch.setattr(LiveEvidence, "measure", lambda _: measured.append(True))
    monkeypatch.setattr(LiveEvidence, "due", lambda _, in_doubt: in_doubt)
    model = of_two_caves()
    # In training, half of them lie 2 % apart: each 1 % from the middle.
    apart = np.float32([[2.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    model = replace(model, vectors=np.tile(apart, (len(model.errors), 1, 1)))
    scan = drive_cave("hdl32e", 1)[0]

    def measures(*speeds):
        selector = Selector(model)
        for i in range(12):
            members = {t: rooms.moved(speed) for t, speed in zip((3, 5), speeds, strict=True)}
            selector.observe(i * 10**8, scan, Motions(members[3], members))
            if i == 0:
                selector.select()
        measured.clear()
        selector.measure()
        return bool(measured)

    assert not measures(1.0, 1.019)
    assert measures(1.0, 1.021)


@pytest.mark.parametrize("rule", [ADAPTIVE, STANDBY])
def test_a_member_without_a_pose_gets_no_weight(rule):
    selector = Selector(of_two_caves(), rule, (3, 5))
    scans, nothing = drive_cave("hdl32e", 3), np.full((4, 4), np.nan)
    for member, other in ((3, 5), (5, 3)):
        selector.reset()
        (before,) = selections(selector, scans[:1], IN_A_BANK)
        dying = IN_A_BANK._replace(members=IN_A_BANK.members | {member: nothing})
        selections(selector, scans[1:2], dying)
        (after,) = selections(selector, scans[2:3], IN_A_BANK)
        assert sum(before.weights.values()) == pytest.approx(1.0)
        assert after.weights == {member: 0.0, other: 1.0}
        assert (after.trial, after.parameters) == (other, SETS[other])


def test_a_member_without_a_pose_is_not_chosen():
    selector, nothing = Selector(of_two_caves(), "paper", (3, 5)), np.full((4, 4), np.nan)
    scans = drive_cave("hdl32e", 3)
    dying = IN_A_BANK._replace(members={3: np.eye(4), 5: nothing})
    chosen = selections(selector, scans[:1], IN_A_BANK) + selections(selector, scans[1:3], dying)
    assert [one.trial for one in chosen] == [5, 3, 3]
    assert chosen[-1].parameters == SETS[3]
