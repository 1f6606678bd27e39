"""Damages valid files of every kind that comes from elsewhere, and looks at what becomes of them.

    python benchmarks/fuzz.py [--minutes 2] [--only TARGET ...] [--seed 0]

Each target runs for so many minutes of the clock, in a process of its own. Whatever is damaged must
be read, or give an `AdaptuneError`: no other exception, no crash, no more than ten seconds of the
processor for a case and no more than three gigabytes. What breaks this is printed with its seed
and number, which give the same case again. `tests/support/fuzz.py` makes the damage.
"""

import argparse
import faulthandler
import io
import itertools
import json
import multiprocessing as mp
import os
import resource
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "support"))

import drives
import fuzz
import local_link
from random_models import random_model

from adaptune._system import processes, yaml12
from adaptune.model import ErrorModel
from adaptune.model.error_model import render
from adaptune.odometry import wire
from adaptune.odometry.program import CommandSettings, read_output
from adaptune.odometry.systems.played_bag import PoseRecorder
from adaptune.odometry.systems.ros_system import PoseReader
from adaptune.odometry.template import Template
from adaptune.recording import Scan, SequenceConfig
from adaptune.recording.folder import read_scan
from adaptune.recording.recording import open_sequence
from adaptune.reference.stored import StoredEstimate
from adaptune.runs.archive import Archive, Frames, Trial
from adaptune.selector import Selector
from adaptune.trajectory import Trajectory, read_trajectory, write_tum
from offline.trial_table import rows

BYTES = 3 << 30
ODOMETRY = "nav_msgs/msg/Odometry"
STAMPS = drives.FIRST_STAMP + np.arange(30) * 10**8


def of_files(folder: Path, read: Callable[[Path], object], without: str = "") -> fuzz.Case:
    """Damage one file in a folder, but for those of a name, read it, and put it back."""
    there = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != without)
    sound = {path: path.read_bytes() for path in there}

    def one(rng: np.random.Generator) -> object:
        path = list(sound)[int(rng.integers(len(sound)))]
        path.write_bytes(fuzz.damage(sound[path], rng))
        try:
            return read(path)
        finally:
            # A reader may have moved what is of no use to it.
            for each, content in sound.items():
                each.parent.mkdir(parents=True, exist_ok=True)
                each.write_bytes(content)

    return one


def poses(n: int = len(STAMPS)) -> np.ndarray:
    """A curve of shape (n, 4, 4)."""
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 0, 3] = 0.5 * np.arange(n)
    return T


def trajectories(folder: Path) -> fuzz.Case:
    """Files of poses: a reference, or what a program leaves."""
    write_tum(folder / "a.tum", Trajectory(STAMPS, poses()))
    np.savetxt(folder / "b.txt", poses()[:, :3].reshape(-1, 12))
    lines = ["#timestamp [ns],x,y,z,qw,qx,qy,qz"]
    lines += [f"{s},{x},0,0,1,0,0,0" for s, x in zip(STAMPS, poses()[:, 0, 3], strict=True)]
    (folder / "c.csv").write_text("\n".join(lines))

    def read(path: Path) -> object:
        settings = CommandSettings(
            command=("a",), output=path.name, format="kitti" if path.suffix == ".txt" else "tum"
        )
        found = read_output(path, settings, STAMPS) if path.suffix != ".csv" else None
        known = read_trajectory(path) if path.suffix != ".txt" else found
        assert known is not None
        assert np.isfinite(known.T_world_sensor).all()
        assert (np.diff(known.stamps) > 0).all()
        return known

    return of_files(folder, read)


def model(folder: Path) -> fuzz.Case:
    """Error models, with and without the digest of what is damaged."""
    random_model().save(folder / "model.safetensors")

    def read(path: Path) -> object:
        found = ErrorModel.load(path)
        render(found, path)
        return Selector(found)

    return of_files(folder, read)


def archive(folder: Path) -> fuzz.Case:
    """Trials of a study."""
    made, n = Archive(folder), len(STAMPS)
    rng = np.random.default_rng(0)
    nothing = np.zeros(n, bool)
    described = rng.integers(0, 9, (n, 90)).astype(np.float32)
    made.write_frames("one", Frames(STAMPS, poses(), described, {"ndt": 90}, np.zeros(n, "f4")))
    for number in range(3):
        trial = Trial.of({"a": 1.0 + number}, poses(), rng.gamma(1, 1, n), nothing, 1.0)
        made.write("one", number, trial)

    def read(_: Path) -> object:
        opened = Archive(folder)
        rows(opened, ["one"])
        opened.sets()
        opened.read_frames("one")
        numbers = list(opened.finished("one"))
        return opened.read_errors("one", numbers), [opened.read("one", n) for n in numbers]

    return of_files(folder, read)


