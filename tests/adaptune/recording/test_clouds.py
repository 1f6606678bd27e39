import re

import numpy as np
import pytest
import rec
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from rosbags.typesys import Stores, get_typestore

from adaptune.recording import clouds
from adaptune.recording.clouds import PointCloudError, from_fields
from adaptune.recording.timing import AUTO, Timing, doubts

_STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES = ["f4", "f8", "i2", "u1", "u2", "u4", "i4"]


def raw_of(n, **fields):
    """A structured array of x, y, z = (1, 2, 3) and further fields, each (type, values)."""
    kinds = [(a, "<f4") for a in "xyz"] + [(name, kind) for name, (kind, _) in fields.items()]
    raw = np.zeros(n, kinds)
    raw["x"], raw["y"], raw["z"] = 1, 2, 3
    for name, (_, values) in fields.items():
        raw[name] = values
    return raw


def decode(message, timing=AUTO):
    """Decode a message of ROS 2 from what it is serialised to."""
    data = _STORE.serialize_cdr(message, message.__msgtype__)
    return clouds.decode_cloud(bytes(data), cdr=True, timing=timing)


@st.composite
def layouts(draw):
    """Any order of fields, gaps, types and byte order."""
    order = draw(st.sampled_from("<>"))
    extra = draw(st.lists(st.sampled_from(["ring", "time", "intensity", "a", "b"]), unique=True))
    names = draw(st.permutations(["x", "y", "z", *extra]))
    kinds, offsets, at = [], [], 0
    for name in names:
        allowed = {"ring": ["u1", "u2", "i4"], "time": ["f4", "f8", "u4"]}.get(
            name, ["f4", "f8"] if name in "xyz" else TYPES
        )
        at += draw(st.integers(0, 5))
        kinds.append(order + draw(st.sampled_from(allowed)))
        offsets.append(at)
        at += np.dtype(kinds[-1]).itemsize
    return np.dtype(
        {
            "names": names,
            "formats": kinds,
            "offsets": offsets,
            "itemsize": at + draw(st.integers(0, 7)),
        }
    )


@settings(max_examples=150, deadline=None)
@given(
    dtype=layouts(),
    width=st.integers(0, 20),
    height=st.integers(1, 3),
    padding=st.integers(0, 9),
    data=st.data(),
)
def test_any_layout_gives_the_points_written(dtype, width, *, height, padding, data):
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    raw = np.zeros((height, width), dtype)
    points = rng.uniform(1, 50, (height, width, 3)).astype(np.float32)
    for i, axis in enumerate("xyz"):
        raw[axis] = points[..., i]
    n = height * width
    if "time" in (dtype.names or ()):
        scale = 1e9 if raw["time"].dtype.kind == "u" else 1
        raw["time"] = (np.linspace(0, 0.1, n) * scale).reshape(height, width)
    if "ring" in (dtype.names or ()):
        raw["ring"] = (np.arange(n) % 100).reshape(height, width)
    rows = [row.tobytes() + bytes(padding) for row in raw]
    message = rec.cloud(
        raw, data=np.frombuffer(b"".join(rows), np.uint8), row_step=width * dtype.itemsize + padding
    )

    scan = decode(message)

    assert np.array_equal(scan.points, points.reshape(-1, 3))
    assert scan.points.dtype == np.float32
    assert scan.points.flags.c_contiguous
    if "time" in (dtype.names or ()):
        assert scan.times is not None
        np.testing.assert_allclose(scan.times, np.linspace(0, 0.1, n)[:n], atol=2e-9)
    if "ring" in (dtype.names or ()):
        assert scan.rings.dtype == np.uint16
        assert np.array_equal(scan.rings, np.arange(n) % 100)


@given(
    hnp.arrays(
        np.float32,
        st.tuples(st.integers(0, 30), st.just(3)),
        elements=st.sampled_from([0.0, 1.0, -2.5, np.nan, np.inf, -np.inf]),
    )
)
def test_points_that_are_not_measurements_are_dropped_with_all_that_is_theirs(points):
    raw = rec.velodyne(points)
    raw["intensity"] = np.where(np.arange(len(points)) % 5, np.arange(len(points)), np.nan)
    keep = np.isfinite(points).all(axis=1) & (points != 0).any(axis=1)
    scan = decode(rec.cloud(raw))
    assert np.array_equal(scan.points, points[keep])
    assert scan.times is not None
    assert scan.rings is not None
    assert np.array_equal(scan.times, raw["time"][keep])
    assert np.array_equal(scan.rings, raw["ring"][keep])
    assert scan.intensities is not None
    assert np.array_equal(scan.intensities, np.nan_to_num(raw["intensity"][keep]))


