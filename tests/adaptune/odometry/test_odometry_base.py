import numpy as np
import pytest
import turns
from needs import needs_evalio
from rooms import moved
from walker import Walker, at, x_on

from adaptune.odometry import OdometryError
from adaptune.odometry.base import InProcess
from adaptune.odometry.keyframe import KeyframeGicp, KeyframeNdt, KeyframeSettings, KeyframeVgicp
from adaptune.odometry.own_frame import END, MIDDLE, START, AtStamp, duration_of
from adaptune.odometry.prepared import PreparedScan
from adaptune.odometry.registry import odometry_class
from adaptune.recording.scan import Scan
from adaptune.space import Selection

TURN = 10**8


def carried(share, way, scans, T_previous_current=None):
    """What comes of exact poses along x, in metres, after that share of the scans."""
    carry = AtStamp(share)
    first, *others = scans
    begun = carry.begin(first * TURN, TURN, moved(way(first)), T_previous_current)
    offset = begun[0, 3] - way(first + share)
    poses = [carry(i * TURN, TURN, moved(way(i + share) + offset)) for i in others]
    return [T[0, 3] for T in poses]


@pytest.mark.parametrize("share", [START, MIDDLE, END])
@pytest.mark.parametrize("known", [True, False])
def test_at_constant_velocity_nothing_is_lost(share, known):
    motion = moved(0.3) if known else None
    scans = (0, 1, 2, 4, 5, 9)  # some are missing
    np.testing.assert_allclose(
        carried(share, lambda t: 0.3 * t, scans, motion), [0.3 * i for i in scans[1:]], atol=1e-9
    )


def test_a_pose_at_the_end_is_that_of_the_next_stamp():
    """Where scans follow each other without a gap, whatever the velocity."""
    found = np.array(carried(END, lambda t: t**3, range(8), moved(0.0)))
    np.testing.assert_allclose(np.diff(found)[1:], np.diff(np.arange(1, 8) ** 3)[1:])


def test_turns_are_carried_back_too():
    def turned(i):
        return moved(yaw=0.1 * i)

    carry = AtStamp(MIDDLE)
    carry.begin(0, TURN, np.eye(4), turned(1))
    np.testing.assert_allclose(carry(TURN, TURN, turned(1.5)), turned(1), atol=1e-9)


@pytest.mark.parametrize("faulty", [np.full((4, 4), np.nan), np.diag([2.0, 1, 1, 1]), np.eye(3)])
def test_a_faulty_pose_is_left_to_those_who_tell_of_it(faulty):
    carry = AtStamp(END)
    carry.begin(0, TURN, moved(0.0), moved(0.5))
    assert carry(TURN, TURN, faulty) is faulty
    np.testing.assert_allclose(carry(2 * TURN, TURN, moved(1.5)), moved(1.0), atol=1e-9)


def test_how_long_a_scan_takes_and_one_that_takes_no_time_stays():
    points = np.zeros((3, 3), np.float32)
    times = np.array([0.0, 0.05, 0.1], np.float32)
    assert duration_of(Scan(5, points, times=times)) == pytest.approx(TURN, abs=10)
    # Compensated scans have one time, others none.
    assert duration_of(Scan(5, points, times=0 * times)) == 0
    assert duration_of(Scan(5, points)) == 0
    assert duration_of(Scan(5, points[:0], times=times[:0])) == 0
    carry = AtStamp(END)
    np.testing.assert_array_equal(carry.begin(0, 0, moved(1.0), moved(0.5)), moved(1.0))
    np.testing.assert_array_equal(carry(TURN, 0, moved(1.5)), moved(1.5))


