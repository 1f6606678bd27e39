import numpy as np
import pytest
import rec
from rosbags.typesys import get_types_from_msg

from adaptune.recording import SequenceConfig, SequenceError, bag, clouds
from adaptune.recording.recording import open_sequence

DEFINITIONS = {
    "velodyne_msgs/msg/VelodynePacket": "time stamp\nuint8[1206] data\n",
    "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nVelodynePacket[] packets\n",
}
KIND = clouds.VELODYNE_TYPES[0]
VLP16 = 0x22


def packet(number, metres, model=VLP16):
    """A packet of a VLP-16 that sees the same distance everywhere, as its manual describes it."""
    blocks = np.zeros(
        12, [("flag", "<u2"), ("azimuth", "<u2"), ("returns", [("mm2", "<u2"), ("i", "u1")], (32,))]
    )
    blocks["flag"] = 0xEEFF
    # Hundredths of a degree; each block holds two firings of all lasers.
    blocks["azimuth"] = (number * 480 + np.arange(12) * 40) % 36000
    blocks["returns"]["mm2"] = round(metres * 500)
    microseconds = np.array([number * 1327], "<u4")
    raw = blocks.tobytes() + microseconds.tobytes() + bytes([0x37, model])
    return np.frombuffer(raw, np.uint8)


def scan(store, packets):
    types = store.types
    if KIND not in types:
        found = {}
        for name, text in DEFINITIONS.items():
            time = text if store is rec.ROS1 else text.replace("time", "builtin_interfaces/Time")
            found.update(get_types_from_msg(time, name))
        store.register(found)
    each = [
        types["velodyne_msgs/msg/VelodynePacket"](rec.header(rec.START + i * 1_327_000).stamp, data)
        for i, data in enumerate(packets)
    ]
    # As the driver does, the header is stamped when the last packet is there.
    return types[KIND](rec.header(rec.START + 10**8, store=store), each)


@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
def test_packets_are_decoded(tmp_path, name):
    pytest.importorskip("velodyne_decoder")
    path = tmp_path / name
    store = rec.store_of(path)
    message = scan(store, [packet(k, 10.0) for k in range(75)])
    bag_ = rec.write_bag(path, [("/packets", rec.START, message)])
    (first,) = open_sequence(SequenceConfig(bag=str(bag_)))
    assert len(first) == 75 * 12 * 32
    assert abs(first.stamp - rec.START) < 1000
    np.testing.assert_allclose(np.linalg.norm(first.points, axis=1), 10.0, atol=0.01)
    angles = np.rad2deg(np.arcsin(first.points[:, 2] / 10.0))
    assert np.unique(angles.round()).tolist() == list(range(-15, 16, 2))
    assert np.unique(first.rings).tolist() == list(range(16))
    assert first.times.min() == 0
    assert first.times.max() == pytest.approx(0.0995, abs=1e-3)


@pytest.mark.parametrize(
    ("packets", "told"),
    [
        ([], "holds no packet"),
        ([packet(0, 1.0, model=0x77)], "message 1 on /packets: .*model"),
    ],
)
def test_packets_that_tell_nothing_are_an_error(tmp_path, packets, told):
    pytest.importorskip("velodyne_decoder")
    path = tmp_path / "a.bag"
    rec.write_bag(path, [("/packets", rec.START, scan(rec.ROS1, packets))])
    with pytest.raises(SequenceError, match=told):
        list(open_sequence(SequenceConfig(bag=str(path))))


def test_what_decodes_packets_is_named_where_it_is_missing(tmp_path, monkeypatch):
    path = tmp_path / "a.bag"
    rec.write_bag(path, [("/packets", rec.START, scan(rec.ROS1, [packet(0, 1.0)]))])
    monkeypatch.setattr(bag, "find_spec", lambda _: None)
    with pytest.raises(SequenceError, match=r"install adaptune\[velodyne\]"):
        open_sequence(SequenceConfig(bag=str(path)))


def test_points_are_preferred_to_the_packets_they_were_made_of(tmp_path):
    path = tmp_path / "a.bag"
    cloud = rec.cloud(rec.velodyne(rec.scans(1)[0]), rec.START, rec.ROS1)
    both = [("/packets", 5, scan(rec.ROS1, [])), ("/points", 6, cloud)]
    (found,) = open_sequence(SequenceConfig(bag=str(rec.write_bag(path, both))))
    assert len(found) == 60
