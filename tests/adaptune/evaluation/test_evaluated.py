import json

import estimates
import numpy as np
import pytest

import adaptune
from adaptune.errors import AdaptuneError
from adaptune.evaluation import shown
from adaptune.live.own_error import OwnError
from adaptune.recording.config import SequenceConfig
from adaptune.recording.recording import open_sequence
from adaptune.reference import check
from adaptune.reference.estimated import EstimateError
from adaptune.trajectory import Trajectory, write_tum


@pytest.fixture(autouse=True)
def pageless(monkeypatch):
    monkeypatch.setattr(shown, "write_page", lambda *_: None)


@pytest.fixture
def bag(study_file):
    return study_file.parent / "one.bag"


@pytest.fixture
def truth(bag):
    config = SequenceConfig(bag=str(bag), reference="/truth")
    return open_sequence(config).reference()


def longer(truth, factor, noise=0.0):
    """The poses of an odometry that goes too far, with some noise."""
    T = truth.T_world_sensor.copy()
    T[:, :3, 3] *= factor
    T[:, :3, 3] += np.random.default_rng(0).normal(0.0, noise, (len(T), 3))
    return Trajectory(truth.stamps, T)


def evaluated(bag, *trajectories, **options):
    options = {"out": bag.parent / "out", "progress": lambda *_: None} | options
    return adaptune.evaluate(bag, *trajectories, **options)


def test_a_trajectory_is_judged_by_the_reference_that_is_named(bag, truth, tmp_path):
    options = {"out": tmp_path, "sub_trajectory": 1.5}
    found = evaluated(bag, longer(truth, 1.02), reference="/truth", **options)
    (one,) = found.judged
    # Each sub-trajectory is a step longer than 1.5 m.
    assert one.rte == pytest.approx(2.0 * 1.8 / 1.5, abs=0.03)
    low, high = one.interval
    assert low <= one.rte <= high
    assert found.words[0].startswith("trajectory 1 on one is wrong by 2.3")
    assert "by /truth, whose own error registrations do not show." in found.words[0]
    assert len(found.words) <= 5
    (row,) = json.loads((tmp_path / "evaluation.json").read_text())
    assert row["RTE [%]"] == found.rows[0]["RTE [%]"] == pytest.approx(one.rte)
    assert row["judge"] == "/truth"
    assert (tmp_path / "evaluation.csv").read_text().startswith("recording,trajectory,RTE [%]")
    assert [found.verdict(most) for most in (1.0, 2.4, 3.0)] == ["above", "unclear", "below"]


def test_without_a_reference_one_is_estimated_once_and_its_error_counts(
    bag, truth, tmp_path, monkeypatch
):
    estimator = estimates.install(monkeypatch)
    write_tum(tmp_path / "mine.tum", longer(truth, 1.02))
    options = {"reference": "estimated", "out": tmp_path, "sub_trajectory": 2.0}
    found = evaluated(bag, tmp_path / "mine.tum", **options)
    (one,) = found.judged
    own = one.judge.reference.error
    assert own == pytest.approx(0.3, abs=0.05)
    assert (
        "by an estimated reference, whose own error is in the interval, about 0.3" in found.words[0]
    )
    assert "but not what all registrations of these scans get wrong alike" in found.words[0]
    by_truth = evaluated(bag, tmp_path / "mine.tum", **(options | {"reference": "/truth"})).judged[
        0
    ]
    assert one.interval[1] - one.interval[0] > by_truth.interval[1] - by_truth.interval[0]
    again = evaluated(bag, tmp_path / "mine.tum", **options)
    assert again.words == found.words
    assert estimator.names == ["one.bag"]
    # What is as good as the judge, or better, is not told to have no error.
    good = evaluated(bag, longer(truth, 1.0015), **options)
    assert "is better than can be told here: below 0." in good.words[0]
    assert good.verdict(0.01) == "unclear"


@pytest.mark.parametrize(
    ("low", "doubt", "words", "judge"),
    [
        (0.4, "", "is in the interval as far as registrations show it, 0.4 %", "/truth"),
        (0.4, "it gives 2 scans a second", "whose own error is not known", "/truth"),
        (0.6, "", "(as /truth is wrong by 0.8 %), whose own error", "an estimated reference (as"),
    ],
)
def test_a_given_judge_is_measured_and_its_error_counts(
    bag, truth, tmp_path, monkeypatch, low, doubt, words, judge
):
    estimates.install(monkeypatch)
    hops = check.Hops.of([])
    measured = check.MeasuredReference(truth.stamps, truth.T_world_sensor, hops, doubt)
    monkeypatch.setattr(check.MeasuredReference, "error", lambda *_: OwnError(0.8, low, 1.0))
    monkeypatch.setattr(check, "measure_reference", lambda *_: measured)
    made = longer(truth, 1.01)
    found = evaluated(bag, made, sub_trajectory=1.0)
    assert words in " ".join(found.words)
    (one,) = found.judged
    assert one.judge.name.startswith(judge)
    (exact,) = evaluated(bag, made, sub_trajectory=1.0, reference="/truth").judged
    wide = exact.interval[1] - exact.interval[0]
    assert (wide > 0.1) is (not doubt)
    estimates.install(monkeypatch).refusal = EstimateError("the scene may be too bare")
    (one,) = evaluated(bag, made, sub_trajectory=1.0, out=tmp_path).judged
    assert one.judge.name == "/truth"
    assert ("none can be estimated: sequences.one: " in one.judge.doubt) is (low > 0.5)


