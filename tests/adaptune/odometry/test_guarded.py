"""Clean classes of the user have the same faults here as in a process of their own."""

import os
import pickle
import re

import faulty
import numpy as np
import pytest
from setups import setup_of

from adaptune.odometry import OdometryError
from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.remote import Guarded, Isolated, Limits
from adaptune.recording import Scan
from adaptune.selection import Selection
from offline.config import load_study
from offline.workers import Task, Workers, run

TOLD = {
    "init": "RuntimeError: no planes in init",
    "prepare": "RuntimeError: no planes in prepare",
    "start": "RuntimeError: no planes in start",
    "raise": "RuntimeError: no planes here",
    "exit": "SystemExit|ended with code 1",
    "hang": r"a scan took longer than isolation\.seconds = 0\.3",
    "hangs in init": r"a scan took longer than isolation\.seconds = 0\.3",
    "nothing": "TypeError: register returned None, not a Registration",
    "NaN": "it gave a pose that is not finite",
    "not rigid": "it gave a pose that is not rigid",
    "shape": r"it gave a pose of shape \(3, 4\)",
}


def factory(fault="none", name="faulty:Clean", **rest):
    return OdometryFactory(name, {"fault": fault}, faulty.Clean.space, Limits(seconds=0.3), **rest)


def scan(i):
    return Scan(i * 10**8, np.zeros((5, 3), np.float32))


def drive(odometry, n=6):
    """Poses of some scans along x, NaN where there is none."""
    odometry.start(odometry.prepare(scan(0)), np.eye(4))
    poses = [odometry.register(odometry.prepare(scan(i))).T_odom_sensor for i in range(1, n)]
    return [float(T[0, 3]) for T in poses]


def test_only_who_says_so_runs_them_here():
    assert isinstance(factory()(), Isolated)
    assert isinstance(factory(user_code=True)(), Guarded)
    assert isinstance(factory(user_code=True)(isolated=True), Isolated)
    assert isinstance(factory(name="faulty:Faulty", user_code=True)(), Isolated)
    assert isinstance(pickle.loads(pickle.dumps(factory(user_code=True)))(), Guarded)


@pytest.mark.parametrize("fault", TOLD)
@pytest.mark.parametrize("here", [True, False])
def test_faults_are_told_and_another_start_goes_on(fault, here):
    odometry = factory(fault, user_code=here)()
    assert isinstance(odometry, Guarded) == here
    x = drive(odometry)
    first = 2 if fault in ("raise", "exit", "NaN", "not rigid", "hang") else 0
    np.testing.assert_allclose(x[:first], 0.1 * np.arange(1, first + 1))
    assert np.isnan(x[first:]).all()
    (told,) = odometry.faults
    assert re.search(TOLD[fault], told), told
    odometry.start(odometry.prepare(scan(7)), np.eye(4))
    x = float(odometry.register(odometry.prepare(scan(8))).T_odom_sensor[0, 3])
    assert np.isnan(x) if fault in (*faulty.ELSEWHERE, "shape") else x == pytest.approx(0.1)
    if "hang" in fault:
        return
    for _ in range(20):
        odometry.start(odometry.prepare(scan(0)), np.eye(4))
        odometry.register(odometry.prepare(scan(3)))
    assert len(odometry.faults) == 10


def test_it_is_the_same_odometry_here_and_there():
    here, there = factory(user_code=True)({"x": 0.2}), factory()({"x": 0.2})
    assert drive(here) == drive(there)
    for odometry in (here, there):
        odometry.apply(Selection(0, {"x": 0.95}))
    for i in (6, 7):
        a, b = (o.register(o.prepare(scan(i))).T_odom_sensor for o in (here, there))
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(
            here.motions.T_previous_current, there.motions.T_previous_current
        )
    assert here.usage.cpu > 0.0
    assert here.usage.memory is None


def test_settings_are_checked_in_another_process():
    with pytest.raises(OdometryError, match=r"faulty:Clean: settings: fualt: .*'fault'"):
        OdometryFactory("faulty:Clean", {"fualt": "hang"}, faulty.Clean.space, Limits())


@pytest.fixture
def study(study_file, tmp_path):
    overrides = ["odometry.name=faulty:Clean", "odometry.parameters=", "odometry.settings="]
    return load_study(study_file, overrides, tmp_path / "study")


def test_a_class_that_ends_the_worker_then_runs_apart(study):
    setup = setup_of(study, factory("leaves", user_code=True))
    with Workers(setup, 1, 1e9) as workers:
        ((_, result, _),) = run(workers, [Task("one", (0,), ({"x": 0.5},), frames=True)])
    assert result.frames is not None
    assert "its process ended with code 3" in result.trials[0].faults[0]


def test_a_worker_may_end_its_process_group(study):
    with Workers(setup_of(study), 1, 1e9) as workers:
        list(run(workers, [Task("one", (), (), frames=True)]))
        (worker,) = workers._workers.values()
        assert os.getpgid(worker.process.pid) == worker.process.pid


def test_a_trial_of_a_class_that_raises(study):
    setup = setup_of(study, factory("prepare", user_code=True))
    with Workers(setup, 1, 1e9) as workers:
        ((_, result, _),) = run(workers, [Task("one", (0,), ({"x": 0.5},))])
    assert "no planes in prepare" in result.trials[0].faults[0]


def test_the_module_of_a_class_is_known_without_its_import():
    assert factory().module == "faulty"
