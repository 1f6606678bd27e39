import numpy as np
import pytest
from made_passes import course, passed, truth

from adaptune.geometry import steps
from adaptune.metrics import sub_trajectory_rte
from adaptune.odometry.registry import odometry_class
from adaptune.recording.scan import Scan
from adaptune.reference.graph import HALVES, POOL, Consensus


def test_the_halves_are_the_pool_and_have_no_algorithm_in_common():
    assert sorted(HALVES[0] + HALVES[1]) == list(range(len(POOL))) == list(range(5))
    kinds = [{POOL[i][0] for i in half} for half in HALVES]
    assert not kinds[0] & kinds[1]


def test_parameters_are_within_the_spaces_of_their_odometries_and_not_baselines():
    for kind, parameters in POOL:
        space = odometry_class(kind).space
        assert set(parameters) <= set(space.names)
        assert parameters != {name: space.baseline[name] for name in parameters}


def test_it_follows_the_drive():
    found = passed()
    np.testing.assert_array_equal(found.T_odom_sensor[0], np.eye(4))
    assert np.nanmean(sub_trajectory_rte(truth(), found.T_odom_sensor, 5.0)) < 1.5


def test_each_member_has_motions_of_its_own():
    found, true = passed(), steps(truth())
    motions = found.T_previous_current
    assert motions.shape == (len(course()), Consensus.n_members, 4, 4)
    np.testing.assert_array_equal(motions[0], np.tile(np.eye(4), (Consensus.n_members, 1, 1)))
    off = np.linalg.norm((motions[1:] - true[:, None])[..., :3, 3], axis=-1)
    assert (np.median(off, axis=0) < 0.05).all()
    assert len(np.unique(motions[5, :, 0, 3])) == Consensus.n_members


def test_where_all_agree_it_moves_by_their_mean():
    found = passed()
    mean = found.T_previous_current[1:].mean(axis=1)[:, :3, 3]
    off = np.linalg.norm(steps(found.T_odom_sensor)[:, :3, 3] - mean, axis=1)
    assert np.median(off) < 1e-3


@pytest.mark.parametrize("kind", sorted({kind for kind, _ in POOL}))
def test_a_scan_is_prepared_once_for_all_members_of_a_kind(monkeypatch, kind):
    cls, prepared = odometry_class(kind), []
    prepare = cls.prepare
    monkeypatch.setattr(
        cls, "prepare", lambda self, scan: prepared.append(0) or prepare(self, scan)
    )
    consensus = Consensus()
    for scan in course()[:3]:
        consensus.register(scan)
    # One kind may prepare as the other does.
    shared = sum(odometry_class(k).prepare is cls.prepare for k in {k for k, _ in POOL})
    assert len(prepared) == 3 * shared


def test_scans_without_points_leave_it_moving_on():
    consensus = Consensus()
    for scan in course()[:8]:
        before, *_ = consensus.register(scan)
    stamp = course()[8].stamp
    empty = Scan(stamp, np.zeros((0, 3), np.float32))
    T, members, registered = consensus.register(empty)
    assert np.isfinite(T).all()
    assert np.linalg.norm((T - before)[:3, 3]) < 1.0
    assert members.shape == (Consensus.n_members, 4, 4)
    assert not registered