def cache(folder: Path) -> fuzz.Case:
    """Decoded scans; their notes in JSON only adaptune itself writes, on this machine."""
    os.environ["ADAPTUNE_CACHE"] = str(folder / "cache")
    bag = drives.write_bag(folder / "drive.bag", drives.scans(n_scans=6))
    config = SequenceConfig(bag=str(bag), points="/points")
    list(open_sequence(config))

    def read(_: Path) -> object:
        return [len(scan) for scan in open_sequence(config)]

    return of_files(folder / "cache", read, "about.json")


def clouds(folder: Path) -> fuzz.Case:
    """Scans in files of their own; not PCD and PLY, on some of which Open3D itself crashes."""
    points = drives.scans(n_scans=1)[0][1][:200]
    np.save(folder / "1.npy", points)
    np.column_stack([points, points[:, 0]]).astype("<f4").tofile(folder / "2.bin")
    return of_files(folder, lambda path: fuzz.check(read_scan(path, 0)))


def estimate(folder: Path) -> fuzz.Case:
    """What is told of an estimated reference."""
    told = {"about": {}, "scans": 30, "metres": 15.0, "unknown_share": 0.1}
    told |= {"error_percent": {"5.0": 0.1, "25.0": 0.05}, "unknown_seconds": [[0, 1, "a"]]}
    (folder / "a.json").write_text(json.dumps(told))

    def read(path: Path) -> object:
        found = StoredEstimate.read(path.with_suffix(".tum"))
        return None if found is None else found.error(10.0)

    return of_files(folder, read)


def templates(folder: Path) -> fuzz.Case:
    """Parameter files of programs."""
    data = {"mapping": {"voxel": 1.0, "names": ["a", "b"]}, "rate": 10, "on": True}
    (folder / "a.yaml").write_text(yaml12.dump(data))
    (folder / "b.json").write_text(json.dumps(data))

    def read(path: Path) -> object:
        template = Template(path)
        return template.names, template.fill({"voxel": 0.5, "rate": 3})

    return of_files(folder, read)


def programs(_: Path) -> fuzz.Case:
    """Messages of a program that takes scans."""
    scan = Scan(int(STAMPS[0]), drives.scans(n_scans=1)[0][1][:50])
    space: dict[str, Any] = {"a": {"type": "float", "low": 0, "high": 1, "baseline": 0.5}}
    header = {"type": "done", "version": 2, "odometry": "a", "live": True, "space": space}
    sent = [(header, {}), ({"type": "pose", "stamp": 1, "registered": True}, {"pose": np.eye(4)})]
    sent.append(({"type": "register", "stamp": scan.stamp}, wire.scan_arrays(scan)))
    streams = []
    for head, arrays in sent:
        stream = io.BytesIO()
        processes.send(stream, head, **arrays)
        streams.append(stream.getvalue())

    def one(rng: np.random.Generator) -> object:
        stream = io.BytesIO(fuzz.damage(streams[int(rng.integers(len(streams)))], rng))
        while (message := processes.receive(stream)) is not None:
            if message.header.get("type") == "done":
                wire.announced(message)
        return None

    return one


def containers(_: Path) -> fuzz.Case:
    """Messages of poses that a system in a container publishes."""
    link: Any = local_link.LocalLink()
    link.record = lambda *_: None  # the messages are put there
    recorder = PoseRecorder(PoseReader(link, "/odometry"))
    made = [local_link.odometry(int(stamp), T) for stamp, T in zip(STAMPS, poses(5), strict=False)]
    sound = [bytes(link.store.serialize_ros1(each, ODOMETRY)) for each in made]

    def one(rng: np.random.Generator) -> object:
        recorder.received = [(ODOMETRY, fuzz.damage(data, rng)) for data in sound]
        recorder.newest()
        return recorder.poses()

    return one


TARGETS: dict[str, Callable[[Path], fuzz.Case]] = {
    "messages": fuzz.of_messages,
    "bags": fuzz.of_bags,
    "studies": fuzz.of_studies,
    **{
        made.__name__: made
        for made in (
            *(clouds, cache, trajectories, estimate, model, archive, templates, programs),
            containers,
        )
    },
}


def run(name: str, minutes: float, seed: int) -> None:
    """Fuzz one target, and print what became of all cases."""
    faulthandler.enable()
    resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        one = TARGETS[name](Path(folder))
        end = time.monotonic() + 60 * minutes
        in_time = itertools.takewhile(lambda _: time.monotonic() < end, itertools.count())
        counts = fuzz.counted(one, seed, in_time)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10
    assert peak < BYTES, f"{name}: {peak / 1e9:.1f} GB of memory"
    print(f"{name}: {dict(counts)}, at most {peak / 1e6:.0f} MB", flush=True)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=2.0)
    parser.add_argument("--only", nargs="+", choices=list(TARGETS), default=list(TARGETS))
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    failed = []
    for name in given.only:
        process = mp.get_context("spawn").Process(
            target=partial(run, name, given.minutes, given.seed)
        )
        process.start()
        process.join()
        if process.exitcode:
            failed.append(f"{name} (ended with {process.exitcode})")
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
