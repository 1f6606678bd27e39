"""Replays as a recording for the Rerun viewer."""

import hashlib
import os
import threading
from collections import deque
from collections.abc import Collection, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from typing import IO, Any, Self

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import import_extra
from adaptune.files import replacing
from adaptune.progress import Progress, unseen
from adaptune.report.paper import LINES, OTHERS
from adaptune.study.study import Study
from online.parquet_tables import TABLES, write_parquet
from online.recordings import (
    Cloud,
    RecordedMode,
    RecordedReplays,
    Series,
    Words,
    clouds,
    gather,
    write_mcap,
)

_REFERENCE = "#009e73"
_CLOUD = "#8c8c8c"
_HELD = ("parameters", "weights", "health")
"""Kinds of series that stay until the next selection."""
_WIDTHS = {
    "true_error": 3.0,
    "true_error_behind": 2.5,
    "estimated_error": 2.0,
    "estimated_error_low": 0.5,
    "estimated_error_high": 0.5,
    "prepare_ms": 0.7,
    "selection_ms": 2.5,
    "late_ms": 3.0,
}
"""Points; what a mode does has one colour."""


@contextmanager
def rerun_recording(
    path: Path, replays: RecordedReplays, clouds: Iterable[Cloud]
) -> Iterator[Iterator[Cloud]]:
    """Write replays to a ``.rrd`` file, whole or not at all.

    The block receives the clouds and takes them all; each is written on its way.

    Parameters
    ----------
    path
        Of the file.
    replays
        What is written besides the clouds.
    clouds
        In order of time.

    Raises
    ------
    NotInstalledError
        Without Rerun.
    """
    rr, rrb = import_extra("rerun", "rerun", "rerun.blueprint")
    with replacing(path) as temporary, temporary.open("wb") as file, _Pipe(file) as pipe:
        # Properties hold the time of writing.
        stream = rr.RecordingStream(
            "adaptune", recording_id=_identity(replays), send_properties=False
        )
        try:
            stream.save(pipe.name, default_blueprint=_blueprint(rrb, replays))
            stream.send_recording_name(replays.title)
            sender = _Sender(rr, stream, replays.start)
            sender.paths(replays)
            for mode, recorded in replays.modes.items():
                sender.mode(mode, recorded)
            yield _sent(clouds, sender, pipe)
        finally:
            stream.disconnect()


class _Pipe:
    """Writes what comes through it to a file, and raises what goes wrong there.

    Rerun tells only its own log that a disk is full.
    """

    def __init__(self, file: IO[bytes]):
        self._file = file
        self._error: OSError | None = None
        self._read, self._write = os.pipe()
        self._thread = threading.Thread(target=self._copy, daemon=True)
        self.name = f"/dev/fd/{self._write}"

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        os.close(self._write)
        self._thread.join()
        if kind is None:
            self.check()

    def check(self) -> None:
        """Raise what has gone wrong."""
        if self._error is not None:
            raise self._error

    def _copy(self) -> None:
        while data := os.read(self._read, 1 << 16):
            if self._error is None:
                try:
                    self._file.write(data)
                except OSError as error:
                    # Rerun goes on writing until it is told.
                    self._error = error
        os.close(self._read)


def _identity(replays: RecordedReplays) -> str:
    """The same for the same replays: the viewer takes recordings of one identity for one."""
    digest = hashlib.sha256(replays.title.encode())
    for mode, recorded in replays.modes.items():
        digest.update(mode.encode())
        digest.update(recorded.trajectory.stamps.tobytes())
        digest.update(recorded.trajectory.T_world_sensor.tobytes())
    return digest.hexdigest()[:32]


def _sent(clouds: Iterable[Cloud], sender: "_Sender", pipe: _Pipe) -> Iterator[Cloud]:
    for cloud in clouds:
        sender.cloud(cloud)
        pipe.check()
        yield cloud


