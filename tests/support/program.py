"""An odometry as users have them: a recording and a parameter file in, a trajectory out.

Drives straight ahead at the stamps of the scans; asked to go wrong, at those of drives.py.
"""

import json
import os
import sys
import time
from pathlib import Path


def main(source, topic, output, file, fault="none"):
    sys.stdout.write(f"reading {Path(source).name}\n")
    if fault == "none":
        settings = json.loads(Path(file).read_text(encoding="utf-8"))
        poses = drive(bag(source, topic) if topic else kitti(source), settings)
    else:
        poses = [(1_700_000_000_123_456_789 + i * 10**8, (0.3 * i, 0, 0)) for i in range(40)]
    sys.stdout.flush()
    if fault == "exit":
        sys.stderr.write("no planes here\n")
        sys.exit(1)
    if fault == "abort":
        os.abort()
    if fault == "work":
        held = bytearray(200_000_000)
        while time.process_time() < 0.5:
            held[0] ^= 1
    if fault == "hang":
        time.sleep(60)
    if fault == "memory":
        bytearray(1 << 33)
    if fault != "nothing":
        write(Path(output), *spoil(poses, fault), fault)


def drive(stamps, settings):
    """Stamps and positions of a straight drive, which is too long by what the settings say."""
    speed = settings.get("speed", 3.0) * (1.0 + 0.001 * sum(settings["registration"].values()))
    return [(stamp, (speed * (stamp - stamps[0]) / 1e9, 0, 0)) for stamp in stamps]


def bag(path, topic):
    from rosbags.highlevel import AnyReader

    with AnyReader([Path(path)]) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        read = [reader.deserialize(data, c.msgtype) for c, _, data in reader.messages(connections)]
        return [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in read]


def kitti(root):
    sequence = Path(root) / "sequences" / "00"
    times = [round(float(t) * 1e9) for t in (sequence / "times.txt").read_text().split()]
    assert len(times) == len(list((sequence / "velodyne").iterdir()))
    return times


def spoil(poses, fault):
    stamps, places = (list(column) for column in zip(*poses, strict=True))
    if fault == "camera":
        # Ahead is z, left is -x, up is -y: only the translation tells, the drives do not turn.
        places = [(-y, -z, x) for x, y, z in places]
    if fault == "half":
        stamps, places = stamps[:20], places[:20]
    if fault.startswith("begins after "):
        n = int(fault.split()[-1])
        stamps, places = stamps[n:], places[n:]
    if fault == "backwards":
        stamps = stamps[::-1]
    if fault == "late":
        stamps = [stamp + 100_000_000 for stamp in stamps]
    if fault == "clock":
        stamps = [stamp - stamps[0] for stamp in stamps]
    if fault == "NaN":
        places[5] = (float("nan"), 0, 0)
    if fault == "jump":
        places[20:] = [(x + 2.0, y, z) for x, y, z in places[20:]]
    return stamps, places


def write(path, stamps, places, fault):
    if path.suffix == ".txt":
        lines = [f"1 0 0 {x} 0 1 0 {y} 0 0 1 {z}" for x, y, z in places]
        if fault == "not rigid":
            lines[3] = f"2{lines[3][1:]}"
    else:
        separator = "," if path.suffix == ".csv" else " "
        lines = ["# name: program", "# timestamp, x, y, z, qx, qy, qz, qw"]
        for stamp, place in zip(stamps, places, strict=True):
            seconds = f"{stamp // 10**9}.{stamp % 10**9:09d}"
            lines.append(separator.join(map(str, (seconds, *place, 0, 0, 0, 1))))
    text = "\n".join(lines)
    path.write_text(text[:-12] if fault == "cut" else text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