@pytest.mark.parametrize(
    ("field", "kind", "known"),
    [("intensity", "<u1", True), ("reflectivity", "<u2", True), ("intensity", "(3,)<f4", False)],
)
def test_intensities_of_any_kind(field, kind, known):
    values = np.ones((4, 3) if "(" in kind else 4)
    scan = decode(rec.cloud(raw_of(4, **{field: (kind, values)})))
    assert (scan.intensities is not None) == known
    if scan.intensities is not None:
        assert scan.intensities.dtype == np.float32
        assert scan.intensities.tolist() == [1.0] * 4


S = 1_700_000_000.25
NS = 1_700_000_000_250_000_000
DIALECTS = {
    # name: (field, type, values, header's stamp, times expected, shift of the start in ns)
    "velodyne": ("time", "<f4", [0.0, 0.05, 0.1], NS, [0, 0.05, 0.1], 0),
    "velodyne, first rays lost": ("time", "<f4", [0.02, 0.05, 0.1], NS, [0.02, 0.05, 0.1], 0),
    "velodyne, stamped at the end": ("time", "<f4", [-0.1, -0.05, 0], NS, [0, 0.05, 0.1], -100),
    "ouster": ("t", "<u4", [0, 50_000_000, 100_000_000], NS, [0, 0.05, 0.1], 0),
    "hesai": ("timestamp", "<f8", [S, S + 0.05, S + 0.1], NS, [0, 0.05, 0.1], 0),
    "robosense, stamped at the end": (
        "timestamp",
        "<f8",
        [S, S + 0.05, S + 0.1],
        NS + 100_000_000,
        [0, 0.05, 0.1],
        -100,
    ),
    "hesai, clock years off": ("timestamp", "<f8", [1e9, 1e9 + 0.1, 1e9 + 0.2], NS, None, 0),
    "livox": ("timestamp", "<f8", [NS, NS + 5e7, NS + 1e8], NS, [0, 0.05, 0.1], 0),
    "ends of small integers": ("t", "<i1", [-128, 0, 127], NS, [0, 128e-9, 255e-9], 0),
    "a simulator's clock": ("timestamp", "<f8", [2.0, 2.05, 2.1], 2 * 10**9, [0, 0.05, 0.1], 0),
    "a simulator's clock, nanoseconds": (
        "t",
        "<u4",
        [2 * 10**9, 21 * 10**8],
        21 * 10**8,
        None,
        -100,
    ),
    "wrapped below zero": ("t", "<u4", [2**32 - 1000, 0, 10**8], NS, [0, 1e-6, 0.100001], -0.001),
    "all wrapped below zero": ("t", "<u4", [2**32 - 10**8, 2**32 - 1], NS, [0, 0.1], -100),
    "wrapped, and then seconds": ("time", "<f4", [4.294966296, 0, 0.1], NS, [0, 0, 0.1], 0),
    "wrapped, absolute": ("t", "<f8", [S + 4.294967296, S, S + 0.1], NS, [0, 0, 0.1], 0),
    "microseconds, absolute": ("timestamp", "<f8", [S * 1e6, S * 1e6 + 1e5], NS, [0, 0.1], 0),
}


@pytest.mark.parametrize(
    ("field", "kind", "values", "stamp", "times", "shift"), DIALECTS.values(), ids=DIALECTS
)
def test_times_count_from_the_start_of_the_scan_in_every_dialect(
    *, field, kind, values, stamp, times, shift
):
    scan = decode(rec.cloud(raw_of(len(values), **{field: (kind, values)}), stamp))
    unit = 1e-9 if kind == "<u4" else 1.0
    expected = (np.array(values) - values[0]) * unit if times is None else times
    assert scan.times is not None
    np.testing.assert_allclose(scan.times, expected, atol=1e-6)
    assert abs(scan.stamp - (stamp + shift * 10**6)) < 1000


@pytest.mark.parametrize(
    ("kind", "late"), [("<u4", 2**32 - 1000), ("<f4", 4.294966), ("<u4", 10**8)]
)
def test_times_that_wrap_are_told(kind, late):
    scans = [decode(rec.cloud(raw_of(2, time=(kind, [0, late])), NS + n * 10**8)) for n in range(9)]
    told = [str(doubt) for doubt in doubts([scan.reading for scan in scans], 0.1)]
    said = "in 9 of 9 scans some points are 4.29 s later than the others"
    assert any(said in text for text in told) == (late != 10**8)


@pytest.mark.parametrize(
    ("mark", "values", "shift"),
    [("end", [0.0, 0.1], -0.1), ("start", [-0.1, 0.0], 0.0), ("end", [S, S + 0.1], -0.1)],
)
def test_what_the_stamp_marks_can_be_set(mark, values, shift):
    raw = raw_of(2, timestamp=("<f8", values))
    scan = decode(rec.cloud(raw, NS), Timing(mark))
    assert abs(scan.stamp - (NS + shift * 1e9)) < 1000
    np.testing.assert_allclose(scan.times, [0, values[1] - values[0]], atol=1e-6)


