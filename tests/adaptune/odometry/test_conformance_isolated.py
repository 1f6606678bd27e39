"""What odometries must do that run in processes of their own, one suite for all of them."""

from functools import cache

import numpy as np
import pytest
from needs import lacking
from rooms import moved
from turns import STEP, measured

from adaptune.geometry import invert
from adaptune.odometry import OdometryError
from adaptune.odometry.registry import ODOMETRIES, odometry_class
from adaptune.odometry.remote import Isolated, Limits
from adaptune.recording import Scan
from adaptune.space import Selection

NAMES = [name for name in ODOMETRIES if not odometry_class(name).clean]
"""test_conformance.py holds what the others must do."""

every_odometry = pytest.mark.parametrize("name", NAMES)


@pytest.fixture(autouse=True)
def _installed(name):
    try:
        odometry_class(name)()
    except OdometryError as error:
        lacking("rko_lio" if name == "rko_lio" else "evalio", str(error))


N_SCANS = 8
# Metres along x after eight scans: some need a few scans to know their speed.
TOLERANCE = {"ct_icp": 0.1, "form": 0.1, "loam": 0.1, "dlio": 1.0, "lio_sam": 0.2}


def isolated(name, parameters=None):
    return Isolated(
        name, parameters or {}, odometry_class(name).settings_type(), Limits(seconds=60.0)
    )


def begin(odometry, T):
    # LIO-SAM waits for two scans more before its first pose.
    motion = moved(STEP) if odometry.name == "lio_sam" else None
    odometry.start(odometry.prepare(measured(0)), T, motion)


def drive(odometry, T_odom_sensor=None, n=N_SCANS):
    T = np.eye(4) if T_odom_sensor is None else T_odom_sensor
    begin(odometry, T)
    registrations = (odometry.register(odometry.prepare(measured(i))) for i in range(1, n))
    return np.array([T, *(registration.T_odom_sensor for registration in registrations)])


@cache
def usual_drive(name):
    return drive(isolated(name))


@every_odometry
def test_straight_ahead_is_along_x(name):
    T = usual_drive(name)
    tolerance = TOLERANCE.get(name, 0.3)
    np.testing.assert_allclose(T[-1, 0, 3], STEP * (N_SCANS - 1), atol=tolerance)
    np.testing.assert_allclose(T[:, 1:3, 3], 0.0, atol=0.1)
    np.testing.assert_allclose(T[:, :3, :3], np.tile(np.eye(3), (N_SCANS, 1, 1)), atol=0.03)


# DLIO builds its local map in a thread of its own, and takes what there is of it when a scan comes.
REPEATS = {"dlio": 0.02}


@every_odometry
def test_a_new_start_is_fresh_and_the_same_to_the_last_bit(name):
    odometry = isolated(name)
    drive(odometry, n=3)
    np.testing.assert_allclose(
        drive(odometry), usual_drive(name), rtol=0.0, atol=REPEATS.get(name, 0.0)
    )


@every_odometry
def test_where_it_starts_does_not_matter(name):
    T = moved(20.0, -30.0, 4.0, yaw=np.pi / 2)
    np.testing.assert_allclose(
        invert(T) @ drive(isolated(name), T), usual_drive(name), atol=REPEATS.get(name, 1e-9)
    )


@every_odometry
@pytest.mark.parametrize("poor", ["empty", "few", "NaN"])
def test_a_poor_scan_keeps_the_last_motion(name, poor):
    odometry = isolated(name)
    T_before, T = drive(odometry, n=4)[-2:]
    full = measured(4)
    points = np.full_like(full.points, np.nan) if poor == "NaN" else full.points
    n = {"empty": 0, "few": 15, "NaN": None}[poor]
    scan = Scan(full.stamp, points[:n], full.times[:n], full.rings[:n], full.imu)
    T_next, registered = odometry.register(odometry.prepare(scan))
    assert not registered
    np.testing.assert_allclose(T_next, T @ invert(T_before) @ T, atol=1e-6)
    assert odometry.register(odometry.prepare(measured(5))).registered
    assert not odometry.faults


@every_odometry
def test_a_poor_first_scan(name):
    odometry = isolated(name)
    T, T_previous_current = moved(y=5.0), moved(0.3)
    few = measured(0).select(np.arange(10))
    odometry.start(odometry.prepare(few), T, T_previous_current)
    T_next, _ = odometry.register(odometry.prepare(measured(1)))
    np.testing.assert_allclose(T_next, T @ T_previous_current, atol=1e-12)
    for i in range(2, 6):
        T_next, registered = odometry.register(odometry.prepare(measured(i)))
    assert registered
    np.testing.assert_allclose(T_next[:3, 3], [0.3 + 4 * STEP, 5.0, 0.0], atol=1.0)


@every_odometry
def test_what_it_does_not_know_is_refused(name):
    odometry = isolated(name, {"voxl": 1.0})
    with pytest.raises(OdometryError, match="has no parameter 'voxl'"):
        odometry.start(odometry.prepare(measured(0)), np.eye(4))
    if odometry_class(name).live:
        return
    odometry = isolated(name)
    odometry.start(odometry.prepare(measured(0)), np.eye(4))
    with pytest.raises(OdometryError, match="cannot change its parameters between scans"):
        odometry.apply(Selection(0, odometry_class(name).space.baseline))


LATE = {
    # CT-ICP begins with others for 20 scans; FORM has no key scans to leave out so soon.
    "ct_icp": {"voxel_size", "sample_voxel_size"},
    # There are no more keyframes yet than these take, and no registration that takes three steps.
    "dlio": {"submap_knn", "gicp_max_iter"},
    "lio_sam": {"surroundingkeyframeAddingDistThreshold", "surroundingKeyframeSearchRadius"},
    "form": {"keyscan_match_ratio", "max_num_keyscans"},
}


def parameter_cases():
    return [
        (name, parameter)
        for name in NAMES
        for parameter in odometry_class(name).space.names
        if parameter not in LATE.get(name, ())
    ]


@pytest.mark.parametrize(("name", "parameter"), parameter_cases())
def test_every_parameter_takes_effect(name, parameter):
    space = odometry_class(name).space
    usual = usual_drive(name)
    changed = (
        drive(isolated(name, {parameter: space.parameters[parameter].from_unit(u)}))
        for u in (0.0, 1.0)
    )
    assert any(np.abs(poses - usual).max() > 1e-9 for poses in changed)
