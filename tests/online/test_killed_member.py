"""A bank of three odometries, of which one is killed on the way."""

import logging

import drives
import numpy as np
import pytest
from needs import needs_evalio
from wicked import tell

from adaptune.bank.bank import Bank
from adaptune.odometry.factory import OdometryFactory, OdometryPool
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.registry import odometry_class
from adaptune.odometry.remote import SERVICE, Limits
from adaptune.recording import Scan
from adaptune.runs.loop import replay
from adaptune.selector import UntrainedSelector
from adaptune.space import ParameterSets

SETS = {
    3: {"odometry": "gicp", "max_correspondence_distance": 2.0},
    7: {"odometry": "kiss_icp", "voxel_size": 0.5},
    12: {"odometry": "genz_icp", "voxel_size": 0.4, "desired_num_voxelized_points": 1000},
}
STEP = 0.25
"""Metres between scans, ten a second."""
KILLED = range(40, 60)
"""Scans before which the process of trial 12 is killed, if it has one."""


def killing(scans):
    """Scans, and a murder before some of them."""
    for i, scan in enumerate(scans):
        if i in KILLED:
            tell(SERVICE, "genz_icp")
        yield scan


def of_pool(*order):
    """A bank of the sets in this order, and its selector."""
    names = {of["odometry"] for of in SETS.values()}
    pool = OdometryPool(
        {n: OdometryFactory(n, {}, odometry_class(n).space, Limits()) for n in sorted(names)}
    )
    sets = {trial: pool.space.complete(SETS[trial]) for trial in order}
    bank = Bank(pool, sets)
    return bank, UntrainedSelector(ParameterSets(pool.space, order, tuple(sets.values())), 10.0)


@pytest.mark.parametrize("order", [(3, 7, 12), (12, 3, 7)])
def test_a_member_that_is_killed_costs_its_weight_and_nothing_else(order, caplog):
    needs_evalio()
    bank, selector = of_pool(*order)
    scans = [Scan(stamp, points) for stamp, points, _ in drives.scans(0, 110, STEP)]
    with caplog.at_level(logging.WARNING, "adaptune.bank.bank"):
        found = replay(killing(scans), bank, HealthCheck(), selector)
    # The second time, it rests for longer than the drive.
    assert sum(member.ended for member in bank._members) == 1
    bank.close()
    T = found.trajectory.T_world_sensor[-1]
    assert np.linalg.norm(T[:3, 3] - [STEP * (len(scans) - 1), 0.0, 0.0]) < 0.1
    assert not found.restarted.any()
    assert bank.restarts == 1
    told = [r.getMessage() for r in caplog.records if r.name == "adaptune.bank.bank"]
    what = "its process was ended by SIGKILL; the bank goes on without it"
    ended = f"trial 12 (genz_icp) ended: {what}"
    assert told == [ended, "trial 12 (genz_icp) is back", ended]
    weights = [choice.selection.weights for choice in found.choices]
    # Once a second, before the scan is registered.
    assert weights[4][12] > 0.05
    for of_members in weights[5:8]:
        assert of_members[12] == 0.0
        assert sum(of_members.values()) == pytest.approx(1.0)
        assert min(of_members[3], of_members[7]) > 0.0
