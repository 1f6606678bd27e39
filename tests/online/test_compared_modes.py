"""Modes on demand, and what is compared where some are missing."""

import csv
import json
import shutil
from dataclasses import replace

import drives
import numpy as np
import pytest
from made_replays import folder_of
from typer.testing import CliRunner

from adaptune._system.progress import unseen
from adaptune.commands.cli import app
from adaptune.errors import AdaptuneError
from adaptune.model import BankSettings, ErrorModel
from adaptune.runs.files import StoredReplayError
from adaptune.study.config import ALSO
from offline.config import load_study
from online.compare import compare, compared_modes
from online.modes import MODES, Replays, replay_modes, run_replays, run_untrained

EVERY = list(MODES)


@pytest.fixture(scope="module")
def load(study_file, trained_folder, tmp_path_factory):
    """Loads a study whose model knows a better set than the fixed one."""
    folder = shutil.copytree(trained_folder, tmp_path_factory.mktemp("on_demand") / "study")
    path = folder / "model.safetensors"
    model = ErrorModel.load(path)
    errors = model.errors.copy()
    errors[:, model.sets.column(model.bank[1])] *= 0.1
    replace(model, errors=errors).save(path)
    return lambda *overrides, at=folder: load_study(study_file, overrides, at)


@pytest.fixture(scope="module")
def replayed(load):
    study = load("online.modes=all")
    assert run_replays(study, study.model_path) == len(EVERY)
    return study


@pytest.fixture
def own(replayed, load, tmp_path):
    """Loads a copy of `replayed` that a test may change."""
    folder = shutil.copytree(replayed.folder, tmp_path / "study")
    return lambda *overrides: load(*overrides, at=folder)


def selections(study, mode, sequence="three"):
    with (folder_of(study, mode, sequence) / "selections.csv").open() as file:
        return list(csv.DictReader(file))


def about(study, mode, sequence="three"):
    path = folder_of(study, mode, sequence) / "inputs.json"
    return json.loads(path.read_text())["inputs"]


def test_all_are_compared_in_the_order_of_their_lines(replayed):
    rows = compare(replayed).rows
    assert [row.mode for row in rows] == EVERY
    assert {row.yardstick for row in rows} == {"fixed"}
    assert compared_modes(Replays.of(replayed)).words == []


def test_they_do_what_their_names_say(replayed):
    model = ErrorModel.load(replayed.model_path)
    trials = {int(row["trial"]) for row in selections(replayed, "standby")}
    assert trials == {model.fixed}
    weights = {row["weights"] for row in selections(replayed, "adaptive")}
    assert len(weights) > 1
    assert about(replayed, "adaptive")["switching"]["mechanism"] == "bank"
    members = model.bank[:4]  # without the reserve
    even = " ".join(f"{member}:{1 / len(members):.3f}" for member in members)
    assert {row["weights"] for row in selections(replayed, "even")} == {even}
    assert about(replayed, "even")["switching"]["mechanism"] == "bank"


def test_they_are_made_once_and_again_for_another_model(own):
    study = own("online.modes=all")
    before = selections(study, "adaptive")
    assert run_replays(study, study.model_path) == 0
    shutil.rmtree(folder_of(study, "adaptive"))
    assert run_replays(study, study.model_path) == 1
    assert [r["trial"] for r in selections(study, "adaptive")] == [r["trial"] for r in before]
    # Without being asked for, they are compared if they are there, and renewed by a command.
    settings = BankSettings(sharpness=7.0)
    replace(ErrorModel.load(study.model_path), bank_settings=settings).save(study.model_path)
    plain = own()
    assert run_replays(plain, plain.model_path) == 2
    assert {row.mode for row in compare(plain).rows} == {*EVERY} - {"standby", "even"}
    assert run_replays(study, study.model_path) == 2
    assert {row.mode for row in compare(plain).rows} == set(EVERY)


def test_what_a_scan_takes_is_compared_with_the_time_to_the_next(own, monkeypatch):
    study, asked = own(), []
    monkeypatch.setattr("online.compare.late", lambda *given: asked.append(given) or ["it is late"])
    assert "it is late" in compare(study).verdict
    ((rows, mode, periods),) = asked
    assert {row.mode for row in rows} >= {mode}
    assert periods == pytest.approx({"three": 100.0})


def test_where_live_changes_are_in_vain_the_other_modes_are_replayed(own, monkeypatch, caplog):
    study = own("online.modes=[paper, untrained]", "online.switching.mechanism=live")
    shutil.rmtree(study.folder / "replays")
    asked = []
    monkeypatch.setattr("online.modes._in_vain", lambda *_: asked.append(1) or "it never reads x")
    run_replays(study, study.model_path)
    assert Replays.of(study).made("three") == ("baseline", "fixed", "untrained")
    assert "paper is not replayed on three: it never reads x" in caplog.text
    assert len(asked) == 1


