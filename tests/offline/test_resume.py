import re
import shutil
import subprocess
import sys
from dataclasses import replace

import drives
import numpy as np
import pytest

from adaptune._system.strict import ConfigurationError
from adaptune.errors import AdaptuneError
from adaptune.model import ErrorModel
from offline.config import load_study
from offline.train import train


def load(folder):
    return load_study(folder / "small.yaml", ["offline.trials=4"], folder / "run")


def write(study_file, folder):
    for name in ("one", "two"):
        shutil.copy2(study_file.parent / f"{name}.bag", folder)
    text = study_file.read_text().replace("bag: three.bag", f"bag: {study_file.parent}/three.bag")
    (folder / "small.yaml").write_text(text)
    return load(folder)


@pytest.fixture
def study(study_file, tmp_path):
    return write(study_file, tmp_path)


@pytest.fixture(scope="module")
def finished(study_file, tmp_path_factory):
    """A folder with recordings, a study, and its run; not to be changed."""
    folder = tmp_path_factory.mktemp("finished")
    train(write(study_file, folder))
    return folder


@pytest.fixture
def trained(finished, tmp_path):
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    configuration = tmp_path / "run/study.yaml"
    configuration.write_text(configuration.read_text().replace(str(finished), str(tmp_path)))
    return load(tmp_path)


def test_frames_that_are_damaged_or_removed_are_made_again(trained):
    frames = trained.archive().of("one") / "frames.npz"
    before = timeless(frames)
    frames.write_bytes(frames.read_bytes()[:100])
    train(trained)
    assert timeless(frames) == before
    frames.unlink()
    train(trained)
    assert timeless(frames) == before


def timeless(frames):
    """The arrays of a file of frames, without the time that their evidence took."""
    with np.load(frames) as arrays:
        return {name: arrays[name].tobytes() for name in arrays if name != "evidence_ms"}


def mtimes(folder):
    """When the files of trials were written, by sequence and number."""
    return {path.relative_to(folder): path.stat().st_mtime_ns for path in folder.rglob("*.npz")}


def test_only_what_depends_on_another_recording_is_computed_again(trained, tmp_path, caplog):
    before, trials = ErrorModel.load(trained.model_path), trained.folder / "trials"
    written = mtimes(trials)
    drives.write_bag(tmp_path / "new.bag", drives.scans(7, 40))
    (tmp_path / "new.bag").replace(tmp_path / "one.bag")
    study = load(tmp_path)
    found = train(study).model
    assert re.search(r"4 trials are run again: .*one\.bag has other content", caplog.text)
    after = mtimes(trials)
    assert written.items() <= after.items()
    assert {path.parts[0].partition("-")[0] for path in after.keys() - written} == {"one"}
    assert found.sets.parameters == before.sets.parameters
    of_one, of_two = found.sequence == 0, found.sequence == 1
    assert not np.array_equal(found.errors[of_one], before.errors[before.sequence == 0])
    assert np.array_equal(found.errors[of_two], before.errors[before.sequence == 1])


def test_with_nothing_to_do_nothing_is_done(trained):
    before, time = trained.model_path.read_bytes(), trained.model_path.stat().st_mtime_ns
    first = train(trained)
    assert trained.model_path.stat().st_mtime_ns == time
    # A refit finds the same.
    model = ErrorModel.load(trained.model_path)
    replace(model, provenance=model.provenance | {"evidence": ""}).save(trained.model_path)
    train(trained)
    assert trained.model_path.read_bytes() == before
    assert len(first.trials) == 4


def test_a_folder_names_the_study_that_was_trained_in_it(trained):
    for name in trained.training:
        assert load_study(trained.folder).archive().of(name).exists()


def test_small_files_that_are_damaged_or_gone_cost_no_trial(trained):
    written, archive = mtimes(trained.folder / "trials"), trained.archive()
    current, inputs = trained.folder / "trials/current.json", archive.of("one") / "inputs.json"
    for file, text in ((current, None), (current, "{"), (inputs, None), (inputs, "{")):
        before = file.read_text()
        file.unlink() if text is None else file.write_text(text)
        train(load(trained.folder.parent))
        assert file.read_text() == before
    assert mtimes(trained.folder / "trials").keys() == written.keys()


@pytest.mark.parametrize("file", ["trials/one/inputs.json", "replays/three/reference.inputs.json"])
def test_a_folder_of_an_older_version_stays_as_it_is(study_file, tmp_path, file):
    path = tmp_path / "run" / file
    path.parent.mkdir(parents=True)
    path.write_text("{}")
    with pytest.raises(
        ConfigurationError, match=r"run: its trials .* run again with another --fol"
    ):
        load_study(study_file, [], tmp_path / "run")
    assert path.exists()


@pytest.mark.usefixtures("study")
def test_a_recording_of_empty_clouds_is_refused(tmp_path):
    empty = [(stamp, points[:3], T) for stamp, points, T in drives.scans(0, 20)]
    (tmp_path / "two.bag").unlink()
    drives.write_bag(tmp_path / "two.bag", empty)
    with pytest.raises(
        AdaptuneError, match=r"two: none of its 20 scans has 20 points; check `points`"
    ):
        train(load_study(tmp_path / "small.yaml", [], tmp_path / "other"))


def test_two_cannot_work_in_one_folder(study):
    study.open()
    other = (
        "from pathlib import Path; from offline.config import load_study;"
        f"load_study(Path({str(study.folder.parent / 'small.yaml')!r}), [],"
        f" Path({str(study.folder)!r})).open()"
    )
    done = subprocess.run(
        [sys.executable, "-c", other], capture_output=True, text=True, check=False
    )
    assert "another adaptune is at work here" in done.stderr
