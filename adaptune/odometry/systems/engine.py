"""The Docker engine: images, and containers that can reach nothing and leave nothing behind.

Nothing in the folders that containers write to is trusted.
"""

import contextlib
import hashlib
import io
import json
import logging
import os
import shutil
import signal
import stat
import subprocess
import sys
import tarfile
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, Literal, NamedTuple

from pydantic import Field

from adaptune._system import processes, yaml12
from adaptune._system.files import process_name, replacing_folder, temporary_prefix
from adaptune._system.keeper import Ended
from adaptune.errors import NotInstalledError, OdometryError, UnavailableError
from adaptune.odometry.base import BaseSettings
from adaptune.odometry.systems import remover

OWNER = "adaptune.owner"  # label of every container: the process that has started it
_NOBODY = 65534
_CPU_PERIOD = 100_000  # microseconds over which the use of cores is counted
_WEIGHT = 10 * 1024
"""Of a core against other processes: at any load, a system has the cores that it may use."""
_MOST_WRITTEN = 4 * 1024**3  # bytes of a file; a process that writes more gets SIGXFSZ
_TAIL_LINES = 50
_CONTAINER_POLL = 0.02  # seconds
_REMOVAL = 20.0  # seconds that a container may take to remove what its user has written

_log = logging.getLogger(__name__)


class ContainerSettings(BaseSettings):
    """An image, and what its containers may use besides `isolation.memory`."""

    image: str = Field(min_length=1)
    cpus: float = Field(1.0, ge=0.01, le=4096)  # cores
    pids: int = Field(1024, ge=16, le=10**6)  # processes and threads
    # A name or a number, as in ``docker run --user``; by default not root where that is possible.
    user: str | None = Field(None, coerce_numbers_to_str=True)


class EngineError(UnavailableError):
    """A Docker engine that does not answer, or does not have the image."""


class Mount(NamedTuple):
    """A file or folder of the host in a container."""

    source: Path
    target: str
    writable: bool = False


@cache
def engine() -> Any:
    """A client of the Docker engine, or an `EngineError`; removes what others have left."""
    from docker import DockerClient
    from docker.errors import DockerException

    for name in ("docker", "urllib3"):
        logging.getLogger(name).setLevel(logging.WARNING)  # they log every request
    try:
        client = DockerClient.from_env()
        client.ping()
    except (DockerException, OSError) as error:
        where = os.environ.get("DOCKER_HOST", "unix:///var/run/docker.sock")
        what = f"no Docker engine answers at {where}"
        help_ = "install Docker Engine, or start it: `sudo service docker start`"
        if "Permission" in str(error):
            what = f"this user may not use the Docker engine at {where}"
            help_ = "add yourself to its group, `sudo usermod -aG docker $USER`, and log in again"
        elif "DOCKER_HOST" in os.environ:
            help_ = "is DOCKER_HOST right?"
        raise EngineError(f"{what}: {help_}") from error
    for container in client.api.containers(all=True, filters={"label": OWNER}):
        if is_orphan(container["Labels"][OWNER]):
            _log.info("removing container %s of an earlier run", container["Id"][:12])
            _remove(client, container["Id"])
    return client


def is_orphan(owner: str) -> bool:
    """Whether the process that a label names has ended."""
    boot_and_space, pid, _ = owner.rsplit(".", 2)
    here = str(process_name(os.getpid())).rsplit(".", 2)[0]
    if boot_and_space.split(".")[0] != here.split(".")[0]:
        return True
    return boot_and_space == here and process_name(int(pid)) != owner


def _remove(client: Any, container: str) -> None:
    from docker.errors import APIError

    # One that is gone, or on its way, is as good as removed; the next use of an engine that does
    # not answer removes the others.
    with contextlib.suppress(APIError, OSError):
        client.api.remove_container(container, v=True, force=True)


