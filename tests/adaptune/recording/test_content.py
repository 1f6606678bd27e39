"""What a look at each cloud shows, on a drive through a hall, and what it must not show."""

import numpy as np
import pytest

from adaptune.recording.content import Content, of_looks
from adaptune.recording.scan import Reading, Scan
from adaptune.trajectory import Trajectory

START = 1_700_000_000_000_000_000
N = 120
HALL = np.array([[-10.0, -4.0, -1.2], [30.0, 9.0, 5.0]])


def rays(columns=150, rings=16, view=360.0):
    """Directions of the rays of a spinning LiDAR, of shape (n, 3)."""
    turn = np.radians(np.linspace(-view / 2, view / 2, columns, endpoint=False))
    turn, tilt = np.meshgrid(turn, np.radians(np.linspace(-15, 15, rings)), indexing="ij")
    flat = np.cos(tilt)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), np.sin(tilt)], -1).reshape(-1, 3)


def pose_at(i):
    """A robot that drives along an arc, 1 m/s at 10 Hz."""
    yaw = 0.02 * i
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:2, 3] = 5.0 * np.sin(yaw), 5.0 * (1.0 - np.cos(yaw))
    return T


def seen(i, directions, room=HALL):
    """Points of the room's walls, floor and ceiling, in the sensor's frame."""
    T = pose_at(i)
    along = directions @ T[:3, :3].T + 1e-9
    away = np.where(along > 0, room[1] - T[:3, 3], room[0] - T[:3, 3]) / along
    away = away.min(axis=1) + np.random.default_rng(i).normal(0.0, 0.01, len(along))
    return directions * away[:, None]


def drive(view=360.0, room=HALL, n=N):
    return [seen(i, rays(view=view), room) for i in range(n)]


def findings(clouds, step=10**8, **reading):
    content = Content()
    for i, points in enumerate(clouds):
        kept = np.ascontiguousarray(points, np.float32)
        content.see(Scan(START + round(i * step), kept, reading=Reading(**reading)))
    return list(of_looks(content.looks, ("/points",)))


def changed(change, which=slice(None), clouds=None):
    """The drive with some of its clouds changed."""
    clouds = drive() if clouds is None else clouds
    for i in range(len(clouds))[which]:
        clouds[i] = change(i, clouds[i])
    return clouds


def wedge(half):
    """Only the points of a wedge, which is elsewhere in every cloud."""

    def of(i, points):
        turn = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
        middle = np.random.default_rng(i).uniform(-150.0, 150.0)
        return points[np.abs(turn - middle) < half]

    return of


def near(metres):
    """All points at about this distance."""

    def of(i, points):
        away = metres * np.random.default_rng(i).uniform(0.9, 1.1, (len(points), 1))
        return points * (away / np.linalg.norm(points, axis=1, keepdims=True))

    return of


def turned(order, signs=(1.0, 1.0, 1.0)):
    return lambda _, points: points[:, order] * signs


def thinned(share):
    return lambda i, points: points[np.random.default_rng(i).random(len(points)) < share]


def held(i, every):
    return seen(i - i % every, rays())


PART, COVER, MAP = "see a part of the usual turn", "something covers the sensor", "they are a map"
LITTLE, REPEATED = "hold less than 15% of the usual", "repeat the points of the one before"
AXES, ALTERNATE = "the axes of the points change", "two kinds of clouds alternate"


@pytest.mark.parametrize(
    ("clouds", "expected"),
    [
        (changed(wedge(30.0), slice(3, None, 4)), [(30, PART, 0.3, 11.9)]),
        (changed(wedge(30.0), slice(5, None, 10)), [(12, PART, 0.5, 11.5)]),
        (changed(wedge(85.0), slice(1, None, 2)), [(60, PART, 0.1, 11.9)]),
        (changed(wedge(60.0), slice(40, 90)), [(50, PART, 4.0, 8.9)]),
        (changed(near(0.3), slice(20, 100)), [(80, COVER, 2.0, 9.9)]),
        (
            changed(near(0.6), slice(0, 20), changed(near(0.3), slice(100, None))),
            [(20, COVER, 0.0, 1.9), (20, COVER, 10.0, 11.9)],
        ),
        (changed(near(0.8)), [("all", COVER, 0.0, 11.9)]),
        (changed(lambda i, p: thinned(0.98**i)(i, p)), [(12, LITTLE, 10.8, 11.9)]),
        (changed(thinned(0.1), slice(60, 70)), [(10, LITTLE, 6.0, 6.9)]),
        (changed(thinned(0.002), slice(60, 61)), [(1, "fewer than 20 valid points", 6.0, 6.0)]),
        (changed(lambda i, _: held(i, 2)), [(60, REPEATED, 0.1, 11.9)]),
        (changed(lambda *_: seen(50, rays()), slice(50, 81)), [(30, REPEATED, 5.1, 8.0)]),
    ],
)  # fmt: skip
def test_clouds_that_differ_are_counted_and_said_when(clouds, expected):
    found = findings(clouds)
    for one, (n, what, begin, end) in zip(found, expected, strict=True):
        assert one.what.startswith("all 120 clouds" if n == "all" else f"{n} of 120 clouds")
        assert what in one.what
        assert one.seconds == pytest.approx((begin, end), abs=0.05)
        assert one.of == "points"
        assert one.mend


