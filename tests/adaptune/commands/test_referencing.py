import re

import commands
import estimates
import pytest

from adaptune.commands import terminal
from adaptune.reference import estimate
from adaptune.reference.stored import StoredEstimate
from adaptune.trajectory import read_tum


@pytest.fixture
def bag(study_file):
    return study_file.parent / "one.bag"


@pytest.fixture
def adaptune(tmp_path, monkeypatch):
    """Call the command line; estimates are made up."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(terminal.console, "width", 100)
    monkeypatch.setattr(estimate, "estimate_reference", estimates.Estimator())
    return lambda *words: commands.call("reference", *words)


def test_a_recording_gets_files_and_sentences(adaptune, bag, tmp_path):
    done = adaptune(bag)
    assert done.exit_code == 0, done.stderr
    assert "Estimated reference: 11.7 m, 40 scans." in done.stdout
    assert re.search(r"It is wrong by about \d.* % over 2 m, as its two halves tell", done.stdout)
    assert "It is known everywhere." in done.stdout
    assert "write `reference: one_reference.tum` under" in done.stdout.splitlines()[-1]
    assert len(read_tum(tmp_path / "one_reference.tum")) == 40
    stored = StoredEstimate.read(tmp_path / "one_reference.tum")
    assert stored.about == {"recording": str(bag), "points": "/points"}


def test_where_it_is_lost_is_said(adaptune, bag, tmp_path, monkeypatch):
    monkeypatch.setattr(estimate, "estimate_reference", estimates.Estimator(untrusted=[9]))
    done = adaptune(bag, "--out", "refs")
    assert done.exit_code == 0, done.stderr
    assert re.search(
        r"unknown for \d.* % of the scans, which have no pose: .* from 0.9 to 2.0 s after",
        done.stdout,
    )
    assert (tmp_path / "refs/one_reference.json").exists()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["none.bag"], "there is no such file"),
        (["BAG", "--points", "/none"], "/none"),
        (["STUDY"], "is a study, not a recording"),
        (["poses.tum"], "is a file of poses"),
    ],
)
def test_mistakes_are_told_in_a_sentence(adaptune, bag, study_file, tmp_path, words, expected):
    (tmp_path / "poses.tum").write_text("1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    named = {"BAG": bag, "STUDY": study_file}
    done = adaptune(*(named.get(word, word) for word in words))
    assert done.exit_code == 2
    assert expected in done.stderr


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--out", "a_file/refs"], "a_file/refs: cannot be written to"),
        (["--out", "mine"], "mine/one_reference.tum: is there, and is not of an estimate"),
    ],
)
def test_what_is_wrong_is_told_before_the_estimate(
    adaptune, bag, tmp_path, monkeypatch, words, expected
):
    (tmp_path / "a_file").touch()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/one_reference.tum").write_text("mine")

    def estimated(*_):
        raise AssertionError

    monkeypatch.setattr(estimate, "estimate_reference", estimated)
    done = adaptune(bag, *words)
    assert done.exit_code == 2
    assert expected in done.stderr
    assert (tmp_path / "mine/one_reference.tum").read_text() == "mine"