@cache
def _owner() -> tuple[str, Any]:
    """Label of this process's containers, and who removes them if it is killed."""
    owner = str(process_name(os.getpid()))
    process = subprocess.Popen(
        [sys.executable, remover.__file__, f"{OWNER}={owner}", temporary_prefix()],
        stdin=subprocess.PIPE,  # which closes with this process
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    return owner, process


def image_digest(name: str) -> str:
    """Digest of an image; an `EngineError` if it is not here, or no engine is."""
    return str(_image(name)["Id"])


def _image(name: str) -> Any:
    try:
        from docker.errors import APIError, ImageNotFound
    except ImportError as error:
        what = f"docker cannot be imported ({error}); run `pip install docker`"
        raise NotInstalledError(what) from error
    with _telling(name):
        try:
            return engine().api.inspect_image(name)
        except ImageNotFound as error:
            help_ = f"`docker pull {name}`, or `docker build` it"
            raise EngineError(f"there is no image {name!r} on this machine: {help_}") from error
        except APIError as error:
            raise EngineError(f"image {name!r}: {error.explanation or error}") from error


@contextlib.contextmanager
def _telling(image: str) -> Iterator[None]:
    """Say what the engine refuses, or that it does not answer."""
    from docker.errors import APIError

    try:
        yield
    except APIError as error:
        kind = EngineError if error.is_server_error() else OdometryError
        raise kind(f"image {image!r}: {error.explanation or error}") from error
    except OSError as error:
        raise EngineError(f"the Docker engine does not answer any more ({error})") from error


def default_user(settings: ContainerSettings) -> str:
    """User in a container: the study's, or the image's own if not root, or nobody special."""
    if settings.user is not None:
        return settings.user
    own = str(_image(settings.image)["Config"].get("User") or "")
    if own.partition(":")[0] not in ("", "0", "root"):
        return own
    me, group = os.getuid(), os.getgid()
    return f"{me}:{group}" if me else f"{_NOBODY}:{_NOBODY}"


class Container:
    """A running container.

    It has no network, or that of another container, no privileges and no new ones, and sees nothing
    of the host but its mounts. There is an `OdometryError` if it cannot be started.

    Memory is in gigabytes. The command is the image's own if it is empty; a bare one takes the
    place of the image's entry point, too. A bare one, and one in the network of another, may use
    all cores until `hold_to_cores`.
    """

    def __init__(
        self,
        settings: ContainerSettings,
        memory: float,
        command: Sequence[str] = (),
        mounts: Sequence[Mount] = (),
        *,
        user: str,
        environment: Mapping[str, str] | None = None,
        bare: bool = False,
        network_of: "Container | None" = None,
    ):
        from docker.types import LogConfig, Ulimit
        from docker.types import Mount as Bind

        self.image, self._cpus = settings.image, settings.cpus
        digest, client = image_digest(settings.image), engine()
        binds = [
            Bind(m.target, str(m.source.resolve()), type="bind", read_only=not m.writable)
            for m in mounts
        ]
        limit = int(memory * 1e9)
        # A user without a name has no folder to write to.
        nameless = user[0].isdigit() and user.partition(":")[0] != "0"
        home = {"HOME": "/tmp"} if nameless else {}
        host = client.api.create_host_config(
            mounts=binds,
            network_mode="none" if network_of is None else f"container:{network_of.id}",
            mem_limit=limit,
            memswap_limit=limit,
            cpu_period=_CPU_PERIOD,
            cpu_quota=-1 if bare or network_of else int(settings.cpus * _CPU_PERIOD),
            cpu_shares=min(max(int(settings.cpus * _WEIGHT), 2), 262_144),
            pids_limit=settings.pids,
            cap_drop=["ALL"],
            security_opt=["no-new-privileges"],
            init=True,
            ulimits=[
                Ulimit(name="core", soft=0, hard=0),
                Ulimit(name="fsize", soft=_MOST_WRITTEN, hard=_MOST_WRITTEN),
            ],
            log_config=LogConfig(config={"max-size": "64m"}),
        )
        try:
            with _telling(settings.image):
                self.id = client.api.create_container(
                    digest,
                    None if bare else list(command) or None,
                    user=user,
                    environment=home | dict(environment or {}),
                    labels={OWNER: _owner()[0]},
                    host_config=host,
                    entrypoint=list(command) if bare else None,
                )["Id"]
                client.api.start(self.id)
        except OdometryError:
            self.close()
            raise

    id: str | None = None
    out_of_memory = False
    _removed = False

    def ended(self) -> int | None:
        """Exit code, or minus the signal's number; None while it runs."""
        from docker.errors import NotFound

        with _telling(self.image):
            try:
                state = engine().api.inspect_container(self.id)["State"]
            except NotFound:  # somebody has removed it
                return -signal.SIGKILL
        self.out_of_memory = bool(state["OOMKilled"])
        if state["Running"]:
            return None
        code = int(state["ExitCode"])
        return 128 - code if code - 128 in set(signal.Signals) else code

    def wait(self, seconds: float) -> int | None:
        """Wait for the end, at most so long, and say how it `ended`."""
        end = time.monotonic() + seconds
        while (code := self.ended()) is None and time.monotonic() < end:
            time.sleep(_CONTAINER_POLL)
        return code

    def hold_to_cores(self) -> None:
        """Let it use no more cores than the settings say from now on."""
        quota = int(self._cpus * _CPU_PERIOD)
        with _telling(self.image):
            engine().api.update_container(self.id, cpu_period=_CPU_PERIOD, cpu_quota=quota)

    def used(self) -> Ended:
        """CPU seconds and megabytes now; zero where it has ended."""
        stats: dict[str, Any] = {}
        with contextlib.suppress(OdometryError), _telling(self.image):
            stats = engine().api.stats(self.id, stream=False, one_shot=True)
        memory = stats.get("memory_stats", {})
        # Files that were read may be forgotten at any time.
        cached = memory.get("stats", {})
        files = cached.get("total_inactive_file", cached.get("inactive_file", 0))
        held = memory.get("usage", 0) - files
        cpu = stats.get("cpu_stats", {}).get("cpu_usage", {}).get("total_usage", 0)
        return Ended(0, 1e-9 * cpu, 1e-6 * held)

    def run(self, command: str, environment: Mapping[str, str] | None = None) -> str:
        """Begin a command in a login shell, without its output; a name for `finished`."""
        with _telling(self.image):
            name: str = engine().api.exec_create(
                self.id, ["/bin/bash", "-l", "-c", command], environment=dict(environment or {})
            )["Id"]
            engine().api.exec_start(name, detach=True)
        return name

    def finished(self, name: str) -> int | None:
        """Exit code of a command that `run` began; None while it runs."""
        from docker.errors import NotFound

        with _telling(self.image):
            try:
                state = engine().api.exec_inspect(name)
            except NotFound:
                return -signal.SIGKILL  # with its container
        return None if state["Running"] else int(state["ExitCode"] or 0)

    def last_lines(self) -> str:
        """The last lines that it wrote."""
        return processes.plain_lines(self.log(_TAIL_LINES))

    def log(self, lines: int | Literal["all"] = "all") -> bytes:
        """What it wrote."""
        with contextlib.suppress(OdometryError), _telling(self.image):
            return bytes(engine().api.logs(self.id, tail=lines))
        return b""

    def close(self) -> None:
        """End and remove it, with its volumes; what is asked of it later finds none."""
        if self.id is not None and not self._removed:
            self._removed = True
            _remove(engine(), self.id)


_EMPTY = "adaptune-empty:latest"  # an image without a file


def own_container(
    command: Sequence[str], folder: Path, environment: Mapping[str, str]
) -> Container:
    """Run a Python program of adaptune's in a container, which may write to the folder."""
    with _telling(_EMPTY):
        if not engine().api.images(_EMPTY, quiet=True):
            nothing = io.BytesIO()
            tarfile.open(fileobj=nothing, mode="w").close()
            engine().api.import_image_from_data(
                nothing.getvalue(), repository="adaptune-empty", tag="latest"
            )
    # Links lead to places outside of an environment.
    pythons = [sys.prefix, sys.base_prefix, str(Path(sys.executable).resolve().parents[1])]
    own = [str(Path(__file__).parents[3]), "/usr", "/lib", "/lib64", "/bin", "/etc/ld.so.cache"]
    absolute = {path for path in (*own, *pythons, *sys.path) if path[:1] == "/" and path.strip("/")}
    mounts = [Mount(Path(path), path) for path in sorted(absolute) if Path(path).exists()]
    return Container(
        ContainerSettings(image=_EMPTY),
        1.0,
        [sys.executable, *command],
        [*mounts, Mount(folder, str(folder), writable=True)],
        user=f"{os.getuid()}:{os.getgid()}",
        environment={"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
        | dict(environment),
        bare=True,
    )


# Folders that containers write to, and what is kept of them.


def make_shared(folder: Path) -> Path:
    """Make a folder that any user of a container may write to."""
    folder.mkdir()
    folder.chmod(0o777)
    return folder


@contextlib.contextmanager
def opened(path: Path, root: Path) -> Iterator[BinaryIO | None]:
    """Open a regular file below `root`; None if there is none, or it is a link, or a pipe."""
    inside = path.parent.resolve() == root.resolve() / path.parent.relative_to(root)
    try:
        flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK
        file = os.fdopen(os.open(path, flags), "rb") if inside else None
    except OSError:
        file = None
    if file is None:
        yield None
        return
    with file:
        yield file if stat.S_ISREG(os.fstat(file.fileno()).st_mode) else None


def copy_regular(path: Path, root: Path, target: Path) -> bool:
    """Copy a regular file below `root`; False if there is none."""
    with opened(path, root) as file:
        if file is None:
            return False
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("wb") as copy:
            shutil.copyfileobj(file, copy)
    return True


def regular_files(root: Path) -> Iterator[Path]:
    """All files below a folder, links and what they lead to left out."""
    for folder, _, names in os.walk(root):
        yield from (path for name in names if not (path := Path(folder) / name).is_symlink())


def remove_shared(folder: Path, image: str, user: str) -> None:
    """Remove a folder; what another user has written, that user removes in a container."""
    shutil.rmtree(folder, ignore_errors=True)
    if not folder.exists():
        return
    with contextlib.suppress(OdometryError):
        container = Container(
            ContainerSettings(image=image),
            0.5,
            ["/bin/sh", "-c", "rm -rf /shared/*"],
            [Mount(folder, "/shared", writable=True)],
            user=user,
            bare=True,
        )
        with contextlib.closing(container):
            container.wait(_REMOVAL)
    shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def kept_log(run: Any, logs: Path | None, fault: str | None, **about: Any) -> Iterator[Path | None]:
    """A folder for the block to fill, which then replaces that of the same set; None if not kept.

    `logs` is the folder of the sequence's logs. ``trial.yaml`` holds what the run of a recording
    has used, and what `about` says.
    """
    if logs is None:
        yield None
        return
    settings, parameters, usage = run.settings, run.parameters, run.usage
    whole = json.dumps([settings.model_dump(mode="json"), parameters], sort_keys=True)
    name = hashlib.blake2b(whole.encode(), digest_size=4).hexdigest()
    with replacing_folder(logs / name) as temporary:
        temporary.mkdir()
        note = {"parameters": parameters, **about}
        if settings.image is not None:
            note = {"image": settings.image, "digest": image_digest(settings.image)} | note
        note |= {"cpu": round(usage.cpu, 3), "memory": round(usage.memory or 0.0, 1)}
        if fault:
            note["fault"] = fault
        (temporary / "trial.yaml").write_text(yaml12.dump(note), encoding="utf-8")
        yield temporary
