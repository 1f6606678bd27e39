#!/usr/bin/env python3
"""Run the odometry over the bag in /data and write /output/trajectory.tum.

Parameters are those of /parameters.yaml below `gicp`, if there is such a file. The topic is the
first argument, or POINTS_TOPIC of the environment, or the file's `common/points_topic`.
"""

import os
import sys
import time
from pathlib import Path

import yaml
from genpy import Time
from lidar_odometry import (
    POINTS_TOPIC,
    LidarOdometry,
    check_layout,
    quaternion,
    to_scan,
    tuned,
)
from rosbag import Bag

DATA, PARAMETERS, OUTPUT = Path("/data"), Path("/parameters.yaml"), Path("/output/trajectory.tum")


def main() -> None:
    """Write the poses of all scans, with stamps to the nanosecond."""
    bags = sorted(DATA.glob("*.bag"))
    if len(bags) != 1:
        sys.exit(f"{DATA} holds {len(bags)} bags: mount a folder with one there")
    given = (yaml.safe_load(PARAMETERS.read_text()) if PARAMETERS.exists() else None) or {}
    topic = (given.get("common") or {}).get("points_topic", POINTS_TOPIC)
    topic = sys.argv[1] if len(sys.argv) > 1 else os.environ.get("POINTS_TOPIC", topic)
    imitate = given.get("imitate") or {}
    time.sleep(imitate.get("ready_delay", 0.0))
    odometry = LidarOdometry(tuned(given.get("gicp")), imitate.get("frame"))
    lines = []
    with Bag(str(bags[0])) as bag:
        for i, (_, message, _) in enumerate(bag.read_messages([topic])):
            check_layout(message, imitate.get("layout"))
            if i < imitate.get("late", 0):
                continue
            stamp = message.header.stamp
            T = odometry.register(to_scan(message, stamp.to_nsec()))
            time.sleep(imitate.get("seconds_per_scan", 0.0))
            if i % imitate.get("one_of", 1):
                continue
            if "own_clock" in imitate:
                stamp = Time.from_sec(time.time())
            numbers = [*T[:3, 3], *quaternion(T)]
            pose = " ".join(f"{number:.9f}" for number in numbers)
            lines.append(f"{stamp.secs}.{stamp.nsecs:09d} {pose}\n")
            if len(lines) == imitate.get("die_at"):
                sys.exit(f"gicp: terminating after {len(lines)} scans: the map is corrupt")
    if not lines:
        sys.exit(f"{bags[0]} holds no clouds on {topic}: name the topic as argument")
    OUTPUT.write_text("".join(lines))


if __name__ == "__main__":
    main()
