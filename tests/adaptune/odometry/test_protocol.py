"""Every kind of `OdometryInstance` goes through the whole protocol."""

import numpy as np
import pytest
from street import N_SCANS, drive, make, scan

from adaptune.bank.bank import Bank
from adaptune.geometry import invert
from adaptune.odometry import OdometryError
from adaptune.odometry.base import InProcess, OdometryInstance, Usage
from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.keyframe import KeyframeGicp, KeyframeSettings
from adaptune.odometry.remote import Isolated, Limits
from adaptune.space import Selection

BASELINE = KeyframeGicp.space.baseline
OTHER = {"max_correspondence_distance": 1.0, "keyframe_interval": 1.0}
FACTORY = OdometryFactory("gicp", {}, KeyframeGicp.space, Limits(seconds=60.0))


def gicp(parameters=None):
    return InProcess(KeyframeGicp(parameters))


def isolated(parameters=None):
    return Isolated("gicp", parameters or {}, KeyframeSettings(), Limits(seconds=60.0))


KINDS = {
    "odometry": gicp,
    "isolated": isolated,
    "process": lambda: make("process"),
    "command": lambda: make("command"),
    "bank": lambda: Bank(gicp, {4: BASELINE, 9: OTHER}, 3.0),
    "bank, isolated": lambda: Bank(isolated, {4: BASELINE, 9: OTHER}, 3.0),
    "bank, two cores": lambda: Bank(FACTORY, {4: BASELINE, 9: OTHER}, 3.0, cores=2),
}
ELSEWHERE = {"isolated", "process", "bank, isolated", "bank, two cores"}
every_kind = pytest.mark.parametrize("kind", KINDS)


def prepared_by(odometry: OdometryInstance):
    return [odometry.prepare(scan(i)) for i in range(N_SCANS)]


@every_kind
def test_submit_and_collect_are_register(kind):
    one, other = KINDS[kind](), KINDS[kind]()
    expected = drive(one, prepared_by(one))
    prepared = prepared_by(other)
    other.start(prepared[0], np.eye(4))
    for i in range(1, N_SCANS):
        other.submit(prepared[i])
        np.testing.assert_array_equal(other.collect().T_odom_sensor, expected[i])
        np.testing.assert_array_equal(
            other.motions.T_previous_current, invert(expected[i - 1]) @ expected[i]
        )


@every_kind
def test_motions_chain_to_the_poses(kind):
    odometry = KINDS[kind]()
    prepared = prepared_by(odometry)
    given, T = np.eye(4), np.eye(4)
    given[0, 3], T[1, 3] = 0.4, 5.0
    odometry.start(prepared[0], T, given)
    # There is no motion yet but the one given.
    np.testing.assert_array_equal(odometry.motions.T_previous_current, given)
    for one in prepared[1:]:
        pose = odometry.register(one).T_odom_sensor
        T = T @ odometry.motions.T_previous_current
        np.testing.assert_allclose(T, pose, atol=1e-9)
    members = odometry.motions.members
    assert list(members) == ([4, 9] if "bank" in kind else [])
    for motion in members.values():
        assert motion[0, 3] == pytest.approx(0.4, abs=0.1)
    odometry.start(prepared[0], T)
    for motion in (odometry.motions[0], *odometry.motions[1].values()):
        np.testing.assert_array_equal(motion, np.eye(4))


@every_kind
def test_usage_grows_and_faults_are_none(kind):
    odometry = KINDS[kind]()
    assert odometry.usage.cpu == 0.0
    prepared = prepared_by(odometry)
    drive(odometry, prepared[:4])
    before = odometry.usage
    for one in prepared[4:]:
        odometry.register(one)
    after = odometry.usage
    assert isinstance(after, Usage)
    assert before.cpu > 0.0
    # A program has run before its first pose is known.
    assert before.cpu == after.cpu if kind == "command" else before.cpu < after.cpu
    assert (after.memory is None) == (kind not in (*ELSEWHERE, "command"))
    assert after.memory is None or after.memory > 10.0
    assert list(odometry.faults) == []


@every_kind
def test_it_applies_a_selection_between_scans(kind):
    odometry, usual = KINDS[kind](), KINDS[kind]()
    prepared = prepared_by(odometry)
    expected = drive(usual, prepared_by(usual))
    poses = drive(odometry, prepared[:6])
    if kind == "command":
        with pytest.raises(OdometryError, match="cannot change its parameters"):
            odometry.apply(Selection(9, OTHER))
        return
    odometry.apply(Selection(9, OTHER))
    after = np.array([odometry.register(one).T_odom_sensor for one in prepared[6:]])
    np.testing.assert_array_equal(poses, expected[:6])
    assert np.abs(after - expected[6:]).max() > 1e-5
    np.testing.assert_allclose(after[:, 0, 3], expected[6:, 0, 3], atol=0.1)


@every_kind
def test_it_begins_again_after_it_was_closed(kind):
    odometry = KINDS[kind]()
    odometry.close()
    expected = drive(odometry, prepared_by(odometry))
    used = odometry.usage.cpu
    odometry.close()
    odometry.close()
    assert odometry.usage.cpu == used
    # A hand-over has no parameters but those it has; its second start is like the first.
    np.testing.assert_allclose(drive(odometry, prepared_by(odometry)), expected, atol=1e-6)
    assert odometry.usage.cpu == used if kind == "command" else odometry.usage.cpu > used
