"""Trials in containers: what they cost besides the bag, two at a time, and what kills leave behind.

    python benchmarks/containers.py cost [TRIALS]
    python benchmarks/containers.py parallel [TRIALS]
    python benchmarks/containers.py kills [KILLS] [SEED]
    python benchmarks/containers.py ros2 [SCANS]

It builds the reference image if needed, and records a garden of 20 s. `cost` runs trials one after
the other: their time less that of the bag. `parallel` runs as many one after the other, and then
two at a time. `kills` sends SIGKILL to a campaign with two workers, or to one of its workers, at a
random moment, and counts what the engine holds: 5 s later, and when the next campaign has begun.
`ros2` drives the ROS 2 reference in lockstep by clouds of 29,000 points: CPU time of what carries
them, and the trial's time next to the node's own.
"""

import logging
import os
import re
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "support"))

import kills
import needs
import ros2_reference

from adaptune._system import yaml12
from adaptune.odometry.remote import Limits
from adaptune.odometry.systems.engine import OWNER, engine, is_orphan
from adaptune.odometry.systems.ros2_system import Ros2
from adaptune.recording import Scan
from adaptune.simulation import Course
from adaptune.simulation.record import record
from offline.config import load_study


@contextmanager
def study_file() -> Iterator[Path]:
    """A study of the reference image with a recorded garden."""
    image = needs.reference_image()
    distance = {"type": "float", "low": 1.0, "high": 10.0, "baseline": 4.0, "log": True}
    odometry = {
        "name": "rustle",
        "settings": {"image": image, "template": "params.yaml", "odometry": "/Odometry"},
        "parameters": {"gicp/max_correspondence_distance": distance},
    }
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        record(Course(scenes=["garden"], length=40, sensor="vlp16", seed=1), folder / "garden.bag")
        given = {
            "odometry": odometry,
            "sequences": {
                "garden": {
                    "bag": "garden.bag",
                    "points": "/velodyne_points",
                    "reference": "/gt_poses",
                }
            },
            "training": ["garden"],
            "sub_trajectory": 10.0,
            "offline": {"trials": 8, "initial": 8, "workers": 2, "sampler": "random"},
        }
        template = {
            "common": {"points_topic": "/velodyne_points"},
            "gicp": {"max_correspondence_distance": 4.0, "downsampling": 0.5},
        }
        (folder / "params.yaml").write_text(yaml12.dump(template))
        (folder / "study.yaml").write_text(yaml12.dump(given))
        yield folder / "study.yaml"


def trial(study: Any) -> Any:
    """Run the baseline once; what the log of its folder says of it."""
    odometry = study.odometry({}, "garden")
    scan = next(iter(study.sequences.open("garden")))
    begin = time.monotonic()
    odometry.start(odometry.prepare(scan), np.eye(4))
    seconds = time.monotonic() - begin
    assert not odometry.faults, odometry.faults
    return seconds, odometry.usage


def bag_seconds(study: Any) -> float:
    """How long the bag is played."""
    from rosbags.highlevel import AnyReader

    with AnyReader([study.sequences.program_input("garden").path]) as reader:
        return float(reader.duration) * 1e-9


def cost(path: Path, n: int) -> None:
    """Seconds of trials besides the bag."""
    study = load_study(path)
    bag = bag_seconds(study)
    trial(study)  # the first of a process asks once which user the image allows
    besides, used = [], []
    for _ in range(n):
        seconds, usage = trial(study)
        besides.append(seconds - bag)
        used.append((100.0 * usage.cpu / bag, usage.memory))
    cpu, memory = np.median(np.array(used, float), axis=0)
    print(
        f"bag of {bag:.1f} s; a trial takes besides, in seconds: median {np.median(besides):.2f},"
    )
    print(f"  least {min(besides):.2f}, most {max(besides):.2f}, of {n} trials")
    print(f"  the node: {cpu:.0f} % of a core, {memory:.0f} MB")


def parallel(path: Path, n: int) -> None:
    """How much faster two containers at a time are."""
    study = load_study(path)
    trial(study)
    took = []
    for at_once in (1, 2):
        begin = time.monotonic()
        with ThreadPoolExecutor(at_once) as pool:
            list(pool.map(lambda _: trial(study), range(n)))
        took.append(time.monotonic() - begin)
    print(
        f"{n} trials: one at a time {took[0]:.1f} s, two {took[1]:.1f} s: {took[0] / took[1]:.2f}x"
    )


