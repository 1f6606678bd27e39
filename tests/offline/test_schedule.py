"""Which drives a worker is given, and when a trial is complete."""

import numpy as np
import pytest
from made_trials import Drawn
from rooms import along_x

from adaptune.runs.archive import Archive, Frames
from offline.campaign import Schedule
from offline.config import load_study

SEGMENTS = [[0, 2, 12], [14, 16, 26], [28, 30, 40]]
CUT = Frames(
    np.arange(40) * 10**8,
    along_x(0.3 * np.arange(40)),
    np.zeros((40, 90), np.float32),
    {"ndt": 90},
    np.zeros(40, np.float32),
    evidence_ms=1.0,
    segments=np.array(SEGMENTS),
)


@pytest.fixture
def schedule(study_file, tmp_path):
    study = load_study(study_file, ["sub_trajectory=1.0"], tmp_path / "study")
    archive = Archive(study.folder / "trials")
    archive.write_frames("one", CUT)
    made = Schedule(study, archive, "runs")
    for number in range(4):
        made.add("one", number, {"keyframe_interval": 1.0 + number})
    return made


def begins(*tasks):
    return [task.segment.first for task in tasks]


def test_a_worker_goes_on_where_its_scans_are_and_else_where_nobody_is(schedule):
    one = schedule.take(set(), set(), 2)
    held = {one.prepares}
    other = schedule.take(set(), held, 2)
    again = schedule.take(held, {other.prepares}, 2)
    assert begins(one, other, again) == [0, 14, 0]
    # Some are left for others, and for the time when the next sets wait.
    assert [list(task.sets) for task in (one, other, again)] == [[0, 1], [0, 1], [2]]
    held_by_other = {other.prepares}
    last = schedule.take(held, held_by_other, 2)
    assert (begins(last), list(last.sets)) == ([0], [3])
    # Where nothing waits that it holds, it takes what nobody has.
    assert begins(schedule.take(held, held_by_other, 2)) == [28]


def test_sets_that_take_scans_alike_are_driven_together(schedule, study_file, tmp_path):
    study = load_study(study_file, ["odometry={name: gicp}"], tmp_path / "other")
    schedule = Schedule(study, schedule._archive, "runs")
    sets = [{"downsampling": 0.5 if number % 2 else 0.25} for number in range(4)]
    for number, parameters in enumerate(sets):
        schedule.add("one", number, study.odometry.space.complete(parameters))
    one = schedule.take(set(), set(), 2)
    other = schedule.take(set(), {one.prepares}, 2)
    again = schedule.take({one.prepares}, {other.prepares}, 2)
    assert [list(task.sets) for task in (one, other, again)] == [[0], [0], [2]]
    assert begins(one, other, again) == [0, 14, 0]


class Slow(Drawn):
    """Trial 1 is too slow along the first segment."""

    def wait(self):
        ((worker, drives),) = super().wait()
        if 1 in drives:
            drives[1][0].too_slow = True
        return [(worker, drives)]


def test_trials_are_made_of_their_segments_and_a_slow_set_is_driven_no_more(schedule):
    pool = Slow(lambda _, parameters: parameters["keyframe_interval"] - 1.0)
    found = {number: trial for _, number, trial in schedule.run(pool)}
    assert sorted(found) == [0, 1, 2, 3]
    driven = [task.segment.first for task in pool.tasks if 1 in task.sets]
    assert driven == [0]
    assert found[1].failure.startswith("too slow: ")
    assert not found[2].failure
    assert found[2].mean_error == pytest.approx(2.0 * 1.2, abs=0.3)
    known = np.isfinite(found[3].T_odom_sensor[:, 0, 0])
    assert np.flatnonzero(~known).tolist() == [12, 13, 26, 27]
    counted = np.flatnonzero(~np.isnan(found[3].errors))
    assert set(counted) <= {*range(2, 12), *range(16, 26), *range(30, 40)}
    assert not schedule.waits()


def test_what_is_not_described_is_described_first_and_measured_last(study_file, tmp_path):
    study = load_study(study_file, [], tmp_path / "study")
    archive = Archive(study.folder / "trials")
    schedule, pool = Schedule(study, archive, "runs"), Drawn(lambda *_: 1.0)
    schedule.add("two", 0, {})
    for done in schedule.run(pool):
        schedule.store(*done)
        assert np.isnan(archive.read_frames("two").evidence_ms)
    schedule.close()
    assert [bool(task.sets) for task in pool.tasks] == [False, True, False]
    assert archive.read_frames("two").evidence_ms == 1.0
    assert list(archive.finished("two")) == [0]
