import numpy as np
import pytest
from rooms import along_x, scan_at, street

from adaptune.geometry import invert
from adaptune.reference.carried import Carried, left_out, may_be_carried, without
from adaptune.reference.check import measure_reference, pose_at
from adaptune.trajectory import Trajectory

WORLD, EVERY = street(), 200_000_000
START = 10**18


def drive(way, seconds=6.0, before=10.0, after=10.0):
    """Scans and poses of a robot that drives at 1 m/s, is carried by `way`, and drives on."""
    n, carried, m = (round(5 * s) for s in (before, seconds, after))
    x = 0.2 * np.concatenate([np.arange(n), np.full(carried, n), n + np.arange(m)])
    share = np.concatenate([np.zeros(n), np.linspace(0, 1, carried), np.ones(m)])
    T = along_x(x)
    T[:, :3, 3] += share[:, None] * way
    stamps = START + EVERY * np.arange(len(x))
    scans = [scan_at(WORLD, at, int(stamps[i]), i) for i, at in enumerate(x)]
    return scans, Trajectory(stamps, T)


def found_by(scans, reference):
    carried = Carried()
    for scan in scans:
        carried.see(scan, pose_at(reference, scan.stamp))
    return carried.findings(START)


@pytest.mark.parametrize("way", [(0, 0, 9.0), (0, 0, -5.0), (12.0, 4.0, 0)])
def test_a_lift_and_a_ferry_are_told_and_left_out(way):
    scans, reference = drive(np.array(way))
    (finding,) = found_by(scans, reference)
    assert "stand still while the reference moves by" in finding.what
    begin, end = finding.seconds
    assert 7.9 <= begin <= 10.1
    assert 15.7 <= end <= 18.1
    kept = without(reference, [finding], START)
    unknown = np.isnan(kept.at(reference.stamps)[:, 0, 0])
    seconds = (reference.stamps - START) * 1e-9
    assert unknown[(seconds > 10.1) & (seconds < 15.7)].all()
    assert not unknown[(seconds < 7.9) | (seconds > 18.1)].any()
    np.testing.assert_array_equal(unknown, left_out(reference.stamps, [finding], START))


@pytest.mark.parametrize(("before", "after"), [(0.0, 12.0), (12.0, 0.0)])
def test_a_recording_may_begin_or_end_in_a_lift(before, after):
    scans, reference = drive(np.array((0, 0, 9.0)), before=before, after=after)
    (finding,) = found_by(scans, reference)
    begin, end = finding.seconds
    assert begin <= max(before, 0.5)
    assert end >= before + 5.0


@pytest.mark.parametrize(
    "change",
    [
        lambda reference: reference,
        # Another clock, other units, and another frame are no lift.
        lambda reference: Trajectory(reference.stamps + 4 * 10**9, reference.T_world_sensor),
        lambda reference: Trajectory(
            reference.stamps, reference.T_world_sensor * np.where(np.eye(4), 1.0, 3.0)
        ),
        lambda reference: Trajectory(reference.stamps, invert(reference.T_world_sensor)),
    ],
)
def test_who_stands_is_not_carried(change):
    scans, reference = drive(np.zeros(3))
    assert found_by(scans, change(reference)) == []


def test_scans_in_the_frame_of_a_map_are_not_carried():
    scans, reference = drive(np.zeros(3), seconds=0.2)
    still = [scan_at(WORLD, 0.0, scan.stamp, i) for i, scan in enumerate(scans)]
    assert found_by(still, reference) == []


class Recorded(list):
    n_messages, name = 130, "a.bag"


def test_the_error_of_a_reference_is_that_of_the_rest():
    scans, reference = drive(np.array((0, 0, 9.0)), before=12.0, after=12.0)
    measured = measure_reference(Recorded(scans), reference)
    assert len(measured.carried) == 1
    assert measured.error(5.0).mean < 2.0
    lost = np.isnan(measured.T_ref_sensor[:, 0, 0])
    assert not lost[measured.hops.start].any()
    assert not lost[measured.hops.end].any()


def test_an_odometry_that_stands_while_the_reference_moves_is_looked_at():
    _, reference = drive(np.array((0, 0, 9.0)))
    _, seen = drive(np.zeros(3))
    T_ref, T = reference.T_world_sensor, seen.T_world_sensor
    assert may_be_carried(T_ref, T)
    assert not may_be_carried(T_ref, T_ref)
    assert not may_be_carried(T, T)
