import numpy as np
import pytest
from made_passes import course, passed, truth

from adaptune.metrics import sub_trajectory_rte
from adaptune.odometry.registry import odometry_class
from adaptune.recording.scan import Scan
from adaptune.reference.graph import HALVES, POOL, Consensus


def test_the_halves_are_the_pool_and_have_no_algorithm_in_common():
    assert sorted(HALVES[0] + HALVES[1]) == list(range(len(POOL))) == list(range(5))
    kinds = [{POOL[i][0] for i in half} for half in HALVES]
    assert not kinds[0] & kinds[1]


def test_it_follows_the_drive():
    found = passed()
    np.testing.assert_array_equal(found.T_odom_sensor[0], np.eye(4))
    assert np.nanmean(sub_trajectory_rte(truth(), found.T_odom_sensor, 5.0)) < 1.5


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
