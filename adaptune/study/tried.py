"""A study's system on the first seconds of a recording, and what to write for it."""

import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer

from adaptune import files
from adaptune.errors import OdometryError, UnavailableError
from adaptune.files import temporary_folder
from adaptune.odometry.docker.rustle import MAX_SCATTER
from adaptune.odometry.program import ProgramInput
from adaptune.odometry.registry import OdometryFactory
from adaptune.progress import Progress
from adaptune.recording.scan import Scan
from adaptune.study.study import Study

SECONDS = 20.0
"""Of the recording."""


class Tried(NamedTuple):
    """What a system did in one way of playing; stamps in nanoseconds."""

    play: str
    fault: str | None
    start: float  # seconds until it hears scans
    n_scans: int
    stamps: NDArray[np.int64]  # of the poses, and of the scans that they are of: both of shape (m,)
    of_scans: NDArray[np.int64]
    lag: float | None  # seconds from a scan to its pose; None for a bag
    cpu: float  # cores

    @property
    def late(self) -> NDArray[Any]:
        """Seconds by which poses have later stamps than their scans, of shape (m,)."""
        return 1e-9 * (self.stamps - self.of_scans)

    @property
    def by_clock(self) -> bool:
        """Whether the system stamps by a clock: not by the scans, nor steadily later."""
        off = np.abs(self.late - np.median(self.late)) if len(self.late) else self.late
        return len(off) > 0 and float(np.percentile(off, 95)) > 1e-9 * MAX_SCATTER

    def row(self, begin: int) -> dict[str, Any]:
        """What is shown, where the first scan has the stamp `begin`."""
        late = float(np.median(self.late)) if len(self.late) else 0.0
        of_scan = f"{late:.2f} s after the scan's" if late > 1e-9 * MAX_SCATTER else "the scan's"
        return {
            "play": self.play,
            "start [s]": self.start,
            "first pose after [s]": 1e-9 * (self.of_scans[0] - begin) if len(self.late) else None,
            "poses per scan": len(self.stamps) / self.n_scans,
            "stamps": ("a clock's" if self.by_clock else of_scan) if len(self.late) else None,
            "lag [s]": self.lag,
            "CPU of a second [s]": self.cpu,
            "fits": "no" if self.fault else "yes",
        }


def try_system(study: Study, progress: Progress) -> tuple[list[str], list[dict[str, Any]]]:
    """Run the baseline on the begin of the first training sequence, in both ways of playing.

    Returns sentences, the decision first, and a row for each way.

    Raises
    ------
    AdaptuneError
        If the recording cannot be used, or the system runs in neither way.
    """
    factory, name = study.odometry, study.training[0]
    if not isinstance(factory, OdometryFactory) or factory.name != "rustle":
        raise OdometryError(
            "odometry.name: only rustle has several ways of playing to try; run `adaptune offline`"
        )
    given, settings = study.sequences.program_input(name), factory.settings
    with temporary_folder() as folder:
        given = first_seconds(given, folder / "cut.bag")
        imu = settings.imu or given.imu or None
        own = {"points": settings.points or given.points, "imu": imu}
        bag = {"play": "bag", "node": None, "set_parameter": None, "rate": settings.rate or 1.0}
        progress("played bag", 0, 2)
        played = factory.changed(
            settings=settings.model_copy(update=bag), program_input=lambda _: given
        )
        by_bag = _tried("bag", played(None, name), given)
        progress("lockstep", 1, 2)
        one_by_one = factory.changed(
            settings=settings.model_copy(update={"play": "lockstep"} | own), program_input=None
        )
        sequences = replace(study.sequences, with_imu=imu is not None)
        scans = list(islice(sequences.open(name), len(given.stamps)))
        stepped = _tried("lockstep", one_by_one(None, name), given, scans)
        progress("lockstep", 2, 2)
    rows = [tried.row(int(given.stamps[0])) for tried in (by_bag, stepped)]
    return advice(by_bag, stepped, own, settings), rows


def first_seconds(given: ProgramInput, path: Path) -> ProgramInput:
    """The first seconds of a bag, with all topics, message by message as they are."""
    n = int(np.searchsorted(given.stamps, given.stamps[0] + SECONDS * 1e9))
    with AnyReader([given.path]) as reader, Writer(path) as writer:
        store = reader.typestore
        known = {
            c.id: writer.add_connection(c.topic, c.msgtype, typestore=store)
            for c in reader.connections
        }
        scans = 0
        for connection, at, data in reader.messages():
            scans += connection.topic == given.points
            if scans > n:
                break
            writer.write(known[connection.id], at, data)
    truth = None if given.T_ref_sensor is None else given.T_ref_sensor[:n]
    return given._replace(path=path, stamps=given.stamps[:n], T_ref_sensor=truth, logs=None)


def _tried(play: str, odometry: Any, given: ProgramInput, scans: Sequence[Scan] = ()) -> Tried:
    """Run on a bag, or on scans, one after the other."""
    at, lags, fault = given.stamps, [], None
    stamps: list[int] = []
    of_scans: list[int] = []
    with closing(odometry):
        try:
            if not scans:
                odometry.start(at[0], np.eye(4))
                stamps = odometry.pose_stamps.tolist()
                before = np.searchsorted(at, stamps, "right").clip(1) - 1
                of_scans = (at if len(stamps) == len(at) else at[before]).tolist()
            for i, scan in enumerate(scans):
                if i == 0:
                    odometry.start(scan, np.eye(4))
                else:
                    odometry.submit(scan)
                    begin = time.monotonic()
                    there = odometry.ready(odometry.patience)
                    lags += [time.monotonic() - begin] if there and not odometry.ended else []
                    odometry.collect()
                if odometry.ended:
                    break
                if (stamp := odometry.pose_stamp) is not None:
                    stamps.append(stamp)
                    of_scans.append(scan.stamp)
        except UnavailableError:
            raise
        except OdometryError as error:
            fault = str(error)
        fault = next(iter(odometry.faults), fault)
    of = np.array(stamps, np.int64), np.array(of_scans, np.int64)
    lag = float(np.median(lags)) if lags else None
    cpu = odometry.usage.cpu / (1e-9 * float(at[-1] - at[0]))
    return Tried(play, fault, odometry.start_seconds, len(at), *of, lag, cpu)


def advice(bag: Tried, stepped: Tried, own: dict[str, Any], settings: Any) -> list[str]:
    """The decision, the settings that follow, and what goes wrong in the other way."""
    if bag.fault and stepped.fault:
        raise OdometryError(
            f"the system runs in no way of playing; bag: {bag.fault}; lockstep: {stepped.fault}"
        )
    chosen = bag if stepped.fault else stepped
    words = {"play": chosen.play} | ({} if chosen is bag else own)
    if chosen.start > 0.5 * settings.ready:
        words["ready"] = round(3.0 * chosen.start)
    if chosen is stepped and (stepped.lag or 0.0) > 0.5 * settings.patience:
        words["patience"] = round(5.0 * (stepped.lag or 0.0), 1)
    if chosen.by_clock and settings.use_sim_time is None:
        words["use_sim_time"] = True
    lines = "".join(f"\n    {files.dump({k: v}).strip()}" for k, v in words.items() if v)
    why = "nothing is lost and it can adapt" if chosen is stepped else "lockstep does not fit"
    said = [f"Write under odometry.settings, because {why}:{lines}"]
    other = stepped if chosen is bag else bag
    return said + ([f"With play: {other.play}: {other.fault}"] if other.fault else [])
