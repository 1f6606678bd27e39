import shutil

import fake_odometry
import numpy as np
import pytest
from commands import succeeded

from adaptune.archive import Archive
from adaptune.metrics import cap
from adaptune.model import ErrorModel
from adaptune.study.oracle import oracle_errors
from offline.config import load_study
from offline.train import odometry_rows, oracle_sets, run_oracle, train

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
    found = oracle_errors(archive, "three", model)
    assert set(found.trials) == set(oracle_sets(model, N))
    assert found.trials[0] == model.fixed
    assert found.errors.shape == (40, N)
    # The last sub-trajectory of 3 m begins ten scans before the end.
    assert np.isfinite(found.errors[:29]).all()
    assert np.isnan(found.errors[31:]).all()
    least = np.nanmean(cap(found.errors), axis=0).min()
    assert f"{least:.3f}" in done.stdout
    assert oracle_errors(archive, "one", model) is None


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
    assert oracle_errors(other.archive("oracle"), "three", model) is None
    assert "of other inputs: sequences.three.stop is new; run `adaptune online" in caplog.text
    (row,) = run_oracle(other, 2)
    assert row["sets"] == 2
    assert len(oracle_errors(other.archive("oracle"), "three", model).errors) < 40
    assert not files[oracle_sets(model, 4)[3]].exists()


def test_each_of_several_odometries_is_run_on_the_test(study_file, tmp_path):
    fake = f"{{name: {fake_odometry.NAME}, label: LABEL}}"
    two = ", ".join(fake.replace("LABEL", label) for label in ("one", "two"))
    overrides = [f"odometry=[{two}]", "offline.trials=5", "offline.initial=5"]
    study = load_study(study_file, overrides, tmp_path)
    training = train(study)
    rows = odometry_rows(study, training)
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
    assert odometry_rows(study, training) == rows
    alone = [row for row in training.trials if row["odometry"] == "one"]
    assert odometry_rows(study, training._replace(trials=alone)) == []
