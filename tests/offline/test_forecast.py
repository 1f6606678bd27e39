import numpy as np
import pytest

from adaptune.runs.archive import Archive
from offline.campaign import ALONE, FITTING, USUAL_COST, Forecast, forecast
from offline.config import load_study
from offline.search import Stopwatch


@pytest.fixture
def study(study_file, trained_folder):
    return load_study(study_file, [], trained_folder)


def test_it_follows_from_the_baseline_s_drives(study, tmp_path):
    archive = Archive(study.folder / "trials")
    costs = [1e-3 * archive.finished(name)[0].cost for name in ("one", "two")]
    alone = forecast(study, archive, 1, Stopwatch(tmp_path))
    assert alone.each == pytest.approx(USUAL_COST * 40 * sum(costs))  # scans of both
    assert alone.rest == 0.0  # trials drove the whole recordings
    two = forecast(study, archive, 2, Stopwatch(tmp_path, replays=True))
    assert two.each == alone.each / 2
    members = 5 if study.mechanism == "bank" else 1
    replays = ALONE + members * len(study.rules)
    assert two.rest == pytest.approx(40 * np.mean(costs) * replays)


def test_banks_leave_the_search_half_of_the_time(study_file, trained_folder, tmp_path):
    def rest(hours):
        few = load_study(study_file, [f"offline.hours={hours!r}"], trained_folder)
        return forecast(few, Archive(few.folder / "trials"), 1, Stopwatch(tmp_path, True)).rest

    whole = rest(1.0)
    of_banks = whole - rest(1e-9)
    assert of_banks > 0.0
    assert rest((2.0 * (whole + FITTING) - of_banks) / 3600.0) == pytest.approx(
        whole - 0.5 * of_banks
    )


def test_finalists_drive_the_rest_of_long_recordings(study, tmp_path, monkeypatch):
    archive = Archive(study.folder / "trials")
    drives = archive.summaries(["one", "two"], [0])
    monkeypatch.setattr(archive, "summaries", lambda *_: drives)
    monkeypatch.setattr(archive, "is_uncut", lambda _: False)
    found = forecast(study, archive, 1, Stopwatch(tmp_path))
    assert found.rest == pytest.approx(9 * found.each)


@pytest.mark.parametrize(
    ("left", "most", "words"),
    [
        (32, np.inf, "it takes about 7 min: 32 parameter sets of 10.0 s, and the rest"),
        (32, 200.0, "it takes about 3 min: 10 parameter sets of 10.0 s, and the rest"),
        (np.inf, 90.0, "it takes about 90 s: 0 parameter sets of 10.0 s, and the rest"),
    ],
)
def test_it_is_said_in_a_line(left, most, words):
    assert Forecast(10.0, 90.0).words(left, most) == words
