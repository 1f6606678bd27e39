import re
import shutil

import commands
import made_references
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from adaptune.archive import Archive
from adaptune.commands import terminal
from adaptune.reference import estimate
from adaptune.reference.stored import EstimateError, StoredEstimate
from adaptune.study.references import ensure_references
from offline.check_reference import (
    Judged,
    Run,
    check_reference,
    choose,
    judge_by_both,
    over_all,
    rank_correlation,
)
from offline.config import load_study

SCALES = (1.0, 1.01, 0.97, 1.05)


def straight(n, step=1.0):
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 0, 3] = step * np.arange(n)
    return T


def runs(n, restarted=()):
    lost = np.zeros(n, bool)
    lost[list(restarted)] = True
    return [Run(straight(n, scale), lost) for scale in SCALES]


def test_the_same_reference_judges_alike():
    T = straight(60)
    judged = judge_by_both(T, T, runs(60), 10.0)
    np.testing.assert_allclose(judged.given, judged.estimated)
    # Over 11 m, the first scan beyond 10.
    np.testing.assert_allclose(judged.given, [0.0, 1.1, 3.3, 5.5], atol=1e-9)
    choice = choose(judged)
    assert choice.rank == pytest.approx(1.0)
    assert choice.picked == choice.best == judged.given.min()


def test_a_reference_of_wrong_scale_picks_the_set_that_shares_its_error():
    judged = judge_by_both(straight(60), straight(60, 1.05), runs(60), 10.0)
    choice = choose(judged)
    assert choice.picked == pytest.approx(5.5)
    assert choice.rank < 0.0


def test_only_what_both_know_counts():
    T, estimated = straight(60), straight(60)
    # Far off where it is not known.
    wild = [Run(run.T_odom_sensor.copy(), run.restarted) for run in runs(60)]
    for run in wild:
        run.T_odom_sensor[30:, 1, 3] += np.linspace(0.0, 30.0, 30)
    for one, other in ((T, estimated), (estimated, T)):
        part = one.copy()
        part[30:] = np.nan
        judged = judge_by_both(part, other, wild, 10.0)
        np.testing.assert_allclose(judged.given, [0.0, 1.1, 3.3, 5.5], atol=1e-9)
        np.testing.assert_allclose(judged.estimated, judged.given, atol=1e-9)


def test_a_lost_track_counts_as_a_failure_and_a_new_piece_not_at_all():
    T = straight(60)
    lost = judge_by_both(T, T, runs(60, [30]), 10.0)
    # 11 of 49 sub-trajectories lead over it.
    assert lost.given[0] == pytest.approx(30.0 * 11 / 49)
    jumping = [Run(run.T_odom_sensor.copy(), run.restarted) for run in runs(60)]
    for run in jumping:
        run.T_odom_sensor[30:, 1, 3] += 7.0
    judged = judge_by_both(T, T, jumping, 10.0, [0, 30])
    np.testing.assert_allclose(judged.given, [0.0, 1.1, 3.3, 5.5], atol=1e-9)


def test_without_a_common_sub_trajectory_nothing_is_known():
    T = straight(8)
    judged = judge_by_both(T, T, runs(8), 10.0)
    assert np.isnan(judged.given).all()
    assert np.isnan(choose(judged)).all()
    assert len(over_all([([0, 1, 2, 3], judged)]).given) == 0
    assert np.isnan(choose(over_all([])).ratio)


def errors(n):
    return arrays(np.float64, n, elements=st.floats(0.01, 30.0))


@given(st.integers(1, 9).flatmap(lambda n: st.tuples(errors(n), errors(n))))
@settings(max_examples=100, deadline=None)
def test_no_pick_is_better_than_the_best(both):
    choice = choose(Judged(*both))
    assert choice.ratio >= 1.0
    assert np.isnan(choice.rank) or -1.0 - 1e-9 <= choice.rank <= 1.0 + 1e-9


@given(errors(6))
@settings(max_examples=50, deadline=None)
def test_the_rank_correlation_knows_only_the_order(one):
    rank = rank_correlation(one, 4.0 * one)
    assert rank == pytest.approx(1.0) or np.ptp(one) == 0.0 or len(np.unique(one)) < 6
    assert np.isnan(rank_correlation(one[:2], one[:2]))
    assert np.isnan(rank_correlation(one, np.ones(6)))


def test_over_all_sequences_the_sets_count_that_ran_on_each():
    one = Judged(np.array([1.0, 2.0, 3.0]), np.array([1.5, 2.5, 3.5]))
    other = Judged(np.array([5.0, 0.2]), np.array([4.0, 0.1]))
    judged = over_all([([0, 1, 7], one), ([7, 1], other)])
    np.testing.assert_allclose(judged.given, [(2.0 + 0.2) / 2, (3.0 + 5.0) / 2])
    np.testing.assert_allclose(judged.estimated, [(2.5 + 0.1) / 2, (3.5 + 4.0) / 2])


