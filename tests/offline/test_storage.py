"""The mirror of a study's trials in Optuna's storages."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import optuna
import postgres
import pytest
from optuna.storages.journal import JournalFileBackend

from adaptune.space import Float, Integer, ParameterSpace, PooledSpace
from adaptune.strict import ConfigurationError
from offline.config import OfflineConfig, load_study
from offline.storage import JOURNAL, MirrorRow, StorageError, open_mirror


@pytest.fixture
def study(study_file, tmp_path):
    return at(study_file, tmp_path)


def at(study_file, folder, *overrides):
    study = load_study(study_file, overrides, folder / "mirrored")
    study.folder.mkdir(exist_ok=True)
    return study


def mirror_of(study, finished):
    return open_mirror(study.folder, study.config.offline, study.odometry.space, finished)


def row(number):
    rng = np.random.default_rng(number)
    parameters = {
        "max_correspondence_distance": rng.uniform(0.1, 5.0),
        "keyframe_interval": rng.uniform(0.5, 15.0),
    }
    attributes = {"one": rng.random(), "lost": number}
    return MirrorRow(parameters, (rng.gamma(1.0),), attributes, {"ms_per_scan <= 9": rng.normal()})


def in_journal(study):
    storage = optuna.storages.JournalStorage(JournalFileBackend(str(study.folder / JOURNAL)))
    return optuna.load_study(study_name="mirrored", storage=storage)


def assert_mirrors(mirror, n):
    trials = mirror.get_trials()
    assert [trial.number for trial in trials] == list(range(n))
    for trial in trials:
        expected = row(trial.number)
        assert (trial.params, trial.values) == (expected.parameters, list(expected.values))
        assert expected.attributes.items() <= trial.user_attrs.items()
        assert trial.constraints == expected.constraints


def test_trials_are_told_once_and_in_order(study):
    mirror_of(study, {}).report(range(3), row)
    mirror = mirror_of(study, {})
    mirror.report(range(3), row)
    mirror.report(range(5), row)
    mirror.report(range(4), row)
    assert_mirrors(in_journal(study), 5)


def test_numbers_may_come_in_any_order(study):
    """As where every sequence has a search of its own."""
    mirror_of(study, {}).report([0, 3, 1], row)
    mirror_of(study, {}).report([0, 3, 6, 1, 4], row)
    numbers = [trial.user_attrs["adaptune trial"] for trial in in_journal(study).get_trials()]
    assert numbers == [0, 3, 1, 6, 4]


def test_a_journal_that_knows_all_is_not_replayed(study, monkeypatch):
    mirror_of(study, {}).report(range(3), row)
    monkeypatch.setattr(optuna, "create_study", None)
    mirror_of(study, {}).report(range(3), None)


def cut_short(journal):
    journal.write_bytes(journal.read_bytes()[:-20])


def garble(journal):
    lines = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(b"".join([*lines[:3], b"\xffnonsense\n", *lines[3:-1]]))


def empty(journal):
    journal.write_bytes(b"")


def lock(journal):
    """What a killed driver may leave behind."""
    Path(f"{journal}.lock").symlink_to(journal)


@pytest.mark.parametrize("harm", [cut_short, garble, empty, Path.unlink, lock])
def test_a_damaged_journal_is_made_anew(study, harm):
    mirror_of(study, {}).report(range(4), row)
    harm(study.folder / JOURNAL)
    mirror_of(study, {}).report(range(5), row)
    assert_mirrors(in_journal(study), 5)


def test_what_is_no_number_is_a_failed_trial(study):
    mirror_of(study, {}).report(range(1), lambda n: row(n)._replace(values=(float("nan"),)))
    (trial,) = in_journal(study).get_trials()
    assert trial.state == optuna.trial.TrialState.FAIL


def test_trials_of_several_odometries_have_their_own_parameters_alone(tmp_path):
    """In Optuna's words: parameters are conditional on the odometry."""
    distance = Float(low=0.1, high=10.0, baseline=1.0, log=True)
    space = PooledSpace(
        {
            "gicp": ParameterSpace.of(distance=distance, passes=Integer(low=1, high=9, baseline=3)),
            "ndt": ParameterSpace.of(distance=distance),
        }
    )
    run = SimpleNamespace(folder=tmp_path / "mirrored")
    run.folder.mkdir()
    for n in (1, 2):  # at first, and when resumed
        mirror = open_mirror(run.folder, OfflineConfig(), space, {})
        mirror.report(range(n), lambda number: MirrorRow(space.baselines[number], (1.0,)))
    trials = in_journal(run).get_trials()
    assert [trial.params for trial in trials] == [
        {"odometry": "gicp", "gicp.distance": 1.0, "gicp.passes": 3},
        {"odometry": "ndt", "ndt.distance": 1.0},
    ]
    assert all(trial.distributions.keys() == trial.params.keys() for trial in trials)
    assert trials[1].distributions["ndt.distance"].log


@pytest.fixture
def database():
    """A server, and the URL of its first database."""
    with postgres.running() as (server, url):
        yield server, url.format("postgres")


def test_a_database_is_told_the_same(study_file, tmp_path, database):
    _, url = database
    study = at(study_file, tmp_path, f"offline.storage={url}")
    mirror_of(study, {}).report(range(3), row)
    finished = {n: row(n).parameters for n in range(3)}
    mirror_of(study, finished).report(range(5), row)
    mirror = optuna.load_study(study_name="mirrored", storage=url.replace("://", "+pg8000://"))
    assert_mirrors(mirror, 5)
    for others in ({}, {0: row(7).parameters}):
        with pytest.raises(StorageError, match="holds 5 trials of another study named mirrored"):
            mirror_of(study, others)


def test_a_database_that_goes_is_told_later(study_file, tmp_path, database, caplog):
    server, url = database
    study = at(study_file, tmp_path, f"offline.storage={url}")
    mirror = mirror_of(study, {})
    mirror.report(range(1), row)
    server.stop()
    mirror.report(range(2), row)
    mirror.report(range(3), row)
    assert caplog.text.count("does not receive trials now") == 1
    server.start()
    mirror.report(range(4), row)
    mirror.report(range(5), row)
    assert_mirrors(mirror._mirror, 5)


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("postgresql://me:secret@localhost:1/x", "cannot be reached"),
        ("nonsense://x", "is not the URL of a database"),
        ("postgresql+nonsense://x", "is not the URL of a database"),
        ("postgresql+asyncpg://x", "its driver is not installed"),
    ],
)
def test_a_storage_that_cannot_be_used_is_told_without_its_password(
    study_file, tmp_path, url, words
):
    study = at(study_file, tmp_path, f"offline.storage={url}")
    with pytest.raises(StorageError, match=words) as told_:
        mirror_of(study, {})
    assert "offline.storage" in str(told_.value)
    assert "secret" not in str(told_.value)


def test_passwords_come_from_the_environment_and_go_nowhere(study_file, tmp_path, monkeypatch):
    url = "offline.storage=postgresql://me:${PASSWORD}@host/x"
    with pytest.raises(ConfigurationError, match="environment variable PASSWORD is not set"):
        at(study_file, tmp_path, url)
    monkeypatch.setenv("PASSWORD", "secret")
    study = at(study_file, tmp_path, url)
    assert study.config.offline.storage == "postgresql://me:secret@host/x"
    study.open()
    written = (study.folder / "study.yaml").read_text()
    assert "postgresql://me@host/x" in written
    assert "secret" not in written
    with pytest.raises(ConfigurationError, match=r"offline\.storage"):
        at(study_file, tmp_path, "offline.storage=localhost")
