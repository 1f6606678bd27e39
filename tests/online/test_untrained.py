"""Replays of a bank that needs no trials, no model and no reference."""

import csv
import json

import numpy as np
import pytest
from commands import refused, succeeded
from made_replays import folder_of

from adaptune._system import manifest, yaml12
from adaptune.odometry.portfolio import read_portfolio
from adaptune.runs.files import StoredReplayError, read_run
from adaptune.selector import UntrainedSelector, untrained_sets
from adaptune.study.driven import ModeError
from offline.config import load_study
from online.compare import compare
from online.modes import ReplaySetup, run_untrained, sequences_without_model
from online.reference import reference_folder
from online.replayed import read_replays
from online.tables import tables
from online.verdict import remarks

MODES = ["baseline", "untrained"]
BLIND = "sequences.three.reference=none"
WHOLE = (
    "odometry={name: command, settings: {command: [sh, '{input}', '{output}', '{size}']}, "
    "parameters: {size: {type: float, low: 0.1, high: 3, baseline: 1}}}"
)


class Measuring(UntrainedSelector):
    """Says that it is lost at the second of its selections."""

    def __init__(self, sets, length):
        super().__init__(sets, length)
        self.n = 0

    def select(self):
        self.n += 1
        if self.n == 1:  # nothing is known yet
            return super().select()
        error = 2.0 * self.n
        return (
            super()
            .select()
            ._replace(
                estimated_error=error,
                estimated_low=error - 1.0,
                estimated_high=error + 3.0,
                state="lost" if self.n == 2 else "good",
            )
        )


@pytest.fixture
def load(study_file, tmp_path, monkeypatch):
    monkeypatch.setattr("online.modes.UntrainedSelector", Measuring)
    return lambda *overrides: load_study(study_file, overrides, tmp_path / "run")


def test_nothing_but_a_recording_is_needed(load, caplog):
    study = load(BLIND)
    assert run_untrained(study) == 2
    assert run_untrained(study) == 0
    assert not study.model_path.exists()
    assert not (reference_folder(study, "three") / "reference.tum").exists()
    folder = folder_of(study, "untrained")
    about = manifest.recorded(folder / manifest.FILE)
    sets = untrained_sets(study.odometry.space)
    assert about["switching"]["members"] == list(sets.parameters)
    assert about["model"] is None
    weights = [row["weights"] for row in read(folder / "selections.csv")]
    # Until something is measured.
    assert weights[0] == "0:1.000 1:0.000 2:0.000 3:0.000"
    assert weights[-1] != weights[0]
    # They are no trials: a trial of the same number has other parameters.
    (bank,) = (of for m, of in read_replays(study, "three").modes.items() if m == MODES[1])
    assert list(bank.weights) == ["baseline", *(f"untrained set {i}" for i in (1, 2, 3))]
    rows = compare(study).rows
    assert [(row.sequence, row.mode, row.rte) for row in rows] == [
        ("three", m, None) for m in MODES
    ]
    # Training is refused without a reference, which test three does not need.
    said = succeeded("compare", study.folder).stdout
    assert f"Next: adaptune offline {study.folder}" in said
    blind = ("-o", BLIND, "-o", "sequences.one.reference=none")
    said = succeeded("compare", study.folder, *blind).stdout
    first = f"leave out `reference: none` of {study.sequences.recorded_in('one')}; then"
    assert f"Next: {first} adaptune offline {study.folder}" in said
    # An estimate is told as one.
    assert rows[0].estimated is None
    assert (rows[1].estimated, rows[1].estimated_interval) == (6.0, (5.0, 9.0))
    nobody = "No test sequence has a reference: nobody can say what was gained."
    estimate = (
        "three has no reference. `untrained` estimates its own mean RTE there: 6.000 % (95 % "
        "interval 5.000-9.000 %)."
    )
    assert remarks(rows) == [estimate]
    assert compare(study).verdict == [nobody, estimate]
    assert caplog.messages == [
        "three, untrained: the bank is lost at 1.0 s",
        "three, untrained: the bank goes on at 2.0 s",
    ]


