import numpy as np
import turns

from adaptune.odometry.kiss_icp import Kiss


def begun(n=8):
    odometry = Kiss()
    odometry.start(odometry.prepare(turns.turn(0)), np.eye(4))
    for i in range(1, n):
        odometry.register(odometry.prepare(turns.turn(i)))
    return odometry


def test_the_map_is_carried_over():
    odometry = begun()
    before = odometry._kiss.local_map.point_cloud()
    odometry.configure({"voxel_size": 0.5})
    after = odometry._kiss.local_map.point_cloud()
    # Smaller cells hold at least as many points, and no other ones.
    assert set(map(tuple, after)) == set(map(tuple, before))
    odometry.configure({"voxel_size": 2.0, "max_points_per_voxel": 3})
    coarse = odometry._kiss.local_map.point_cloud()
    assert len(coarse) < 0.5 * len(before)
    assert set(map(tuple, coarse)) < set(map(tuple, before))
    assert odometry._kiss.config.mapping.voxel_size == 2.0


def test_the_threshold_begins_again_where_it_is_told_to():
    odometry = begun()
    sigma = odometry._kiss.adaptive_threshold.get_threshold()
    odometry.configure({"voxel_size": 0.7})
    assert odometry._kiss.adaptive_threshold.get_threshold() == sigma
    odometry.configure({"min_motion_th": 0.05})
    np.testing.assert_allclose(odometry._kiss.adaptive_threshold.get_threshold(), sigma)
    odometry.configure({"initial_threshold": 0.9, "min_motion_th": 0.2})
    np.testing.assert_allclose(odometry._kiss.adaptive_threshold.get_threshold(), 0.9)
