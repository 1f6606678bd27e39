import numpy as np
import pytest

from adaptune.metrics import sub_trajectory_rte
from adaptune.odometry.registry import odometry_class
from adaptune.simulation import SCENES, Course
from adaptune.simulation.record import simulate


@pytest.mark.parametrize("scene", SCENES)
def test_odometry_survives(scene):
    cls = odometry_class("gicp")
    odometry = cls({"max_correspondence_distance": 1.5, "keyframe_interval": 3.0})
    T_world_sensor, poses = [], []
    for scan in simulate(Course(scenes=(scene,), length=26.0, columns=300)):
        prepared = odometry.prepare(scan)
        if poses:
            poses.append(odometry.register(prepared).T_odom_sensor)
        else:
            odometry.start(prepared, scan.T_world_sensor)
            poses.append(scan.T_world_sensor)
        T_world_sensor.append(scan.T_world_sensor)
    errors = sub_trajectory_rte(np.array(T_world_sensor), np.array(poses), 25.0)
    assert np.nanmean(errors) < 4.0


@pytest.mark.parametrize("scene", SCENES)
def test_the_last_tile_of_a_scene_may_be_short(scene):
    scan = next(simulate(Course(scenes=(scene, "cave"), length=22.0, columns=16)))
    assert len(scan) > 100
