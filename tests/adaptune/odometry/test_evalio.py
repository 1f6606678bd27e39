from dataclasses import replace

import numpy as np
import pytest
import turns
from needs import needs_evalio
from scipy.spatial.transform import Rotation

from adaptune.odometry import OdometryError
from adaptune.odometry.evalio import Loam, MadIcp, Pipeline
from adaptune.odometry.registry import odometry_class
from adaptune.recording import Scan

NAMES = ("ct_icp", "dlio", "evalio_kiss_icp", "form", "genz_icp", "lio_sam", "loam", "mad_icp")


@pytest.fixture(autouse=True)
def _evalio():
    needs_evalio()


class Listener:
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
    scan = turns.measured(0, turns.ROWS, turns.COLUMNS)
    odometry = odometry_class(name)()
    odometry.start(odometry.prepare(scan), np.eye(4))
    odometry._pipeline = Listener()
    odometry.register(odometry.prepare(scan))
    points = odometry._pipeline.given
    near = np.linalg.norm(scan.points, axis=1) >= 1.0
    ringed = hasattr(odometry.settings, "rows")
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
        R = Rotation.from_euler("z", turned).as_matrix().astype(np.float32)
        prepared = Loam().prepare(Scan(0, scan.points @ R.T, scan.times, scan.rings))
        assert prepared.shape == (turns.ROWS, turns.COLUMNS)
        assert len(prepared.cloud) == turns.ROWS * turns.COLUMNS
        filled = (prepared.cloud[:, 0] != 0).sum()
        assert filled > 0.98 * len(scan)


@pytest.mark.parametrize(
    ("lacking", "words", "names"),
    [
        ("rings", "record clouds with a `ring` field", ["loam", "form", "lio_sam"]),
        ("imu", "needs an IMU, and the scans do not bring along", ["dlio", "lio_sam"]),
        ("times", "record clouds with a time field", ["ct_icp"]),
    ],
)
def test_what_scans_must_hold(lacking, words, names):
    for name in names:
        with pytest.raises(OdometryError, match=words):
            odometry_class(name)().prepare(replace(turns.measured(0), **{lacking: None}))


def test_more_lasers_than_rows():
    settings = Loam.settings_type(rows=16)
    with pytest.raises(OdometryError, match=r"odometry\.settings\.rows: 16 rows .* number 31"):
        Loam(settings=settings).prepare(turns.turn(0))


def test_a_scan_without_times_among_others_with_them_keeps_the_last_motion():
    # It would end the process.
    odometry = odometry_class("evalio_kiss_icp")()
    odometry.start(odometry.prepare(turns.turn(0)), np.eye(4))
    odometry.register(odometry.prepare(turns.turn(1)))
    _, registered = odometry.register(odometry.prepare(Scan(0, turns.turn(2).points)))
    assert not registered


def test_parameters_that_are_not_tuned():
    settings = MadIcp.settings_type(parameters={"b_max": 1, "num_keyframes": 4})
    # An integer where a float is meant; and what is tuned comes before what is set.
    odometry = MadIcp({"num_keyframes": 2}, settings)
    odometry.start(odometry.prepare(turns.turn(0)), np.eye(4))
    assert odometry.register(odometry.prepare(turns.turn(1))).registered
    assert odometry.parameters["num_keyframes"] == 2


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"b_mx": 1.0}, r"parameters\.b_mx: mad has no such parameter; did you mean 'b_max'"),
        ({"num_keyframes": 2.5}, r"parameters\.num_keyframes: mad takes a value like 8, not 2\.5"),
    ],
)
def test_parameters_that_do_not_exist_or_fit(given, message):
    # Also before anything runs.
    for use in (MadIcp.describe, lambda settings: MadIcp(settings=settings)):
        with pytest.raises(OdometryError, match=message):
            use(MadIcp.settings_type(parameters=given))


@pytest.mark.parametrize("name", NAMES)
def test_what_is_tuned_is_the_pipelines_own(name):
    cls: type[Pipeline] = odometry_class(name)
    from evalio.pipelines import all_pipelines

    defaults = all_pipelines()[cls.pipeline].default_params()
    for parameter, value in cls.space.baseline.items():
        assert defaults[parameter] == value
        assert type(defaults[parameter]) is type(value)
    assert cls.untuned.keys() <= defaults.keys()
