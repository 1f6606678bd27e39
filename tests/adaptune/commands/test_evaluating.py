import commands
import pytest

from adaptune.commands import terminal


@pytest.fixture
def evaluate(tmp_path, monkeypatch, study_file):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(terminal.console, "width", 130)
    bag = study_file.parent / "one.bag"
    options = ("--reference", "/truth", "--sub-trajectory", 1)
    return lambda *words: commands.call("evaluate", bag, *words, *options)


def test_one_command_says_how_good_and_writes_a_page(evaluate, tmp_path):
    done = evaluate("/truth", "--details")
    assert done.exit_code == 0, done.output
    assert done.stdout.startswith("/truth on one is wrong by 0.00 %")
    for words in ("Errors over 1 m", "APE [m]", "KITTI [%]", "More: runs/evaluate/evaluation.html"):
        assert words in done.stdout
    folder = tmp_path / "runs/evaluate"
    assert (folder / "figures/paths.png").exists()
    assert "one-errors" in (folder / "evaluation.html").read_text("utf-8")
    assert {path.name for path in folder.glob("*.*")} == {
        *("evaluation.html", "evaluation.csv", "evaluation.json")
    }


@pytest.mark.parametrize(
    ("place", "most", "code", "words"),
    [
        ("0 0 0 0 0 0 1", "1%", 0, "Below 1 %."),
        ("[0, 0, 0, 0, 0, 0.7071, 0.7071]", "1%", 3, "Surely above 1 %."),
        ("0 0 0 0 0 0 1", "x", 2, "--max x: give a percentage"),
        ("0 0 0", "1", 2, "extrinsic: give numbers"),
    ],
)
def test_a_bound_decides_the_exit_code(evaluate, monkeypatch, place, most, code, words):
    monkeypatch.setattr("adaptune.evaluation.shown.write_page", lambda *_: None)
    done = evaluate("/truth", "--max", most, "--extrinsic", place)
    assert done.exit_code == code, done.output
    assert words in done.stdout + " ".join(done.stderr.split())
