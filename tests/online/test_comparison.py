import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import drives
import numpy as np
import pytest
from made_replays import folder_of
from tables import with_run

from adaptune._system import manifest
from adaptune.errors import AdaptuneError
from adaptune.metrics import LOST_ABOVE
from adaptune.model import BankSettings, ErrorModel
from adaptune.model.rules import mean_errors
from adaptune.runs.files import StoredReplayError, read_run
from adaptune.study import driven
from adaptune.study.driven import ModeError, another_odometry, bank_members
from adaptune.trajectory import Trajectory, read_tum, write_tum
from offline.config import load_study
from online.compare import NONE, compare
from online.modes import run_replays
from online.reference import read_reference, reference_folder
from online.statistics import ComparisonRow
from online.verdict import remarks

MODES = ["baseline", "fixed", "adaptive", "paper"]


@pytest.fixture(scope="module")
def trained(study_file, trained_folder, tmp_path_factory):
    folder = shutil.copytree(trained_folder, tmp_path_factory.mktemp("run") / "study")
    return load_study(study_file, [], folder)


@pytest.fixture(scope="module")
def replayed(trained):
    run_replays(trained, trained.folder / "model.safetensors")
    return trained


def test_where_track_is_lost_nothing_is_advised_and_all_is_listed(replayed, monkeypatch):
    monkeypatch.setattr("adaptune.study.driven.LOST_ABOVE", -1.0)
    found = compare(replayed)
    assert found.advised == NONE
    assert found.verdict[-1] == "Until then, rely on none."
    assert {row["mode"] for row in found.front} >= {"baseline", "adaptive"}
    assert not any(row["recommended"] for row in found.front)


def test_another_odometry_is_tried_where_track_is_lost(trained):
    name, error = another_odometry(trained, "three")
    assert name == "gicp"
    assert 0.0 < error < LOST_ABOVE
    of_gicp = trained.config.odometry.model_copy(update={"name": "gicp"})
    config = trained.config.model_copy(update={"odometry": of_gicp})
    assert another_odometry(replace(trained, config=config), "three")[0] == "kiss_icp"


def test_where_track_is_lost_the_likeliest_cause_is_told(trained, monkeypatch):
    causes, held = {"one": "night"}, {"one": 25.0, "two": 25.0, "three": np.inf}
    monkeypatch.setattr(driven, "another_odometry", lambda _, name: ("gicp", held[name]))
    monkeypatch.setattr(driven, "hard_to_track", lambda scans: causes.get(Path(scans.name).stem))

    def said(*faults, **errors):
        (words,) = driven.lost_in_words(trained, "x", errors, faults)
        return words

    for errors in ({"one": 5.0}, {"one": np.nan}):
        assert driven.lost_in_words(trained, "x", errors) == []
    # The worst sequence tells.
    words = said(one=1.0, two=10.0)
    assert words.startswith("Even with x track is lost on two: RTE 5.5 %. ")
    assert "parameters: gicp loses it, too, so points' times" in words
    assert "the odometry does not suit the recording, or points' times" in said(three=9.0)
    assert "The likeliest cause: night." in said(one=10.0, two=1.0)
    held["one"] = 0.619
    words = said(one=10.0, two=1.0)
    assert "gicp holds track on one, with 0.62 %: it is the odometry, not the data." in words
    assert "night" not in words
    words = said("", "it crashed", one=9.0)
    assert words.endswith("The odometry itself failed there: it crashed. Mend that first.")


def test_where_references_are_as_wrong_as_sets_the_verdict_is_doubted(replayed, monkeypatch):
    assert not any("Doubt this" in said for said in compare(replayed).verdict)
    model = ErrorModel.load(replayed.model_path)
    own = mean_errors(model.errors, model.sequence)[list(model.sets).index(0)]
    wrong = SimpleNamespace(error=lambda _: 0.5 * own)
    monkeypatch.setattr("online.compare.estimates_of", lambda *_: {"one": wrong, "two": wrong})
    said = compare(replayed).verdict[-1]
    assert said.startswith("Doubt this: the estimated reference of training is wrong by ")
    assert f" by {0.5 * own:.2f} %, where the odometry's own parameters have {own:.2f} %," in said


def test_where_training_lost_track_is_told(own):
    assert not any("lost track" in said for said in compare(own).verdict)
    model = ErrorModel.load(own.model_path)
    first, fixed = model.sequence == 0, list(model.sets).index(model.fixed)
    for columns, words in (
        ([0], "In training, the odometry's own parameters lost track on one (RTE 30.0 %)."),
        ([0, fixed], "own parameters lost track on one (RTE 30.0 %), and the fixed set lost"),
    ):
        errors = model.errors.copy()
        errors[np.ix_(first, columns)] = np.inf
        replace(model, errors=errors).save(own.model_path)
        assert words in " ".join(compare(own).verdict)