@pytest.mark.parametrize("name", ["kiss_icp", "genz_icp", "mad_icp", "form"])
def test_a_motion_is_that_between_stamps_while_the_sensor_gets_faster(name):
    if name != "kiss_icp":
        needs_evalio()
    odometry, gain, n = odometry_class(name)(), 0.02, 20
    scans = [turns.turn(i, gain=gain) for i in range(n)]
    odometry.start(odometry.prepare(scans[0]), np.eye(4))
    poses = [odometry.register(odometry.prepare(scan)).T_odom_sensor for scan in scans[1:]]
    # They begin at rest, so the first scans are deskewed wrongly.
    found = np.array(poses)[9:, 0, 3]
    true = turns.way(np.arange(float(n)), gain)[10:]
    # From scan 10 to 19, motions between ends are 0.18 m longer, between middles 0.09 m.
    assert abs((found[-1] - found[0]) - (true[-1] - true[0])) < 0.04


class Prepares(Walker):
    """Prepares scans by a parameter."""

    @property
    def preparation(self):
        return type(self), self.parameters["speed"]

    def prepare(self, scan):
        return [scan.stamp, self.parameters["speed"]]


def test_a_scan_is_prepared_once_for_all_that_are_alike():
    one, alike, other = (InProcess(Prepares({"speed": speed})) for speed in (1.0, 1.0, 2.0))
    shared = PreparedScan(at(3), {})
    assert shared.by(one) is shared.by(alike)
    assert shared.by(other) == [at(3).stamp, 2.0]
    assert shared.stamp == at(3).stamp


def test_gicp_and_vgicp_share_clouds_of_the_same_downsampling():
    fine = {"downsampling": 0.25}
    assert KeyframeGicp(fine).preparation == KeyframeVgicp(fine).preparation
    assert KeyframeGicp(fine).preparation != KeyframeGicp().preparation
    assert KeyframeGicp(fine).preparation != KeyframeNdt(fine).preparation
    near = KeyframeSettings(min_range=2.0)
    assert KeyframeGicp(fine).preparation != KeyframeGicp(fine, near).preparation
    # The number of iterations does not matter.
    assert KeyframeGicp({"iterations": 5}).preparation == KeyframeGicp().preparation


class Plain(Walker):
    """Returns a tuple of its own, and the same array every time."""

    def start(self, prepared, T_odom_sensor, T_previous_current=None):
        super().start(prepared, T_odom_sensor, T_previous_current)
        self.one = T_odom_sensor.copy()

    def register(self, prepared):
        self.one[:] = super().register(prepared).T_odom_sensor
        return self.one, True


def test_motions_chain_whatever_an_adapter_returns():
    odometry = InProcess(Plain({"speed": 2.0}))
    given = moved(0.5)
    odometry.start(odometry.prepare(at(0)), np.eye(4), given)
    assert odometry.motions.T_previous_current[0, 3] == 0.5
    for second in (1, 2, 3):
        registration = odometry.register(odometry.prepare(at(second)))
        assert registration.registered is True
        assert registration.T_odom_sensor[0, 3] == 2.0 * second
        assert odometry.motions.T_previous_current[0, 3] == 2.0
    assert odometry.motions.members == {}


def test_no_pose_is_no_motion():
    odometry = InProcess(Walker({}, {2: np.nan}))
    odometry.start(odometry.prepare(at(0)), np.eye(4))
    x_on(odometry, (1, 2))
    assert np.isnan(odometry.motions.T_previous_current[0, 3])
    odometry.start(odometry.prepare(at(2)), np.eye(4))
    np.testing.assert_array_equal(odometry.motions.T_previous_current, np.eye(4))


def test_other_parameters_of_an_adapter_that_is_not_live():
    odometry = InProcess(Walker({}))
    with pytest.raises(OdometryError, match=r"scans: set online\.switching\.mechanism to bank"):
        odometry.apply(Selection(0, {"speed": 2.0}))


@pytest.mark.parametrize("seconds", [-1.0, np.inf, np.nan])
def test_the_past_that_a_restart_needs_is_a_number_of_seconds(seconds):
    class Endless(Walker):
        warm_up = seconds

    with pytest.raises(OdometryError, match=r"Endless: warm_up is .*; give seconds, 0 or more"):
        Endless.describe(None)
