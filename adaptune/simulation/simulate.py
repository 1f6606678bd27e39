"""Drive through a world and scan it."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune import open3d
from adaptune.geometry import Poses
from adaptune.sequence.scan import Scan
from adaptune.simulation import rays as kernels
from adaptune.simulation.course import Course
from adaptune.simulation.mesh import REFLECTIVITY, Mesh
from adaptune.simulation.motions import MOTIONS
from adaptune.simulation.movers import RADIUS, model, populate
from adaptune.simulation.ride import Ride
from adaptune.simulation.road import Road
from adaptune.simulation.scenes import scene
from adaptune.simulation.scenes.base import TILE
from adaptune.simulation.sensors import SENSORS, directions
from adaptune.simulation.weather import WEATHERS
from adaptune.simulation.world import World

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
        self.road = Road([(scene(name), length) for name, length in course.legs], course.seed)
        self.ride = Ride(self.road, MOTIONS[course.motion], course.seed)

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
        air = WEATHERS[course.weather]
        columns = course.columns or sensor.columns
        rings = np.tile(np.arange(sensor.rings, dtype=np.uint16), columns)
        offsets = np.arange(columns) / (columns * course.turns)
        times = np.repeat(offsets, sensor.rings).astype(np.float32)
        receiver = kernels.Receiver(*sensor.range, sensor.noise, sensor.dropout)
        caster = _Caster(self, sensor.range[1])
        for number, stamp in enumerate(self.stamps()[:-1].tolist()):
            start = (stamp - EPOCH) * 1e-9
            T_world_sensor = self.ride.poses(start + offsets)
            looks = directions(course.sensor, columns, start, course.turns)
            cast = caster.cast(looks, T_world_sensor, start + offsets)
            rng = np.random.default_rng([course.seed, 6, number])
            points, intensities, kept = kernels.receive(
                looks.reshape(-1, 3),
                cast,
                receiver,
                (air.extinction, air.backscatter, air.reach),
                rng.random((2, len(cast.rays)), np.float32),
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
        self._movers = populate(drive.road) if drive.course.moving_objects else []
        kinds = {mover.kind for mover in self._movers}
        self._models = {kind: _Target(model(kind), np.zeros(3)) for kind in kinds}

    def cast(
        self, looks: NDArray[np.float32], T_world_sensor: Poses, times: NDArray[np.float64]
    ) -> kernels.Cast:
        """Cast rays from each column's pose."""
        station = float(self._road.station(T_world_sensor[0, 0, 3]))
        tile = int(station // TILE)
        if tile != self._here:
            mesh = self._world.around((tile + 0.5) * TILE, self._sight * _DETOUR + TILE / 2.0)
            self._origin = T_world_sensor[0, :3, 3].copy()
            self._target = _Target(mesh, self._origin)
            self._here = tile
        rays = kernels.aim(looks, T_world_sensor, self._origin)
        hits, normals, reflectivity = self._target.cast(rays)
        for mover in self._movers:
            if abs(mover.middle - station) > mover.swing + self._sight:
                continue
            centres, yaw = mover.at(self._road, times)
            picked, local = kernels.towards(
                rays, looks.shape[1], centres - self._origin, yaw, RADIUS[mover.kind]
            )
            if not len(picked):
                continue
            nearer, turned, shine = self._models[mover.kind].cast(local)
            hit = nearer < hits[picked]
            picked, turned, heading = picked[hit], turned[hit], yaw[picked[hit] // looks.shape[1]]
            hits[picked], reflectivity[picked] = nearer[hit], shine[hit]
            cos, sin = np.cos(heading), np.sin(heading)
            normals[picked, 0] = cos * turned[:, 0] - sin * turned[:, 1]
            normals[picked, 1] = sin * turned[:, 0] + cos * turned[:, 1]
            normals[picked, 2] = turned[:, 2]
        return kernels.Cast(rays, hits, normals, reflectivity)


class _Target:
    """A mesh that rays can be cast at, relative to an origin."""

    def __init__(self, mesh: Mesh, origin: NDArray[np.float64]) -> None:
        o3d: Any = open3d.load()
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
