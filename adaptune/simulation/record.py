"""Recordings of simulated courses: ROS bags and KITTI odometry folders."""

import heapq
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from adaptune import files, geometry
from adaptune.files import replacing, replacing_folder
from adaptune.geometry import Poses, invert
from adaptune.progress import Progress, unseen
from adaptune.recording.export import (
    T_CAMERA_LIDAR,
    Message,
    Messages,
    measurements,
    structured,
    write_kitti_poses,
    write_kitti_sequence,
)
from adaptune.recording.scan import Imu, Scan
from adaptune.report.charts import Axis, Chart, Cloud, Line, Panel
from adaptune.report.drawing import draw_chart
from adaptune.simulation import kernels
from adaptune.simulation.course import (
    IMU,
    MOTIONS,
    NOISE,
    POINTS,
    POSES,
    SENSORS,
    T_IMU_LIDAR,
    Course,
    SimulationError,
    directions,
)
from adaptune.simulation.mesh import REFLECTIVITY, Mesh
from adaptune.simulation.scenes import SCENES, TILE
from adaptune.simulation.world import Ride, Road, World
from adaptune.trajectory import Trajectory, write_tum

# Drive through a world and scan it.


EPOCH = 1_600_000_000_000_000_000
"""Nanoseconds at which every recording starts."""

_DETOUR = 1.2
"""Metres of road in a metre of sight, where it winds."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulatedScan(Scan):
    """A scan with intensities, rings and its true pose."""

    intensities: NDArray[np.float32]  # from 0 to 255
    rings: NDArray[np.uint16]
    T_world_sensor: Poses  # at the scan's stamp, of shape (4, 4)


class Drive:
    """A course with its road and the sensor's ride along it."""

    def __init__(self, course: Course) -> None:
        self.course = course
        self.road = Road([(SCENES[name], length) for name, length in course.legs], course.seed)
        self.ride = Ride(self.road, MOTIONS[course.motion], course.seed, course.stand)

    def __len__(self) -> int:
        """Whole scans in the drive."""
        return int(self.ride.duration * self.course.turns)

    def stamps(self) -> NDArray[np.int64]:
        """Borders of the scans in nanoseconds, one more than there are scans."""
        borders = np.arange(len(self) + 1) * (1e9 / self.course.turns)
        return np.asarray(EPOCH + np.rint(borders).astype(np.int64))

    def seconds(self, stamps: NDArray[np.int64]) -> NDArray[np.float64]:
        """Seconds since the start of stamps in nanoseconds."""
        return np.asarray((stamps - EPOCH) * 1e-9, np.float64)

    def scans(self) -> Iterator[SimulatedScan]:
        """Scan the world from one end of the drive to the other."""
        course, sensor = self.course, SENSORS[self.course.sensor]
        columns = course.columns or sensor.columns
        rings = np.tile(np.arange(sensor.rings, dtype=np.uint16), columns)
        offsets = np.arange(columns) / (columns * course.turns)
        times = np.repeat(offsets, sensor.rings).astype(np.float32)
        looks = directions(course.sensor, columns)
        receiver = kernels.Receiver(*sensor.range, sensor.noise, sensor.dropout)
        caster = _Caster(self, sensor.range[1])
        for number, stamp in enumerate(self.stamps()[:-1].tolist()):
            start = (stamp - EPOCH) * 1e-9
            T_world_sensor = self.ride.poses(start + offsets)
            cast = caster.cast(looks, T_world_sensor)
            rng = np.random.default_rng([course.seed, 6, number])
            # Two numbers for each ray, so that a seed gives the recording that it always gave.
            chance, _ = rng.random((2, len(cast.rays)), np.float32)
            points, intensities, kept = kernels.receive(
                looks.reshape(-1, 3),
                cast,
                receiver,
                chance,
                rng.standard_normal(len(cast.rays), np.float32),
            )
            yield SimulatedScan(
                stamp=stamp,
                points=points,
                times=times[kept],
                intensities=intensities,
                rings=rings[kept],
                T_world_sensor=T_world_sensor[0],
            )