def test_a_scan_stamped_at_its_end_without_times_starts_a_period_before():
    assert decode(rec.cloud(raw_of(1), NS), Timing("end", period=0.2)).stamp == NS - 200_000_000


@pytest.mark.parametrize(
    ("unit", "kind", "values"),
    [
        ("us", "<u4", [0, 100_000]),
        ("ms", "<f4", [0, 100]),
        ("ns", "<f4", [0, 1e8]),
        ("turn", "<f4", [0, 1]),
    ],
)
def test_a_unit_can_be_set(unit, kind, values):
    raw = raw_of(2, time=(kind, values))
    scan = decode(rec.cloud(raw), Timing(unit=unit))
    np.testing.assert_allclose(scan.times, [0, 0.1], rtol=1e-6)


@pytest.mark.parametrize(
    ("values", "kind", "help_"),
    [
        ([0, 100.0], "<f4", "write `time_unit: ms`"),
        ([0, 1e5], "<f4", "write `time_unit: us`"),
        ([1e30, 2e30], "<f4", "write `time_unit: none`"),
        ([S, S + 128], "<f4", "too much for float32; no `time_unit` mends them"),
        ([500.0, 500.1], "<f4", "another clock; write `stamp: first_point`"),
        ([3.0, 3.1], "<f8", "begin 3 s after their scan's stamp"),
        ([-3.0, -2.9], "<f8", "another clock"),
    ],
)
def test_times_no_scan_takes_are_refused_with_what_mends_them(values, kind, help_):
    cloud = rec.cloud(raw_of(2, time=(kind, values)), NS)
    with pytest.raises(PointCloudError) as caught:
        decode(cloud)
    assert help_ in str(caught.value)
    if mark := re.search("`stamp: (.*?)`", str(caught.value)):
        scan = decode(cloud, Timing(mark[1]))
        assert scan.stamp == NS
        np.testing.assert_allclose(scan.times, [0, 0.1], atol=1e-4)
    elif unit := re.search("write `time_unit: (.*?)`", str(caught.value)):
        times = decode(cloud, Timing(unit=unit[1])).times
        assert times is None if unit[1] == "none" else times[1] == pytest.approx(0.1)


def test_the_sensor_s_own_clock_can_be_the_stamp():
    raw = raw_of(2, timestamp=("<f8", [1e9, 1e9 + 0.1]))
    assert decode(rec.cloud(raw, NS), Timing("sensor_clock")).stamp == 10**18
    with pytest.raises(PointCloudError, match="leave `stamp: sensor_clock` out"):
        decode(rec.cloud(raw_of(2, time=("<f4", [0, 0.1])), NS), Timing("sensor_clock"))


def seen(n=200):
    return np.random.default_rng(0).normal(0, 10, (n, 3))


@pytest.mark.parametrize(
    "mark", [[65535.0] * 3, [1e19] * 3, [5000.0, 0, 0]], ids=["16 bits", "huge", "along x"]
)
def test_marks_of_rays_that_did_not_come_back_are_dropped(mark):
    points = seen()
    points[::3] = mark
    scan = decode(rec.cloud(rec.velodyne(points)))
    assert np.array_equal(scan.points, np.delete(points, np.s_[::3], axis=0).astype(np.float32))
    assert len(scan.times) == len(scan)


def test_a_point_that_a_long_range_lidar_may_see_stays():
    assert len(decode(rec.cloud(rec.velodyne(np.vstack([seen(), [[1500, 20, 3]]]))))) == 201


@pytest.mark.parametrize(
    ("points", "changes"),
    [(seen(), {"is_bigendian": True}), (seen() * 1e3, {}), (seen() + np.array([5e5, 5e6, 0]), {})],
)
def test_coordinates_that_are_misread_are_refused(points, changes):
    with pytest.raises(PointCloudError, match=r"% of the points are farther than 1000 m: they"):
        decode(rec.cloud(rec.velodyne(points), **changes))


def damaged(**changes):
    return rec.cloud(rec.velodyne(rec.scans(1)[0]), **changes)


def field(*given):
    return rec.ROS2.types["sensor_msgs/msg/PointField"](*given)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fields": [field(a, 0, 7, 1) for a in "xy"]}, "no field z; there is x"),
        ({"fields": [field("x", 20, 7, 1)]}, "ends beyond"),
        ({"fields": [field("x", 0, 99, 1)]}, "unknown datatype 99"),
        ({"fields": [field("x", 0, 7, 1)] * 2}, "appears twice"),
        ({"fields": [field(a, 0, 7, 2) for a in "xyz"]}, "not one number"),
        ({"width": 2**32 - 1, "height": 2**32 - 1}, "need"),
        ({"data": np.empty(0, np.uint8)}, "there are 0"),
    ],
)
def test_a_message_that_is_no_cloud_is_refused(changes, message):
    with pytest.raises(PointCloudError, match=message):
        decode(damaged(**changes))