def test_a_damaged_front_is_named(own):
    (own.folder / "front.json").write_text("hello {")
    with pytest.raises(
        StoredReplayError, match=r"front\.json: is damaged .*`adaptune offline` again"
    ):
        compare(own)


def test_replays_with_a_model_for_another_budget_are_not_compared(own, study_file):
    other = load_study(study_file, ["online.budget=1x"], own.folder)
    with pytest.raises(AdaptuneError, match=r"online\.budget: .* was fitted for another one"):
        compare(other)


def test_where_track_is_lost_a_fault_of_the_odometry_is_named(own, monkeypatch):
    monkeypatch.setattr("adaptune.study.driven.LOST_ABOVE", -1.0)
    monkeypatch.setattr("online.compare.LOST_ABOVE", -1.0)
    for path in (own.folder / "replays/three").glob("*/replay.json"):
        changed = json.loads(path.read_text()) | {"fault": "ValueError: matrix is singular"}
        path.write_text(json.dumps(changed))
    lost = compare(own).verdict[0]
    words = "The odometry itself failed there: ValueError: matrix is singular. Mend that first."
    assert lost.endswith(words)


@pytest.fixture
def own(replayed, study_file, tmp_path):
    """A copy of `replayed` that a test may change."""
    return load_study(study_file, [], shutil.copytree(replayed.folder, tmp_path / "study"))


def test_rows_and_files(replayed):
    rows = compare(replayed).rows
    assert [(row.sequence, row.mode) for row in rows] == [("three", mode) for mode in MODES]
    of = {row.mode: row for row in rows}
    assert of["fixed"].ratio == 1.0
    for row in rows:
        assert row.ratio_interval in (None, (1.0, 1.0))  # too short, or equal
        assert row.ratio == pytest.approx(row.rte / of["fixed"].rte)
    folder = replayed.folder / "comparison"
    with (folder / "comparison.csv").open() as file:
        assert [row["mode"] for row in csv.DictReader(file)] == MODES
    assert json.loads((folder / "comparison.json").read_text())[1]["vs fixed"] == 1.0
    # 12 m are too short for KITTI's error.
    for row, written in zip(
        rows, json.loads((folder / "comparison.json").read_text()), strict=True
    ):
        assert 0.0 < row.standard.rpe < row.standard.ape * 10
        assert (written["ape_m"], written["rpe_m"]) == (row.standard.ape, row.standard.rpe)
        assert (written["kitti_percent"], written["kitti_lengths_m"]) == (None, None)


def test_baseline_and_fixed_keep_their_parameters(replayed):
    model = ErrorModel.load(replayed.folder / "model.safetensors")
    about = {m: manifest.recorded(folder_of(replayed, m) / manifest.FILE) for m in MODES}
    assert about["baseline"]["parameters"] == replayed.odometry.space.baseline
    assert about["fixed"]["parameters"] == model.sets[model.fixed]


def test_values_that_stay_read_as_those_that_change(own):
    path = folder_of(own, "fixed") / manifest.FILE
    parameters = {"mode": True, "size": 3, "kernel": "none"}
    manifest.record(path, manifest.recorded(path) | {"parameters": parameters})
    choices = read_run(path.parent).values
    assert choices == {"mode": ["True"], "size": [3.0], "kernel": ["none"]}


def test_one_set_is_driven_where_there_is_no_bank(own, study_file):
    model = ErrorModel.load(own.folder / "model.safetensors")
    given = ["online.switching.mechanism=live"]
    path = own.folder / "alone.safetensors"
    model.save(path)
    study = replace(
        load_study(
            study_file, [*given, "online.period=0.5", "online.modes=[standby, paper]"], own.folder
        ),
        model_file=path,
    )
    assert run_replays(study, path) == 2  # of the others, those before are the same
    row = next(row for row in compare(study).rows if row.mode == "standby")
    assert row.rte < 3.0
    folder = folder_of(study, "standby")
    about = {
        mode: manifest.recorded(folder_of(study, mode) / manifest.FILE)["switching"]
        for mode in ("standby", "paper")
    }
    # Also the paper's rule has one instance, and all sets to choose from.
    assert about["paper"]["mechanism"] == about["standby"]["mechanism"] == "live"
    with (folder / "selections.csv").open() as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        chosen = model.sets[int(row["trial"])]
        assert {name: float(row[name]) for name in chosen} == pytest.approx(chosen)
        assert row["weights"] == ""


