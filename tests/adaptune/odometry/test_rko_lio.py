import importlib.util
from dataclasses import replace

import numpy as np
import pytest
import turns
from needs import lacking
from scipy.spatial.transform import Rotation

from adaptune.odometry import OdometryError
from adaptune.odometry.rko_lio import RkoLio


@pytest.fixture(autouse=True)
def _rko_lio():
    if importlib.util.find_spec("rko_lio") is None:
        lacking("rko_lio", "RKO-LIO is not installed: pip install 'adaptune[rko-lio]'")


def poses(odometry, scans):
    odometry.start(odometry.prepare(scans[0]), np.eye(4))
    return np.array([odometry.register(odometry.prepare(scan)).T_odom_sensor for scan in scans[1:]])


def test_it_needs_an_imu():
    with pytest.raises(OdometryError, match="needs an IMU, and the scans do not bring along"):
        RkoLio().prepare(turns.turn(0))


def test_a_sensor_that_does_not_stand_upright():
    # RKO-LIO believes its first frame to be level, and would take gravity for acceleration.
    T_tilted_sensor = np.eye(4)
    T_tilted_sensor[:3, :3] = Rotation.from_euler("yx", [35, -20], degrees=True).as_matrix()
    scans = [
        replace(
            scan,
            points=(scan.points @ T_tilted_sensor[:3, :3].T).astype(np.float32),
            imu=replace(scan.imu, T_sensor_imu=T_tilted_sensor @ scan.imu.T_sensor_imu),
        )
        for scan in map(turns.measured, range(8))
    ]
    odometry = RkoLio()
    T = poses(odometry, scans)
    up = odometry._T_base_sensor[:3, :3] @ T_tilted_sensor[:3, 2]
    np.testing.assert_allclose(up, [0.0, 0.0, 1.0], atol=1e-3)
    np.testing.assert_allclose(T[-1, :3, 3], 7 * turns.STEP * T_tilted_sensor[:3, 0], atol=0.2)
    np.testing.assert_allclose(T[:, :3, :3], np.tile(np.eye(3), (7, 1, 1)), atol=0.03)


def test_scans_whose_points_have_no_times():
    scans = [replace(turns.measured(i), times=None) for i in range(8)]
    T = poses(RkoLio(), scans)
    np.testing.assert_allclose(T[-1, :3, 3], [7 * turns.STEP, 0.0, 0.0], atol=0.3)
