import csv
import threading
from itertools import islice

import drives
import local_link
import numpy as np
import pytest
from rooms import moved, scan_at, street
from typer.testing import CliRunner

from adaptune.commands.cli import app
from adaptune.errors import warn_once
from adaptune.recording.scan import Scan
from adaptune.ros.link import LinkError
from online import watch
from online.watch import Watch, in_words, watch_topics

STEP = 0.15


def watched(wrong=lambda T, _: T, n=70):
    watch, told = Watch(length=5.0), []
    for i in range(n):
        scan = scan_at(street(), STEP * i, seed=i)
        told.append(watch.see(Scan(i * 10**8, scan.points), wrong(moved(STEP * i), i)))
    return [one for one in told if one is not None]


def test_nothing_speaks_against_what_is_right():
    told = watched()
    assert [one.state for one in told[2:]] == ["good"] * 5
    assert told[-1].high < 2.0
    assert in_words(told)[0].startswith("Nothing speaks against it in 6 s")


def test_what_stands_still_is_not_to_be_relied_on():
    told = watched(lambda _, i: moved(STEP * min(i, 30)))
    assert told[-1].state == "lost"
    first, *_ = in_words(told)
    assert first.startswith("Do not rely on it: it is lost for")
    assert "first at" in first


def test_one_that_begins_late_is_lost_and_then_good():
    told = watched(lambda T, i: T if i > 25 else np.full((4, 4), np.nan), n=90)
    assert (told[2].state, told[2].why) == ("lost", "no pose for 2.0 s")
    assert told[-1].state == "good"
    assert told[-1].restarts == 0


def test_a_lost_cloud_is_no_failure():
    told = watched(lambda T, i: T if i % 10 != 5 else np.full((4, 4), np.nan))
    assert [one.state for one in told[2:]] == ["good"] * 5
    assert told[-1].restarts == 0


@pytest.fixture
def bag(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    drives.write_bag(tmp_path / "a.bag", drives.scans(n_scans=40))
    return tmp_path / "a.bag"


def test_the_command_watches_along_a_bag(bag):
    result = CliRunner().invoke(app, ["watch", str(bag), "--odometry", "/truth"])
    assert result.exit_code == 0, result.output
    rows = list(csv.DictReader((bag.parent / "watch.csv").open()))
    assert rows[-1]["state"] == "good"
    assert float(rows[-1]["seconds"]) > 2.0


def test_what_was_told_is_kept_where_the_robot_goes_away(bag, monkeypatch):
    played = iter(drives.scans(4, 30))

    def messages():
        for stamp, points, T in played:
            yield "/odom", local_link.odometry(stamp, T)
            yield "/points", local_link.cloud(stamp, points)
        link.alive = False

    link = local_link.LocalLink(messages())
    link.close = lambda: None
    monkeypatch.setattr("adaptune.ros.ros2.local_ros2", lambda: link)
    monkeypatch.setattr("online.topics.SILENCE", 0.1)
    result = CliRunner().invoke(
        app, ["watch", "--ros2", "--points", "/points", "--odometry", "/odom"]
    )
    assert "adaptune's node in ROS has ended" in str(result.exception) + result.output
    assert list(csv.DictReader((bag.parent / "watch.csv").open()))


def test_ctrl_c_ends_it(bag, monkeypatch):
    def watched_until_interrupted(*_):
        yield from watched(n=41)
        raise KeyboardInterrupt

    link = local_link.LocalLink()
    monkeypatch.setattr("adaptune.ros.ros2.local_ros2", lambda: link)
    monkeypatch.setattr(watch, "watch_topics", watched_until_interrupted)
    words = ["watch", "--ros2", "--points", "/points", "--odometry", "/odom"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    assert "Nothing speaks against it in 4 s" in result.output
    assert len(list(csv.DictReader((bag.parent / "watch.csv").open()))) == 5


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--odometry", "/odom"], "name a bag, or listen on a robot"),
        (["a.bag", "--odometry", "/odom", "--ros2"], "name a bag, or listen on a robot"),
        (["a.bag", "--odometry", "/nobody"], "/nobody"),
        (["--ros2", "--odometry", "/odom"], "--points: name the topic"),
        (["a.bag", "--odometry", "/truth", "--sub-trajectory", "-3"], "more than 0"),
        (["--ros2", "--points", "/p", "--odometry", "my odom"], "--odometry my odom: "),
    ],
)
def test_what_is_wrong_is_told(bag, words, says):  # noqa: ARG001
    result = CliRunner().invoke(app, ["watch", *words])
    assert says in str(result.exception) + result.output


def test_a_node_on_a_robot_is_watched_and_told_as_diagnostics(monkeypatch):
    monkeypatch.setattr(watch, "PATIENCE", 60.0)
    monkeypatch.setattr(watch, "WAITING", 0)  # all may wait
    played = drives.scans(4, 30)

    def messages():
        for i, (stamp, points, T) in enumerate(played):
            still = played[min(i, 18)][2]  # it stands still in the end
            yield "/odom", local_link.odometry(stamp, still if i > 18 else T)
            yield "/points", local_link.cloud(stamp, points)

    link = local_link.LocalLink(messages())
    told = list(islice(watch_topics(link, "/points", "/odom", np.eye(4), 5.0), 3))
    assert [one.state for one in told[:2]] == ["unknown", "unknown"]
    first = link.published["/diagnostics"][0].status[0]
    assert (first.level, first.name) == (1, "adaptune: /odom")
    assert {pair.key for pair in first.values} >= {"state", "restarts"}
    assert not link.holds  # it sets no parameter


def test_poses_that_come_late_are_told_in_words_of_a_listener(monkeypatch, caplog):
    warn_once.cache_clear()
    monkeypatch.setattr(watch, "PATIENCE", 0.0)
    monkeypatch.setattr(watch, "WAITING", 0)
    monkeypatch.setattr("online.topics.SILENCE", 0.1)
    played = drives.scans(4, 30)

    def messages():
        for stamp, points, _ in played:
            yield "/points", local_link.cloud(stamp, points)
        finished.wait()
        for stamp, _, T in played:
            yield "/odom", local_link.odometry(stamp, T)
        link.alive = False

    finished, link = threading.Event(), local_link.LocalLink(messages())
    every = watch_topics(link, "/points", "/odom", np.eye(4), 5.0)
    *_, last = islice(every, 3)
    finished.set()
    with pytest.raises(LinkError):
        list(every)
    assert last.state == "lost"
    assert "come later than 0 s after their scans, and are not used" in caplog.text
    assert "patience" not in caplog.text
