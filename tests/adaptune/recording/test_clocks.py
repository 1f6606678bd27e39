"""Clocks that leap while a bag is recorded."""

import numpy as np
import pytest
import rec
from small_bag import texts

from adaptune.recording import SequenceConfig
from adaptune.recording.findings import clock_parts
from adaptune.recording.inspect import inspect
from adaptune.recording.recording import open_sequence

SECOND, N = 10**9, 80
TIMES = np.arange(N) / 10.0
LATE = TIMES >= 5.0


def leaping(kind):
    """Seconds of stamps and of the recorder's clock, in the order of recording."""
    late = LATE * 1.0
    return {
        "sound": (TIMES, TIMES),
        "set back": (TIMES - 1.03 * late, TIMES - 1.03 * late),
        "set back by whole periods": (TIMES - 1.0 * late, TIMES - 1.0 * late),
        "sensor restarts": (TIMES - 3600.0 * late, TIMES),
        "1970": (TIMES - 1.6e9 * ~LATE, TIMES - 1.6e9 * ~LATE),
        "set to another zone": (TIMES + 7200.0 * late, TIMES + 7200.0 * late),
        "sensor finds its master": (TIMES + 37.0 * late, TIMES),
        "played twice": (TIMES - 5.0 * late, TIMES + 100.0 * late),
    }[kind]


def of_seconds(seconds):
    return rec.START + np.rint(np.asarray(seconds) * SECOND).astype(np.int64)


@pytest.mark.parametrize("name", ["a.bag", "a.sqlite3", "a.mcap"])
@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("set back", "the stamps of 3.90 to 4.97 s come twice"),
        ("set back by whole periods", "come twice"),
        ("sensor restarts", "leaps by -3,599.9 s at 5.0 s; 30 of 80 scans are left out"),
        ("1970", "leaps by +1,600,000,000.1 s at 5.0 s; 30 of 80 scans are left out"),
        ("set to another zone", "leaps by +7,200.1 s at 5.0 s; 30 of 80 scans are left out"),
        ("sensor finds its master", "leaps by +37.1 s at 5.0 s; 30 of 80 scans are left out"),
        ("played twice", "leaps by -4.9 s at 105.0 s; 30 of 80 scans are left out"),
        ("sound", None),
    ],
)
def test_the_longest_part_is_used_and_told(tmp_path, caplog, name, kind, said):
    if name == "a.mcap" and "set back" in kind:
        pytest.skip("its writer puts so few messages into one chunk, in the order of their times")
    path = tmp_path / name
    store, messages = rec.store_of(path), []
    clouds = rec.scans(N, points=30)
    for i, (stamp, recorded) in enumerate(zip(*map(of_seconds, leaping(kind)), strict=True)):
        cloud = rec.cloud(rec.velodyne(clouds[i]), int(stamp), store)
        pose = rec.pose(int(stamp), (0.1 * i, 0, 0), (0, 0, 0, 1), store)
        messages += [("/points", int(recorded) + 10**6, cloud)]
        messages += [("/poses", int(recorded) + 2 * 10**6, pose)]
    rec.write_bag(path, messages, chunk=1 << 12)

    def opened(**given):
        config = SequenceConfig(bag=str(path), reference="/poses", **given)
        return open_sequence(config)

    found = inspect(path)
    assert [t for t in texts(found) if "clock" in t] == [t for t in texts(found) if said]
    for _ in range(2):  # and from the cache
        scans = list(opened())
        steps = np.diff([scan.stamp for scan in scans])
        assert steps.tolist() == [SECOND // 10] * len(steps)
        if said:
            (told,) = [t for t in texts(found) if "clock" in t]
            assert said in told
            assert told in caplog.text
            assert f"; {N - len(scans)} of {N} scans are left out" in told
    assert opened().n_messages == len(scans)
    assert len(found.content.looks) == len(scans)
    # Poses are those of the part, and go one way.
    x = opened().reference().T_world_sensor[:, 0, 3]
    np.testing.assert_allclose(np.diff(x), 0.1, atol=1e-6)
    assert abs(len(x) - len(scans)) <= 1
    # Its beginning is another part, where there is one.
    begin = [np.array_equal(s.points, c) for s, c in zip(opened(stop=3.0), clouds, strict=False)]
    assert begin == [True] * 30
    # Shares are those of the part.
    half = list(opened(part="0-50%"))
    assert abs(len(half) - len(scans) / 2) <= 1
    assert half[0].stamp == scans[0].stamp


@pytest.mark.parametrize("back", [1, 3])
def test_inspect_tells_as_many_scans_as_are_left_out(tmp_path, back):
    times = TIMES[:30] - 0.1 * back * (np.arange(30) > 20)
    times[10] += 50.0
    messages = [
        ("/points", int(rec.START + i * 10**8), rec.cloud(rec.velodyne(cloud), int(s), rec.ROS1))
        for i, (s, cloud) in enumerate(zip(of_seconds(times), rec.scans(30), strict=True))
    ]
    bag = rec.write_bag(tmp_path / "a.bag", messages)
    left = 30 - len(list(open_sequence(SequenceConfig(bag=str(bag)))))
    assert left == 1 + back
    assert f"/points: {left} of 30 stamps do not come after" in "".join(texts(inspect(bag)))


def shaken(rng):
    """Host stamps of scans that wait for the recorder now and then."""
    times = np.arange(300) / 10.0
    for begin in (50, 150):
        times[begin : begin + 12] = times[begin + 11] + np.arange(12) * 1e-3
    return times + rng.normal(0, 0.01, 300) * 0.1


@pytest.mark.parametrize(
    "times",
    [
        np.zeros(50),
        np.repeat(np.arange(40), 2) / 10.0,
        np.sort(np.r_[np.arange(40) / 10.0, np.arange(40) / 10.0 + 1e-6]),
        np.arange(300)[np.random.default_rng(0).random(300) > 0.3] / 10.0,
        np.r_[np.arange(50) / 10.0, 5.0 + np.arange(100) / 20.0],
        np.r_[np.arange(50), 900, np.arange(51, 100)] / 10.0,
        np.ravel(np.column_stack([np.arange(50) + 1e4, np.arange(50)])) / 10.0,
        np.r_[np.arange(50), np.arange(350, 400)] / 10.0,
        shaken(np.random.default_rng(0)),
    ],
    ids=[
        *("none", "repeated", "doubled", "dropped", "faster", "one leap", "two sensors", "paused"),
        "late",
    ],
)
def test_what_is_odd_and_no_leap_stays_whole(times):
    stamps = of_seconds(times)
    recorded = stamps if np.all(np.diff(times) >= 0) else of_seconds(np.arange(len(times)) / 10.0)
    (part,) = clock_parts(stamps, recorded)
    assert (part.first, part.last) == (0, len(times))
