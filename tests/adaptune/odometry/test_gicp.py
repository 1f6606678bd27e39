import numpy as np
import pytest

from adaptune.metrics import sub_trajectory_rte
from adaptune.odometry.registry import odometry_class
from adaptune.recording.config import SequenceConfig
from adaptune.recording.recording import open_sequence


@pytest.mark.services
def test_parameters_matter_as_much_as_is_known(recorded):
    """A loop through a hall at two scans a second; the figures come with the recording."""
    topics = {"points": "/velodyne_points", "reference": "/gt_poses"}
    sequence = open_sequence(SequenceConfig(bag=str(recorded / "hall.bag"), **topics, cache=False))
    scans = list(sequence)
    T_ref_sensor = sequence.reference().at(np.array([scan.stamp for scan in scans]))
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
