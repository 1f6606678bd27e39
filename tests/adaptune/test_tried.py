import numpy as np
import pytest
from contained import VALUES, recording, template
from needs import reference_image
from rosbags.highlevel import AnyReader

from adaptune.odometry import OdometryError
from adaptune.odometry.docker.rustle import RustleSettings
from adaptune.progress import unseen
from adaptune.study import tried
from adaptune.study.tried import Tried, first_seconds, try_system
from offline.config import load_study

AT = np.arange(10, dtype=np.int64) * 10**8
OWN = {"points": "/velodyne", "imu": None}


def found(play, fault=None, late=0, start=3.0, lag=None):
    return Tried(play, fault, start, len(AT), AT + late, AT, lag, 0.5)


def settings(**given):
    return RustleSettings(image="x", template="p.yaml", odometry="/o", **given)


@pytest.mark.parametrize(
    ("bag", "lockstep", "written"),
    [
        ({}, {}, "it can adapt:\n    play: lockstep\n    points: /velodyne"),
        ({}, {"fault": "no"}, "lockstep does not fit:\n    play: bag"),
        ({"fault": "no"}, {"lag": 1.5}, "points: /velodyne\n    patience: 7.5"),
        ({}, {"fault": "no"} | {"start": 60.0}, "play: bag"),
        ({"start": 40.0}, {"fault": "no"}, "play: bag\n    ready: 120"),
        ({"late": AT}, {"fault": "no"}, "play: bag\n    use_sim_time: true"),
    ],
)
def test_the_decision_and_the_settings_that_follow(bag, lockstep, written):
    given = found("bag", **bag), found("lockstep", **lockstep)
    said = tried.advice(*given, OWN, settings())
    assert said[0].endswith(written)
    assert said[1:] == [f"With play: {one.play}: no" for one in given if one.fault]


def test_neither_way_is_one_sentence():
    with pytest.raises(OdometryError, match="in no way of playing; bag: none; lockstep: dead"):
        tried.advice(found("bag", "none"), found("lockstep", "dead"), OWN, settings())


@pytest.mark.parametrize(
    ("late", "stamps"),
    [(0, "the scan's"), (10**8, "0.10 s after the scan's"), (AT // 2, "a clock's")],
)
def test_whose_stamps_they_are(late, stamps):
    row = found("bag", late=late).row(0)
    assert row["stamps"] == stamps
    assert row["poses per scan"] == 1.0


def test_the_first_seconds_of_a_bag_are_as_they_were(tmp_path, monkeypatch):
    monkeypatch.setattr(tried, "SECONDS", 1.0)
    whole = recording(tmp_path)
    part = first_seconds(whole, tmp_path / "cut.bag")
    with AnyReader([whole.path]) as before, AnyReader([part.path]) as after:
        kept = [(c.topic, at, data) for c, at, data in after.messages()]
        assert kept == [(c.topic, at, data) for c, at, data in before.messages()][: len(kept)]
    assert sum(topic == "/points" for topic, *_ in kept) == len(part.stamps) == 10
    np.testing.assert_array_equal(part.stamps, whole.stamps[:10])


@pytest.mark.services
def test_both_ways_are_tried(study_file, tmp_path):
    file = template(tmp_path / "p.yaml", late=2)
    given = f"image: {reference_image()}, template: {file}, odometry: /Odometry, rate: 4"
    name, value = next(iter(VALUES.items()))
    study = load_study(
        study_file,
        [
            "odometry.name=rustle",
            f"odometry.settings={{{given}}}",
            f"odometry.parameters={{{name}: {{type: float, low: 1, high: 9, baseline: {value}}}}}",
        ],
        tmp_path / "run",
    )
    said, rows = try_system(study, unseen)
    assert "play: lockstep" in said[0]
    assert [row["play"] for row in rows] == ["bag", "lockstep"]
    for row in rows:
        assert row["first pose after [s]"] == pytest.approx(0.2)
        assert row["poses per scan"] == pytest.approx(38 / 40)
        assert row["stamps"] == "the scan's"
        assert row["fits"] == "yes"
        assert row["start [s]"] > 0.0
        assert row["CPU of a second [s]"] > 0.0