class _Sender:
    """Sends replays to a stream."""

    def __init__(self, rr: Any, stream: Any, start: int):
        self._rr, self._stream, self._start = rr, stream, start

    def paths(self, replays: RecordedReplays) -> None:
        """All of every path, and where each mode is."""
        rr = self._rr
        self._stream.log("/world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        if replays.reference is not None:
            self._path("/world/reference", replays.reference.T_world_sensor[:, :3, 3], _REFERENCE)
        for mode, recorded in replays.modes.items():
            xyz = recorded.trajectory.T_world_sensor[:, :3, 3]
            colour = LINES[mode]["color"]
            self._path(f"/world/{mode}", xyz, colour)
            at = f"/world/{mode}/sensor"
            look = rr.Points3D.from_fields(colors=[_rgb(colour)], radii=[rr.Radius.ui_points(7.0)])
            self._stream.log(at, look, static=True, strict=True)
            self._send(at, recorded.trajectory.stamps, rr.Points3D.columns(positions=xyz))
        look = rr.Points3D.from_fields(colors=[_rgb(_CLOUD)], radii=[rr.Radius.ui_points(1.0)])
        self._stream.log("/world/scan", look, static=True, strict=True)

    def mode(self, mode: str, recorded: RecordedMode) -> None:
        """Numbers and texts over time."""
        rr = self._rr
        for kind, of in recorded.series.items():
            for i, (name, series) in enumerate(of.items()):
                at = _entity(kind, mode, name)
                colour = OTHERS[i % len(OTHERS)] if kind == "weights" else LINES[mode]["color"]
                self._line(at, f"{mode} {name}", colour, _WIDTHS.get(name, 1.2), kind in _HELD)
                self._send(at, series.stamps, rr.Scalars.columns(scalars=series.values))
        for name, words in recorded.words.items():
            self._texts(_entity("words", mode, name), words, mode)
        self._texts(_entity("words", mode, "selection"), recorded.selections, mode)

    def cloud(self, cloud: Cloud) -> None:
        """The points where they were measured."""
        T = cloud.T_odom_sensor.astype(np.float32)
        points = cloud.points @ T[:3, :3].T + T[:3, 3]
        columns = self._rr.Points3D.columns(positions=points).partition([len(points)])
        self._send("/world/scan", np.array([cloud.stamp]), columns)
        # A slow disk does not fill the memory.
        self._stream.flush()

    def _path(self, entity: str, xyz: NDArray[np.float64], colour: str) -> None:
        strips = self._rr.LineStrips3D(
            [xyz], colors=[_rgb(colour)], radii=[self._rr.Radius.ui_points(1.5)]
        )
        self._stream.log(entity, strips, static=True, strict=True)

    def _line(self, entity: str, name: str, colour: str, width: float, held: bool) -> None:
        mode = "StepAfter" if held else "Linear"
        lines = self._rr.SeriesLines(
            colors=[_rgb(colour)], widths=[width], names=[name], interpolation_mode=mode
        )
        self._stream.log(entity, lines, static=True, strict=True)

    def _texts(self, entity: str, words: Words, mode: str) -> None:
        # A list of one colour could be three numbers.
        packed = int.from_bytes([*_rgb(LINES[mode]["color"]), 255])
        colours = np.full(len(words.texts), packed, np.uint32)
        self._send(entity, words.stamps, self._rr.TextLog.columns(text=words.texts, color=colours))

    def _send(self, entity: str, stamps: NDArray[np.int64], columns: Any) -> None:
        rr = self._rr
        times = [
            rr.TimeColumn("stamp", timestamp=stamps.astype("datetime64[ns]")),
            rr.TimeColumn("seconds", duration=(stamps - self._start).astype("timedelta64[ns]")),
        ]
        self._stream.send_columns(entity, indexes=times, columns=columns, strict=True)


def _entity(*parts: str) -> str:
    """A path in the recording; in the names of parameters, Rerun escapes what it must."""
    from rerun import new_entity_path

    return str(new_entity_path(list(parts)))


def _rgb(colour: str) -> list[int]:
    return list(bytes.fromhex(colour.removeprefix("#")))


def _blueprint(rrb: Any, replays: RecordedReplays) -> Any:
    """The places at the left; errors, selections and times at the right."""
    # The modes have the colours of the pictures, one of which is black.
    white = rrb.archetypes.PlotBackground(color=[255, 255, 255])

    def over_time(name: str, *parts: str, tall: tuple[float, float] | None = None) -> Any:
        axis = rrb.ScalarAxis(range=tall) if tall else None
        origin = _entity(*parts)
        return rrb.TimeSeriesView(origin=origin, name=name, axis_y=axis, background=white)

    def of_all(kind: str) -> dict[str, Series]:
        modes = replays.modes.values()
        return {k: v for mode in modes for k, v in mode.series.get(kind, {}).items()}

    chosen = [
        over_time(f"weights of {mode}", "weights", mode, tall=(0.0, 1.0))
        for mode, recorded in replays.modes.items()
        if recorded.series.get("weights")
    ]
    for name in of_all("parameters"):
        having = [mode for mode, r in replays.modes.items() if name in r.series["parameters"]]
        contents = [_entity("parameters", mode, name) for mode in having]
        view = {"origin": "/parameters", "contents": contents, "name": name, "background": white}
        chosen.append(rrb.TimeSeriesView(**view))
    chosen.append(rrb.TextLogView(origin="/words", name="selections in words"))
    right = rrb.Vertical(
        over_time("errors in percent", "errors"),
        rrb.Tabs(*chosen, active_tab=0),
        rrb.Tabs(
            over_time("milliseconds", "milliseconds"),
            over_time("lost, restarted", "health"),
            active_tab=0,
        ),
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin="/world", name=replays.title, background=[250, 250, 250]),
            right,
            column_shares=[3, 2],
        ),
        rrb.TimePanel(timeline="seconds", state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
    )


