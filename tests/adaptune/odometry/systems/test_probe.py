"""What `inspect` says of a ROS system, by the poses that came from it."""

from adaptune.odometry.systems.probe import about_poses

TENTH = 10**8
SHOWN = [(2.0 + 0.1 * i, i * TENTH) for i in range(30)]
CAME = [(at + 0.02, stamp) for at, stamp in SHOWN]


def test_poses_before_the_first_scan_are_not_of_it():
    said = about_poses(CAME, SHOWN)
    early = about_poses([(0.0, 0), (1.9, 0), *CAME], SHOWN)
    assert early == {"poses before the first scan": "2"} | said
    assert said["first pose"] == "after 1 scans, 0.0 s"
    assert said["poses of a scan"] == "1.00 (30 of 30 scans have one)"
    assert said["lockstep"] == "yes"


def test_one_that_publishes_only_before_the_first_scan_is_told():
    said = about_poses([(0.0, 0)], SHOWN)
    assert said["poses before the first scan"] == "1"
    assert said["poses"] == "none"


def test_one_that_needs_some_scans_begins_late():
    said = about_poses([(1.0, 0), *CAME[10:]], SHOWN)
    assert said["first pose"] == "after 11 scans, 1.0 s"
    assert said["poses of a scan"] == "1.00 (20 of 20 scans have one)"
