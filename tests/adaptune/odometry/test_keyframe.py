from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from adaptune.geometry import invert
from adaptune.odometry.keyframe import KeyframeOdometry
from adaptune.space import Float, ParameterSpace

STEP = np.eye(4)
STEP[:3, :3] = Rotation.from_euler("z", 0.03).as_matrix()
STEP[:3, 3] = 0.4, 0.01, 0.0


class Turning(KeyframeOdometry):
    """Finds a constant turn and speed, and keeps what it was given as a guess."""

    space = ParameterSpace({"keyframe_interval": Float(low=0.1, high=9.0, baseline=1.0)})

    def __init__(self):
        super().__init__()
        self.guesses = []

    def prepare(self, scan):
        return scan

    def usable(self, prepared):
        return prepared.usable

    def align(self, target, source, T_target_guess):
        truth = np.linalg.matrix_power(STEP, source.number - target.number)
        self.guesses.append(invert(truth) @ T_target_guess)
        return truth, source.ok


def scan(number, stamp=None, usable=True, ok=True):
    stamp = number * 10**8 if stamp is None else stamp
    return SimpleNamespace(number=number, stamp=stamp, usable=usable, ok=ok)


def drive(scans):
    odometry = Turning()
    odometry.start(scans[0], np.eye(4), STEP)
    for one in scans[1:]:
        odometry.register(one)
    return np.array(odometry.guesses)


@pytest.mark.parametrize(
    "scans",
    [
        [scan(n) for n in (0, 1, 2, 4, 5, 8, 9, 30, 31)],
        [scan(n) for n in (0, 1, 3, 5, 7, 8)],
        [scan(0), scan(1), scan(2, usable=False), scan(3), scan(5, ok=False), scan(8), scan(9)],
        [scan(n, stamp=-n) for n in range(5)],
    ],
    ids=["dropped", "every other", "not registered", "backwards"],
)
def test_a_motion_goes_on_for_the_time_that_has_passed(scans):
    guesses = drive(scans)
    np.testing.assert_allclose(guesses, np.broadcast_to(np.eye(4), guesses.shape), atol=1e-9)


def test_stamps_that_shake_do_not_shake_the_prediction():
    rng = np.random.default_rng(3)
    stamps = [n * 10**8 + int(rng.uniform(-2e6, 2e6)) for n in range(20)]
    shaken = drive([scan(n, stamp) for n, stamp in enumerate(stamps)])
    np.testing.assert_array_equal(shaken, drive([scan(n) for n in range(20)]))


def test_time_that_does_not_pass_is_no_motion_without_end():
    assert np.isfinite(drive([scan(n, 7) for n in range(5)])).all()