@pytest.fixture
def folder(trained_folder, tmp_path):
    shutil.copytree(trained_folder, tmp_path / "run")
    return tmp_path / "run"


@pytest.fixture
def counted(study_file, monkeypatch):
    """Estimates that are made of the truth, and of which recordings they were."""
    asked = []

    def made(scans, advance=lambda *_: None, priors=None):
        asked.append(scans.name)
        name = re.search(r"one|two", scans.name)[0]
        of = made_references.of_truth(study_file.parent / f"{name}.bag", scale=0.001)
        return of(scans, advance, priors)

    monkeypatch.setattr(estimate, "estimate_reference", made)
    return asked


def test_a_study_is_checked_by_its_trials(study_file, folder, counted):
    study = load_study(study_file, [], folder)
    rows = check_reference(study)
    assert [row["sequence"] for row in rows] == ["one", "two", "all: fixed set"]
    assert len(counted) == 2
    archive = Archive(folder / "trials")
    for row in rows[:2]:
        assert row["sets"] == 10
        assert row["rank corr."] > 0.8
        best = min(run.mean_error for run in archive.finished(row["sequence"]).values())
        assert row["best [%]"] == pytest.approx(best, rel=0.2)
        assert 0.0 < row["estimate, by the given [%]"] < 1.0
        assert row["ratio"] >= 1.0
    assert rows[-1]["by itself [%]"] is None
    # What is there is not estimated again, unless it is of other scans.
    assert check_reference(study) == rows
    assert len(counted) == 2
    assert (folder / "references/one.check.tum").exists()
    beside = folder / "references/one.check.json"
    beside.write_text(beside.read_text().replace('"stride": 1', '"stride": 2'))
    assert check_reference(study) == rows
    assert len(counted) == 3


def test_a_file_that_was_estimated_is_not_given(study_file, folder, counted, tmp_path):
    check_reference(load_study(study_file, [], folder))
    for suffix in (".tum", ".json"):
        made = folder / f"references/one.check{suffix}"
        made.rename((tmp_path / "mine").with_suffix(suffix))
    overrides = [f"sequences.one.reference={tmp_path / 'mine.tum'}"]
    study = load_study(study_file, overrides, folder)
    assert [row["sequence"] for row in check_reference(study)] == ["two"]
    assert len(counted) == 2


def test_scans_are_taken_as_they_were_recorded(study_file, folder, counted):
    dropping = ["sequences.one.views=[{drop: {share: 0.5}}]", "training=[one]"]
    rows = check_reference(load_study(study_file, dropping, folder))
    assert len(counted) == 1
    assert rows[0]["unknown [%]"] == 0.0
    # The estimate of the study itself is the same.
    about = StoredEstimate.read(folder / "references/one.check.tum").about
    study = load_study(study_file, [*dropping, "sequences.one.reference="], folder)
    ensure_references(study, ["one"])
    assert study.sequences.estimate("one").about == about
    assert StoredEstimate.read(folder / "references/one.check.tum").scans == 40


def test_one_that_is_refused_leaves_the_others(study_file, folder, counted, monkeypatch, caplog):
    made = estimate.estimate_reference

    def refuse(scans, *given):
        if "one" in scans.name:
            raise EstimateError("the robot hardly moves")
        return made(scans, *given)

    monkeypatch.setattr(estimate, "estimate_reference", refuse)
    rows = check_reference(load_study(study_file, [], folder))
    assert [row["sequence"] for row in rows] == ["two"]
    (said,) = (message for message in caplog.messages if "hardly" in message)
    assert said.startswith("sequences.one: ")
    only = load_study(study_file, ["training=[one]"], folder)
    with pytest.raises(EstimateError, match=r"sequences\.one: .* hardly moves"):
        check_reference(only)
    assert len(counted) == 1


def test_the_command_writes_a_table(study_file, folder, counted, monkeypatch):
    monkeypatch.setattr(terminal.console, "width", 120)
    done = commands.call("reference", study_file, "--check", "--folder", folder)
    assert done.exit_code == 0, done.stderr
    assert len(counted) == 2
    assert "all: fixed set" in done.stdout
    assert "adaptune trials" in done.stdout.splitlines()[-1]
    for suffix in ("csv", "json"):
        assert "rank corr." in (folder / f"reference_check.{suffix}").read_text()


def test_without_trials_there_is_nothing_to_check(study_file, tmp_path):
    done = commands.call("reference", study_file, "--check", "--folder", tmp_path / "none")
    assert done.exit_code == 2
    assert "no training sequence with a given reference has finished trials" in done.stderr
