import os
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from wicked import IMPORTS, gone, wait_until_gone

from adaptune._system import processes
from adaptune._system.strict import ConfigurationError
from adaptune.commands.tune import inspect
from adaptune.model import ModelError
from adaptune.model.error_model import ErrorModel
from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.remote import Limits
from adaptune.selector import Selector
from adaptune.space import Float, ParameterSpace
from offline.config import load_study
from offline.train import train
from online.modes import run_replays

NAMED = {
    "odometry": ["odometry.name=wicked_one:It", "odometry.parameters=", "odometry.settings="],
    "descriptor": ["descriptor=wicked_one:It"],
    "sampler": ["offline.sampler=wicked_one:It"],
}


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """Write modules that a study can name."""
    monkeypatch.syspath_prepend(str(tmp_path))
    processes.servers.clear()

    def write(name, text):
        (tmp_path / f"{name}.py").write_text(text)

    return write


@pytest.mark.parametrize(
    ("fault", "kind"),
    [*((fault, "odometry") for fault in IMPORTS), ("end", "descriptor")],
)
def test_an_import_that_goes_wrong_is_one_error(mine, monkeypatch, study_file, fault, kind):
    text, words = IMPORTS[fault]
    mine("wicked_one", text)
    if fault == "sleep":
        monkeypatch.setattr(processes, "IMPORT_SECONDS", 1.0)
    with pytest.raises(ConfigurationError, match=f"wicked_one:It: .*{words}"):
        load_study(study_file, NAMED[kind])
    assert "wicked_one" not in sys.modules


@pytest.mark.parametrize("kind", NAMED)
def test_what_is_no_module(study_file, kind):
    overrides = [o.replace("wicked_one:It", "../x:y") for o in NAMED[kind]]
    with pytest.raises(ConfigurationError, match=r"'\.\./x' is not the name of a module"):
        load_study(study_file, overrides)


@pytest.mark.parametrize("kind", NAMED)
def test_a_class_of_a_notebook_belongs_into_a_file(study_file, kind):
    overrides = [o.replace("wicked_one:It", "__main__:Mine") for o in NAMED[kind]]
    words = r"lives in this session only; put it into a file, mine\.py, and name mine:Mine"
    with pytest.raises(ConfigurationError, match=words):
        load_study(study_file, overrides)


MINE = """
import os
from pathlib import Path
with Path(__file__).with_name("imported").open("a") as file:
    file.write(f"{os.getpid()} ")

import numpy as np
from pydantic import Field
from adaptune.odometry import BaseSettings, Odometry, Registration
from adaptune.space import Float, ParameterSpace

class Settings(BaseSettings):
    step: float = Field(0.3, gt=0)

class Mine(Odometry):
    space = ParameterSpace({"scale": Float(low=0.5, high=2.0, baseline=1.1)})
    settings_type = Settings
    live, clean = True, True
    def prepare(self, scan):
        return scan.stamp
    def start(self, prepared, T_odom_sensor, T_previous_current=None):
        self.T = T_odom_sensor
    def register(self, prepared):
        self.T = self.T.copy()
        self.T[0, 3] += self.settings.step * self.parameters["scale"]
        return Registration(self.T)

def described(scan):
    return [len(scan), scan.points[:, 0].mean() if len(scan) else 0.0]
"""


@pytest.mark.services
@pytest.mark.usefixtures("processes")
def test_the_driver_imports_no_code_of_the_user_s(mine, study_file, tmp_path, capsys):
    mine("users_own", MINE)
    overrides = [
        "odometry.name=users_own:Mine",
        "odometry.parameters=",
        "odometry.settings={step: 0.3}",
        "descriptor=users_own:described",
        "offline={trials: 4, initial: 2, batch: 2, workers: 1}",
        "online.switching.mechanism=live",
    ]
    study = load_study(study_file, overrides, tmp_path / "study")
    assert study.odometry.settings.model_dump() == {"step": 0.3}
    model = train(study).model
    assert len(model.sets) == 4
    # There is no bank, and the fixed set may be the baseline, whose replay is its own then.
    assert run_replays(study, study.model_path) in (2, 3)
    imported = (tmp_path / "imported").read_text().split()
    assert len(set(imported)) >= 3
    assert str(os.getpid()) not in imported

    # Another study does not name the descriptor: nothing of it is used.
    (tmp_path / "imported").unlink()
    processes.servers.clear()
    with pytest.raises(ModelError, match="the model: uses the descriptor 'users_own:described'"):
        Selector(model)
    assert Selector(model, descriptors=["users_own:described"]).fixed == model.fixed
    other = load_study(study_file, [*overrides[:3], *overrides[5:]], tmp_path / "other")
    (tmp_path / "imported").unlink()
    with pytest.raises(ModelError, match=r"model\.safetensors: uses the descriptor 'users_own:des"):
        run_replays(other, study.model_path)
    inspect(study.model_path)
    assert "users_own:described" in capsys.readouterr().out
    ErrorModel.load(study.model_path)
    assert not (tmp_path / "imported").exists()


def test_mistakes_in_the_settings_of_a_user_s_class(mine, study_file):
    mine("users_own", MINE)
    base = ["odometry.name=users_own:Mine", "odometry.parameters="]
    for given, words in (
        ("odometry.settings={stepp: 1}", "odometry.settings.stepp: .*did you mean 'step'"),
        ("odometry.settings={step: -1}", "odometry.settings.step: "),
        ("odometry.parameters={scal: {low: 1}}", "no parameter 'scal': did you mean 'scale'"),
    ):
        with pytest.raises(ConfigurationError, match=words):
            load_study(study_file, [*base, given])