def test_a_judge_that_contradicts_the_scans_says_so_where_it_is_named(bag, truth, tmp_path):
    turned = np.eye(4)
    turned[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    write_tum(tmp_path / "turned.tum", Trajectory(truth.stamps, truth.T_world_sensor @ turned))
    found = evaluated(bag, truth, reference=tmp_path / "turned.tum", sub_trajectory=1.0)
    assert "turned.tum contradicts the scans (over some metres they differ by " in found.words[0]
    assert "other axes" in found.words[0]
    assert found.judged[0].cause is None


def test_what_is_judged_is_not_its_own_judge(bag, monkeypatch):
    estimates.install(monkeypatch)
    (one,) = evaluated(bag, "/truth").judged
    assert one.judge.name == "an estimated reference"
    (one,) = evaluated(bag, longer(one.trajectory, 1.01)).judged
    assert one.judge.name == "/truth"


def test_two_files_of_one_name_are_two(bag, truth, tmp_path):
    for folder, factor in (("one", 1.01), ("two", 1.02)):
        (tmp_path / folder).mkdir()
        write_tum(tmp_path / folder / "a.tum", longer(truth, factor))
    both = [str(tmp_path / folder / "a.tum") for folder in ("one", "two")]
    found = evaluated(bag, *both, reference="/truth", sub_trajectory=1.0)
    assert [(pair.better, pair.other) for pair in found.pairs] == [tuple(both)]


def test_which_of_several_is_better_or_that_nobody_can_tell(bag, truth):
    made = [longer(truth, factor, 0.002) for factor in (1.03, 1.01, 1.0102)]
    found = evaluated(bag, *made, reference="/truth", sub_trajectory=1.0)
    assert found.judged[0].name == "trajectory 1"
    assert [(pair.better, pair.other) for pair in found.pairs] == [
        ("trajectory 2", "trajectory 3"),
        ("trajectory 2", "trajectory 1"),
    ]
    near, far = (pair.ratio for pair in found.pairs)
    assert near.interval[0] < near.value < 1.0 < near.interval[1] * 1.05
    assert far.interval[1] < 0.5
    text = " ".join(found.words)
    assert found.words[0].startswith("Best: trajectory 2")
    assert "It surely has 0.3" in text
    words = evaluated(bag, *made[:2], reference="/truth", sub_trajectory=3.0).words
    unsure = "Not sure that it is better: it has 0.33 times trajectory 1's error (too short for an "
    assert unsure in " ".join(words)


def test_of_clipped_errors_only_the_least_is_said(bag, truth):
    found = evaluated(bag, longer(truth, 0.2), reference="/truth", sub_trajectory=1.0)
    text = " ".join(found.words)
    assert "trajectory 1 on one is wrong by 30 % or more over 1 m, by /truth." in text
    assert " It was worst at 0.0 s, x 0.0 y 0.0 m: 30 % or more." in text
    assert "drifts" not in text
    assert found.verdict(50.0) == "unclear"
    T = longer(truth, 1.01).T_world_sensor
    T[10:, 0, 3] += np.clip(np.arange(len(T) - 10.0), 0.0, 10.0)  # it goes astray for a second
    astray = Trajectory(truth.stamps, T)
    found = evaluated(bag, astray, reference="/truth", sub_trajectory=1.0)
    assert found.verdict(50.0) == "unclear"
    text = " ".join(found.words)
    assert "% (95 % interval " in text
    assert "It drifts by " in text
    assert text.count("30 % or more") == 1


def test_the_length_suits_what_is_judged(bag, truth):
    part = Trajectory(truth.stamps[:13], truth.T_world_sensor[:13])
    lengths = [
        evaluated(bag, *given, reference="/truth").judged[0].judge.reference.length
        for given in ([truth], [part], [truth, part])
    ]
    assert lengths[0] > lengths[1] == lengths[2]


def test_bags_with_the_same_topic_are_rows_the_worst_first(study_file, tmp_path, monkeypatch):
    estimates.install(monkeypatch)
    bags = [study_file.parent / f"{name}.bag" for name in ("one", "two", "three")]
    found = adaptune.evaluate(bags, "/truth", out=tmp_path, progress=lambda *_: None)
    assert {one.judge.recording for one in found.judged} == {"one", "two", "three"}
    errors = [one.rte for one in found.judged]
    assert errors == sorted(errors, reverse=True)
    assert found.words[0].startswith("Worst: /truth on ")
    assert found.pairs == []
    with pytest.raises(AdaptuneError, match="is of one recording, and there are 3"):
        adaptune.evaluate(bags, bags[0].with_suffix(".tum"), out=tmp_path)


def test_faults_gaps_and_parts_are_told(bag, truth):
    T = longer(truth, 1.0)
    T.T_world_sensor[20:30] = T.T_world_sensor[20]  # it hangs
    kept = np.r_[0:8, 24:40]
    late = Trajectory(truth.stamps[kept], truth.T_world_sensor[kept], 5.0)
    found = evaluated(bag, T, reference="/truth", sub_trajectory=1.0)
    (one,) = found.judged
    assert any("stands still while the robot moves" in fault.what for fault in one.faults)
    (one,) = evaluated(bag, late, reference="/truth", sub_trajectory=1.0).judged
    (fault,) = one.faults
    assert str(fault) == "it gives nothing, from 0.7 to 2.4 s"
    rare = Trajectory(truth.stamps[::5], truth.T_world_sensor[::5])
    (one,) = evaluated(bag, rare, reference="/truth", sub_trajectory=1.0).judged
    assert "one pose for 5 of the judge's, and is judged there alone" in str(one.faults[0])
    part = Trajectory(truth.stamps[:25], truth.T_world_sensor[:25])
    found = evaluated(bag, part, reference="/truth", sub_trajectory=1.0)
    assert "it gives nothing, from 2.4 to 3.9 s" in " ".join(found.words)
    assert found.verdict(5.0) == "unclear"
    assert evaluated(bag, truth, reference="/truth", sub_trajectory=1.0).verdict(5.0) == "below"


def test_where_the_judge_knows_nothing_is_told(bag, truth, tmp_path, monkeypatch):
    estimates.install(monkeypatch, untrusted=[14])
    found = evaluated(bag, truth, reference="estimated", sub_trajectory=1.0, out=tmp_path)
    (one,) = found.judged
    assert one.unknown_share == pytest.approx(1.1 / 3.9, abs=0.03)
    assert "Nobody can judge 28 % of trajectory 1 on one (1.4 to 2.5 s, " in " ".join(found.words)
    # No sub-trajectory leads through.
    crossing = (one.seconds > 1.05) & (one.seconds < 1.4)
    assert np.isnan(one.errors[crossing]).all()


def test_what_the_poses_are_comes_first(bag, truth):
    place = np.eye(4)
    place[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    wrong = Trajectory(truth.stamps, truth.T_world_sensor @ place)
    found = evaluated(bag, wrong, reference="/truth")
    assert "of other axes" in found.words[0]
    mended = found.judged[0].cause.mend.split('"')[1]
    numbers = [float(number) for number in mended.split()]
    (one,) = evaluated(bag, wrong, reference="/truth", extrinsic=numbers).judged
    assert one.cause is None
    assert one.rte < 0.1


@pytest.mark.parametrize(
    ("given", "options", "words"),
    [
        (["none.tum"], {}, "none.tum: there is no such file; topics begin with /"),
        (["/none"], {}, "no topic /none; .*; it holds /points .*, /truth"),
        (["/points"], {}, "/points is sensor_msgs/msg/PointCloud2, not poses"),
        ([], {}, "name a trajectory"),
        (["/truth"], {"pose_time": "middle"}, "pose_time: give stamp or end"),
        (["/truth"], {"sub_trajectory": -1.0}, "give metres, more than 0"),
        (
            ["/truth"],
            {"sub_trajectory": 50.0},
            "no 50 m of it can be judged; .* a smaller --sub-trajectory",
        ),
        (["/truth"], {"extrinsic": [1.0, 2.0]}, "extrinsic: give numbers"),
        (["/truth"], {"extrinsic": "0, 0, 0, 1"}, "extrinsic: give numbers"),
        (["/truth"], {"reference": "none"}, "reference none: errors are measured by a reference"),
        (
            ["/truth"],
            {"clock_offset": 1e6},
            "/truth covers 1701000000.1.*, the scans cover",
        ),
        ([(np.arange(3), np.eye(4))], {}, "trajectory: .*; give stamps of shape"),
        (["EMPTY"], {}, "holds no pose"),
    ],
)
def test_bad_input_is_told_in_a_sentence(bag, tmp_path, given, options, words):
    (tmp_path / "empty.tum").touch()
    given = [tmp_path / "empty.tum" if one == "EMPTY" else one for one in given]
    with pytest.raises(AdaptuneError, match=words) as error:
        evaluated(bag, *given, **({"reference": "/truth"} | options))
    assert "\n" not in str(error.value)