@pytest.mark.parametrize("frame", ["", "a", "ab", "abc", "abcd"])
def test_a_message_is_the_same_however_it_is_serialised(frame):
    raw = rec.velodyne(rec.scans(1)[0])
    forms = []
    for store, serialise in (
        (rec.ROS1, rec.ROS1.serialize_ros1),
        (rec.ROS2, rec.ROS2.serialize_cdr),
        (rec.ROS2, lambda m, kind: rec.ROS2.serialize_cdr(m, kind, little_endian=False)),
    ):
        message = rec.cloud(raw, store=store, header=rec.header(rec.START, frame, store))
        forms.append((bytes(serialise(message, message.__msgtype__)), store is rec.ROS2))
    for data, cdr in forms:
        cloud = clouds.parse(data, cdr)
        assert cloud.stamp == rec.START
        assert [name for name, *_ in cloud.fields] == list(raw.dtype.names or ())
        assert np.array_equal(clouds.read_points(cloud), raw)


@pytest.mark.parametrize("cdr", [False, True])
@pytest.mark.parametrize("livox", [False, True])
def test_a_message_cut_short_or_too_long_is_refused(cdr, livox):
    store, points = rec.ROS2 if cdr else rec.ROS1, rec.scans(1, 3)[0]
    if livox:
        message, decode = rec.livox(store, clouds.LIVOX_TYPES[0], points), clouds.decode_livox
    else:
        message, decode = rec.cloud(rec.velodyne(points), store=store), clouds.decode_cloud
    serialise = store.serialize_cdr if cdr else store.serialize_ros1
    data = bytes(serialise(message, message.__msgtype__))
    assert len(decode(data, cdr)) == 3
    wrong = [data[:n] for n in range(len(data))]
    for part in wrong if livox else [*wrong, data + bytes(4)]:
        with pytest.raises(PointCloudError, match="not a whole"):
            decode(part, cdr)


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_any_change_of_a_message_gives_a_scan_or_an_error(data):
    u32 = st.one_of(st.integers(0, 100), st.integers(0, 2**32 - 1))
    changes = data.draw(
        st.fixed_dictionaries(
            {},
            optional={
                "height": u32,
                "width": u32,
                "point_step": u32,
                "row_step": u32,
                "is_bigendian": st.booleans(),
                "data": st.binary(max_size=2000).map(lambda b: np.frombuffer(b, np.uint8)),
                "fields": st.lists(
                    st.builds(
                        field,
                        st.sampled_from(["x", "y", "z", "time", "t", "ring", "", "é"]),
                        u32,
                        st.integers(0, 255),
                        u32,
                    ),
                    max_size=7,
                ),
            },
        )
    )
    try:
        scan = decode(damaged(**changes))
    except PointCloudError:
        return
    assert np.isfinite(scan.points).all()
    for values in (scan.times, scan.rings):
        assert values is None or len(values) == len(scan)
    assert scan.times is None or (np.isfinite(scan.times).all() and (scan.times >= 0).all())


@pytest.mark.parametrize(
    ("name", "kind", "values", "unit", "span"),
    [
        ("time_offset_ns", "i4", (0, 1e8), None, 0.1),
        ("t_us", "u4", (0, 1e5), None, 0.1),
        ("Point_TimeStamp", "f8", (1.7e9, 1.7e9 + 0.1), None, 0.1),
        ("relative_time", "f4", (-0.1, 0.0), None, 0.1),
        ("offset", "u4", (0, 1e5), "us", 0.1),
        ("time_of_day", "f4", (0, 100.0), None, None),
        ("t_offset", "u4", (0, 1e5), None, None),
        ("time_flags", "u1", (0, 1), None, None),
        ("number_of_times", "i4", (3, 3), None, None),
        ("distance", "f4", (0, 0.1), None, None),
    ],
)
def test_fields_that_look_like_times_are_read_or_named(name, kind, values, unit, span):
    n = 50
    raw = np.zeros(n, [*((axis, "f4") for axis in "xyz"), (name, kind)])
    raw["x"] = np.arange(1, n + 1)
    raw[name] = np.linspace(*values, n).astype(kind)
    scan = from_fields(raw, 1_700_000_000 * 10**9, Timing(unit=unit))
    if span is None:
        assert scan.times is None
        told = [str(doubt) for doubt in doubts([scan.reading] * 10, 0.1)]
        assert len(told) == (name != "distance")
        assert not told or f"the field {name!r} looks like times and is not read" in told[0]
    else:
        assert np.ptp(scan.times) == pytest.approx(span, rel=1e-5)