LEAVES = "sleep 1000 & echo $!; setsid sleep 1000 & echo $!; echo $$; "


def begin(tmp_path, then):
    """A program that leaves children, and the processes that it has started."""
    with (tmp_path / "output").open("wb+") as output:
        program = processes.Program(["sh", "-c", LEAVES + then], 4.0, stdout=output)
        while len(pids := (tmp_path / "output").read_text().split()) < 3:
            time.sleep(0.01)
    return program, pids


def test_what_a_program_has_started_ends_with_it(tmp_path):
    program, pids = begin(tmp_path, "sleep 0.2; exit 7")
    assert program.wait(10.0).code == 7
    wait_until_gone(pids)
    program.close()
    of_its_group = processes.Program(["sh", "-c", "kill -9 0"], 4.0)
    assert of_its_group.wait(10.0).code == -signal.SIGKILL
    of_its_group.close()
    for end in (processes.Program.close, processes.Program.end):
        program, pids = begin(tmp_path, "wait")
        assert program.wait(0.05) is None
        assert not any(map(gone, pids))
        end(program)
        wait_until_gone(pids)
        program.close()


DRIVER = """
import sys, time
import numpy as np
from adaptune._system import processes
from adaptune.odometry.base import BaseSettings
from adaptune.odometry.remote import Isolated, Limits
from adaptune.recording import Scan
program = processes.Program(["sh", "-c", {leaves!r} + "wait"], 4.0, stdout=None)
odometry = Isolated("with_children:Mine", {{}}, BaseSettings(), Limits())
odometry.start(Scan(0, np.zeros((5, 3), np.float32)), np.eye(4))
time.sleep(60)
"""

CHILDREN = MINE.replace(
    "        self.T = T_odom_sensor\n",
    """        self.T = T_odom_sensor
        import subprocess
        path = Path(__file__).with_name("children")
        started = [subprocess.Popen(["sleep", "1000"], start_new_session=s) for s in (False, True)]
        path.write_text(" ".join(str(p.pid) for p in started) + f" {os.getpid()}\\n")
""",
).replace(
    "        self.T = self.T.copy()\n",
    "        self.T = self.T.copy()\n        if prepared == 3: os.killpg(0, 9)\n",
)


def test_what_a_driver_has_started_ends_when_it_is_killed(mine, tmp_path):
    mine("with_children", CHILDREN)
    driver = subprocess.Popen(
        [sys.executable, "-c", DRIVER.format(leaves=LEAVES)],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    pids = [driver.stdout.readline().strip() for _ in range(3)]
    path = tmp_path / "children"
    end = time.monotonic() + 30.0
    while not (path.exists() and path.read_text().endswith("\n")) and time.monotonic() < end:
        time.sleep(0.02)
    pids += path.read_text().split()
    assert not any(map(gone, pids))
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    wait_until_gone(pids)


def test_an_odometry_that_kills_its_group_costs_one_fault(mine, tmp_path):
    mine("with_children", CHILDREN)
    space = ParameterSpace({"scale": Float(low=0.5, high=2.0, baseline=1.0)})
    odometry = OdometryFactory("with_children:Mine", {}, space, Limits())()

    def scan(stamp):
        from adaptune.recording import Scan

        return Scan(stamp, np.zeros((5, 3), np.float32))

    odometry.start(scan(0), np.eye(4))
    first = (tmp_path / "children").read_text().split()
    assert np.isfinite(odometry.register(scan(1)).T_odom_sensor).all()
    assert np.isnan(odometry.register(scan(3)).T_odom_sensor).all()
    assert odometry.faults == ["its process was ended by SIGKILL"]
    wait_until_gone(first)
    odometry.start(scan(4), np.eye(4))
    assert np.isfinite(odometry.register(scan(5)).T_odom_sensor).all()
    second = (tmp_path / "children").read_text().split()
    odometry.close()
    wait_until_gone(second)


BUSY = """
import os, time
running, run = os.pipe()
for _ in range(2):
    if os.fork() == 0:
        held = bytearray(100_000_000)
        while time.process_time() < 0.3: pass
        time.sleep(0.6)
        os._exit(0)
os.close(run)
os.read(running, 1)  # until both have ended; it takes no notice of how
"""


def test_a_program_is_measured_with_all_that_it_starts():
    program = processes.Program([sys.executable, "-c", BUSY], 4.0)
    code, cpu, memory = program.wait(30.0)
    program.close()
    assert code == 0
    assert 0.6 <= cpu < 3.0
    assert 200.0 <= memory < 400.0


SCRIPT = "import sys; from adaptune.__main__ import main; sys.exit(main())"


@pytest.mark.parametrize("how", [("-m", "adaptune"), ("-c", SCRIPT)])
def test_the_command_takes_modules_of_the_working_folder_last(tmp_path, how):
    for name in ("random", "typing", "offline"):
        (tmp_path / f"{name}.py").write_text("import os; os.abort()")
    path = os.pathsep.join(["", *sys.path])
    done = subprocess.run(
        [sys.executable, *how, "--version"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.startswith("adaptune "), done.stderr


def test_sockets_have_short_names(tmp_path):
    folder = tmp_path / ("x" * 120)
    folder.mkdir()
    with socket.socket(socket.AF_UNIX) as server, socket.socket(socket.AF_UNIX) as client:
        with processes.socket_name(folder / "odometry.sock") as name:
            server.bind(name)
        server.listen()
        assert (folder / "odometry.sock").is_socket()
        with processes.socket_name(folder / "odometry.sock") as name:
            client.connect(name)
