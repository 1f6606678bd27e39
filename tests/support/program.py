"""An odometry as users have them: a recording and a parameter file in, a trajectory out.

Registers each scan to the one before with small_gicp; asked to go wrong, it only pretends to, from
drives.py's poses.
"""

import json
import os
import sys
import time
from pathlib import Path


def main(source, topic, output, file, fault="none"):
    sys.stdout.write(f"reading {Path(source).name}\n")
    if fault == "none":
        settings = json.loads(Path(file).read_text(encoding="utf-8"))["registration"]
        poses = register(bag(source, topic) if topic else kitti(source), settings)
    else:
        poses = [(1_700_000_000_123_456_789 + i * 10**8, straight(0.3 * i)) for i in range(40)]
    sys.stdout.flush()
    if fault == "exit":
        sys.stderr.write("no planes here\n")
        sys.exit(1)
    if fault == "abort":
        os.abort()
    if fault == "work":
        work()
    if fault == "hang":
        time.sleep(60)
    if fault == "memory":
        bytearray(1 << 33)
    if fault != "nothing":
        write(Path(output), *spoil(poses, fault), fault)


def work():
    """Half a second of CPU time in one child, 200 MB in another."""
    if os.fork() == 0:
        while time.process_time() < 0.5:
            pass
        os._exit(0)
    if os.fork() == 0:
        held = bytearray(200_000_000)
        time.sleep(0.5)
        os._exit(len(held) % 2)
    os.wait()
    os.wait()


def straight(x):
    return [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0]]


def register(clouds, settings):
    import numpy as np
    import small_gicp

    before, T, step, poses = None, np.eye(4), np.eye(4), []
    for stamp, points in clouds:
        cloud, tree = small_gicp.preprocess_points(points, settings["voxel"], num_threads=1)
        if before is not None:
            step = small_gicp.align(
                before[0],
                cloud,
                before[1],
                init_T_target_source=step,
                max_correspondence_distance=settings["distance"],
                num_threads=1,
            ).T_target_source
            T = T @ step
        before = cloud, tree
        # To the digits of a TUM file, the drives have no rotation.
        poses.append((stamp, T[:3].tolist()))
    return poses


def bag(path, topic):
    from rosbags.highlevel import AnyReader

    with AnyReader([Path(path)]) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        for connection, _, data in reader.messages(connections):
            message = reader.deserialize(data, connection.msgtype)
            floats = message.data.reshape(-1, message.point_step)[:, :12].copy().view("<f4")
            stamp = message.header.stamp
            yield stamp.sec * 10**9 + stamp.nanosec, floats.astype(float)


def kitti(root):
    import numpy as np

    sequence = Path(root) / "sequences" / "00"
    times = np.loadtxt(sequence / "times.txt")
    for t, file in zip(times, sorted((sequence / "velodyne").iterdir()), strict=True):
        yield round(t * 1e9), np.fromfile(file, "<f4").reshape(-1, 4)[:, :3].astype(float)


def spoil(poses, fault):
    stamps, rows = (list(column) for column in zip(*poses, strict=True))
    if fault == "camera":
        # Ahead is z, left is -x, up is -y: only the translation tells, the drives do not turn.
        rows = [[[1, 0, 0, -T[1][3]], [0, 1, 0, -T[2][3]], [0, 0, 1, T[0][3]]] for T in rows]
    if fault == "half":
        stamps, rows = stamps[: len(stamps) // 2], rows[: len(rows) // 2]
    if fault.startswith("begins after "):
        n = int(fault.split()[-1])
        stamps, rows = stamps[n:], rows[n:]
    if fault == "backwards":
        stamps = stamps[::-1]
    if fault == "late":
        stamps = [stamp + 100_000_000 for stamp in stamps]
    if fault == "clock":
        stamps = [stamp - stamps[0] for stamp in stamps]
    if fault == "NaN":
        rows[5] = straight(float("nan"))
    if fault == "not rigid":
        rows[3] = [[2, 0, 0, 0.9], *rows[3][1:]]
    if fault == "jump":
        rows[20:] = [[[1, 0, 0, T[0][3] + 2.0], *T[1:]] for T in rows[20:]]
    return stamps, rows


def write(path, stamps, rows, fault):
    if path.suffix == ".txt":
        lines = [" ".join(str(v) for row in T for v in row) for T in rows]
    else:
        separator = "," if path.suffix == ".csv" else " "
        lines = ["# name: program", "# timestamp, x, y, z, qx, qy, qz, qw"]
        for stamp, T in zip(stamps, rows, strict=True):
            numbers = (*(row[3] for row in T), *quaternion(T))
            lines.append(f"{stamp // 10**9}.{stamp % 10**9:09d}{separator}")
            lines[-1] += separator.join(map(str, numbers))
    text = "\n".join(lines)
    path.write_text(text[:-12] if fault == "cut" else text + "\n", encoding="utf-8")


def quaternion(T):
    """Of a small rotation: x, y, z, w."""
    w = (1 + T[0][0] + T[1][1] + T[2][2]) ** 0.5 / 2
    turned = (T[2][1] - T[1][2], T[0][2] - T[2][0], T[1][0] - T[0][1])
    return (*(v / (4 * w) for v in turned), w)


if __name__ == "__main__":
    main(*sys.argv[1:])
