from dataclasses import replace

import numpy as np
import pytest

from adaptune.archive import Frames, Trial
from adaptune.bank.bank import Bank
from adaptune.geometry import invert, steps
from adaptune.live.hops import CLIP, Hop, Hops
from adaptune.metrics import sub_trajectory_rte
from adaptune.model.weights import MemberWeights
from adaptune.odometry import InProcess, Odometry
from adaptune.odometry.base import Registration
from adaptune.recording import Scan
from adaptune.space import Float, ParameterSpace, Selection
from offline.labelled import BankSimulation, error_vectors, recorded_motions

N = 60
LENGTH = 5.0
NOTHING = Hops.of([])


def straight(scales):
    """Poses along x, each step as long as it says."""
    T = np.tile(np.eye(4), (N, 1, 1))
    T[1:, 0, 3] = np.cumsum(np.broadcast_to(scales, N - 1))
    return T


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
    errors = sub_trajectory_rte(frames().T_ref_sensor, T_odom_sensor, LENGTH, restarted)
    return Trial({}, T_odom_sensor, errors, restarted, np.ones(N, bool), np.zeros(N))


def lost_at(i, scale=0.3):
    """A trial that loses track at a frame, and goes on at the reference."""
    T = straight(scale)
    T[i:] = T[i:] + (frames().T_ref_sensor[i] - T[i])
    restarted = np.zeros(N, bool)
    restarted[i] = True
    return trial(T, restarted)


def simulated(trials, weights, lost_track=3.0, hops=NOTHING):
    f = frames()
    motions = recorded_motions(f, trials)
    simulation = BankSimulation(
        f.stamps,
        f.T_ref_sensor,
        f.descriptors,
        np.arange(N) // 10,
        LENGTH,
        lost_track,
        hops,
        lambda members: motions[:, list(members)],
    )
    members = tuple(range(len(trials)))
    return simulation, simulation.errors(MemberWeights(members, np.tile(weights, (6, 1))))


def test_errors_are_vectors_as_long_as_they_say():
    of = trial(straight(0.33))
    vectors = error_vectors(frames().T_ref_sensor, of, LENGTH)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), of.errors, rtol=1e-5)
    known = ~np.isnan(of.errors)
    assert (vectors[known, 0] > 9.0).all()
    lost = error_vectors(frames().T_ref_sensor, lost_at(20), LENGTH)
    assert np.isinf(lost[10]).all()
    assert np.isfinite(lost[25]).all()


def test_members_that_err_in_opposite_directions_make_up_for_it():
    trials = [trial(straight(0.31)), trial(straight(0.29))]
    for weights, expected in (([1.0, 0.0], 3.4), ([0.5, 0.5], 0.0), ([0.0, 1.0], 3.4)):
        _, errors = simulated(trials, weights)
        known = errors[~np.isnan(errors)]
        assert len(known) == (~np.isnan(trials[0].errors)).sum()
        np.testing.assert_allclose(known, expected, atol=1e-6)


def test_a_member_that_lost_track_is_left_out():
    sound, lost = trial(straight(0.31)), lost_at(20, 0.29)
    simulation, errors = simulated([sound, sound, lost], [0.3, 0.3, 0.4])
    agreeing = simulation.agreeing(MemberWeights((0, 1, 2), np.tile([0.3, 0.3, 0.4], (6, 1))))
    assert agreeing[:, :2].all()
    assert not agreeing[25:28, 2].any()
    assert agreeing[:19, 2].all()
    # The windows across the loss are not worse than the sound members alone.
    assert errors[5:20].max() < 100 * 0.01 * 17 / LENGTH + 5.0
    # Where all are lost, nobody knows, and the bank stands still with them for a second.
    _, errors = simulated([lost, lost_at(20)], [0.5, 0.5])
    assert (errors[10:20] == 30.0).all()


def test_members_vote_with_their_weights_and_the_reference_judges():
    sound, wrong = trial(straight(0.3)), trial(straight(0.2))
    # One sound member outvotes two wrong ones by its weight, but not by number: scans decide.
    simulation, errors = simulated([sound, wrong, wrong], [0.8, 0.1, 0.1])
    known = ~np.isnan(errors)
    assert errors[known].max() < 4.0  # until it is noticed, and after restarts
    # Two of three that have the votes are believed, as in a bank.
    _, errors = simulated([sound, wrong, wrong], [0.2, 0.4, 0.4])
    assert errors[known].min() > 20.0
    # Other weights than those that vote: the mean of the members that agree.
    votes = MemberWeights((0, 1, 2), np.tile([0.8, 0.1, 0.1], (6, 1)))
    even = MemberWeights((0, 1, 2), np.full((6, 3), 1.0 / 3.0))
    assert simulation.errors(even, votes)[known].max() < 12.0
    # Where the reference is unknown, nobody judges.
    unknown = replace(simulation, T_ref_sensor=np.full_like(simulation.T_ref_sensor, np.nan))
    assert np.isinf(unknown._misplaced(5, np.tile(np.eye(4), (2, 3, 1, 1)), (1, 3))).all()


