import numpy as np
import pytest
from rooms import along_x

from adaptune.live.own_error import OwnError
from adaptune.recording.inspect import inspect
from adaptune.reference.check import MeasuredReference, advice, proposed_sub_trajectory
from adaptune.reference.estimate import recording_config
from adaptune.reference.estimated import EstimateError
from adaptune.trajectory import Trajectory


def path(metres, seconds=1000):
    """A reference along a straight line; the last 40 % of the time are for the test."""
    stamps = np.linspace(0, seconds * 10**9, 101).astype(np.int64)
    return Trajectory(stamps, along_x(np.linspace(0.0, metres, 101)))


class Measured(MeasuredReference):
    """Errors that are known: metres that do not grow with the length."""

    def __init__(self, metres, doubt=""):
        object.__setattr__(self, "metres", metres)
        object.__setattr__(self, "doubt", doubt)

    def error(self, length):
        mean = 100.0 * self.metres / length
        return OwnError(mean, 0.8 * mean, 1.25 * mean) if length < 80.0 else None


@pytest.mark.parametrize(
    ("metres", "wrong", "length", "sentence"),
    [
        (600.0, 0.01, 25.0, ""),
        (600.0, 0.2, 50.0, "use a sub_trajectory of 50 m, or `reference: estimated`"),
        (600.0, 1.0, 25.0, "at no length that fits: use `reference: estimated`"),
        (60.0, 0.02, 5.0, ""),
        (60.0, 0.2, 10.0, "at no length that fits"),
        (4.0, 0.2, 2.0, ""),
    ],
)
def test_a_noisy_reference_needs_longer_sub_trajectories(metres, wrong, length, sentence):
    reference, measured = path(metres), Measured(wrong)
    if metres < 5.0:
        object.__setattr__(measured, "error", lambda _: None)
    proposed = proposed_sub_trajectory(reference, measured)
    assert proposed == {4.0: 1.0}.get(metres, length)
    said = advice(measured, reference)
    assert sentence in said
    assert bool(said) == bool(sentence)
    # Where registrations prove nothing, they replace nothing.
    assert advice(Measured(wrong, "the sensor sees 70 degrees only"), reference) == ""


@pytest.mark.parametrize(
    ("metres", "seconds", "length"),
    [
        *((1.0, 1000, 1.0), (15.0, 1000, 2.0), (20.0, 1000, 5.0), (50.0, 1000, 5.0)),
        *((248.0, 1000, 10.0), (2500.0, 1000, 25.0), (215.0, 215, 10.0), (215.0, 38, 25.0)),
        *((107.0, 11, 25.0), (60.0, 6, 10.0), (900.0, 30, 25.0)),
    ],
)
def test_longer_drives_and_faster_ones_get_longer_ones(metres, seconds, length):
    assert proposed_sub_trajectory(path(metres, seconds)) == length


def test_the_way_before_the_test_does_not_count():
    reference = path(20.0)
    reference.T_world_sensor[:60, 0, 3] *= 100.0
    assert proposed_sub_trajectory(reference) == 5.0


def test_the_sequence_is_the_one_that_inspect_proposes(study_file, tmp_path):
    found = inspect(study_file.parent / "one.bag")
    config = recording_config(found)
    assert (config.points, config.reference) == ("/points", "/truth")
    assert recording_config(found, "/other", "/gps").points == "/other"
    assert recording_config(found, "/other", "/gps").reference == "/gps"
    poses = tmp_path / "poses.tum"
    poses.write_text("1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    with pytest.raises(EstimateError, match="file of poses"):
        recording_config(inspect(poses))
