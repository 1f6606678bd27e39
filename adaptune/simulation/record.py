"""Recordings of simulated courses: ROS 1 bags with their ground truth."""

import heapq
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune import geometry
from adaptune._system import open3d
from adaptune._system.files import replacing, write_text
from adaptune._system.progress import Progress, unseen
from adaptune.geometry import Poses, invert
from adaptune.recording.export import Message, Messages, measurements, structured
from adaptune.recording.scan import Imu, Scan
from adaptune.simulation import kernels
from adaptune.simulation.course import (
    IMU,
    IMU_NOISE,
    MOTIONS,
    POINTS,
    POSES,
    SCENES,
    SENSORS,
    T_IMU_LIDAR,
    Course,
    SimulationError,
    directions,
)
from adaptune.simulation.mesh import REFLECTIVITY, Mesh
from adaptune.simulation.tiles import TILE
from adaptune.simulation.world import Ride, Road, World
from adaptune.trajectory import Trajectory, write_tum

EPOCH = 1_600_000_000_000_000_000  # nanoseconds at which every recording starts

_DETOUR = 1.2  # metres of road in a metre of sight, where it winds


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulatedScan(Scan):
    """A scan with its true pose; intensities are from 0 to 255."""

    T_world_sensor: Poses  # at the scan's stamp, of shape (4, 4)


