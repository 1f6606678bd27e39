import drives
import numpy as np
import pytest
from wicked import tell

from adaptune.bank.bank import Bank
from adaptune.bank.members import KEPT, SERVICE, Member, spread
from adaptune.odometry.base import WARM_UP, InProcess
from adaptune.odometry.factory import OdometryFactory, OdometryPool
from adaptune.odometry.registry import odometry_class
from adaptune.odometry.remote import Limits
from adaptune.recording.scan import Scan
from adaptune.space import Selection

POOL = OdometryPool(
    {
        name: OdometryFactory(name, {}, odometry_class(name).space, Limits())
        for name in ("gicp", "vgicp")
    }
)
SETS = [
    {"odometry": "gicp", "keyframe_interval": 1.0},
    {"odometry": "vgicp", "keyframe_interval": 2.0},
    {"odometry": "gicp", "downsampling": 1.0},
    {"odometry": "vgicp", "resolution": 0.7},
    {"odometry": "gicp", "keyframe_interval": 3.0, "downsampling": 1.0},
]
STEP = 0.25


@pytest.fixture(scope="module")
def scans():
    return [Scan(stamp, points) for stamp, points, _ in drives.scans(0, 40, STEP)]


def bank(n_cores):
    return Bank(
        POOL,
        {3 * i: POOL.space.complete(one) for i, one in enumerate(SETS)},
        cores=n_cores,
    )


def run(odometry, scans, before=lambda _: None):
    trials = odometry.trials
    odometry.apply(Selection(trials[0], {}, dict.fromkeys(trials, 1.0 / len(trials))))
    poses, moved = [], []
    for i, scan in enumerate(scans):
        before(i)
        prepared = odometry.prepare(scan)
        if i == 0:
            odometry.start(prepared, np.eye(4))
        else:
            poses.append(odometry.register(prepared).T_odom_sensor)
            moved.append(list(odometry.motions.members.values()))
    odometry.close()
    return np.array(poses), np.array(moved)


def test_members_are_spread_over_the_cores():
    made = spread(POOL, [POOL.space.complete(one) for one in SETS], 2)
    # Those that prepare alike are together, and this process has the smaller share.
    assert [isinstance(one, Member) for one in made] == [False, False, True, True, True]
    assert len({one.preparation for one in made if isinstance(one, Member)}) == 1
    made = spread(POOL, [POOL.space.complete(one) for one in SETS], 9)
    assert sum(isinstance(one, InProcess) for one in made) == 1
    assert len({one.preparation for one in made}) == 5


@pytest.mark.parametrize("n_cores", [2, 3, 8])
def test_the_number_of_cores_changes_no_motion(scans, n_cores):
    alone, motions = run(bank(1), scans)
    together, same = run(bank(n_cores), scans)
    np.testing.assert_array_equal(together, alone)
    np.testing.assert_array_equal(same, motions)
    np.testing.assert_allclose(alone[-1, :3, 3], [STEP * 39, 0.0, 0.0], atol=0.1)


def test_members_that_restart_see_the_same_scans(scans):
    """More scans than a process keeps, and members that are told to restart."""

    def restarting(odometry):
        def before(i):
            if i in (10, 25):
                told = frozenset(odometry.trials[1:3] if i == 10 else odometry.trials[3:])
                weights = dict.fromkeys(odometry.trials, 0.2)
                odometry.apply(Selection(0, {}, weights, restart=told))

        return before

    one, other = bank(1), bank(2)
    for member in (*one._members, *other._members):
        member.warm_up = 1.0
    poses, motions = run(one, scans, restarting(one))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("adaptune.bank.members.KEPT", 4)
        # The other process has its own limit: it must know what this one forgot.
        same, others = run(other, scans, restarting(other))
    assert one.restarts == other.restarts == 4
    np.testing.assert_array_equal(same, poses)
    np.testing.assert_array_equal(others, motions)
    assert KEPT > 12 * 10


def test_members_know_how_much_of_the_past_they_need_wherever_they_run():
    kiss = OdometryFactory("kiss_icp", {}, odometry_class("kiss_icp").space, Limits())
    pool = OdometryPool({**POOL.factories, "kiss_icp": kiss})
    sets = [{"odometry": "kiss_icp"}, {"odometry": "gicp"}]
    for cores in (1, 2):
        made = spread(pool, [pool.space.complete(one) for one in sets], cores)
        assert [member.warm_up for member in made] == [WARM_UP, 0.0]


def test_a_process_that_is_killed_costs_its_members_weight(scans):
    odometry = bank(2)

    dead = []

    def before(i):
        for name in ("gicp", "vgicp") if i == 15 else ():
            tell(SERVICE, name)
        dead.append(sum(member.ended for member in odometry._members))

    poses, _ = run(odometry, scans, before)
    assert max(dead) == 3
    assert dead[-1] == 0
    assert len(odometry.faults) == 3
    assert set(odometry.faults) == {"its process was ended by SIGKILL"}
    np.testing.assert_allclose(poses[-1, :3, 3], [STEP * 39, 0.0, 0.0], atol=0.1)


def test_usage_counts_the_process_once(scans):
    odometry = bank(2)
    run(odometry, scans[:10])
    used = odometry.usage
    assert 0.0 < used.other_cpu < used.cpu
    assert 20.0 < used.memory < 5_000.0


def test_a_process_ends_with_the_last_of_its_members(scans):
    made = spread(POOL, [POOL.space.complete(one) for one in SETS], 2)
    members = [one for one in reversed(made) if isinstance(one, Member)]
    process = members[0].preparation
    for member in members:
        member.start(member.prepare(scans[0]), np.eye(4))
    for i, member in enumerate(members):
        assert process.conversation.alive
        member.close()
        for other in members[i + 1 :]:
            assert np.isfinite(other.register(other.prepare(scans[1])).T_odom_sensor).all()
            assert not other.faults
    assert not process.conversation.alive