def test_what_is_missing_somewhere_is_told_and_left_out(own, tmp_path):
    bag = drives.write_bag(tmp_path / "four.bag", drives.scans(4, 40))
    four = f"sequences.four={{bag: {bag}, points: /points, reference: /truth}}"
    both = own("test=[three, four]", four, "online.modes=[adaptive, paper, even]")
    run_replays(both, both.model_path)
    shutil.rmtree(folder_of(both, "paper", "four"))
    shutil.rmtree(folder_of(both, "baseline"))
    assert {row.mode for row in compare(both).rows} == {"fixed", "adaptive", "even"}
    assert compared_modes(Replays.of(both)).words == [
        "Not compared, because replays are missing: `baseline` on three, `paper` on four; "
        "`adaptune online` makes them."
    ]
    shutil.rmtree(folder_of(both, "fixed", "four"))
    run_untrained(both)
    compared = compared_modes(Replays.of(both))
    assert (compared.sequences, compared.unfinished) == (("three",), ("four",))
    assert (
        "Not compared, because replays are missing: `fixed` on four, `paper` on four; `adaptune "
        "online` makes them."
    ) in compare(both).details
    shutil.rmtree(folder_of(both, "fixed"))
    assert {(row.mode, row.yardstick) for row in compare(both).rows} == {
        ("baseline", "baseline"),
        ("untrained", "baseline"),
    }
    shutil.rmtree(folder_of(both, "untrained", "four"))
    assert compared_modes(Replays.of(both)).sequences == ("three",)
    shutil.rmtree(folder_of(both, "untrained"))
    with pytest.raises(StoredReplayError, match=r"three: there is no fixed; run"):
        compare(both)


def test_where_only_some_were_replayed_without_a_model_those_are_compared(own, tmp_path):
    bag = drives.write_bag(tmp_path / "four.bag", drives.scans(4, 40))
    four = f"sequences.four={{bag: {bag}, points: /points, reference: /truth}}"
    both = own("test=[three, four]", four)
    shutil.rmtree(both.folder / "replays", ignore_errors=True)
    run_untrained(both)
    shutil.rmtree(folder_of(both, "baseline"))
    assert {row.sequence for row in compare(both).rows} == {"four"}
    assert (
        "Not compared, because replays are missing: `baseline` on three; `adaptune online "
        "--untrained` makes them."
    ) in compare(both).verdict  # what is recommended was not driven
    # Nothing that was is of the model.
    other = own("test=[three, four]", four, "online.budget=2x")
    assert compare(other).verdict[0].startswith("Keep the odometry's own parameters")


def test_without_a_test_what_training_recommends_is_not_compared(own):
    study = own("test=[]")
    shutil.rmtree(study.folder / "replays", ignore_errors=True)
    run_untrained(study)
    found = compare(study)
    assert found.model is None
    assert found.verdict[-1].endswith(": to compare it, name a test (test:).")


def test_the_command_line(own, study_file):
    folder = own().folder
    words = [str(study_file), "--folder", str(folder)]
    done = CliRunner().invoke(app, ["online", *words, "-o", "online.modes=all"])
    assert done.exit_code == 0, done.output
    assert "All replays were there already" in done.stdout
    assert "-o online.modes=all" in done.stdout.splitlines()[-1]
    shutil.rmtree(folder_of(own(), "paper"))
    done = CliRunner().invoke(app, ["compare", *words])
    assert done.exit_code == 0, done.output
    assert "paper" not in done.stdout
    done = CliRunner().invoke(app, ["compare", *words, "--details"])
    assert "replays are missing: `paper` on three" in done.stdout
    for value, words_ in (
        ("[even, even]", "one of them is named twice"),
        ("[odd]", "no mode 'odd'"),
    ):
        done = CliRunner().invoke(app, ["online", *words, "-o", f"online.modes={value}"])
        assert done.exit_code == 2
        assert words_ in done.stderr
    assert set(ALSO) < set(EVERY)


def test_a_baseline_with_a_fault_is_replayed_once_more(study_file, tmp_path, caplog):
    at = list(load_study(study_file, [], tmp_path / "any").sequences.open("three"))[5].stamp

    def made(name, once):
        falls = f"fault: raise, at: {at}, once: {once}"
        odometry = f"odometry={{name: 'faulty:Apart', settings: {{{falls}}}}}"
        study = load_study(study_file, [odometry], tmp_path / name)
        replay_modes(study, ["three"], ["baseline"], unseen)
        return Replays.of(study).read("three", "baseline")

    (tmp_path / "fell").touch()
    sound, found = made("sound", f"'{tmp_path}/fell'"), made("falls", f"'{tmp_path}/once'")
    assert (found.summary.restarts, found.summary.fault) == (0, "")
    np.testing.assert_array_equal(found.trajectory.T_world_sensor, sound.trajectory.T_world_sensor)
    words = "three, baseline: a fault with the odometry's own parameters: "
    assert [said for said in caplog.messages if words in said and "so once more" in said]
    with pytest.raises(AdaptuneError, match=f"{words}.*no planes here.*; mend the odometry, or"):
        made("always", "''")
    assert not (tmp_path / "always/replays").exists()
