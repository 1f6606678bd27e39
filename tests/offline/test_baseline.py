import logging
from dataclasses import replace

import numpy as np
import pytest

from adaptune.archive import Archive, Trial
from adaptune.errors import AdaptuneError
from offline import campaign
from offline.campaign import BaselineError, check_baseline, run_baseline
from offline.config import load_study
from offline.train import train
from offline.trial import TrialSettings, TrialSetup
from offline.workers import Workers

FEW = ["offline.trials=3", "offline.initial=3", "offline.workers=1"]


def study_of(study_file, folder, *given, name="Stumbling", **settings):
    """The study with a stumbling odometry."""
    text = ", ".join(f"{name}: {value}" for name, value in settings.items())
    odometry = f"odometry={{name: 'stumbling:{name}', settings: {{{text}}}}}"
    return load_study(study_file, [odometry, *FEW, *given], folder)


@pytest.mark.parametrize("name", ["Stumbling", "Apart"])
@pytest.mark.parametrize("fault", ["constructor", "prepare", "start", "register", "nothing", "NaN"])
def test_a_baseline_that_fails_stops_the_campaign(study_file, tmp_path, name, fault):
    study = study_of(study_file, tmp_path / "study", name=name, fault=fault)
    reason = {"nothing": "returned None", "NaN": "pose"}.get(fault, "no licence")
    with pytest.raises(AdaptuneError, match=rf"sequences\.(one|two): .*baseline.*{reason}.*again"):
        train(study)
    assert not list(study.folder.rglob("*.npz"))
    assert not study.model_path.exists()
    if fault == "register":
        # Once it is mended, the same command works, and nothing has stayed.
        train(study_of(study_file, tmp_path / "study", name=name))
        assert not Archive(study.folder / "trials").read("one", 0).faults


def test_a_single_fault_is_told(caplog):
    n = 40
    run = Trial({}, np.tile(np.eye(4), (n, 1, 1)), *np.zeros((4, n)), ("hm",))
    with caplog.at_level(logging.WARNING, "offline.baseline"):
        check_baseline("mine", "one", replace(run, unhealthy={"no_pose": 3}))
    assert "sequences.one: mine with its own parameters, the baseline: 1 fault, the last: hm" in (
        caplog.text
    )
    for failed in ({"unhealthy": {"no_pose": 4}}, {"faults": ("hm",) * 10}):
        with pytest.raises(BaselineError, match=r"sequences\.one: mine fails .*; hm; nothing"):
            check_baseline("mine", "one", replace(run, **failed))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({}, None),
        ({"axis": 1}, "turned by about 90 degrees"),
        ({"step": -0.3}, "turned by about 180 degrees, or reversed in time"),
    ],
)
def test_a_reference_that_contradicts_the_motion_is_told(
    study_file, tmp_path, caplog, settings, words
):
    study = study_of(study_file, tmp_path / "study", **settings)
    with caplog.at_level(logging.WARNING, "offline.baseline"):
        train(study)
    told = [r.getMessage() for r in caplog.records if "contradicts" in r.getMessage()]
    if words is None:
        assert not told
        return
    assert len(told) == 2
    assert told[0].startswith("sequences.one: the reference contradicts")
    assert words in told[0]
    assert "extrinsic" in told[0]
    assert "clock_offset" in told[0]


def test_the_baseline_wins_where_trials_flatter(study_file, tmp_path):
    study = study_of(study_file, tmp_path / "study", "offline.trials=6")
    training = train(study)
    best = int(np.nanargmin(np.mean(list(training.means.values()), axis=0)))
    assert best != 0
    assert training.fixed == training.model.fixed == 0
    assert "the baseline is better than the trials suggested: its rte is" in training.remark
    assert f"trial {best}, the best by its trials" in training.remark
    assert "the fixed set is the baseline" in training.remark
    for row in training.rows:
        assert (
            row["baseline, whole run"] == row["fixed, whole run"] == pytest.approx(row["baseline"])
        )


def study_of_two(study_file, folder, second):
    """The study with a stumbling odometry and another."""
    return load_study(study_file, [f"odometry=[{{name: 'stumbling:Stumbling'}}, {second}]"], folder)


def run_baselines(study):
    """Run the baselines, and return the archive."""
    archive = Archive(study.folder / "trials")
    setup = TrialSetup(TrialSettings.of(study.config), study.odometry, study.sequences)
    with Workers(setup, 1, 1e9) as workers:
        run_baseline(study, archive, workers, lambda *_: None)
    return archive


def test_the_baseline_of_every_odometry_is_run_once(study_file, tmp_path, monkeypatch):
    second = "{name: 'stumbling:Apart', label: apart, settings: {step: 0.31}}"
    study = study_of_two(study_file, tmp_path / "study", second)
    archive = run_baselines(study)
    for name in ("one", "two"):
        for number, parameters in enumerate(study.odometry.space.baselines):
            assert archive.read(name, number, whole=True).parameters == parameters
        assert len(archive.read_frames(name).stamps) == 40
    # One that is lacking is run alone.
    monkeypatch.setattr(campaign, "check_baseline", lambda *told: ran.append(told[:2]))
    ran = []
    archive.trial_path("two", 1, whole=True).unlink()
    run_baselines(study)
    assert ran == [("apart", "two")]