def test_a_member_that_lost_track_stands_still_until_it_is_noticed():
    motions = recorded_motions(frames(), [lost_at(20, 0.29), trial(straight(0.29))])
    still = (motions[:, 0] == np.eye(4)).all(axis=(1, 2))
    # The step to the frame at which it was lost, and those that begin within a second of it.
    assert np.flatnonzero(still).tolist() == list(range(19, 29))
    np.testing.assert_allclose(motions[~still, 0, 0, 3], 0.29)
    np.testing.assert_allclose(motions[:, 1, 0, 3], 0.29)


def hops_of(pairs, far=0.3):
    """Hops that measure the reference."""
    moved = [np.eye(4) for _ in pairs]
    for T, (start, end) in zip(moved, pairs, strict=True):
        T[0, 3] = far * (end - start)
    return Hops.of([(a, b, Hop(T, np.eye(3))) for T, (a, b) in zip(moved, pairs, strict=True)])


def test_what_is_measured_comes_before_the_period():
    trials = [trial(straight(0.3)), trial(straight(0.309)), lost_at(45, 0.3)]
    hops = hops_of([(0, 10), (5, 30), (20, 40), (30, 50)])
    simulation, _ = simulated(trials, np.ones(3) / 3, hops=hops)
    live = simulation.live((0, 1, 2))
    assert live is simulation.live((0, 1, 2))
    assert live[:2] == [None, None]  # a hop that ends at the first frame of a period comes too late
    for found, windows in zip(live[2:4], (1.0, 1.0), strict=True):
        # 3 % of what the odometry should have moved.
        np.testing.assert_allclose(found.products.diagonal(), [0.0, 9.0, 0.0], atol=1e-9)
        assert found.windows == windows
    np.testing.assert_allclose(live[5].products.diagonal()[:2], [0.0, 9.0], atol=1e-9)
    # The last member stood still, but no hop has said so yet.
    np.testing.assert_allclose(live[5].products[2, 2], 0.0, atol=1e-9)
    simulation, _ = simulated(trials, np.ones(3) / 3, hops=hops_of([(30, 49)]))
    assert simulation.live((0, 1, 2))[5].products[2, 2] > 4.0
    # In another order, and without the lost one.
    other = simulation.live((1, 0))[5]
    np.testing.assert_allclose(other.products.diagonal(), [9.0, 0.0], atol=1e-9)


def test_over_a_motion_that_is_unknown_nothing_is_measured():
    T = straight(0.33)
    T[30:] = T[30:] + (frames().T_ref_sensor[30] - T[30])
    simulation, _ = simulated(
        [trial(straight(0.3)), trial(T)], [0.5, 0.5], hops=hops_of([(20, 35)])
    )
    products = simulation.live((0, 1))[4].products
    assert products[0, 0] == pytest.approx(0.0, abs=1e-9)
    assert products[1, 1] == pytest.approx(CLIP**2)


class Recorded(Odometry):
    """Makes the motions of a trial."""

    space = ParameterSpace({"number": Float(low=0.0, high=9.0, baseline=0.0)})
    live = clean = False

    def __init__(self, parameters, trials):
        super().__init__(parameters)
        self.steps = steps(trials[int(parameters["number"])].T_odom_sensor)

    def prepare(self, scan):
        return scan.stamp

    def start(self, _prepared, T_odom_sensor, _T_previous_current=None):
        self.T = T_odom_sensor

    def register(self, prepared):
        self.T = self.T @ self.steps[prepared // 10**8 - 1]
        return Registration(self.T, True)


def test_it_is_what_a_bank_does():
    rng = np.random.default_rng(0)
    trials = [trial(straight(0.3 + rng.normal(0.0, 0.005, N - 1))) for _ in range(3)]
    weights = rng.dirichlet(np.ones(3), 6)
    simulation, _ = simulated(trials, weights[0])
    sets = [{"number": float(i)} for i in range(3)]
    box = Bank(lambda p: InProcess(Recorded(p, trials)), dict(enumerate(sets)), lost_track=1e9)
    f = frames()
    poses = [np.eye(4)]
    for i, stamp in enumerate(f.stamps):
        prepared = box.prepare(Scan(int(stamp), np.zeros((30, 3), np.float32)))
        box.apply(Selection(0, {}, dict(enumerate(weights[i // 10]))))
        if i == 0:
            box.start(prepared, np.eye(4))
        else:
            poses.append(box.register(prepared).T_odom_sensor)
    expected = sub_trajectory_rte(f.T_ref_sensor, np.array(poses), LENGTH)
    alone = replace(simulation, lost_track=1e9)
    np.testing.assert_allclose(
        alone.errors(MemberWeights((0, 1, 2), weights)), np.minimum(expected, 30.0)
    )
    np.testing.assert_allclose(invert(poses[0]), np.eye(4))
