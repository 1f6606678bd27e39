"""Recordings that tests write."""

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from adaptune.recording.clouds import DEFINITIONS

DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
for _store in (ROS1, ROS2):
    _types = {}
    for _name, _text in DEFINITIONS.items():
        _types.update(get_types_from_msg(_text, _name))
    _store.register(_types)
_tf = "geometry_msgs/TransformStamped[] transforms\n"
ROS1.register(get_types_from_msg(_tf, "tf2_msgs/msg/TFMessage"))
START = 1_700_000_000_123_456_789


def header(stamp, frame="lidar", store=ROS2):
    time = store.types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
    if store is ROS1:
        return store.types["std_msgs/msg/Header"](0, time, frame)
    return store.types["std_msgs/msg/Header"](time, frame)


def velodyne(points, span=0.1):
    """Points of shape (n, 3) with the fields of Velodyne's driver, its odd offsets included."""
    floats = [(name, "<f4") for name in ("x", "y", "z", "intensity")]
    raw = np.zeros(len(points), [*floats, ("ring", "<u2"), ("time", "<f4")])
    assert raw.itemsize == 22
    for i, axis in enumerate("xyz"):
        raw[axis] = points[:, i]
    raw["ring"] = np.arange(len(points)) % 16
    raw["time"] = np.linspace(0, span, len(points))
    return raw


def cloud(raw, stamp=START, store=ROS2, **changes):
    """A PointCloud2 of a structured array of shape (n,) or (height, width)."""
    fields = []
    big = False
    for name in raw.dtype.names or ():
        kind, offset = (raw.dtype.fields or {})[name][:2]
        base, shape = (kind.subdtype[0], kind.shape) if kind.subdtype else (kind, (1,))
        big |= base.byteorder == ">"
        code = DATATYPES[f"{base.kind}{base.itemsize}"]
        fields.append(store.types["sensor_msgs/msg/PointField"](name, offset, code, shape[0]))
    height, width = raw.shape if raw.ndim == 2 else (1, len(raw))
    step = raw.dtype.itemsize
    given = {
        "header": header(stamp, store=store),
        "height": height,
        "width": width,
        "fields": fields,
        "is_bigendian": big,
        "point_step": step,
        "row_step": step * width,
        "data": np.ascontiguousarray(raw).ravel().view(np.uint8).copy(),
        "is_dense": False,
    }
    return store.types["sensor_msgs/msg/PointCloud2"](**(given | changes))


def livox(store, kind, points, stamp=START):
    """A message of Livox's driver, of one of the types that say the same."""
    t = store.types
    each = [
        t[kind.replace("Msg", "Point")](i * 1000, *map(float, p), 10, 16, i % 6)
        for i, p in enumerate(points)
    ]
    return t[kind](header(stamp, "x", store), stamp, len(each), 1, np.zeros(3, np.uint8), each)


def pose(stamp, position, quaternion, store):
    made = bare_pose(position, quaternion, store)
    return store.types["geometry_msgs/msg/PoseStamped"](header(stamp, "map", store), made)


def bare_pose(position, quaternion, store):
    types = store.types
    return types["geometry_msgs/msg/Pose"](
        types["geometry_msgs/msg/Point"](*position),
        types["geometry_msgs/msg/Quaternion"](*quaternion),
    )


def fixed_frame(child, parent, position, store=ROS1):
    """A frame on /tf_static that is not turned."""
    types = store.types
    vector, turned = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    transform = types["geometry_msgs/msg/Transform"](vector(*position), turned(0, 0, 0, 1))
    stamped = types["geometry_msgs/msg/TransformStamped"]
    made = stamped(header(START, parent, store), child, transform)
    return types["tf2_msgs/msg/TFMessage"]([made])


def imu(stamp, rate, force, store=ROS2):
    """Measurements without orientation."""
    types, unknown = store.types, np.zeros(9)
    rate, force = (types["geometry_msgs/msg/Vector3"](*map(float, v)) for v in (rate, force))
    orientation = types["geometry_msgs/msg/Quaternion"](0, 0, 0, 1)
    return types["sensor_msgs/msg/Imu"](
        header(stamp, "imu", store), orientation, unknown, rate, unknown, force, unknown
    )


def writer_of(path, compression=None, chunk=1 << 20):
    """Writes a ROS 1 bag, or a ROS 2 one where the path says so."""
    if store_of(path) is ROS1:
        writer = rosbag1.Writer(path)
        writer.chunk_threshold = chunk
        if compression:
            writer.set_compression(rosbag1.Writer.CompressionFormat[compression])
    else:
        plugin = rosbag2.StoragePlugin[path.suffix[1:].upper()]
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        if compression:
            mode = rosbag2.CompressionMode[compression]
            writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    return writer


def write_bag(path, messages, compression=None, topics=(), chunk=1 << 20):
    """Write a ROS 1 bag, or a ROS 2 one where the path says so: ``.sqlite3``, ``.mcap``.

    Messages are made by `store_of(path)`. `topics` are pairs of topic and type without messages;
    a `chunk` of ROS 1 has at least so many bytes.
    """
    store, writer = store_of(path), writer_of(path, compression, chunk)
    with writer:
        connections = {t: writer.add_connection(t, kind, typestore=store) for t, kind in topics}
        for topic, recorded, message in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            data = (store.serialize_ros1 if store is ROS1 else store.serialize_cdr)(message, kind)
            writer.write(connections[topic], recorded, data)
    return path


def store_of(path):
    return ROS1 if path.suffix == ".bag" else ROS2


def scans(n=5, points=60, seed=0):
    """Clouds to record, of shape (points, 3)."""
    rng = np.random.default_rng(seed)
    return [rng.normal(0, 10, (points, 3)).astype(np.float32) for _ in range(n)]


def drive(path, n=20, **options):
    """Record `n` scans at 10 Hz on /points and poses at 20 Hz on /poses, moving along x."""
    store = store_of(path)
    messages = []
    for i, points in enumerate(scans(n)):
        stamp = START + i * 10**8
        messages.append(("/points", stamp + 10**7, cloud(velodyne(points), stamp, store)))
    for i in range(2 * n):
        stamp = START + i * 5 * 10**7
        messages.append(("/poses", stamp, pose(stamp, (0.1 * i, 0, 0), (0, 0, 0, 1), store)))
    return write_bag(path, sorted(messages, key=lambda m: m[1]), **options)
