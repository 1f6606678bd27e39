import itertools

import numpy as np
import pytest

from adaptune._system import open3d
from adaptune.metrics import sub_trajectory_rte
from adaptune.odometry.registry import odometry_class
from adaptune.simulation import SCENES, SENSORS, Course
from adaptune.simulation.mesh import fractal
from adaptune.simulation.record import EPOCH, SimulatedDrive, simulate
from adaptune.simulation.world import World


def course(*scenes, **given):
    defaults = {"length": 12.0, "sensor": "vlp16", "columns": 300}
    return Course.model_validate({"scenes": scenes, **defaults, **given})


def some(course, n):
    return list(itertools.islice(simulate(course), n))


def surface(drive, station, reach):
    """Scene in which the distance to the world's surface can be asked for."""
    o3d = open3d.load()
    mesh = World(drive.road).around(station, reach)
    scene = o3d.t.geometry.RaycastingScene()
    tensor = o3d.core.Tensor.from_numpy
    scene.add_triangles(tensor(mesh.vertices.astype(np.float32)), tensor(mesh.triangles.copy()))
    return lambda points: scene.compute_distance(tensor(points.astype(np.float32))).numpy()


def test_the_same_seed_gives_the_same_bytes():
    given = course("street", "garden", seed=5)
    for a, b in zip(some(given, 6), some(given, 6), strict=True):
        assert a.stamp == b.stamp
        for name in ("points", "times", "intensities", "rings", "T_world_sensor"):
            assert getattr(a, name).tobytes() == getattr(b, name).tobytes(), name
    other = some(given.model_copy(update={"seed": 6}), 1)[0]
    assert other.points.tobytes() != some(given, 1)[0].points.tobytes()


def test_scans_say_what_they_hold():
    given = course("street", rate=20.0)
    scans = list(simulate(given))
    assert len(scans) == len(SimulatedDrive(given))
    for number, scan in enumerate(scans):
        assert scan.stamp == EPOCH + number * 50_000_000
        n = len(scan)
        assert n > 1000
        assert scan.points.shape == (n, 3)
        assert scan.points.dtype == scan.times.dtype == scan.intensities.dtype == np.float32
        assert scan.rings.dtype == np.uint16
        assert np.isfinite(scan.points).all()
        assert np.all(np.diff(scan.times) >= 0.0)
        assert 0.0 <= scan.times[0] <= scan.times[-1] < 0.05
        assert scan.intensities.min() >= 0.0
        assert scan.intensities.max() <= 255.0
        elevation = np.arcsin(scan.points[:, 2] / np.linalg.norm(scan.points, axis=1))
        np.testing.assert_allclose(elevation, SENSORS["vlp16"].elevations[scan.rings], atol=1e-5)


def test_every_column_is_seen_from_its_own_pose():
    drive = SimulatedDrive(course("street", motion="car"))
    to_surface = surface(drive, 0.0, 150.0)
    *_, scan = itertools.islice(drive.scans(), 4)
    T = drive.ride.poses((scan.stamp - EPOCH) * 1e-9 + scan.times)
    points = scan.points.astype(float)
    moving = np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]
    still = points @ scan.T_world_sensor[:3, :3].T + scan.T_world_sensor[:3, 3]
    # Range noise is 15 mm; the car moves a metre during the scan.
    assert np.quantile(to_surface(moving), 0.999) < 0.06
    assert np.quantile(to_surface(still), 0.9) > 0.15


@pytest.mark.parametrize("name", SENSORS)
def test_every_sensor_scans(name):
    scan = some(Course(scenes=("corridor",), length=12.0, sensor=name), 1)[0]
    sensor = SENSORS[name]
    away = np.linalg.norm(scan.points, axis=1)
    assert len(scan) > 0.6 * len(sensor.elevations) * sensor.columns
    assert away.min() > sensor.range[0] - 0.1
    assert away.max() < sensor.range[1] + 0.1
    assert set(scan.rings.tolist()) == set(range(len(sensor.elevations)))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_robot_can_drive_through_every_scene_into_every_other(seed):
    # Every ordered pair of scenes once.
    names = list(SCENES)
    order = [names[0]]
    for step in range(1, len(names)):
        i = 0
        for _ in range(len(names)):
            i = (i + step) % len(names)
            order.append(names[i])
    drive = SimulatedDrive(Course(scenes=tuple(order), length=15.0, seed=seed))
    to_surface = surface(drive, drive.road.length / 2.0, drive.road.length)
    t = np.arange(0.0, drive.ride.duration, 0.1)
    T = drive.ride.poses(t)
    clearance = to_surface(T[:, :3, 3])
    worst = int(np.argmin(clearance))
    station = float(drive.road.station(T[worst, 0, 3]))
    leg = next(leg for leg in drive.road.legs if leg.start <= station <= leg.stop)
    assert clearance[worst] > 0.35, (station, leg.scene)


@pytest.mark.parametrize("scene", SCENES)
def test_odometry_survives(scene):
    cls = odometry_class("gicp")
    odometry = cls({"max_correspondence_distance": 1.5, "keyframe_interval": 3.0})
    T_world_sensor, poses = [], []
    for scan in simulate(Course(scenes=(scene,), length=26.0, columns=300)):
        prepared = odometry.prepare(scan)
        if poses:
            poses.append(odometry.register(prepared).T_odom_sensor)
        else:
            odometry.start(prepared, scan.T_world_sensor)
            poses.append(scan.T_world_sensor)
        T_world_sensor.append(scan.T_world_sensor)
    errors = sub_trajectory_rte(np.array(T_world_sensor), np.array(poses), 25.0)
    assert np.nanmean(errors) < 4.0


@pytest.mark.parametrize("scene", SCENES)
def test_the_last_tile_of_a_scene_may_be_short(scene):
    scan = next(simulate(Course(scenes=(scene, "cave"), length=22.0, columns=16)))
    assert len(scan) > 100


RNG = np.random.default_rng(0)


def test_noise_is_bounded_smooth_and_centred():
    points = RNG.uniform(-1e3, 1e3, (20_000, 3))
    values = fractal(points, 3.0, seed=5)
    assert np.abs(values).max() <= 1.0
    assert abs(values.mean()) < 0.02
    assert values.std() > 0.2
    assert np.abs(fractal(points + 1e-4, 3.0, seed=5) - values).max() < 1e-3


def test_noise_depends_on_place_and_seed_alone():
    points = RNG.uniform(-50.0, 50.0, (100, 3))
    whole = fractal(points, 2.0, seed=1, octaves=3)
    np.testing.assert_array_equal(fractal(points[40:60], 2.0, seed=1, octaves=3), whole[40:60])
    assert np.abs(fractal(points, 2.0, seed=2, octaves=3) - whole).max() > 0.1
