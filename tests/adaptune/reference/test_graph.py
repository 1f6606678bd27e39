import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_passes import chained, drifting, hop, pairs, straight, winding
from rooms import moved

from adaptune.geometry import steps
from adaptune.metrics import sub_trajectory_rte
from adaptune.reference.graph import Edge, optimised

N = 120
TRUTH = winding(N)
DRIFTING = drifting(TRUTH)


def edges(T, of=None, **wrong):
    return [Edge(*pair, hop(T, *pair, **wrong)) for pair in of or pairs(len(T))]


def farthest(T, other):
    return float(np.linalg.norm((T - other)[:, :3, 3], axis=1).max())


def test_registrations_that_are_right_take_the_drift_away():
    assert farthest(DRIFTING, TRUTH) > 2.0
    found = optimised(DRIFTING, edges(TRUTH))
    assert farthest(found, TRUTH) < 0.2
    assert np.nanmax(sub_trajectory_rte(TRUTH, found, 10.0)) < 0.2


def test_without_registrations_the_motions_stay():
    np.testing.assert_allclose(optimised(DRIFTING, []), DRIFTING, atol=1e-6)


@given(st.integers(0, 10**6))
@settings(max_examples=8, deadline=None)
def test_poses_begin_at_the_identity_and_their_rotations_stay_rotations(seed):
    rng = np.random.default_rng(seed)
    T = winding(40)
    somewhere = moved(*rng.normal(0.0, 100.0, 3), rng.uniform(-3.0, 3.0)) @ T
    noisy = [Edge(a, b, hop(T, a, b, rng.normal(0.0, 0.05, 3))) for a, b in pairs(40)]
    found = optimised(somewhere, noisy)
    np.testing.assert_allclose(found[0], np.eye(4), atol=1e-12)
    R = found[:, :3, :3]
    np.testing.assert_allclose(R.transpose(0, 2, 1) @ R, np.tile(np.eye(3), (40, 1, 1)), atol=1e-9)
    assert (np.linalg.det(R) > 0.0).all()
    assert (found[:, 3] == [0.0, 0.0, 0.0, 1.0]).all()


@pytest.mark.parametrize("off", [(3.0, 0.0, 0.0), (0.0, -20.0, 5.0)])
def test_one_registration_that_is_wrong_by_metres_hardly_counts(off):
    wrong = Edge(45, 70, hop(TRUTH, 45, 70, off))
    found = optimised(DRIFTING, [*edges(TRUTH), wrong])
    assert farthest(found, optimised(DRIFTING, edges(TRUTH))) < 0.02


def test_one_motion_that_is_wrong_by_a_metre_hardly_counts():
    motions = steps(TRUTH)
    motions[50, 0, 3] += 1.0
    assert farthest(optimised(chained(motions), edges(TRUTH)), TRUTH) < 0.1


def test_a_direction_that_registrations_do_not_tell_is_left_to_the_motions():
    # The path turns by 90 degrees from the start to the end of each: the frames differ.
    T = chained([moved(x=0.4, yaw=np.pi / 50)] * 60)
    ends = pairs(61, (25,), 1)
    wrong = {"off": (0.5, 0.0, 0.0)}
    assert farthest(optimised(T, edges(T, ends, **wrong)), T) > 0.3
    assert farthest(optimised(T, edges(T, ends, **wrong, unknown=[0])), T) < 0.02
    assert farthest(optimised(T, edges(T, ends, **wrong, unknown=[1])), T) > 0.3


def test_what_they_tell_across_a_tunnel_still_counts():
    T = straight(60)
    found = optimised(drifting(T, 0.0), edges(T, unknown=[0]))
    assert np.abs(found[:, 1, 3]).max() < 0.1 < np.abs(drifting(T, 0.0)[:, 1, 3]).max()
