"""What becomes of a study whose files were damaged, whose recordings changed, or that is in use."""

import shutil
import subprocess
import sys

import drives
import pytest

from adaptune.errors import AdaptuneError
from adaptune.study.mistakes import ConfigurationError
from offline.offline_study import load_study
from offline.train import train


def load(folder):
    return load_study(folder / "small.yaml", ["offline.trials=4"], folder / "run")


def write(study_file, folder):
    for name in ("one", "two"):
        shutil.copy2(study_file.parent / f"{name}.bag", folder)
    text = study_file.read_text().replace("bag: three.bag", "bag: two.bag")
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
    frames = trained.folder / "trials/one/frames.npz"
    before = frames.read_bytes()
    frames.write_bytes(before[:100])
    train(trained)
    assert frames.read_bytes() == before
    frames.unlink()
    train(trained)
    assert frames.read_bytes() == before


def test_a_damaged_trial_is_named(trained):
    trial = trained.folder / "trials/two/00002.npz"
    trial.write_bytes(trial.read_bytes()[:1000])
    with pytest.raises(AdaptuneError, match=r"00002\.npz: is damaged .* remove it"):
        train(trained)
    trial.unlink()
    train(trained)


def test_another_recording_in_its_place_is_noticed(trained, tmp_path):
    (tmp_path / "one.bag").unlink()
    drives.write_bag(tmp_path / "one.bag", drives.scans(7, 40))
    with pytest.raises(ConfigurationError, match=r"other values of recordings\.one"):
        train(load_study(tmp_path / "small.yaml", ["offline.trials=4"], trained.folder))


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
        "from pathlib import Path; from offline.offline_study import load_study;"
        f"load_study(Path({str(study.folder.parent / 'small.yaml')!r}), [],"
        f" Path({str(study.folder)!r})).open()"
    )
    done = subprocess.run(
        [sys.executable, "-c", other], capture_output=True, text=True, check=False
    )
    assert "another adaptune is at work here" in done.stderr


@pytest.mark.parametrize("text", ["", "training: [", "\xff", "a: 1\n"])
def test_a_damaged_configuration_is_named(study, text):
    study.open()
    (study.folder / "study.yaml").write_text(text, encoding="latin-1")
    with pytest.raises(ConfigurationError, match=r"study\.yaml: is damaged"):
        study.check()
