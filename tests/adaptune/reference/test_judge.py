import numpy as np
import pytest
from rooms import straight, trajectory

from adaptune.reference.judge import Reference


def test_errors_of_the_last_seconds_stand_where_their_sub_trajectories_end():
    # The odometry goes 10 % too far over the tenth to the twentieth metre.
    T = straight(40)
    T[10:20, 0, 3] += 0.1 * np.arange(1, 11)
    T[20:, 0, 3] += 1.0
    reference = Reference(trajectory(straight(40)), 4.5)
    errors, behind = (f(trajectory(T)) for f in (reference.errors, reference.errors_behind))
    assert np.isnan(errors[35:]).all()
    assert np.isnan(behind[:5]).all()
    step = float(np.diff(trajectory(T).stamps[:2])[0]) * 1e-9
    n = int(30.0 / step) + 1
    expected = [errors[max(0, i + 1 - n) : i + 1].mean() for i in range(35)]
    np.testing.assert_allclose(behind[5:], expected)
    assert np.nanmax(errors) > 5.0
    assert np.isnan(Reference(None, 4.5).errors_behind(trajectory(T))).all()


def test_errors_around_a_pose_are_those_of_the_sub_trajectories_through_it():
    T = straight(40)
    T[10:, 0, 3] += 0.5
    reference, odometry = Reference(trajectory(straight(40)), 4.5), trajectory(T)
    errors, around = reference.errors(odometry), reference.errors_around(odometry)
    # Each starts at a pose and ends at the fifth after it.
    expected = [errors[max(0, i - 5) : min(i + 1, 35)].mean() for i in range(40)]
    np.testing.assert_allclose(around, expected, atol=1e-9)
    assert around[[4, 15]].tolist() == pytest.approx([0.0, 0.0], abs=1e-9)
    assert np.isnan(Reference(None, 4.5).errors_around(odometry)).all()


def test_scans_without_reference_do_not_count():
    truth, odometry = straight(60), trajectory(straight(100, 1.01))
    late = Reference(trajectory(truth, 20), 25.0).standard(odometry)
    assert late.rpe == pytest.approx(0.01)
    assert Reference(None, 25.0).standard(odometry) is None
    # One pose says nothing.
    assert Reference(trajectory(truth[:1], 20), 25.0).standard(odometry) is None