# Write replays as recordings to look at: Rerun, MCAP, Parquet.


FORMATS = ("rerun", "mcap", "parquet")
_PACKAGES = {"rerun": "rerun", "parquet": "pyarrow"}
"""What the extra of a format's name installs."""


def installed_formats() -> list[str]:
    """The formats whose packages are there."""
    return [f for f in FORMATS if f not in _PACKAGES or find_spec(_PACKAGES[f]) is not None]


def record_replays(
    study: Study,
    name: str,
    formats: Collection[str],
    progress: Progress = unseen,
) -> list[Path]:
    """Write the replays of a sequence as recordings.

    Parameters
    ----------
    study
        The study; ``recordings`` in its folder receives the files.
    name
        Of the sequence.
    formats
        Some of `FORMATS`.
    progress
        Called after every scan.

    Returns
    -------
    list of Path
        What was written: files of Rerun and Parquet, and MCAP files, each in a folder of its own.

    Raises
    ------
    AdaptuneError
        If there is no replay, it cannot be read, a package is not installed, or the disk is full.
    """
    for needed in formats:
        if needed in _PACKAGES:
            import_extra(needed, _PACKAGES[needed])
    replays, folder = gather(study, name), study.folder / "recordings"
    written: list[Path] = []
    for mode in replays.modes if "parquet" in formats else ():
        for table in TABLES:
            written.append(folder / f"{name}_{mode}_{table}.parquet")
            write_parquet(written[-1], study.folder / "replays" / name / mode / f"{table}.csv")
    if not {"rerun", "mcap"} & set(formats):
        return written
    with ExitStack() as stack:
        # The scans are read once for both.
        seen = _clouds(study, name, replays, progress)
        if "rerun" in formats:
            written.append(folder / f"{name}.rrd")
            seen = stack.enter_context(rerun_recording(written[-1], replays, seen))
        if "mcap" in formats:
            write_mcap(folder / name, replays, seen)
            written.append(folder / name / f"{name}.mcap")
        deque(seen, maxlen=0)
    return written


def _clouds(
    study: Study, name: str, replays: RecordedReplays, progress: Progress
) -> Iterator[Cloud]:
    sequence, done = study.sequences.open(name), count(1)
    n = sequence.n_messages
    show = partial(progress, name)
    yield from clouds(
        sequence, replays.modes[replays.placing].trajectory, lambda: show(next(done), n)
    )
    show(n, n)
