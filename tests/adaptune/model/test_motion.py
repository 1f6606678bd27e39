import numpy as np
from scipy.spatial.transform import Rotation

from adaptune.geometry import invert
from adaptune.model.descriptor import speed_and_turn_rate

STAMPS = 10**18 + np.arange(40, dtype=np.int64) * 10**8


def circle(rate=0.5, radius=2.0):
    """Counterclockwise, `rate` radians a second."""
    T = np.tile(np.eye(4), (len(STAMPS), 1, 1))
    angle = rate * (STAMPS - STAMPS[0]) * 1e-9
    T[:, :3, :3] = Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    T[:, 0, 3], T[:, 1, 3] = radius * np.sin(angle), radius * (1 - np.cos(angle))
    return T


def test_a_circle_from_wherever_it_is_seen():
    T_odom_world = invert(circle()[13])
    found = speed_and_turn_rate(STAMPS, T_odom_world @ circle())
    assert found[0].tolist() == [0.0, 0.0]
    # A second's chord, from the first full second on.
    np.testing.assert_allclose(found[10:, 0], 2 * 2.0 * np.sin(0.25), rtol=1e-9)
    np.testing.assert_allclose(found[1:, 1], 0.5, rtol=1e-6)
    np.testing.assert_allclose(found[1, 0], 1.0, rtol=1e-3)


def test_where_no_pose_is_known_the_last_motion_stands():
    T = circle()
    T[20:30] = np.nan
    T[:3] = np.nan
    found = speed_and_turn_rate(STAMPS, T)
    assert np.isfinite(found).all()
    np.testing.assert_array_equal(found[20:30], np.tile(found[19], (10, 1)))
    np.testing.assert_array_equal(found[:3], 0.0)
    # Across the gap: over the eleven scans since the last one that is known.
    np.testing.assert_allclose(found[30, 1], 0.5, rtol=1e-6)
    assert not speed_and_turn_rate(STAMPS, np.full_like(T, np.nan)).any()
