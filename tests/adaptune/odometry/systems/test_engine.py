import copy
import json
import os
import subprocess
import sys
import time
from contextlib import closing
from functools import cache

import pytest
import requests
from contained import LABEL
from needs import reference_image

from adaptune.errors import OdometryError
from adaptune.odometry.systems import engine as engine_module
from adaptune.odometry.systems.engine import (
    Container,
    ContainerSettings,
    EngineError,
    Mount,
    default_user,
    image_digest,
)

pytestmark = pytest.mark.services

NOBODY = "65534:65534"
LOOK = """
import json, os, resource, socket
def refused(do):
    try:
        do()
    except OSError as error:
        return error.strerror
def connect(host):
    socket.create_connection((host, 80), 5)
status = dict(line.split(":", 1) for line in open("/proc/self/status"))
print(json.dumps({
    "links": os.listdir("/sys/class/net"),
    "connect": [refused(lambda: connect(host)) for host in ("192.0.2.1", "172.17.0.1")],
    "write": refused(lambda: open("/given/new", "w")),
    "kept": refused(lambda: open("/kept/new", "w").write("written")),
    "user": [os.getuid(), os.getgid()],
    "capabilities": [status[name].strip() for name in ("CapEff", "CapPrm", "CapBnd")],
    "privileges": status["NoNewPrivs"].strip(),
    "core": resource.getrlimit(resource.RLIMIT_CORE),
    "variable": os.environ["VARIABLE"],
}))
"""


@pytest.fixture(scope="module")
def settings():
    return ContainerSettings(image=reference_image(), cpus=0.5, pids=40)


@pytest.fixture
def fresh(monkeypatch):
    renewed = cache(engine_module.engine.__wrapped__)
    monkeypatch.setattr(engine_module, "engine", renewed)
    return renewed


def started(settings, *command, memory=0.3, mounts=(), user=NOBODY, **more):
    return Container(settings, memory, command, mounts, user=user, **more)


def run(settings, *command, **more):
    with closing(started(settings, *command, **more)) as container:
        return container.wait(60.0), container.log().decode()


def gone(client, container):
    found = client.api.containers(quiet=True, all=True, filters={"id": container})
    return not found


def test_it_reaches_nothing_and_may_do_nothing(settings, tmp_path):
    given, kept = tmp_path / "given", tmp_path / "kept"
    for folder in (given, kept):
        folder.mkdir()
        folder.chmod(0o777)
    mounts = [Mount(given, "/given"), Mount(kept, "/kept", writable=True)]
    code, said = run(
        settings, "python3", "-c", LOOK, mounts=mounts, environment={"VARIABLE": "a b"}
    )
    assert code == 0, said
    seen = json.loads(said)
    assert seen["links"] == ["lo"]
    assert seen["connect"] == ["Network is unreachable"] * 2
    assert seen["write"] == "Read-only file system"
    assert seen["kept"] is None
    assert (kept / "new").read_text() == "written"
    assert seen["user"] == [65534, 65534]
    assert {int(mask, 16) for mask in seen["capabilities"]} == {0}
    assert seen["privileges"] == "1"
    assert seen["core"] == [0, 0]
    assert seen["variable"] == "a b"


def test_its_limits_are_those_that_were_given(settings):
    with closing(started(settings, "sleep", "60", memory=0.25)) as container:
        api = engine_module.engine().api
        found = api.inspect_container(container.id)
        limits = found["HostConfig"]
        assert limits["Memory"] == limits["MemorySwap"] == 250_000_000
        assert (limits["CpuQuota"], limits["CpuPeriod"]) == (50_000, 100_000)
        assert limits["PidsLimit"] == 40
        assert limits["NetworkMode"] == "none"
        assert not limits["Privileged"]
        assert found["Image"] == image_digest(settings.image)
        assert f".{os.getpid()}." in found["Config"]["Labels"][LABEL]
        assert container.ended() is None
        used = container.used()
        assert 0.0 <= used.cpu < 60.0
        assert 0.0 < used.memory < 250.0


@pytest.mark.parametrize(
    ("script", "code"), [("exit 7", 7), ("kill -ABRT $$", -6), ("nonsense", 127)]
)
def test_how_it_ended(settings, script, code):
    with closing(started(settings, "sh", "-c", f"echo here; {script}")) as container:
        assert container.wait(60.0) == code
        assert not container.out_of_memory
        assert "here" in container.last_lines().split(" | ")
    assert container.ended() == -9
    assert container.last_lines() == ""
    assert container.log() == b""
    assert container.used() == (0, 0.0, 0.0)


def test_commands_run_beside_it(settings):
    with closing(started(settings, "sleep", "60")) as container:
        name = container.run("sleep 0.3; exit $NUMBER", {"NUMBER": "4"})
        end = time.monotonic() + 20.0
        while (code := container.finished(name)) is None:
            assert time.monotonic() < end
            time.sleep(0.02)
        assert code == 4
    assert container.finished(name) is not None
    with pytest.raises(OdometryError, match=settings.image):
        container.run("true")