def read(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_what_a_bank_measures_of_itself_is_kept_and_compared(load):
    study = load()
    run_untrained(study)
    folder = folder_of(study, "untrained")
    rows = read(folder / "selections.csv")
    assert [row["estimated_error_percent"] for row in rows] == ["nan", "4.0000", "6.0000", "8.0000"]
    assert (rows[2]["estimated_low_percent"], rows[2]["estimated_high_percent"]) == (
        "5.0000",
        "9.0000",
    )
    assert [row["lost"] for row in rows] == ["0", "1", "0", "0"]
    summary = json.loads((folder / "replay.json").read_text())
    assert summary["lost_seconds"] == 1.0
    stored = read_run(folder)
    np.testing.assert_array_equal(stored.estimated[1:], [[4, 3, 7], [6, 5, 9], [8, 7, 11]])
    assert [choice.selection.lost for choice in stored.choices] == [False, True, False, False]
    compared = compare(study).rows
    assert [row.mode for row in compared] == MODES
    assert compared[0].ratio == 1.0
    assert compared[1].ratio == pytest.approx(compared[1].rte / compared[0].rte)
    written = json.loads((study.folder / "comparison/comparison.json").read_text())
    assert written[1]["vs baseline"] == compared[1].ratio
    assert (written[1]["estimated [%]"], written[1]["estimated_high"]) == (6.0, 9.0)
    assert {"estimated [%]", "lost [s]"} <= tables(compared, 3.0)[0].rows[0].keys()
    said = remarks(compared)
    assert said[0].startswith("`untrained` estimates its own mean RTE at 6.000 %")
    assert not any("fixed" in one or "no reference" in one for one in said)


def test_other_members_are_replayed_again(load):
    run_untrained(load())
    other = load("online.switching.size=3")
    with pytest.raises(StoredReplayError, match=r"untrained was made .*switching\.members has an"):
        compare(other)
    assert run_untrained(other) == 1  # the baseline is the same


def test_without_a_test_all_recordings_are_replayed_whole(load, study_file):
    assert sequences_without_model(load().config) == ("three",)
    study = load("test=[]", "training=[one: 0-60%, two]")
    assert sequences_without_model(study.config) == ("one", "two", "three")
    assert run_untrained(load("test=[]", "training=[two]")) == 6
    assert [row.sequence for row in compare(load("test=[]", "training=[two]")).rows][-2:] == [
        "all"
    ] * 2
    with pytest.raises(StoredReplayError, match="test: name at least one sequence to compare on"):
        compare(load_study(study_file, ["test=[]"], study.folder / "other"))


def test_a_bank_of_what_cannot_be_in_one_is_refused(study_file, tmp_path, load):
    words = [study_file, "--untrained", "--folder", tmp_path / "run"]
    said = refused("online", *words, "-o", WHOLE)
    assert "untrained is not possible: a program that runs whole recordings" in said
    said = refused("online", *words, "--model", "some.safetensors")
    assert "--untrained uses no model; leave out --model some.safetensors" in said
    setup = ReplaySetup.of(load())
    for mode in ("fixed", "adaptive"):
        with pytest.raises(ModeError, match=f"{mode}: needs an error model"):
            setup.mode(mode)
    assert setup.mode("baseline").selector is None


def test_the_command_line_names_what_follows(study_file, tmp_path):
    words = [study_file, "--folder", tmp_path / "run"]
    assert "2 replays made" in succeeded("online", *words, "--untrained").stdout
    done = succeeded("compare", *words)
    made = (tmp_path / "run").rglob("comparison/comparison.csv")
    # A narrow terminal breaks the names of columns.
    assert ["vs baseline" in path.read_text("utf-8") for path in made] == [True]
    assert "fixed.yaml" not in done.stdout
    assert "adaptune offline" in done.stdout.splitlines()[-1]
    said = refused("compare", *words, "-o", BLIND)
    assert "run `adaptune online --untrained` with this study, which" in said


def test_members_are_the_first_of_the_portfolio(load, tmp_path):
    base = load().odometry.space.baseline
    sets = [base, *({**base, "keyframe_interval": x} for x in (2.0, 4.0, 8.0))]
    data = {"odometry": "fake_odometry:Fake", "sets": [{"parameters": one} for one in sets]}
    (path := tmp_path / "mine.yaml").write_text(yaml12.dump(data))
    given = f"offline.portfolio={{{path}: {read_portfolio(str(path)).digest}}}"
    mode = ReplaySetup.of(load(given)).mode("untrained")
    assert list(mode.sets.values()) == sets[:2]
