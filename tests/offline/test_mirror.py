from pathlib import Path

import numpy as np
import optuna
import pytest
from optuna.storages.journal import JournalFileBackend

from adaptune.space import Float, Integer, ParameterSpace, PooledSpace
from offline.search import JOURNAL, Mirror, MirrorRow

SPACE = ParameterSpace.of(
    max_correspondence_distance=Float(low=0.1, high=5.0, baseline=1.0),
    keyframe_interval=Float(low=0.5, high=15.0, baseline=1.0),
)


@pytest.fixture
def folder(tmp_path):
    made = tmp_path / "mirrored"
    made.mkdir()
    return made


def mirror_in(folder):
    return Mirror(folder, 1, SPACE)


def row(number):
    rng = np.random.default_rng(number)
    parameters = {
        "max_correspondence_distance": rng.uniform(0.1, 5.0),
        "keyframe_interval": rng.uniform(0.5, 15.0),
    }
    attributes = {"one": rng.random(), "lost": number}
    return MirrorRow(parameters, (rng.gamma(1.0),), attributes, {"ms_per_scan <= 9": rng.normal()})


def in_journal(folder):
    storage = optuna.storages.JournalStorage(JournalFileBackend(str(folder / JOURNAL)))
    return optuna.load_study(study_name="mirrored", storage=storage)


def assert_mirrors(mirror, n):
    trials = mirror.get_trials()
    assert [trial.number for trial in trials] == list(range(n))
    for trial in trials:
        expected = row(trial.number)
        assert (trial.params, trial.values) == (expected.parameters, list(expected.values))
        assert expected.attributes.items() <= trial.user_attrs.items()
        assert trial.constraints == expected.constraints


def test_trials_are_told_once_and_in_order(folder):
    mirror_in(folder).report(range(3), row)
    mirror = mirror_in(folder)
    mirror.report(range(3), row)
    mirror.report(range(5), row)
    mirror.report(range(4), row)
    assert_mirrors(in_journal(folder), 5)


def test_numbers_may_come_in_any_order(folder):
    mirror_in(folder).report([0, 3, 1], row)
    mirror_in(folder).report([0, 3, 6, 1, 4], row)
    numbers = [trial.user_attrs["adaptune trial"] for trial in in_journal(folder).get_trials()]
    assert numbers == [0, 3, 1, 6, 4]


def test_a_journal_that_knows_all_is_not_replayed(folder, monkeypatch):
    mirror_in(folder).report(range(3), row)
    monkeypatch.setattr(optuna, "create_study", None)
    mirror_in(folder).report(range(3), None)


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
def test_a_damaged_journal_is_made_anew(folder, harm):
    mirror_in(folder).report(range(4), row)
    harm(folder / JOURNAL)
    mirror_in(folder).report(range(5), row)
    assert_mirrors(in_journal(folder), 5)


def test_what_is_no_number_is_a_failed_trial(folder):
    mirror_in(folder).report(range(1), lambda n: row(n)._replace(values=(float("nan"),)))
    (trial,) = in_journal(folder).get_trials()
    assert trial.state == optuna.trial.TrialState.FAIL


def test_trials_of_several_odometries_have_their_own_parameters_alone(folder):
    distance = Float(low=0.1, high=10.0, baseline=1.0, log=True)
    space = PooledSpace(
        {
            "gicp": ParameterSpace.of(distance=distance, passes=Integer(low=1, high=9, baseline=3)),
            "ndt": ParameterSpace.of(distance=distance),
        }
    )
    for n in (1, 2):  # at first, and when resumed
        mirror = Mirror(folder, 1, space)
        mirror.report(range(n), lambda number: MirrorRow(space.baselines[number], (1.0,)))
    trials = in_journal(folder).get_trials()
    assert [trial.params for trial in trials] == [
        {"odometry": "gicp", "gicp.distance": 1.0, "gicp.passes": 3},
        {"odometry": "ndt", "ndt.distance": 1.0},
    ]
    assert all(trial.distributions.keys() == trial.params.keys() for trial in trials)
    assert trials[1].distributions["ndt.distance"].log
