import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from adaptune.geometry import from_quaternions
from adaptune.metrics import sub_trajectory_rte
from adaptune.odometry.registry import odometry_class
from adaptune.recording import clouds


def recording(path):
    scans, translations, quaternions = [], [], []
    with AnyReader([path]) as reader:
        for connection, _, data in reader.messages():
            if connection.topic == "/velodyne_points":
                scans.append(clouds.decode_cloud(data, cdr=False))
            elif connection.topic == "/gt_poses":
                message = reader.deserialize(data, connection.msgtype)
                p, q = message.pose.position, message.pose.orientation
                translations.append((p.x, p.y, p.z))
                quaternions.append((q.x, q.y, q.z, q.w))
    return scans, from_quaternions(translations, quaternions)


def test_parameters_matter_as_much_as_is_known(recorded):
    """A loop through a hall at two scans a second; the figures come with the recording."""
    scans, T_ref_sensor = recording(recorded / "hall.bag")
    cls = odometry_class("gicp")
    settings = cls.settings_type(downsampling=0.25, min_range=1.0, iterations=30)
    prepared = [cls(settings=settings).prepare(scan) for scan in scans]
    for distance, interval, percent in [(1.0, 1.0, 5.0), (4.0, 4.0, 0.85), (2.0, 1.0, 0.38)]:
        parameters = {"max_correspondence_distance": distance, "keyframe_interval": interval}
        odometry = cls(parameters, settings)
        odometry.start(prepared[0], np.eye(4))
        poses = np.array([np.eye(4), *(odometry.register(p).T_odom_sensor for p in prepared[1:])])
        errors = sub_trajectory_rte(T_ref_sensor, poses, 5.0)
        assert np.nanmean(errors) == pytest.approx(percent, rel=0.02)