class _Caster:
    """Casts rays into the world nearby, which it builds again for every tile."""

    def __init__(self, drive: Drive, sight: float) -> None:
        self._road, self._sight = drive.road, sight
        self._world = World(drive.road)
        self._here: int | None = None

    def cast(self, looks: NDArray[np.float32], T_world_sensor: Poses) -> kernels.Cast:
        """Cast rays from each column's pose."""
        station = float(self._road.station(T_world_sensor[0, 0, 3]))
        tile = int(station // TILE)
        if tile != self._here:
            mesh = self._world.around((tile + 0.5) * TILE, self._sight * _DETOUR + TILE / 2.0)
            self._origin = T_world_sensor[0, :3, 3].copy()
            self._target = _Target(mesh, self._origin)
            self._here = tile
        rays = kernels.aim(looks, T_world_sensor, self._origin)
        return kernels.Cast(rays, *self._target.cast(rays))


class _Target:
    """A mesh that rays can be cast at, relative to an origin."""

    def __init__(self, mesh: Mesh, origin: NDArray[np.float64]) -> None:
        o3d: Any = files.load()
        self._tensor = o3d.core.Tensor.from_numpy
        self._scene = o3d.t.geometry.RaycastingScene()
        vertices = np.ascontiguousarray(mesh.vertices - origin, np.float32)
        triangles = np.ascontiguousarray(mesh.triangles, np.uint32)
        self._scene.add_triangles(self._tensor(vertices), self._tensor(triangles))
        # The last one is for rays that hit nothing.
        self._reflectivity = np.append(REFLECTIVITY[mesh.materials], np.float32(0.0))

    def cast(
        self, rays: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Cast rays of shape (n, 6): metres to the hit, its normal and its reflectivity."""
        answer = self._scene.cast_rays(self._tensor(np.ascontiguousarray(rays)))
        triangles = np.minimum(answer["primitive_ids"].numpy(), len(self._reflectivity) - 1)
        hits, normals = answer["t_hit"].numpy(), answer["primitive_normals"].numpy()
        return hits, normals, self._reflectivity[triangles]


def simulate(course: Course) -> Iterator[SimulatedScan]:
    """Drive a course and scan it, one scan at a time; stamps always mark a scan's start."""
    return Drive(course).scans()


# Simulated measurements of an inertial measurement unit.


GRAVITY = 9.80665
"""m/s^2, downwards along the world's z axis."""


Inertial = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Angular velocities (rad/s) and specific forces (m/s^2) in the IMU's frame, of shape (n, 3).

The specific force points up at rest.
"""


def ideal(ride: Ride, times: NDArray[np.float64]) -> Inertial:
    """Measure without any error, at seconds since the recording's start, of shape (n,)."""
    T_lidar_imu = invert(T_IMU_LIDAR)
    R_lidar_imu, lever = T_lidar_imu[:3, :3], T_lidar_imu[:3, 3]
    R_world_lidar = ride.poses(times)[:, :3, :3]
    _, turn = ride.velocities(times)
    acceleration, turn_rate = ride.accelerations(times)
    # Rotation accelerates the IMU, which is not at the LiDAR's origin.
    round_ = np.cross(turn_rate, lever) + np.cross(turn, np.cross(turn, lever))
    force = acceleration + np.array([0.0, 0.0, GRAVITY])
    force = np.einsum("nji,nj->ni", R_world_lidar, force) + round_
    return turn @ R_lidar_imu, force @ R_lidar_imu


def measure(ride: Ride, times: NDArray[np.float64], rate: float, seed: int) -> Inertial:
    """Measure with biases that wander, and white noise, at times that are `rate` a second.

    `seed` is that of the errors; see `ideal`.
    """
    rng = np.random.default_rng([seed, 5])
    gyro, accel = ideal(ride, times)

    def error(start: float, walk: float, noise: float) -> NDArray[np.float64]:
        shape = (len(times), 3)
        bias = rng.normal(0.0, start, 3)
        bias = bias + np.cumsum(rng.normal(0.0, walk / np.sqrt(rate), shape), axis=0)
        return np.asarray(bias + rng.normal(0.0, noise * np.sqrt(rate), shape))

    gyro = gyro + error(2e-3, NOISE.gyroscope_walk, NOISE.gyroscope)
    return gyro, accel + error(2e-2, NOISE.accelerometer_walk, NOISE.accelerometer)


Layout = Literal["ros1", "ros2", "mcap", "kitti"]
"""ROS 1 bag, ROS 2 folder with sqlite3, one MCAP file, KITTI odometry folder."""

_GEOMETRY = ("Point", "Quaternion", "Pose", "PoseStamped")
_BY_SUFFIX: Mapping[str, Layout] = {".bag": "ros1", ".mcap": "mcap"}
_MARKS = {"ros2": "metadata.yaml", "kitti": "sequences"}
"""Marks of a recording's folder, which may be overwritten."""


def record(
    course: Course,
    path: Path,
    *,
    layout: Layout | None = None,
    overwrite: bool = False,
    progress: Progress = unseen,
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
        Notes every scan, under the recording's name.
    """
    path = Path(path)
    layout = layout or _BY_SUFFIX.get(path.suffix, "ros2")
    stem = path.name if layout in _MARKS else path.stem
    truth = path.with_name(f"{stem}.tum")
    previews = [path.with_name(f"{stem}{suffix}") for suffix in (".png", ".svg")]
    for file in (path, truth, *previews):
        _check(file, overwrite, _MARKS.get(layout) if file is path else None)
    drive = Drive(course)
    if not len(drive):
        raise SimulationError("the course is over before its first scan is: make it longer")
    with ExitStack() as stack:
        temporary_truth = stack.enter_context(replacing(truth))
        picture = Preview(drive)
        scans = picture.watched(progress, path.stem)
        new = stack.enter_context((replacing_folder if layout in _MARKS else replacing)(path))
        if layout == "kitti":
            _write_kitti(drive, scans, new)
        elif layout == "mcap":
            with tempfile.TemporaryDirectory(prefix=f".{path.stem}.", dir=path.parent) as name:
                _write_bag(drive, scans, Path(name) / "bag", 2, mcap=True)
                (file,) = Path(name).glob("bag/*.mcap")
                file.replace(new)
        else:
            # The writer makes the file itself.
            new.unlink(missing_ok=True)
            _write_bag(drive, scans, new, 1 if layout == "ros1" else 2)
        stamps = drive.stamps()
        write_tum(temporary_truth, Trajectory(stamps, drive.ride.poses(drive.seconds(stamps))))
        draw_chart(picture.chart(), *previews)


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


def _write_bag(
    drive: Drive,
    scans: Iterator[SimulatedScan],
    path: Path,
    version: Literal[1, 2],
    mcap: bool = False,
) -> None:
    ros = Messages(version)
    topics = {POINTS: "sensor_msgs/msg/PointCloud2", POSES: "geometry_msgs/msg/PoseStamped"}
    if drive.course.imu is not None:
        topics[IMU] = "sensor_msgs/msg/Imu"
    ros.write(path, topics, _messages(ros, drive, scans), mcap)


def _messages(ros: Messages, drive: Drive, scans: Iterator[SimulatedScan]) -> Iterator[Message]:
    """All messages in the order in which they are sent: a cloud when its scan is over."""
    stamps, course = drive.stamps(), drive.course
    T_world_sensor = drive.ride.poses(drive.seconds(stamps))
    quaternions = geometry.to_quaternions(T_world_sensor)
    types = {name: ros.types[f"geometry_msgs/msg/{name}"] for name in _GEOMETRY}

    def pose(i: int) -> Message:
        stamp = int(stamps[i])
        position = types["Point"](*T_world_sensor[i, :3, 3].tolist())
        orientation = types["Quaternion"](*quaternions[i].tolist())
        pose = types["Pose"](position=position, orientation=orientation)
        header = ros.header(POSES, stamp, "map")
        return POSES, stamp, types["PoseStamped"](header=header, pose=pose)

    def seen() -> Iterator[Message]:
        for i, scan in enumerate(scans):
            yield pose(i + 1)
            end, cloud = int(stamps[i + 1]), structured(scan)
            if at_end := course.stamp == "end":
                cloud["time"] -= np.float32((end - scan.stamp) * 1e-9)
            header = ros.header(POINTS, end if at_end else scan.stamp, "velodyne")
            yield POINTS, end, ros.cloud(header, cloud)

    inertial: Iterator[Message] = iter(())
    if course.imu is not None:
        at = np.arange(stamps[0], stamps[-1] + 1, 10**9 // course.imu, dtype=np.int64)
        measured = measure(drive.ride, drive.seconds(at), course.imu, course.seed)
        inertial = measurements(ros, Imu(at, *measured), IMU)
    yield pose(0)
    yield from heapq.merge(inertial, seen(), key=itemgetter(1))


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


# A picture of a simulated recording.


_MAP_SCANS, _MAP_POINTS = 150, 4000
"""Number of scans in the map, and points of each."""


class Preview:
    """The picture of a drive, whose content is collected scan by scan."""

    def __init__(self, drive: Drive) -> None:
        self._drive = drive
        self._map: list[NDArray[np.float64]] = []
        self._scan: SimulatedScan | None = None

    def watched(self, progress: Progress, name: str) -> Iterator[SimulatedScan]:
        """The scans of the drive; `progress` is told of each."""
        n = len(self._drive)
        for i, scan in enumerate(self._drive.scans()):
            if i % max(n // _MAP_SCANS, 1) == 0 and len(scan):
                T = scan.T_world_sensor
                points = scan.points[:: max(len(scan) // _MAP_POINTS, 1)]
                near = points[np.linalg.norm(points[:, :2], axis=1) < 45.0]
                # Height above the sensor, in its own upright frame.
                self._map.append(np.column_stack([near @ T[:2, :3].T + T[:2, 3], near @ T[2, :3]]))
            if i == n // 2:
                self._scan = scan
            yield scan
            progress(name, i + 1, n)

    def chart(self) -> Chart:
        """The map with the path, and the middle scan from above and as a panorama."""
        course, n = self._drive.course, len(self._drive)
        title = (
            f"{' - '.join(name for name, _ in course.legs)}, {course.sensor}, {course.motion}, "
            f"seed {course.seed}: {n} scans, {self._drive.road.length:.0f} m"
        )
        panels = [self._map_panel()]
        if self._scan is not None and len(self._scan):
            panels += _scan_panels(self._scan.points)
        return Chart("preview", title, tuple(panels))

    def _map_panel(self) -> Panel:
        points = np.concatenate(self._map) if self._map else np.empty((0, 3))
        x, y, z = points[np.argsort(points[:, 2], kind="stable")].T
        T = self._drive.ride.poses(np.linspace(0.0, self._drive.ride.duration, 2000))
        cloud = Cloud(x, y, z, "height above the sensor [m]", (-1.5, 4.0))
        drawn = cloud, Line(T[:, 0, 3], T[:, 1, 3], "path")
        title = "the recording from above"
        return Panel(Axis("x [m]"), Axis("y [m]"), drawn, title, equal=True, height=1.5)


def _scan_panels(points: NDArray[np.float32]) -> list[Panel]:
    away = np.linalg.norm(points, axis=1)
    span = float(np.percentile(np.abs(points[:, :2]).max(axis=1), 97))
    look: Any = {"colour_label": "range [m]", "colour_limits": (1.0, 80.0), "log_colour": True}
    x, y = (Axis(f"{name} [m]", limits=(-span, span)) for name in "xy")
    above = Cloud(points[:, 0], points[:, 1], away, **look)
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    elevation = np.degrees(np.arcsin(points[:, 2] / away))
    seen = Cloud(azimuth, elevation, away, **look, size=4)
    around = Axis("azimuth [deg]", limits=(180.0, -180.0))
    return [
        Panel(x, y, (above,), "one scan from above", equal=True, height=1.2),
        Panel(around, Axis("elevation [deg]"), (seen,), "the same scan as the sensor sees it"),
    ]