def test_a_bank_that_pays_is_weighed(own, study_file):
    """And what is replayed does not end in failure."""
    model = ErrorModel.load(own.folder / "model.safetensors")
    assert len(model.bank) >= 4
    # What is measured live hardly counts.
    settings = BankSettings(min_fixed_share=0.5, prior_windows=1e9)
    paying = replace(model, bank_settings=settings)
    path = own.folder / "paying.safetensors"
    paying.save(path)
    study = load_study(study_file, ["online.switching.mechanism=bank"], own.folder)
    study = replace(study, model_file=path)
    run_replays(study, path)
    with (folder_of(study, "adaptive") / "selections.csv").open() as file:
        for row in csv.DictReader(file):
            pairs = [pair.split(":") for pair in row["weights"].split()]
            weights = {int(trial): float(weight) for trial, weight in pairs}
            assert list(weights) == model.bank[:4]  # the baseline is its reserve
            assert weights[model.fixed] >= 0.5
            assert sum(weights.values()) == pytest.approx(1.0, abs=0.002)
            assert int(row["trial"]) == model.fixed
    # The published rule has all sets to choose from.
    with (folder_of(study, "paper") / "selections.csv").open() as file:
        assert {int(row["trial"]) for row in csv.DictReader(file)} <= set(model.sets)
    assert next(row.rte for row in compare(study).rows if row.mode == "adaptive") < 3.0
    more = load_study(study_file, ["online.switching.mechanism=bank"], own.folder)
    with pytest.raises(ModeError, match=r"switching\.size: the model was fitted for another"):
        bank_members(more.config.online.switching, replace(model, bank_size=3))


def test_replays_are_made_once(replayed, study_file):
    model = replayed.folder / "model.safetensors"
    assert run_replays(replayed, model) == 0
    cut = load_study(study_file, ["online.period=2"], replayed.folder)
    assert run_replays(cut, model) == 2  # nothing is selected in the others
    # The earlier ones have been kept.
    assert run_replays(replayed, model) == 0


def test_a_sequence_without_reference_is_replayed_but_not_judged(trained, study_file):
    study = load_study(study_file, ["sequences.three.reference=none"], trained.folder)
    run_replays(study, trained.folder / "model.safetensors")
    rows = compare(study).rows
    assert [row.rte for row in rows] == [None] * 4
    assert not (reference_folder(study, "three") / "reference.tum").exists()
    run_replays(trained, trained.folder / "model.safetensors")
    assert compare(trained).rows[0].rte is not None


def test_a_written_reference_is_that_of_the_scans(replayed):
    reference = read_tum(reference_folder(replayed, "three") / "reference.tum")
    np.testing.assert_allclose(reference.T_world_sensor[:, 0, 3], 0.3 * np.arange(40), atol=1e-9)


def test_frames_in_a_gap_of_the_reference_have_no_error(own, study_file, tmp_path):
    truth = own.sequences.open("three").reference()
    seconds = (truth.stamps - truth.stamps[0]) * 1e-9
    kept = (seconds < 0.95) | (seconds > 1.65)
    write_tum(tmp_path / "gap.tum", Trajectory(truth.stamps[kept], truth.T_world_sensor[kept]))
    for max_gap, unknown in ((0.5, 7), (2.0, 0)):
        given = [f"reference={tmp_path}/gap.tum", f"max_gap={max_gap}"]
        study = load_study(study_file, [f"sequences.three.{one}" for one in given], own.folder)
        run_replays(study, study.model_path)
        stamps = read_run(folder_of(own, "fixed")).trajectory.stamps
        in_training = np.isnan(study.sequences.open("three").reference().at(stamps)[:, 0, 0])
        assert np.count_nonzero(in_training) == unknown
        compared = np.isnan(read_reference(study, "three").trajectory.at(stamps)[:, 0, 0])
        np.testing.assert_array_equal(compared, in_training)


