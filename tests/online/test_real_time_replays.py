"""A study whose replays are made in real time."""

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from made_replays import folder_of

from adaptune._system import manifest
from adaptune.model import BankSettings, ErrorModel
from adaptune.runs.files import read_run
from offline.config import load_study
from online.compare import compare
from online.modes import run_replays
from online.verdict import remarks

RATE = "online.real_time.rate=5"
WAITS = "online.real_time.deadline=60"
BANK = "online.switching.mechanism=bank"


@pytest.fixture(scope="module")
def study(study_file, trained_folder, tmp_path_factory):
    """With a bank, and replays in real time."""
    folder = shutil.copytree(trained_folder, tmp_path_factory.mktemp("real_time") / "run")
    overrides = ["online.modes=[adaptive]", BANK, "online.real_time.queue=0", RATE, WAITS]
    study = load_study(study_file, overrides, folder)
    model = ErrorModel.load(study.model_path)
    replace(model, bank_settings=BankSettings()).save(study.model_path)
    with pytest.MonkeyPatch.context() as patch:
        # The selector sees every scan, also where the tests share a core.
        patch.setattr("online.selector_process.SLOTS", 100)
        run_replays(study, study.model_path)
    return study


def summary(study, mode):
    return json.loads((folder_of(study, mode) / "replay.json").read_text())


def test_it_is_recorded_how_a_replay_kept_up(study):
    for mode in ("baseline", "fixed", "adaptive"):
        found = summary(study, mode)
        kept = found["real_time"]
        inputs = manifest.recorded(folder_of(study, mode) / manifest.FILE)
        assert inputs["real_time"] == {"rate": 5.0, "deadline": 60.0, "queue": 0}
        assert (kept["rate"], kept["dropped_scans"], kept["missed_selections"]) == (5.0, 0, 0)
        assert 0.0 < kept["pose_ms_p50"] <= kept["pose_ms_p99"]
        assert (kept["selection_ms_p50"] > 0.0) == (mode == "adaptive")
        with (folder_of(study, mode) / "frames.csv").open() as file:
            late = [float(row["late_ms"]) for row in csv.DictReader(file)]
        assert np.percentile(late, 50) == pytest.approx(kept["pose_ms_p50"], abs=0.01)


def test_without_a_miss_it_is_what_lockstep_gives(study, study_file):
    in_real_time = read_run(folder_of(study, "adaptive"))
    overrides = ["online.modes=[adaptive]", BANK]
    lockstep = load_study(study_file, overrides, study.folder.parent / "lockstep")
    shutil.copytree(study.folder, lockstep.folder)
    assert run_replays(lockstep, lockstep.model_path) == 3  # those in real time are others
    found = read_run(folder_of(lockstep, "adaptive"))
    np.testing.assert_allclose(
        in_real_time.trajectory.T_world_sensor, found.trajectory.T_world_sensor, atol=1e-9
    )
    assert list(in_real_time.choice_stamps) == list(found.choice_stamps)
    np.testing.assert_allclose(in_real_time.estimated, found.estimated, atol=1e-9)
    assert found.summary.real_time is None
    # Both are there, and each is compared with its own.
    for one, pace in ((lockstep, None), (study, {5.0})):
        of_rows = [row.run.real_time for row in compare(one).rows]
        assert (
            all(of is None for of in of_rows)
            if pace is None
            else {r["rate"] for r in of_rows} == pace
        )


def test_replays_in_real_time_are_compared_as_they_are(study):
    """Also where scans were dropped."""
    said = remarks(compare(study).rows)
    (told,) = (text for text in said if text.startswith("Replayed at 5 times the recorded rate,"))
    assert "nothing came too late: 99 % of the poses came within " in told
    fixed = folder_of(study, "fixed")
    said = json.loads((fixed / "replay.json").read_text())
    said["real_time"] |= {"dropped_scans": 1, "missed_selections": 2}
    (fixed / "replay.json").write_text(json.dumps(said))
    for name in ("frames.csv", "trajectory.tum"):
        lines = (fixed / name).read_text().splitlines(keepends=True)
        # One of the last twenty scans.
        (fixed / name).write_text("".join(lines[:-20] + lines[-19:]))
    rows = compare(study).rows
    assert [row.mode for row in rows] == ["baseline", "fixed", "adaptive"]
    assert {row.run.real_time["rate"] for row in rows} == {5.0}
    (found,) = [text for text in remarks(rows) if "too late" in text]
    assert "On three `fixed` was too late for 1 scan and 2 selections, at 5 times the" in found
