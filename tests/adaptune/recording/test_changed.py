import numpy as np
import pytest
import rec

from adaptune.recording import Imu, Scan, SequenceConfig, SequenceError
from adaptune.recording.recording import carry_imu, open_sequence


class Inertial:
    """Scans of 0.1 s, one of them lost, and an IMU of 100 Hz."""

    def __init__(self, begin, end):
        stamps = np.arange(round(begin * 1e9), round(end * 1e9), 10**7)
        zeros = np.zeros((len(stamps), 3))
        self.imu = lambda: Imu(stamps, zeros, zeros) if len(stamps) else None

    def __iter__(self):
        points, times = np.zeros((2, 3), np.float32), np.array([0.0, 0.095], np.float32)
        for tenth in (0, 1, 3, 4):
            yield Scan(tenth * 10**8, points.copy(), times.copy())


def hundredths(begin, end):
    scans = Inertial(begin, end)
    measured = [scan.imu for scan in carry_imu(scans, scans.imu(), "inertial")]
    return [(imu.stamps // 10**7).tolist() for imu in measured]


def test_scans_bring_along_what_the_imu_measured_since_the_one_before():
    # To the first measurement at the scan's end or after it; the first begins with the one before.
    expected = [[*range(11)], [*range(11, 21)], [*range(21, 41)], [*range(41, 51)]]
    assert hundredths(0.0, 9.0) == expected
    assert hundredths(-1.0, 9.0) == expected
    assert hundredths(0.15, 0.45) == [[15], [*range(16, 21)], [*range(21, 41)], [*range(41, 45)]]


def test_an_imu_that_is_not_there_or_of_another_time():
    with pytest.raises(SequenceError, match="inertial: holds no measurements of an IMU; name"):
        hundredths(0.0, 0.0)
    for begin in (-9.0, 20.0):
        with pytest.raises(SequenceError, match="record both on the same clock, or leave"):
            hundredths(begin, begin + 5.0)


@pytest.mark.parametrize("cache", [False, True])
@pytest.mark.parametrize("compensate", [None, "constant_velocity"])
def test_reading_from_a_scan_on_gives_the_same_scans(tmp_path, monkeypatch, cache, compensate):
    monkeypatch.setattr("adaptune.recording.recording._SECONDS_BEFORE", 0.25)
    bag = str(rec.drive(tmp_path / "a.bag"))
    sequence = open_sequence(SequenceConfig(bag=bag, cache=cache, compensate=compensate))
    scans = list(sequence)  # into the cache
    last = scans[-5:]
    some = list(sequence.since(last[0].stamp))
    assert 5 <= len(some) < len(scans)
    for one, other in zip(last, some[-5:], strict=True):
        assert one.stamp == other.stamp
        np.testing.assert_allclose(one.points, other.points, atol=1e-3)
    if cache:  # motion that was undone is kept so
        monkeypatch.setattr("adaptune.recording.compensation.neighbour_motions", None)
    for one, other in zip(scans, sequence, strict=True):
        assert one.points.dtype == other.points.dtype == np.float32
        np.testing.assert_array_equal(one.points, other.points)
