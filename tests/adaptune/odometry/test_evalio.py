from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import turns
from needs import lacking

from adaptune.geometry import invert
from adaptune.odometry import Isolated, Limits, OdometryError, box_class
from adaptune.odometry.evalio import GRAVITY, Loam, MadIcp, Pipeline
from adaptune.sequence import Imu, Scan

try:
    import evalio  # noqa: F401
except ImportError:
    have_evalio = False
else:
    have_evalio = True

NAMES = ("ct_icp", "dlio", "evalio_kiss_icp", "form", "genz_icp", "lio_sam", "loam", "mad_icp")
INERTIAL = ("dlio", "lio_sam")
T_SENSOR_IMU = np.array([[0.0, 1, 0, 0.3], [-1, 0, 0, -0.2], [0, 0, 1, 0.1], [0, 0, 0, 1]])


@pytest.fixture(autouse=True)
def _evalio():
    if not have_evalio:
        lacking("evalio", "evalio is not installed: pip install 'adaptune[evalio]'")


def turn(i, rows=16, columns=300):
    """Scan `i`, with what an IMU measured that lies turned beside the LiDAR."""
    scan = turns.turn(i, rows, columns)
    stamps = np.arange(i * 10**8 + (0 if i == 0 else 10**7), (i + 1) * 10**8 + 1, 10**7)
    noise = np.random.default_rng(i).normal(0.0, 1e-3, (2, len(stamps), 3))
    return replace(scan, imu=Imu(stamps, noise[0], noise[1] + [0.0, 0.0, GRAVITY], T_SENSOR_IMU))


class Listener:
    """A pipeline that keeps what it is given."""

    def __init__(self):
        self.given = []

    def add_lidar(self, given):
        self.given += given.points

    def add_imu(self, measured):
        pass

    def saved_estimates(self):
        return []


@pytest.mark.parametrize("name", NAMES)
def test_what_evalio_receives_is_the_scan(name):
    scan = turn(0, turns.ROWS, turns.COLUMNS)
    box = box_class(name)()
    box.start(box.prepare(scan), np.eye(4))
    box._pipeline = Listener()
    box.register(box.prepare(scan))
    points = box._pipeline.given
    near = np.linalg.norm(scan.points, axis=1) >= 1.0
    ringed = hasattr(box.settings, "rows")
    sent = {
        (np.float32(p.x), np.float32(p.y), np.float32(p.z), round(p.t.nsec / 1e5), p.row)
        for p in points
        if p.x or p.y or p.z
    }
    expected = {
        (*xyz, round(t * 1e4), ring * ringed)
        for xyz, t, ring in zip(
            scan.points[near], scan.times[near].tolist(), scan.rings[near].tolist(), strict=True
        )
    }
    assert len(sent ^ expected) < 0.01 * len(expected)


def test_images_are_complete_whatever_the_phase_of_the_firings():
    scan = turns.turn(0)
    for angle in (0.0, 0.25, 0.5, 0.8):
        turned = angle * 2 * np.pi / turns.COLUMNS
        R = np.array(
            [
                [np.cos(turned), -np.sin(turned), 0],
                [np.sin(turned), np.cos(turned), 0],
                [0, 0, 1],
            ],
            np.float32,
        )
        prepared = Loam().prepare(Scan(0, scan.points @ R.T, scan.times, scan.rings))
        assert prepared.shape == (turns.ROWS, turns.COLUMNS)
        assert len(prepared.cloud) == turns.ROWS * turns.COLUMNS
        filled = (prepared.cloud[:, 0] != 0).sum()
        assert filled > 0.98 * len(scan)


@pytest.mark.parametrize("name", ["loam", "form", "lio_sam"])
def test_images_need_the_lasers(name):
    with pytest.raises(OdometryError, match="record clouds with a `ring` field"):
        box_class(name)().prepare(replace(turn(0), rings=None))


