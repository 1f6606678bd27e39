"""Recordings of simulated courses: ROS bags and KITTI odometry folders."""

import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin

from adaptune import geometry
from adaptune.drawing import as_png_and_svg
from adaptune.files import replacing, replacing_folder
from adaptune.sequence.export import (
    T_CAMERA_LIDAR,
    Message,
    Messages,
    structured,
    write_kitti_poses,
    write_kitti_sequence,
)
from adaptune.sequence.scan import Scan
from adaptune.simulation.course import Course, SimulationError
from adaptune.simulation.inertial import Inertial, measure
from adaptune.simulation.rig import IMU, POINTS, POSES
from adaptune.simulation.simulate import Drive, SimulatedScan
from adaptune.trajectory import Trajectory, write_tum

if TYPE_CHECKING:
    from adaptune.simulation.preview import Preview

Layout = Literal["ros1", "ros2", "mcap", "kitti"]
"""ROS 1 bag, ROS 2 folder with sqlite3, one MCAP file, KITTI odometry folder."""

Progress = Callable[[int, int], None]

_MARKS = {"ros2": "metadata.yaml", "kitti": "sequences"}
"""Marks of a recording's folder, which may be overwritten."""


def record(
    course: Course,
    path: Path,
    *,
    layout: Layout | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> None:
    """Simulate a course and write its recording, its ground truth and a preview.

    The truth, in the TUM format, and the preview, as PNG and SVG, are named after the recording.
    All are written whole or not at all.

    Parameters
    ----------
    course
        The course to simulate.
    path
        Where to write the recording.
    layout
        Format. If not given, the name decides: ``.bag`` is ROS 1, ``.mcap`` a ROS 2 file,
        anything else a ROS 2 folder.
    overwrite
        Whether to replace an existing recording; no other file or folder is replaced.
    progress
        Called after every scan with the numbers of finished and of all scans.
    """
    # matplotlib takes a second to import.
    from adaptune.simulation.preview import Preview

    path = Path(path)
    layout = _layout(path) if layout is None else layout
    stem = path.name if layout in _MARKS else path.stem
    truth = path.with_name(f"{stem}.tum")
    previews = as_png_and_svg(path.with_name(f"{stem}.png"))
    for file in (path, truth, *previews):
        _check(file, overwrite, _MARKS.get(layout) if file is path else None)
    drive = Drive(course)
    if not len(drive):
        raise SimulationError("the course is over before its first scan is: make it longer")
    with ExitStack() as stack:
        temporary_truth = stack.enter_context(replacing(truth))
        temporary_previews = [stack.enter_context(replacing(preview)) for preview in previews]
        scans = _watched(drive, picture := Preview(drive), progress)
        new = stack.enter_context((replacing_folder if layout in _MARKS else replacing)(path))
        if layout == "kitti":
            _write_kitti(drive, scans, new)
        elif layout == "mcap":
            _write_mcap(drive, scans, new)
        else:
            # The writer makes the file itself.
            new.unlink(missing_ok=True)
            _write_bag(drive, scans, new, 1 if layout == "ros1" else 2)
        stamps = drive.stamps()
        write_tum(temporary_truth, Trajectory(stamps, drive.ride.poses(drive.seconds(stamps))))
        picture.save(temporary_previews)


def _layout(path: Path) -> Layout:
    return {".bag": "ros1", ".mcap": "mcap"}.get(path.suffix, "ros2")  # type: ignore[return-value]


def _check(path: Path, overwrite: bool, mark: str | None) -> None:
    """Refuse to replace a recording without `overwrite`, and anything else."""
    if not path.exists():
        return
    if not overwrite:
        raise SimulationError(f"{path} exists already; give --overwrite to replace it")
    if path.is_dir() and (mark is None or not (path / mark).exists()):
        raise SimulationError(f"{path} is a folder, but no recording of this kind: not replaced")
    if mark is not None and not path.is_dir():
        raise SimulationError(f"{path} is a file, the recording would be a folder: not replaced")


def _watched(
    drive: Drive, preview: "Preview", progress: Progress | None
) -> Iterator[SimulatedScan]:
    for number, scan in enumerate(drive.scans(), start=1):
        preview.add(scan)
        yield scan
        if progress is not None:
            progress(number, len(drive))


class _Composer(Messages):
    """Makes the ROS messages of a drive."""

    def __init__(self, drive: Drive, version: Literal[1, 2]) -> None:
        super().__init__(version)
        self._drive = drive

    @property
    def topics(self) -> dict[str, str]:
        """Type of each topic."""
        topics = {POINTS: "sensor_msgs/msg/PointCloud2", POSES: "geometry_msgs/msg/PoseStamped"}
        if self._drive.course.imu is not None:
            topics[IMU] = "sensor_msgs/msg/Imu"
        return topics

    def messages(self, scans: Iterator[SimulatedScan]) -> Iterator[Message]:
        """All messages in the order in which they are sent: a cloud when its scan is over."""
        drive = self._drive
        stamps = drive.stamps()
        T_world_sensor = drive.ride.poses(drive.seconds(stamps))
        quaternions = geometry.to_quaternions(T_world_sensor)
        inertial, inertial_stamps = self._inertial(int(stamps[-1]))
        sent = 0
        yield POSES, int(stamps[0]), self._pose(int(stamps[0]), T_world_sensor[0], quaternions[0])
        for i, scan in enumerate(scans):
            end = int(stamps[i + 1])
            while sent < len(inertial_stamps) and inertial_stamps[sent] <= end:
                stamp = int(inertial_stamps[sent])
                header = self.header(IMU, stamp, "imu")
                yield IMU, stamp, self.imu(header, inertial.gyro[sent], inertial.accel[sent])
                sent += 1
            yield POSES, end, self._pose(end, T_world_sensor[i + 1], quaternions[i + 1])
            yield POINTS, end, self._cloud(scan, end)

    def _inertial(self, end: int) -> tuple[Inertial, NDArray[np.int64]]:
        drive, rate = self._drive, self._drive.course.imu
        if rate is None:
            return Inertial(np.empty((0, 3)), np.empty((0, 3))), np.empty(0, np.int64)
        start = int(drive.stamps()[0])
        stamps = np.arange(start, end + 1, 10**9 // rate, dtype=np.int64)
        return measure(drive.ride, drive.seconds(stamps), rate, drive.course.seed), stamps

    def _pose(self, stamp: int, T: geometry.Poses, quaternion: NDArray[np.float64]) -> Any:
        t = self.types
        pose = t["geometry_msgs/msg/Pose"](
            position=t["geometry_msgs/msg/Point"](*T[:3, 3].tolist()),
            orientation=t["geometry_msgs/msg/Quaternion"](*quaternion.tolist()),
        )
        header = self.header(POSES, stamp, "map")
        return t["geometry_msgs/msg/PoseStamped"](header=header, pose=pose)

    def _cloud(self, scan: SimulatedScan, end: int) -> Any:
        at_end, cloud = self._drive.course.stamp == "end", structured(scan)
        if at_end:
            cloud["time"] -= np.float32((end - scan.stamp) * 1e-9)
        header = self.header(POINTS, end if at_end else scan.stamp, "velodyne")
        return self.cloud(header, cloud)


def _write_bag(
    drive: Drive,
    scans: Iterator[SimulatedScan],
    path: Path,
    version: Literal[1, 2],
    storage: StoragePlugin = StoragePlugin.SQLITE3,
) -> None:
    composer = _Composer(drive, version)
    composer.write(path, composer.topics, composer.messages(scans), storage)


def _write_mcap(drive: Drive, scans: Iterator[SimulatedScan], path: Path) -> None:
    with tempfile.TemporaryDirectory(prefix=f".{path.stem}.", dir=path.parent) as name:
        folder = Path(name) / "bag"
        _write_bag(drive, scans, folder, 2, StoragePlugin.MCAP)
        (file,) = folder.glob("*.mcap")
        file.replace(path)


def _write_kitti(drive: Drive, scans: Iterator[SimulatedScan], folder: Path) -> None:
    """Write sequence 00."""
    T_world_lidar: list[geometry.Poses] = []

    def seen() -> Iterator[Scan]:
        for scan in scans:
            T_world_lidar.append(scan.T_world_sensor)
            yield standing(drive, scan)

    write_kitti_sequence(seen(), folder, T_camera_lidar=T_CAMERA_LIDAR)
    write_kitti_poses(np.array(T_world_lidar), folder, T_camera_lidar=T_CAMERA_LIDAR)


def standing(drive: Drive, scan: SimulatedScan) -> Scan:
    """A scan as KITTI has it: undistorted to the scan's start, intensities from 0 to 1."""
    light = scan.intensities / np.float32(255.0)
    return Scan(scan.stamp, undistort(drive, scan), intensities=light)


def undistort(drive: Drive, scan: SimulatedScan) -> NDArray[np.float32]:
    """Points (n, 3) as if all had been measured at the scan's stamp, by the true motion."""
    assert scan.times is not None
    times, column = np.unique(scan.times, return_inverse=True)
    T_world_column = drive.ride.poses((scan.stamp - drive.stamps()[0]) * 1e-9 + times.astype(float))
    T = (geometry.invert(scan.T_world_sensor) @ T_world_column)[column]
    points = np.einsum("nij,nj->ni", T[:, :3, :3], scan.points) + T[:, :3, 3]
    return np.asarray(points, np.float32)