def left() -> tuple[int, int, int]:
    """Containers of ended processes, and volumes and networks besides the engine's own."""
    api = engine().api
    containers = api.containers(all=True, filters={"label": OWNER})
    orphans = [one for one in containers if is_orphan(one["Labels"][OWNER])]
    networks = [n for n in api.networks() if n["Name"] not in ("bridge", "host", "none")]
    return len(orphans), len(api.volumes()["Volumes"] or ()), len(networks)


def kill(path: Path, n: int, seed: int) -> None:
    """Kill campaigns, and count what is left."""
    rng, later, next_time = np.random.default_rng(seed), [], []
    before = left()
    for i in range(n):
        process = kills.begin(path, path.parent / f"run-{i}")
        threading.Event().wait(rng.uniform(1.0, 20.0))
        workers = kills.workers(process.pid)
        running = len(engine().api.containers(filters={"label": OWNER}))
        victim = "driver"
        if workers and rng.random() < 0.3:
            victim = "worker"
            os.kill(int(rng.choice(workers)), signal.SIGKILL)
            time.sleep(rng.uniform(0.0, 1.0))
        process.kill()
        process.communicate()
        time.sleep(5.0)
        found = left()
        later.append(found[0])
        # What the next campaign does first.
        engine.cache_clear()
        engine()
        next_time.append([now - then for now, then in zip(left(), before, strict=True)])
        print(
            f"kill {i + 1} ({victim}, of {running} containers): {found[0]} left after 5 s, "
            f"{next_time[-1]} containers, volumes and networks when the next begins",
            flush=True,
        )
    print(
        f"{n} kills, seed {seed}: left after 5 s in all {sum(later)}, then {np.sum(next_time, 0)}"
    )


def ros2(n: int) -> None:
    """What lockstep costs besides the node's own time, which the node prints."""
    rng = np.random.default_rng(0)
    walls = rng.uniform(-20.0, 20.0, (29_000, 3)).astype(np.float32)
    walls[np.arange(29_000), rng.integers(0, 2, 29_000)] = 20.0
    scans = [Scan(10**9 + i * 10**8, walls) for i in range(n)]
    program = ("adaptune-reference-ros2", "--params-file", "{parameters}")
    with tempfile.TemporaryDirectory() as name:
        given = ros2_reference.ros2(
            Path(name) / "p.yaml", command=("env", "ADAPTUNE_TIMES=1", *program), patience=60.0
        )
        odometry = Ros2.instance({}, given, Limits(seconds=60.0, memory=2.0), None)
        odometry.start(scans[0], np.eye(4))
        system: Any = odometry._system
        time.sleep(2.0)  # until its node has learnt all of the other
        idle = _idle(system)
        carrier, node = system._node.used().cpu, system._container.used().cpu
        begin, cpu = time.monotonic(), time.process_time()
        for scan in scans[1:]:
            odometry.register(scan)
        took, cpu = time.monotonic() - begin, time.process_time() - cpu
        carrier, node = system._node.used().cpu - carrier, system._container.used().cpu - node
        log = (system.folder / "output.log").read_text()
        own = sum(float(ms) for ms in re.findall(r"scan (?!1:)\d+: (\S+) ms", log)) * 1e-3
        odometry.close()
    used = zip((cpu, carrier), idle, strict=True)
    mine, its = (1e3 * (busy - took * rest) / (n - 1) for busy, rest in used)
    print(f"{n - 1} clouds: CPU of a cloud {mine:.2f} ms here, {its:.2f} ms in adaptune's node,")
    print(f"  {1e3 * node / (n - 1):.2f} ms in the system")
    print(f"  {took:.2f} s in lockstep, {own:.2f} s in the node: {took / own:.2f}x")


def _idle(system: Any) -> tuple[float, float]:
    """Cores that this process and adaptune's node use while nothing is sent but the clock."""
    begin, cpu, carrier = time.monotonic(), time.process_time(), system._node.used().cpu
    time.sleep(3.0)
    took = time.monotonic() - begin
    found = (time.process_time() - cpu) / took, (system._node.used().cpu - carrier) / took
    print(f"the clock alone: {1e2 * found[0]:.1f} and {1e2 * found[1]:.1f} % of a core")
    return found


def main(what: str, n: int, seed: int) -> None:
    """Measure one of the four."""
    logging.basicConfig(format="%(message)s")
    if what == "ros2":
        ros2(n)
        return
    logging.getLogger("adaptune.odometry.systems.ros_system").setLevel(logging.INFO)
    with study_file() as path:
        if what == "cost":
            cost(path, n)
        elif what == "parallel":
            parallel(path, n)
        else:
            kill(path, n, seed)


if __name__ == "__main__":
    given = [*sys.argv[2:], *("6", "0")[len(sys.argv) - 2 :]]
    main(sys.argv[1], int(given[0]), int(given[1]))
