import numpy as np
from rooms import scan_at, street

from adaptune.live.evidence import LiveEvidence
from adaptune.runs.archive import Frames
from offline.frames import with_measured_hops

STEP = 1.0
WORLD = street()


def frames(n, every=10**8):
    T_ref_sensor = np.tile(np.eye(4), (n, 1, 1))
    T_ref_sensor[:, 0, 3] = STEP * np.arange(n)
    return Frames(
        10**9 + every * np.arange(n, dtype=np.int64),
        T_ref_sensor,
        np.zeros((n, 90), np.float32),
        {"ndt": 90},
        np.zeros(n, np.float32),
    )


def scans(of):
    return [scan_at(WORLD, STEP * i, int(stamp), i) for i, stamp in enumerate(of.stamps)]


def test_hops_are_those_of_the_sensor():
    of, told = frames(42), []
    measured = with_measured_hops(scans(of), of, lambda _, *done: told.append(done))
    hops = measured.hops
    # Once a second, from the newest scan whose motion is known.
    assert hops.end.tolist() == [9, 19, 29, 39]
    assert hops.start.tolist() == [4, 9, 19, 29]
    np.testing.assert_allclose(hops.T_start_end[:, 0, 3], STEP * (hops.end - hops.start), atol=0.03)
    np.testing.assert_allclose(hops.T_start_end[:, 1:3, 3], 0.0, atol=0.03)
    assert told[0] == (1, 42)
    assert told[-1] == (42, 42)
    assert measured.evidence_ms > 0.0


def test_what_selectors_do_each_second_is_in_the_time(monkeypatch):
    """Whether the pose can be believed is checked, too, which costs more than the hops do."""
    asked = []

    def check(live):
        asked.append(live)

    monkeypatch.setattr(LiveEvidence, "check", check)
    of = frames(32)
    with_measured_hops(scans(of), of)
    assert len(asked) == 4


def test_where_the_reference_is_unknown_nothing_is_measured():
    of = frames(32)
    of.T_ref_sensor[11] = np.nan
    hops = with_measured_hops(scans(of), of).hops
    assert hops.end.tolist() == [9, 19, 29]
    # None leads over it.
    assert hops.start[1] > 11
    np.testing.assert_allclose(hops.T_start_end[:, 0, 3], STEP * (hops.end - hops.start), atol=0.03)