@pytest.mark.parametrize("name", INERTIAL)
def test_some_need_an_imu(name):
    with pytest.raises(OdometryError, match="needs an IMU, and the scans do not bring along"):
        box_class(name)().prepare(turns.turn(0))


def test_more_lasers_than_rows():
    settings = Loam.settings_type(rows=16)
    with pytest.raises(OdometryError, match=r"odometry\.settings\.rows: 16 rows .* number 31"):
        Loam(settings=settings).prepare(turns.turn(0))


def test_an_image_of_another_size_does_not_reach_the_pipeline():
    box, wide = Loam(), Loam(settings=Loam.settings_type(columns=512))
    box.start(box.prepare(turns.turn(0)), np.eye(4))
    with pytest.raises(OdometryError, match="began with scans of 32 x 450"):
        box.register(wide.prepare(turns.turn(1)))


def test_ct_icp_needs_times():
    with pytest.raises(OdometryError, match="record clouds with a time field"):
        box_class("ct_icp")().prepare(Scan(0, turns.turn(0).points))


def test_a_scan_without_times_among_others_with_them_keeps_the_last_motion():
    # It would end the process.
    box = box_class("evalio_kiss_icp")()
    box.start(box.prepare(turns.turn(0)), np.eye(4))
    box.register(box.prepare(turns.turn(1)))
    _, registered = box.register(box.prepare(Scan(0, turns.turn(2).points)))
    assert not registered


def test_parameters_that_are_not_tuned():
    settings = MadIcp.settings_type(parameters={"b_max": 1, "num_keyframes": 4})
    # An integer where a float is meant; and what is tuned comes before what is set.
    box = MadIcp({"num_keyframes": 2}, settings)
    box.start(box.prepare(turns.turn(0)), np.eye(4))
    assert box.register(box.prepare(turns.turn(1))).registered
    assert box.parameters["num_keyframes"] == 2


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"b_mx": 1.0}, r"parameters\.b_mx: mad has no such parameter; did you mean 'b_max'"),
        ({"num_keyframes": 2.5}, r"parameters\.num_keyframes: mad takes a value like 8, not 2\.5"),
        ({"realtime": 1}, "takes a value like True, not 1"),
    ],
)
def test_parameters_that_do_not_exist_or_fit(given, message):
    with pytest.raises(OdometryError, match=message):
        MadIcp(settings=MadIcp.settings_type(parameters=given))


@pytest.mark.parametrize("name", NAMES)
def test_what_is_tuned_is_the_pipelines_own(name):
    cls: type[Pipeline] = box_class(name)
    from evalio.pipelines import all_pipelines

    defaults = all_pipelines()[cls.pipeline].default_params()
    for parameter, value in cls.space.baseline.items():
        assert defaults[parameter] == value
        assert type(defaults[parameter]) is type(value)
    assert cls.untuned.keys() <= defaults.keys()


N_SCANS = 8
# Metres along x after eight scans: some need a few scans to know their speed.
TOLERANCE = {"ct_icp": 0.1, "form": 0.1, "loam": 0.1, "dlio": 0.8, "lio_sam": 0.2}


def isolated(name, parameters=None):
    return Isolated(name, parameters or {}, box_class(name).settings_type(), Limits(seconds=60.0))


def drive(box, T_odom_sensor=None, n=N_SCANS):
    """Start with the first scan and register the others; poses of shape (n, 4, 4)."""
    T = np.eye(4) if T_odom_sensor is None else T_odom_sensor
    moved = np.eye(4)
    moved[0, 3] = turns.STEP
    # LIO-SAM waits for two scans more before its first pose.
    box.start(box.prepare(turn(0)), T, moved if box.name == "lio_sam" else None)
    return np.array([T, *(box.register(box.prepare(turn(i))).T_odom_sensor for i in range(1, n))])


@cache
def usual_drive(name):
    return drive(isolated(name))


