from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from labelled_places import in_place, labelled, simulated, with_motions
from rooms import along_x
from walker import at, makes

from adaptune.bank.bank import Bank
from adaptune.live.hops import CLIP, Hop, Hops
from adaptune.metrics import sub_trajectory_rte, travelled, window_ends
from adaptune.odometry.health import HealthCheck
from adaptune.runs.archive import Frames, Trial
from adaptune.space import Selection
from adaptune.study.driven import PER_SEGMENT
from offline.labelled import BankSimulation, error_vectors, recorded_motions

LENGTH = 10.0


def poses(steps, turns):
    """Poses along a plane path."""
    heading = np.cumsum(turns)
    T = np.tile(np.eye(4), (len(steps) + 1, 1, 1))
    T[1:, 0, 3] = np.cumsum(steps * np.cos(heading))
    T[1:, 1, 3] = np.cumsum(steps * np.sin(heading))
    return T


def along(T, name="one"):
    known = window_ends(T, LENGTH) >= 0
    errors = np.zeros((known.sum(), 1), np.float32)
    return in_place(name, simulated(np.zeros((len(T), 1)), None, T), known, errors)


def any_path(seed):
    """A path that winds, and on which the robot stands for a while."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(30, 900))
    steps = rng.uniform(0.0, 1.0, n)
    at = int(rng.integers(0, n))
    steps[at : at + int(rng.integers(0, 50))] = 0.0
    return poses(steps, rng.normal(0.0, 0.1, n))


paths = st.integers(0, 2**32 - 1).map(any_path)


@settings(max_examples=60, deadline=None)
@given(paths)
def test_segments_share_out_the_frames(T):
    one = along(T)
    numbers = one.segment
    assert numbers.shape == one.known.shape
    if not len(numbers):
        return
    assert numbers[0] == 0
    assert set(np.diff(numbers)) <= {0, 1}
    distance = travelled(T)[one.known]
    size = PER_SEGMENT * LENGTH
    of_segments = [np.ptp(distance[numbers == n]) for n in np.unique(numbers)]
    # All but the last are as long as they should be, within a step; that is half as long at least,
    # unless it is the only one.
    assert all(size - 2.0 <= length <= size for length in of_segments[:-1])
    if len(of_segments) > 1:
        assert 0.5 * size - 2.0 <= of_segments[-1] <= 1.5 * size
    else:
        assert of_segments[0] <= 1.5 * size


@settings(max_examples=60, deadline=None)
@given(paths, st.integers(0, 9))
def test_nothing_that_is_known_comes_near_to_what_is_left_out(T, which):
    one = along(T)
    if not len(one.known):
        return
    left = one.frames(one.segment == which % (one.segment.max() + 1))
    kept = one.frames(~one.near(left))
    # Sub-trajectories that begin where the other ends have a frame in common.
    first, last = left.known.min(), left.ends.max()
    assert not ((kept.known <= last) & (kept.ends >= first)).any()
    apart = np.linalg.norm(kept.positions[:, None] - left.positions[None], axis=-1)
    assert (apart > LENGTH).all()
    # Nothing else is dropped.
    dropped = one.frames(one.near(left))
    apart = np.linalg.norm(dropped.positions[:, None] - left.positions[None], axis=-1).min(axis=1)
    overlaps = (dropped.known <= last) & (dropped.ends >= first)
    assert (overlaps | (apart <= LENGTH)).all()


def test_with_six_recordings_whole_ones_are_left_out():
    rng = np.random.default_rng(3)
    sequences = [with_motions(f"s{i}", rng, 500) for i in range(6)]
    names = [s.name for s in sequences]
    assert len(labelled(sequences).folds()) == 6
    for left, others in labelled(sequences).folds():
        assert [s.name for s in others.sequences] == [name for name in names if name != left.name]
        assert len(np.unique(others.segments())) == 5 * 3
    folds = labelled(sequences[:5]).folds()
    assert len(folds) == 5 * 3
    for left, others in folds:
        assert [s.name for s in others.sequences] == names[:5]
        (same,) = [s for s in others.sequences if s.name == left.name]
        assert not set(np.unique(left.segment)) & set(np.unique(same.segment))


def test_parts_of_a_recording_are_one_recording():
    rng = np.random.default_rng(3)
    one = with_motions("s0", rng, 500)
    parts = [replace(one, name=f"s{i}", recording="drive.bag") for i in range(6)]
    data = labelled(parts)
    assert data.recordings == ["drive.bag"]
    # So segments are left out; here all parts show the same place, so none of it is known.
    folds = data.folds()
    assert len(folds) == 6 * 3
    for left, others in folds:
        numbers = {int(n) for s in others.sequences for n in np.unique(s.segment)}
        assert int(left.segment[0]) not in numbers
    assert data.folds(by_recording=True) == []
    other = labelled([*parts[:2], replace(one, name="other", recording="other")])
    names = [[s.name for s in others.sequences] for _, others in other.folds(by_recording=True)]
    assert names == [["other"], ["other"], ["s0", "s1"]]


def test_a_segment_takes_its_part_of_everything():
    one = with_motions("one", np.random.default_rng(3), 500)
    n = len(one.errors)
    errors = np.column_stack([np.linspace(0.0, 1.0, n), np.full(n, 50.0)])
    one = replace(one, whole=replace(one, errors=errors, turns=errors, vectors={}))
    kept = one.segment == 1
    some = one.frames(kept)
    # What is left of the drives follows from their errors.
    blocks = np.unique(one.block[kept])
    assert some.in_blocks().shape == (len(blocks), 5)
    expected = errors[kept & (one.block == blocks[0]), 0].mean()
    np.testing.assert_allclose(some.whole.in_blocks()[0], [expected, 30.0])
    assert len(some.period) == len(some.errors) == len(some.whole.turns) == kept.sum()
    assert {len(of) for of in some.vectors.values()} == {kept.sum()}
    # Another objective is known of the whole alone.
    other = replace(one, values=np.ones(5), whole=replace(one.whole, values=np.zeros(2)))
    other = other.frames(kept)
    np.testing.assert_array_equal(other.whole.in_blocks(), np.zeros((1, 2)))
    np.testing.assert_array_equal(other.in_blocks(), np.ones((1, 5)))
    assert one.frames(np.ones(n, bool)) is one
    cut_again = some.frames(np.arange(kept.sum()) < 5)
    np.testing.assert_array_equal(cut_again.known, np.flatnonzero(kept)[:5])


N = 60
SHORT = 5.0
NOTHING = Hops.of([])


def straight(scales):
    """Poses along x, each step as long as it says."""
    return along_x(np.cumsum([0.0, *np.broadcast_to(scales, N - 1)]))


def frames():
    return Frames(
        np.arange(N, dtype=np.int64) * 10**8,
        straight(0.3),
        np.zeros((N, 90), np.float32),
        {"ndt": 90},
        np.zeros(N, np.float32),
    )


def trial(T_odom_sensor, restarted=None):
    restarted = np.zeros(N, bool) if restarted is None else restarted
    errors = sub_trajectory_rte(frames().T_ref_sensor, T_odom_sensor, SHORT, restarted)
    return Trial.of({}, T_odom_sensor, errors, restarted, 0.0)


def lost_at(i, scale=0.3):
    """A trial that loses track at a frame, and goes on at the reference."""
    T = straight(scale)
    T[i:] = T[i:] + (frames().T_ref_sensor[i] - T[i])
    restarted = np.zeros(N, bool)
    restarted[i] = True
    return trial(T, restarted)


def simulation_of(trials, weights, lost_track=3.0, hops=NOTHING):
    f = frames()
    motions = recorded_motions(trials)
    simulation = BankSimulation(
        f.stamps,
        f.T_ref_sensor,
        f.T_ref_sensor,
        f.descriptors,
        np.arange(N) // 10,
        SHORT,
        lost_track,
        hops,
        lambda members: motions[:, list(members)],
    )
    members = tuple(range(len(trials)))
    return simulation, simulation.errors(members, np.tile(weights, (6, 1)))


def test_errors_are_vectors_as_long_as_they_say():
    of = trial(straight(0.33))
    vectors = error_vectors(frames().T_ref_sensor, of, SHORT)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), of.errors, rtol=1e-5)
    known = ~np.isnan(of.errors)
    assert (vectors[known, 0] > 9.0).all()
    lost = error_vectors(frames().T_ref_sensor, lost_at(20), SHORT)
    assert np.isinf(lost[10]).all()
    assert np.isfinite(lost[25]).all()


def test_members_that_err_in_opposite_directions_make_up_for_it():
    trials = [trial(straight(0.31)), trial(straight(0.29))]
    for weights, expected in (([1.0, 0.0], 3.4), ([0.5, 0.5], 0.0), ([0.0, 1.0], 3.4)):
        _, errors = simulation_of(trials, weights)
        known = errors[~np.isnan(errors)]
        assert len(known) == (~np.isnan(trials[0].errors)).sum()
        np.testing.assert_allclose(known, expected, atol=1e-6)


def test_a_member_that_lost_track_is_left_out():
    sound, lost = trial(straight(0.31)), lost_at(20, 0.29)
    simulation, errors = simulation_of([sound, sound, lost], [0.3, 0.3, 0.4])
    agreeing = simulation.agreeing((0, 1, 2), np.tile([0.3, 0.3, 0.4], (6, 1)))
    assert agreeing[:, :2].all()
    assert not agreeing[25:28, 2].any()
    assert agreeing[:19, 2].all()
    # The windows across the loss are not worse than the sound members alone.
    assert errors[5:20].max() < 100 * 0.01 * 17 / SHORT + 5.0


def test_members_vote_with_their_weights_and_the_reference_judges():
    sound, wrong = trial(straight(0.3)), trial(straight(0.2))
    # One sound member outvotes two wrong ones by its weight, but not by number: scans decide.
    simulation, errors = simulation_of([sound, wrong, wrong], [0.8, 0.1, 0.1])
    known = ~np.isnan(errors)
    assert errors[known].max() < 4.0  # until it is noticed, and after restarts
    # Two of three that have the votes are believed, as in a bank.
    _, errors = simulation_of([sound, wrong, wrong], [0.2, 0.4, 0.4])
    assert errors[known].min() > 20.0
    # Other weights than those that vote: the mean of the members that agree.
    members, votes, even = (0, 1, 2), np.tile([0.8, 0.1, 0.1], (6, 1)), np.full((6, 3), 1.0 / 3.0)
    agreeing = simulation.agreeing(members, votes)
    assert simulation.errors(members, even, agreeing)[known].max() < 12.0


def test_the_motion_after_which_a_member_was_restarted_is_not_known():
    motions = recorded_motions([lost_at(20, 0.29), trial(straight(0.29))])
    unknown = np.isnan(motions).any(axis=(2, 3))
    assert [np.flatnonzero(of).tolist() for of in unknown.T] == [[19], []]
    np.testing.assert_allclose(motions[~unknown][:, 0, 3], 0.29)


def test_where_most_are_lost_the_others_carry_them():
    # Alike as they are, they do not outvote the one that is sound.
    trials = [trial(straight(0.3)), lost_at(20), lost_at(20), lost_at(22)]
    simulation, errors = simulation_of(trials, [0.25] * 4)
    assert np.nanmax(errors) < 1e-6
    agreeing = simulation.agreeing((0, 1, 2, 3), np.full((6, 4), 0.25))
    assert agreeing[:, 0].all()
    # They are away until a bank may restart them again.
    away = [np.flatnonzero(~of).tolist() for of in agreeing.T]
    assert away == [[], [*range(19, 29)], [*range(19, 29)], [*range(21, 31)]]


def test_where_all_are_lost_the_health_check_restarts_the_bank():
    trials = [lost_at(20, 0.31), lost_at(20, 0.29)]
    simulation, errors = simulation_of(trials, [0.5, 0.5])
    agreeing = simulation.agreeing((0, 1), np.full((6, 2), 0.5))
    # All are back with the next scan, and the last healthy motion goes on over this one.
    assert np.flatnonzero(~agreeing.any(axis=1)).tolist() == [19]
    assert agreeing[20:].all()
    assert np.nanmax(errors) < 1e-6


def test_an_impossible_motion_restarts_the_bank():
    way = np.full(N - 1, 0.3)
    way[30] = 4.0  # at 10 scans a second
    simulation, errors = simulation_of([trial(straight(way))] * 2, [0.5, 0.5])
    assert np.nanmax(errors) > 29.0
    careful = replace(simulation, health=HealthCheck(max_speed=8.0))
    assert np.nanmax(careful.errors((0, 1), np.full((6, 2), 0.5))) < 1e-6


def hops_of(pairs, far=0.3):
    """Hops that measure the reference."""
    moved = [np.eye(4) for _ in pairs]
    for T, (start, end) in zip(moved, pairs, strict=True):
        T[0, 3] = far * (end - start)
    return Hops.of([(a, b, Hop(T, np.eye(3))) for T, (a, b) in zip(moved, pairs, strict=True)])


def test_what_is_measured_comes_before_the_period():
    trials = [trial(straight(0.3)), trial(straight(0.309)), lost_at(45, 0.3)]
    hops = hops_of([(0, 10), (5, 30), (20, 40), (30, 50)])
    simulation, _ = simulation_of(trials, np.ones(3) / 3, hops=hops)
    squares = simulation.squares((0, 1, 2))
    assert squares is simulation.squares((0, 1, 2))
    # A hop that ends at the first frame of a period comes too late.
    assert squares[:2] == [None, None]
    for found, windows in zip(squares[2:4], (1.0, 1.0), strict=True):
        # 3 % of what the odometry should have moved.
        np.testing.assert_allclose(found.products.diagonal(), [0.0, 9.0, 0.0], atol=1e-9)
        assert found.windows == windows
    np.testing.assert_allclose(squares[5].products.diagonal()[:2], [0.0, 9.0], atol=1e-9)
    # The last member was lost, but no hop has said so yet.
    np.testing.assert_allclose(squares[5].products[2, 2], 0.0, atol=1e-9)
    simulation, _ = simulation_of(trials, np.ones(3) / 3, hops=hops_of([(30, 49)]))
    assert simulation.squares((0, 1, 2))[5].products[2, 2] > 4.0
    # In another order, and without the lost one.
    other = simulation.squares((1, 0))[5]
    np.testing.assert_allclose(other.products.diagonal(), [9.0, 0.0], atol=1e-9)


def test_over_a_motion_that_is_unknown_nothing_is_measured():
    T = straight(0.33)
    T[30:] = T[30:] + (frames().T_ref_sensor[30] - T[30])
    simulation, _ = simulation_of(
        [trial(straight(0.3)), trial(T)], [0.5, 0.5], hops=hops_of([(20, 35)])
    )
    products = simulation.squares((0, 1))[4].products
    assert products[0, 0] == pytest.approx(0.0, abs=1e-9)
    assert products[1, 1] == pytest.approx(CLIP**2)


def test_it_is_what_a_bank_does():
    rng = np.random.default_rng(0)
    ways = [0.3 + rng.normal(0.0, 0.005, N - 1) for _ in range(3)]
    weights = rng.dirichlet(np.ones(3), 6)
    simulation, _ = simulation_of([trial(straight(way)) for way in ways], weights[0])
    make, _ = makes({i: dict(enumerate(way, 1)) for i, way in enumerate(ways)})
    bank = Bank(make, {i: {"speed": i} for i in range(3)}, lost_track=1e9)
    poses = [np.eye(4)]
    for i in range(N):
        prepared = bank.prepare(at(i))
        bank.apply(Selection(0, {}, dict(enumerate(weights[i // 10]))))
        if i == 0:
            bank.start(prepared, np.eye(4))
        else:
            poses.append(bank.register(prepared).T_odom_sensor)
    expected = sub_trajectory_rte(frames().T_ref_sensor, np.array(poses), SHORT)
    alone = replace(simulation, lost_track=1e9)
    np.testing.assert_allclose(alone.errors((0, 1, 2), weights), np.minimum(expected, 30.0))