def test_the_user(settings, monkeypatch):
    monkeypatch.setattr(os, "getuid", lambda: 1234)
    monkeypatch.setattr(os, "getgid", lambda: 123)
    assert default_user(settings) == "1234:123"
    monkeypatch.setattr(os, "getuid", lambda: 0)
    assert default_user(settings) == NOBODY
    assert default_user(settings.model_copy(update={"user": "0"})) == "0"


def test_what_an_image_says_of_user_command_and_volumes(settings):
    client, name = engine_module.engine(), "adaptune-test-volume"
    with closing(started(settings, "true")) as container:
        changes = ["VOLUME /scratch", "USER daemon", 'CMD ["sleep", "60"]']
        client.api.commit(container.id, repository=name, tag="latest", changes=changes)
    try:
        other = ContainerSettings(image=name)
        assert default_user(other) == "daemon"
        with closing(started(other, user=default_user(other))) as container:
            (mount,) = client.api.inspect_container(container.id)["Mounts"]
            assert mount["Type"] == "volume"
            assert client.api.inspect_container(container.id)["Config"]["User"] == "daemon"
        assert mount["Name"] not in str(client.api.volumes(filters={"name": mount["Name"]}))
    finally:
        client.api.remove_image(name, force=True)


def test_without_an_engine_it_says_what_to_do(fresh, monkeypatch):
    monkeypatch.setenv("DOCKER_HOST", "unix:///nowhere")
    with pytest.raises(EngineError) as caught:
        fresh()
    assert str(caught.value) == (
        "no Docker engine answers at unix:///nowhere: is DOCKER_HOST right?"
    )


class Gone:
    def __getattr__(self, name):
        if name == "api":
            return self

        def ask(*_, **__):
            raise requests.ConnectionError("refused")

        return ask


def test_an_engine_that_ends_on_the_way(settings, monkeypatch):
    with closing(started(settings, "sleep", "60")) as container:
        name = container.run("sleep 60")
        with monkeypatch.context() as patch:
            patch.setattr(engine_module, "engine", Gone)
            words = r"the Docker engine does not answer any more \(refused\)"
            for ask in (
                container.ended,
                lambda: container.finished(name),
                lambda: container.run("true"),
                lambda: started(settings, "true"),
            ):
                with pytest.raises(EngineError, match=words):
                    ask()
            assert container.last_lines() == ""
            assert container.log() == b""
            assert container.used() == (0, 0.0, 0.0)
            engine_module.Container.close(copy.copy(container))


def test_what_cannot_be_started(settings, tmp_path):
    with pytest.raises(OdometryError, match="nobody-here"):
        started(settings, "true", user="nobody-here")
    with pytest.raises(OdometryError, match="no-folder"):
        started(settings, "true", mounts=[Mount(tmp_path / "no-folder", "/there")])


def test_what_ended_processes_have_left_is_removed_at_the_first_use(settings, fresh):
    client = engine_module.engine()
    with closing(started(settings, "sleep", "60")) as container:
        own = client.api.inspect_container(container.id)["Config"]["Labels"][LABEL]
    boot, space, pid, begin = own.split(".")
    owners = {
        "ended": f"{boot}.{space}.{pid}.1",
        "another boot": f"{boot[::-1]}.{space}.{pid}.{begin}",
        "another container": f"{boot}.1.{pid}.1",
        "living": own,
    }
    made = {
        name: client.api.create_container(settings.image, ["true"], labels={LABEL: owner})["Id"]
        for name, owner in owners.items()
    }
    try:
        fresh.cache_clear()
        fresh()
        kept = {name for name, container in made.items() if not gone(client, container)}
        assert kept == {"another container", "living"}
    finally:
        for container in made.values():
            if not gone(client, container):
                client.api.remove_container(container, force=True)


KILLED = """
import sys, time
from adaptune.odometry.systems.engine import Container, ContainerSettings
settings = ContainerSettings(image=sys.argv[1])
made = [Container(settings, 0.2, ["sleep", "600"], user="65534") for _ in range(2)]
print(*[container.id for container in made], flush=True)
time.sleep(600)
"""


def test_a_process_that_is_killed_leaves_no_container(settings):
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, settings.image],
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        text=True,
    )
    with process:
        made = process.stdout.readline().split()
        process.kill()
    assert len(made) == 2
    client, end = engine_module.engine(), time.monotonic() + 60.0
    while not all(gone(client, container) for container in made):
        assert time.monotonic() < end
        time.sleep(0.1)


def test_one_that_is_hurried_is_held_to_its_cores_later(settings):
    with closing(started(settings, "sleep", "60", bare=True)) as container:

        def quota():
            found = engine_module.engine().api.inspect_container(container.id)
            return found["HostConfig"]["CpuQuota"]

        assert quota() == -1
        container.hold_to_cores()
        assert quota() == 50_000