@pytest.mark.parametrize("name", NAMES)
def test_straight_ahead_is_along_x(name):
    T = usual_drive(name)
    tolerance = TOLERANCE.get(name, 0.3)
    np.testing.assert_allclose(T[-1, 0, 3], turns.STEP * (N_SCANS - 1), atol=tolerance)
    np.testing.assert_allclose(T[:, 1:3, 3], 0.0, atol=0.1)
    np.testing.assert_allclose(T[:, :3, :3], np.tile(np.eye(3), (N_SCANS, 1, 1)), atol=0.03)


# DLIO builds its local map in a thread of its own, and takes what there is of it when a scan comes.
REPEATS = {"dlio": 0.02}


@pytest.mark.parametrize("name", NAMES)
def test_a_new_start_is_fresh_and_the_same_to_the_last_bit(name):
    box = isolated(name)
    drive(box, n=3)
    np.testing.assert_allclose(drive(box), usual_drive(name), rtol=0.0, atol=REPEATS.get(name, 0.0))


@pytest.mark.parametrize("name", NAMES)
def test_where_it_starts_does_not_matter(name):
    T = np.eye(4)
    T[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    T[:3, 3] = 20.0, -30.0, 4.0
    np.testing.assert_allclose(
        invert(T) @ drive(isolated(name), T), usual_drive(name), atol=REPEATS.get(name, 1e-9)
    )


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("poor", ["empty", "few", "NaN"])
def test_a_poor_scan_keeps_the_last_motion(name, poor):
    box = isolated(name)
    T_before, T = drive(box, n=4)[-2:]
    points, times, rings = (a.copy() for a in (turn(4).points, turn(4).times, turn(4).rings))
    if poor == "NaN":
        points[:] = np.nan
    n = {"empty": 0, "few": 15, "NaN": None}[poor]
    scan = Scan(turn(4).stamp, points[:n], times[:n], rings[:n], turn(4).imu)
    T_next, registered = box.register(box.prepare(scan))
    assert not registered
    np.testing.assert_allclose(T_next, T @ invert(T_before) @ T, atol=1e-6)
    assert box.register(box.prepare(turn(5))).registered
    assert not box.faults


def test_a_poor_first_scan():
    box = isolated("mad_icp")
    T, T_previous_current = np.eye(4), np.eye(4)
    T[1, 3], T_previous_current[0, 3] = 5.0, 0.3
    few = Scan(0, turn(0).points[:10], turn(0).times[:10], turn(0).rings[:10])
    box.start(box.prepare(few), T, T_previous_current)
    T_next, registered = box.register(box.prepare(turn(1)))
    assert registered
    np.testing.assert_allclose(T_next, T @ T_previous_current, atol=1e-12)
    T_next, _ = box.register(box.prepare(turn(2)))
    assert T_next[0, 3] > 0.5


LATE = {
    # CT-ICP begins with others for 20 scans; FORM has no key scans to leave out so soon.
    "ct_icp": {"voxel_size", "sample_voxel_size"},
    # There are no more keyframes yet than these take.
    "dlio": {"submap_knn"},
    "lio_sam": {"surroundingkeyframeAddingDistThreshold", "surroundingKeyframeSearchRadius"},
    "form": {"keyscan_match_ratio", "max_num_keyscans"},
}


def parameter_cases():
    return [
        (name, parameter)
        for name in NAMES
        for parameter in box_class(name).space.names
        if parameter not in LATE.get(name, ())
    ]


@pytest.mark.parametrize(("name", "parameter"), parameter_cases())
def test_every_parameter_takes_effect(name, parameter):
    space = box_class(name).space
    usual = usual_drive(name)
    changed = (
        drive(isolated(name, {parameter: space.parameters[parameter].from_unit(u)}))
        for u in (0.0, 1.0)
    )
    assert any(np.abs(poses - usual).max() > 1e-9 for poses in changed)
