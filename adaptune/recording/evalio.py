"""Sequences of the public data sets that evalio knows, by name."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from itertools import count
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from adaptune import geometry
from adaptune.geometry import Poses
from adaptune.recording.bag import BagSource
from adaptune.recording.config import bag_paths
from adaptune.recording.scan import Frame, Imu, Scan, SequenceError, Source, Timing
from adaptune.trajectory import Trajectory


def evalio_source(name: str) -> Source:
    """Scans, poses and IMU of a sequence such as ``newer_college_2020/short_experiment``.

    evalio knows where the files are (in its data folder, ``$EVALIO_DATA``), what their stamps mean
    and the frames of the poses. adaptune reads bags itself; evalio converts all other files. A
    SequenceError says that evalio is not installed, or does not know or have the sequence.
    """
    try:
        datasets: Any = import_module("evalio.datasets")
    except ImportError as error:
        what = f"evalio's data sets need evalio: `pip install evalio` ({error})"
        raise SequenceError(f"{name}: {what}") from error
    try:
        dataset: Any = datasets.get_sequence(name)
    except Exception as error:
        dataset = error
    if isinstance(dataset, Exception):
        what = f"evalio knows no such sequence ({str(dataset) or type(dataset).__name__})"
        raise SequenceError(f"{name}: {what}; `evalio ls` lists them") from dataset
    if not dataset.is_downloaded():
        help_ = f"fetch it with `evalio dl {name}`, or set EVALIO_DATA to where it is"
        raise SequenceError(f"{name}: not in evalio's data folder ({dataset.folder}); {help_}")
    recording = dataset.data_iter()
    if isinstance(recording, datasets.RosbagIter):
        return EvalioBag(dataset, recording)
    return EvalioFiles(dataset)


def _files(dataset: Any) -> list[Path]:
    return sorted(path for path in Path(dataset.folder).rglob("*") if path.is_file())


def _poses(dataset: Any) -> Trajectory | None:
    """Poses of the LiDAR; evalio's own are of a frame of each data set."""
    truth = dataset.ground_truth_raw()
    if truth is None or not len(truth.stamps):
        return None
    T_truth_sensor = (dataset.imu_T_gt().inverse() * dataset.imu_T_lidar()).to_mat()
    stamps = np.array([stamp.to_nsec() for stamp in truth.stamps], np.int64)
    unique, index = np.unique(stamps, return_index=True)
    T = np.array([pose.to_mat() for pose in truth.poses])[index] @ T_truth_sensor
    return Trajectory(unique, T)


def _place_of_imu(dataset: Any) -> Poses:
    """The IMU's pose in the LiDAR's frame."""
    return geometry.invert(np.asarray(dataset.imu_T_lidar().to_mat(), np.float64))


class EvalioBag(BagSource):
    """A data set in bags. evalio knows the topics, the meaning of the stamps and the poses."""

    def __init__(self, dataset: Any, recording: Any):
        self._dataset, self._imu_topic = dataset, recording.imu_topic
        paths = bag_paths([str(path) for path in recording.path])
        recording.reader.close()
        stamp: Any = "end" if str(recording.lidar_format.stamp) == "end" else "start"
        timing = Timing(stamp, period=float(recording.lidar_params.delta_time().to_sec()))
        super().__init__(paths, recording.lidar_topic, timing)

    @property
    def pose_files(self) -> list[Path]:  # type: ignore[override]
        """The data set's other files."""
        bags = set(self.files)
        return [file for file in _files(self._dataset) if file not in bags]

    def poses(self, name: str | None, child_frame: str | None) -> Trajectory | None:
        """The data set's poses, or those of a topic."""
        return _poses(self._dataset) if name is None else super().poses(name, child_frame)

    def imu(self, name: str | None) -> Imu | None:
        """The data set's IMU."""
        found = super().imu(name or self._imu_topic)
        return None if found is None else replace(found, T_sensor_imu=_place_of_imu(self._dataset))


class EvalioFiles:
    """A data set in its own format, which evalio converts point by point."""

    random_access: ClassVar[bool] = False
    begins: ClassVar[Mapping[str, int]] = {}
    pose_files: Sequence[Path] = ()

    def __init__(self, dataset: Any):
        self._dataset = dataset
        self.n_messages = len(dataset)

    @property
    def files(self) -> list[Path]:
        """All files of the data set."""
        return _files(self._dataset)

    @property
    def name(self) -> str:
        """Name of the sequence."""
        return str(self._dataset.full_name)

    def about(self) -> dict[str, Any]:
        """Its name."""
        return {"name": self.name}

    def frames(self) -> Iterator[Frame]:
        """All scans."""
        measurements = iter(self._dataset.lidar())
        for number in count(1):
            try:
                measurement = next(measurements)
            except StopIteration:
                return
            except Exception as error:
                what = f"scan {number} cannot be read ({error})"
                raise SequenceError(f"{self.name}: {what}") from error
            stamp = measurement.stamp.to_nsec()
            yield Frame(stamp, stamp, partial(_scan, measurement))

    def span(self) -> tuple[int, int] | None:
        """First stamp, and the last one if scans take as long as the LiDAR's data sheet says."""
        first = next(self.frames(), None)
        if first is None:
            return None
        period = self._dataset.lidar_params().delta_time().to_sec()
        return first.stamp, first.stamp + round(self.n_messages * period * 1e9)

    def poses(self, *_: str | None) -> Trajectory | None:
        """The data set's poses."""
        return _poses(self._dataset)

    def imu(self, *_: str | None) -> Imu | None:
        """The data set's IMU."""
        measured = list(self._dataset.imu())
        stamps = np.array([m.stamp.to_nsec() for m in measured], np.int64)
        unique, index = np.unique(stamps, return_index=True)
        gyro = np.array([m.gyro for m in measured], np.float64)[index]
        acceleration = np.array([m.accel for m in measured], np.float64)[index]
        return Imu(unique, gyro, acceleration, _place_of_imu(self._dataset))


def _scan(measurement: Any) -> Scan:
    points = np.array(measurement.to_vec_positions(), np.float32).reshape(-1, 3)
    times = np.array(measurement.to_vec_stamps(), np.float32)
    squares = np.einsum("ij,ij->i", points, points)
    scan = Scan(measurement.stamp.to_nsec(), points, np.maximum(times, np.float32(0.0)))
    return scan.select((squares > 0) & (squares < np.inf))