class SimulatedDrive:
    """A course with its road and the sensor's ride along it."""

    def __init__(self, course: Course) -> None:
        self.course = course
        self.road = Road([(SCENES[name], length) for name, length in course.legs], course.seed)
        motion = MOTIONS[course.motion]
        self.ride = Ride(self.road, motion, course.seed, course.standstill)

    def __len__(self) -> int:
        """Turns of the sensor in the drive; `Course.stride` says which are kept."""
        return int(self.ride.duration * self.course.turns)

    def stamps(self) -> NDArray[np.int64]:
        """Borders of the turns in nanoseconds, one more than there are turns."""
        borders = np.arange(len(self) + 1) * (1e9 / self.course.turns)
        return np.asarray(EPOCH + np.rint(borders).astype(np.int64))

    def seconds(self, stamps: NDArray[np.int64]) -> NDArray[np.float64]:
        """Seconds since the start of stamps in nanoseconds."""
        return np.asarray((stamps - EPOCH) * 1e-9, np.float64)

    def scans(self) -> Iterator[SimulatedScan]:
        """Scan the world from one end of the drive to the other."""
        course, sensor = self.course, SENSORS[self.course.sensor]
        columns = course.firings
        looks = directions(course.sensor, columns)
        n_rings = looks.shape[1]
        rings = np.tile(np.arange(n_rings, dtype=np.uint16), columns)
        offsets = np.arange(columns) / (columns * course.turns)
        times = np.repeat(offsets, n_rings).astype(np.float32)
        receiver = (*sensor.range, sensor.noise, sensor.dropout)
        caster = _Caster(self, sensor.range[1])
        turns = list(enumerate(self.stamps()[:-1].tolist()))
        for number, stamp in turns[:: course.stride]:
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

    def __init__(self, drive: SimulatedDrive, sight: float) -> None:
        self._road, self._sight = drive.road, sight
        self._world = World(drive.road)
        self._here: int | None = None

    def cast(self, looks: NDArray[np.float32], T_world_sensor: Poses) -> kernels.Cast:
        """Cast rays from each column's pose."""
        station = float(self._road.station(T_world_sensor[0, 0, 3]))
        tile = int(station // TILE)
        if tile != self._here:
            mesh = self._world.around((tile + 0.5) * TILE, self._sight * _DETOUR + TILE / 2.0)
            self._build(mesh, T_world_sensor[0, :3, 3].copy())
            self._here = tile
        rays = kernels.aim(looks, T_world_sensor, self._origin)
        answer = self._scene.cast_rays(self._tensor(np.ascontiguousarray(rays)))
        triangles = np.minimum(answer["primitive_ids"].numpy(), len(self._reflectivity) - 1)
        hits, normals = answer["t_hit"].numpy(), answer["primitive_normals"].numpy()
        return kernels.Cast(rays, hits, normals, self._reflectivity[triangles])

    def _build(self, mesh: Mesh, origin: NDArray[np.float64]) -> None:
        """Build what rays are cast at, relative to an origin."""
        o3d: Any = open3d.load()
        self._tensor, self._origin = o3d.core.Tensor.from_numpy, origin
        self._scene = o3d.t.geometry.RaycastingScene()
        vertices = np.ascontiguousarray(mesh.vertices - origin, np.float32)
        triangles = np.ascontiguousarray(mesh.triangles, np.uint32)
        self._scene.add_triangles(self._tensor(vertices), self._tensor(triangles))
        # The last one is for rays that hit nothing.
        self._reflectivity = np.append(REFLECTIVITY[mesh.materials], np.float32(0.0))


def simulate(course: Course) -> Iterator[SimulatedScan]:
    """Drive a course and scan it, one scan at a time; stamps always mark a scan's start."""
    return SimulatedDrive(course).scans()


GRAVITY = 9.80665  # m/s^2, downwards along the world's z axis

Inertial = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Angular velocities (rad/s) and specific forces (m/s^2, up at rest) in the IMU's frame, (n, 3)."""


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
    """Measure as `ideal`, `rate` times a second, with wandering biases and white noise."""
    rng = np.random.default_rng([seed, 5])
    gyro, accel = ideal(ride, times)

    def error(start: float, walk: float, noise: float) -> NDArray[np.float64]:
        shape = (len(times), 3)
        bias = rng.normal(0.0, start, 3)
        bias = bias + np.cumsum(rng.normal(0.0, walk / np.sqrt(rate), shape), axis=0)
        return np.asarray(bias + rng.normal(0.0, noise * np.sqrt(rate), shape))

    gyro = gyro + error(2e-3, IMU_NOISE.gyroscope_walk, IMU_NOISE.gyroscope)
    return gyro, accel + error(2e-2, IMU_NOISE.accelerometer_walk, IMU_NOISE.accelerometer)


_GEOMETRY = ("Point", "Quaternion", "Pose", "PoseStamped")


def record(
    course: Course, path: Path, *, overwrite: bool = False, progress: Progress = unseen
) -> None:
    """Simulate a course and write a ROS 1 bag; beside it its ground truth (TUM), and the course.

    All are written whole or not at all; `overwrite` replaces files that are there. `progress` notes
    every scan, under the bag's name.
    """
    truth, about = path.with_suffix(".tum"), path.with_suffix(".json")
    for file in (path, truth, about):
        if file.exists() and not overwrite:
            raise SimulationError(f"{file} exists already; give --overwrite to replace it")
    drive = SimulatedDrive(course)
    if not len(drive):
        raise SimulationError("the course is over before its first scan is: make it longer")
    ros = Messages(1)
    topics = {POINTS: "sensor_msgs/msg/PointCloud2", POSES: "geometry_msgs/msg/PoseStamped"}
    if course.imu is not None:
        topics[IMU] = "sensor_msgs/msg/Imu"
    with replacing(truth) as new_truth, replacing(path) as new:
        # The writer makes the file itself.
        new.unlink(missing_ok=True)
        ros.write(new, topics, _messages(ros, drive, partial(progress, path.stem)))
        stamps = drive.stamps()
        write_tum(new_truth, Trajectory(stamps, drive.ride.poses(drive.seconds(stamps))))
    # Written last: beside an older bag, it would hide that this is of another course.
    write_text(about, json.dumps(course.recorded()) + "\n")


def _messages(
    ros: Messages, drive: SimulatedDrive, progress: Callable[[int, int], None]
) -> Iterator[Message]:
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
        scans = drive.scans()
        for i in range(len(drive)):
            yield pose(i + 1)
            if i % course.stride:
                continue
            scan, end = next(scans), int(stamps[i + 1])
            cloud = structured(scan)
            if at_end := course.stamp == "end":
                cloud["time"] -= np.float32((end - scan.stamp) * 1e-9)
            header = ros.header(POINTS, end if at_end else scan.stamp, "velodyne")
            yield POINTS, end, ros.cloud(header, cloud)
            progress(i + 1, len(drive))

    inertial: Iterator[Message] = iter(())
    if course.imu is not None:
        at = np.arange(stamps[0], stamps[-1] + 1, 10**9 // course.imu, dtype=np.int64)
        measured = measure(drive.ride, drive.seconds(at), course.imu, course.seed)
        inertial = measurements(ros, Imu(at, *measured), IMU)
    yield pose(0)
    yield from heapq.merge(inertial, seen(), key=itemgetter(1))