@pytest.mark.parametrize(
    ("clouds", "expected"),
    [
        ([np.concatenate(drive(n=i + 1)) for i in range(40)], MAP),
        (changed(lambda i, _: seen(i, rays(75)), slice(60, None)), "at 6.0 s, clouds of 2,400"),
        (changed(lambda i, _: seen(i, rays(rings=64)), slice(30, None)), "become ones of 9,600"),
        (changed(turned([0, 1, 2], (1.0, -1.0, -1.0)), slice(60, None)), "at 6.0 s, " + AXES),
        (changed(turned([2, 0, 1]), slice(60, None)), "at 6.0 s, " + AXES),
        (changed(turned([2, 0, 1]), slice(1, None, 2)), ALTERNATE),
        (changed(lambda i, _: seen(i, rays(view=90.0)), slice(1, None, 2)), ALTERNATE),
        (changed(lambda i, _: seen(i, rays(rings=64)), slice(1, None, 2)), ALTERNATE),
    ],
)
def test_clouds_that_change_for_good_or_alternate_are_named(clouds, expected):
    (one,) = findings(clouds)
    assert expected in one.what
    assert one.mend


def test_clouds_that_repeat_at_once_and_marks_are_left_out():
    twice = [points for points in drive() for _ in range(2)]
    content = Content()
    for i, points in enumerate(twice):
        stamp = START + i // 2 * 10**8 + i % 2 * 1000
        content.see(Scan(stamp, points.astype(np.float32), reading=Reading(marks=0.2)))
    marks, pairs = map(str, of_looks(content.looks, start=5.0))
    assert marks.startswith("20% of the points mark rays that did not come back")
    assert pairs == (
        "120 of 240 clouds repeat the points of the one before, from 5.0 to 16.9 s; "
        "adaptune leaves them out"
    )


CELL = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.5]])
AISLE = np.array([[-30.0, -0.5, -1.2], [30.0, 6.0, 3.0]])


def spun(radians, axes=(0, 1), first=0, last=N):
    """Points as seen while the sensor turns between two clouds, by so much from one to the next."""

    def of(i, points):
        angle, turned = radians * (min(max(i, first), last) - first), points.copy()
        cosine, sine = np.cos(angle), np.sin(angle)
        a, b = axes
        turned[:, a] = cosine * points[:, a] - sine * points[:, b]
        turned[:, b] = sine * points[:, a] + cosine * points[:, b]
        return turned

    return of


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("clouds", "step"),
    [
        (drive(), 10**8),
        (drive()[:9], 10**8),
        (drive()[:1], 10**8),
        (drive(view=70.0), 10**8),
        (drive(room=AISLE), 10**8),
        ([CELL[0] * 0.0 + seen(0, rays(), CELL) + 1e-3 * i for i in range(N)], 10**8),
        (changed(lambda i, _: seen(0, rays(), CELL) + 1e-3 * i, slice(40, 80)), 10**8),
        (changed(lambda i, p: thinned(0.5 + 0.5 * (i * 0.618 % 1.0))(i, p)), 10**8),
        (changed(spun(0.31)), 10**8),
        (changed(spun(0.4, first=60)), 10**8),
        (changed(spun(np.pi / 20, (0, 2), 60, 70)), 10**8),
        (changed(spun(0.8)), 5 * 10**8),
        (changed(wedge(30.0), slice(60, 61)), 10**8),
        ([seen(0, rays()) + 1e-3 * i for i in range(N)], 10**8),
    ],
)
def test_a_drive_that_is_hard_to_track_is_no_fault(clouds, step):
    assert findings(clouds, step) == []


@pytest.mark.parametrize("turn", [0.0, 2.0])
@pytest.mark.parametrize(
    ("in_map", "known", "metres"), [(1, 1, 20), (1, 0, 90), (0, 1, 20), (0, 0, 90)]
)
def test_clouds_in_the_frame_of_a_map_stay_while_the_reference_moves(in_map, known, metres, turn):
    content, poses = Content(), np.array([pose_at(0)] * N)
    poses[:, 0, 3] = np.linspace(0.0, metres, N)
    for i, T in enumerate(poses):
        points = seen(0, rays())
        points = points[np.linalg.norm(points, axis=1) < 12.0] + in_map * T[:3, 3]
        content.see(Scan(START + i * 10**8, points.astype(np.float32)))
    # The map of a mapping node has other axes than that of the reference.
    c, s = np.cos(turn), np.sin(turn)
    poses = np.array([[c, -s, 0, 9], [s, c, 0, 5], [0, 0, 1, 0], [0, 0, 0, 1]]) @ poses
    found = list(content.of_place(Trajectory(START + np.arange(N) * 10**8, poses), bool(known)))
    assert [one.lacks for one in found] == in_map * ["clouds in the sensor's frame"]
    assert all(f"while the reference moves {metres:.1f} m" in one.what for one in found)


def test_a_short_drive_through_a_bare_hall_is_in_no_map():
    content, poses = Content(), np.array([pose_at(2 * i) for i in range(N)])
    for i in range(N):
        content.see(Scan(START + i * 10**8, seen(2 * i, rays()).astype(np.float32)))
    for part in range(0, N, 30):
        some = slice(part, part + 30)
        reference = Trajectory(START + np.arange(N)[some] * 10**8, poses[some])
        assert not list(content.of_place(reference, known=False))
