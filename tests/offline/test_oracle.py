import shutil

import fake_odometry
import numpy as np
import pytest
from commands import succeeded

from adaptune._system.progress import unseen
from adaptune.metrics import cap, sub_trajectory_rte
from adaptune.model import ErrorModel
from adaptune.runs.archive import Archive
from offline.config import load_study
from offline.train import oracle_sets, run_odometries, run_oracle, train
from online.modes import Replays, replay_modes

N = 5


@pytest.fixture
def load(study_file, trained_folder, tmp_path):
    folder = shutil.copytree(trained_folder, tmp_path / "study")
    return lambda *overrides: load_study(study_file, overrides, folder)


@pytest.fixture(scope="module")
def oracle(study_file, trained_folder, tmp_path_factory):
    """A study, and what the oracle's command printed; not to be changed."""
    folder = shutil.copytree(trained_folder, tmp_path_factory.mktemp("oracle") / "study")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("adaptune.commands.online.ORACLE_SETS", N)
        done = succeeded("online", study_file, "--folder", folder, "--oracle")
    return load_study(study_file, [], folder), done


def test_errors_on_test_sequences_are_read(oracle):
    study, done = oracle
    model = ErrorModel.load(study.model_path)
    archive = study.archive("oracle")
    found = archive.errors_of("three", model.sets)
    assert found.keys() == set(oracle_sets(model, N))
    errors = np.stack([*found.values()], axis=1)
    assert errors.shape == (40, N)
    # The last sub-trajectory of 3 m begins ten scans before the end.
    assert np.isfinite(errors[:29]).all()
    assert np.isnan(errors[31:]).all()
    least = np.nanmean(cap(errors), axis=0).min()
    assert f"{least:.3f}" in done.stdout
    assert archive.errors_of("one", model.sets) == {}


def test_a_trial_and_a_replay_of_a_set_are_one_run(oracle):
    """Where a trial drives the whole recording, and nothing is restarted at the reference."""
    study, _ = oracle
    model, archive = ErrorModel.load(study.model_path), study.archive("oracle")
    replay_modes(study, ["three"], ["baseline", "fixed"], unseen, model)
    assert archive.is_uncut("three")
    T_ref_sensor, replays = archive.read_frames("three").counted, Replays(study, model)
    for mode, number in (("baseline", 0), ("fixed", model.fixed)):
        trial, replay = archive.read("three", number), replays.read("three", mode)
        # As the digits of a TUM file and of single precision say.
        np.testing.assert_allclose(
            replay.trajectory.T_world_sensor, trial.T_odom_sensor, rtol=0, atol=1e-8
        )
        # A replay's own reference has the digits of a file, too: here, where scans are just 0.3 m
        # apart and sub-trajectories 3 m long, some of those end one scan later by it.
        driven = replay.trajectory.T_world_sensor
        errors = sub_trajectory_rte(T_ref_sensor, driven, study.config.sub_trajectory)
        assert np.isfinite(errors).sum() > 20
        np.testing.assert_allclose(errors, trial.errors, rtol=1e-5, atol=1e-6)
        assert replay.restarted.tolist() == trial.restarted.astype(bool).tolist()


def test_nothing_learns_from_it(oracle, study_file, trained_folder):
    study, _ = oracle
    before = ErrorModel.load(trained_folder / "model.safetensors")
    assert "three" not in {path.name for path in (study.folder / "trials").iterdir()}
    (study.folder / "model.safetensors").rename(study.folder / "kept.safetensors")
    again = train(load_study(study_file, [], study.folder)).model
    assert again.digest == before.digest
    assert again.provenance == before.provenance
    assert set(Archive(study.folder / "trials").sets()) == set(before.sets)


def test_it_resumes_and_renews_what_has_changed(load, caplog):
    study = load()
    archive, model = study.archive("oracle"), ErrorModel.load(study.model_path)
    run_oracle(study, 3)
    files = {n: archive.trial_path("three", n) for n in oracle_sets(model, 4)}
    made = {n: path.stat().st_mtime_ns for n, path in files.items() if path.exists()}
    assert len(made) == 3
    removed = next(iter(made))
    files[removed].unlink()
    run_oracle(study, 4)
    now = {n: path.stat().st_mtime_ns for n, path in files.items()}
    assert [now[n] == made.get(n) for n in files] == [n in made and n != removed for n in files]
    # The same recording seen in another way.
    other = load("sequences.three.stop=3")
    assert other.archive("oracle").errors_of("three", model.sets) == {}
    (row,) = run_oracle(other, 2)
    assert "4 trials are run again: sequences.three.stop is new" in caplog.text
    assert row["sets"] == 2
    assert len(other.archive("oracle").errors_of("three", model.sets)[model.fixed]) < 40
    assert all(path.exists() for path in files.values())


def test_each_of_several_odometries_is_run_on_the_test(study_file, tmp_path):
    fake = f"{{name: {fake_odometry.NAME}, label: LABEL}}"
    two = ", ".join(fake.replace("LABEL", label) for label in ("one", "two"))
    overrides = [f"odometry=[{two}]", "offline.trials=5", "offline.initial=5"]
    study = load_study(study_file, overrides, tmp_path)
    training = train(study)
    rows = run_odometries(study, training)
    tested = [row["test [%]"] for row in rows]
    assert tested == sorted(tested)
    assert {(row["odometry"], row["set"]) for row in rows} >= {
        (n, "its own parameters") for n in ("one", "two")
    }
    own = [row["vs one's own"] for row in rows if row["set"] == "its own parameters"]
    assert own == [1.0, 1.0]  # the same code
    best = next(row for row in rows if row["set"] != "its own parameters")
    archive = study.archive("odometries")
    errors = cap(archive.read_errors("three", [best["_trial"]]))
    assert best["test [%]"] == pytest.approx(np.nanmean(errors))
    # What is there is not run again, and a single odometry has no such rows.
    assert run_odometries(study, training) == rows
    alone = [row for row in training.trials if row["odometry"] == "one"]
    assert run_odometries(study, training._replace(trials=alone)) == []