def test_rows_over_several_sequences(replayed, study_file, tmp_path):
    bag = drives.write_bag(tmp_path / "four.bag", drives.scans(4, 40))
    study = load_study(
        study_file,
        [
            "test=[three, four]",
            f"sequences.four={{bag: {bag}, points: /points, reference: /truth}}",
        ],
        replayed.folder,
    )
    run_replays(study, replayed.folder / "model.safetensors")
    rows = compare(study).rows
    assert [row.sequence for row in rows] == ["three"] * 4 + ["four"] * 4 + ["all"] * 4
    a, b, all_ = rows[3], rows[7], rows[11]
    assert all_.rte == pytest.approx((a.rte + b.rte) / 2)
    assert all_.standard.ape == pytest.approx((a.standard.ape + b.standard.ape) / 2)
    assert all_.ratio == pytest.approx((a.ratio * b.ratio) ** 0.5)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("odometry.settings.downsampling=0.4", "downsampling changed from 0.5 to 0.4"),
        ("odometry.parameters.keyframe_interval.high=20", "high changed from 15.0 to 20.0"),
        ("test=[]", "name at least one sequence"),
        ("sub_trajectory=2", "sub_trajectory changed from 3.0 to 2.0"),
    ],
)
def test_refuses_a_model_of_something_else(trained, study_file, tmp_path, override, words):
    study = load_study(study_file, [override], trained.folder)
    model = shutil.copy(trained.model_path, tmp_path / "other.safetensors")
    with pytest.raises(AdaptuneError, match=words):
        run_replays(study, model)


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("replay.json", "{"),
        ("replay.json", "[]"),
        ("replay.json", "{}"),
        ("frames.csv", "a,b\n1,2\n"),
        ("frames.csv", "restarted\n" + "0\n" * 40),
        ("selections.csv", "stamp_ns\nnone\n"),
        ("selections.csv", "stamp_ns,weights\n1,0:a\n"),
        ("selections.csv", "stamp_ns,weights\n1,0\n"),
        ("selections.csv", "stamp_ns,weights\n1,0:0.5 1:0.5\n2,0:1\n"),
        ("selections.csv", "nothing"),
        ("selections.csv", "stamp_ns,why_not\n1,\n2,failed\n"),
    ],
)
def test_a_damaged_replay_is_named(replayed, file, text):
    path = folder_of(replayed, "adaptive") / file
    before = path.read_text()
    path.write_text(text)
    try:
        what = (
            rf"{file}: is damaged .*; remove .*adaptive-\w+ and run `adaptune online` with this "
            rf"study"
        )
        with pytest.raises(StoredReplayError, match=what) as caught:
            compare(replayed)
        assert "https://" not in str(caught.value)
    finally:
        path.write_text(before)


def rows_of(sequence="a", **ratios):
    return [
        ComparisonRow(sequence, mode, ratio, ratio)
        for mode, ratio in (ratios | {"fixed": 1.0}).items()
    ]


def test_restarts_are_told_with_their_reason():
    baseline, fixed = rows_of(baseline=1.0)
    once = {"restarts": 1, "unhealthy": {"max_acceleration": 1}}
    both = [with_run(replace(row, first_restart=10.12), **once) for row in (baseline, fixed)]
    said = "On a the health check restarted all modes at 10.1 s (max_acceleration)."
    assert remarks(both)[-1] == said
    more = {"restarts": 3, "unhealthy": {"max_speed": 1, "max_turn_rate": 2}}
    assert remarks([with_run(both[0], **more), both[1]])[-1] == (
        "On a the health check restarted baseline 3 times, first at 10.1 s (max_speed, "
        "max_turn_rate); fixed at 10.1 s (max_acceleration)."
    )


def test_restarts_are_those_of_the_stored_replay(own):
    folder = folder_of(own, "adaptive")
    lines = (folder / "frames.csv").read_text().splitlines()
    head = lines[0].split(",")
    rows = [dict(zip(head, line.split(","), strict=True)) for line in lines[1:]]
    for i, row in enumerate(rows):
        row |= {"restarted": str(int(i in (5, 9)))}
    (folder / "frames.csv").write_text(
        "\n".join([lines[0], *(",".join(row.values()) for row in rows)]) + "\n"
    )
    summary = json.loads((folder / "replay.json").read_text())
    summary |= {"restarts": 2, "unhealthy": {"max_speed": 2}}
    (folder / "replay.json").write_text(json.dumps(summary))
    found = compare(own).rows
    assert remarks(found)[-1] == (
        "On three the health check restarted adaptive 2 times, first at 0.5 s (max_speed)."
    )
    trajectory = folder / "trajectory.tum"
    trajectory.write_text("".join(trajectory.read_text().splitlines(keepends=True)[:20]))
    with pytest.raises(StoredReplayError, match=r"trajectory\.tum: is damaged \(not a row"):
        compare(own)


def test_unknown_cells_are_empty(replayed):
    compare(replayed)
    folder = replayed.folder / "comparison"
    assert "nan" not in (folder / "comparison.csv").read_text()
    assert (folder / "tables.md").read_text().startswith("# study\n\n- ")
