"""Programs in Docker images that receive scans and return poses, one after the other."""

import contextlib
import socket
import tempfile
import time
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import Field

from adaptune import hosting
from adaptune.files import temporary_prefix
from adaptune.odometry import wire
from adaptune.odometry.base import Description, OdometryError
from adaptune.odometry.docker.engine import (
    Container,
    ContainerSettings,
    Mount,
    default_user,
    image_digest,
)
from adaptune.odometry.docker.shared_folder import remove_shared
from adaptune.odometry.isolation import Limits
from adaptune.odometry.process import FIRST_ANSWER, UserProgram, announced_by
from adaptune.odometry.template import replace
from adaptune.space import ParameterSet

_FOLDER = "/adaptune"
_BETWEEN_LOOKS = 0.02
"""Seconds."""


class DockerProcessSettings(ContainerSettings):
    """An image with a program that speaks `adaptune.odometry.wire`.

    Attributes
    ----------
    command : list of str
        The program and its arguments; by default the image's own. It must listen at the Unix socket
        ``{socket}``, which the variable ADAPTUNE_SOCKET names, too.
    settings : dict
        Settings that the program receives.
    """

    command: tuple[str, ...] = ()
    settings: dict[str, Any] = Field(default_factory=dict)


class DockerProcess(UserProgram):
    """An odometry in a container, which it keeps from start to start; a new one after a fault.

    Parameters
    ----------
    parameters, limits
        See `Isolated`.
    settings
        The image.
    """

    settings_type = DockerProcessSettings

    def __init__(self, parameters: ParameterSet, settings: DockerProcessSettings, limits: Limits):
        super().__init__(settings.image, parameters, settings, limits)
        self._hello = {"odometry": None, "settings": settings.settings}
        self._settings = settings
        self._container: Container | None = None
        self._folder: Path | None = None

    @staticmethod
    def describe(settings: DockerProcessSettings) -> Description:
        """What the program reports about itself; an error if it cannot be reached."""
        return _describe(settings.model_dump_json(), image_digest(settings.image))

    def close(self) -> None:
        super().close()
        if self._container is not None:
            self._container.close()
            self._container = None
        if self._folder is not None:
            remove_shared(self._folder, self.name, default_user(self._settings))
            self._folder = None

    def _connect(self) -> wire.SocketStream:
        self._folder = folder = Path(tempfile.mkdtemp(prefix=temporary_prefix()))
        folder.chmod(0o777)  # for any user of the image
        inside = f"{_FOLDER}/odometry.sock"
        self._container = Container(
            self._settings,
            self._limits.memory,
            [replace(argument, {"socket": inside}) for argument in self._settings.command],
            [Mount(folder, _FOLDER, writable=True)],
            user=default_user(self._settings),
            environment={"ADAPTUNE_SOCKET": inside},
        )
        connection = self._reach(folder / "odometry.sock")
        connection.settimeout(max(self._limits.seconds, FIRST_ANSWER))
        return wire.SocketStream(connection)

    def _reach(self, path: Path) -> socket.socket:
        """Connect as soon as the program listens."""
        assert self._container is not None
        begin, what = time.monotonic(), "it does not listen at its socket"
        while time.monotonic() - begin < FIRST_ANSWER:
            connection = socket.socket(socket.AF_UNIX)
            with contextlib.suppress(OSError):
                connection.connect(str(path))
                return connection
            connection.close()
            if (ended := self._ended()) is not None:
                what = f"{ended} before it listened at its socket"
                break
            time.sleep(_BETWEEN_LOOKS)
        words = self._container.last_lines()
        self.close()
        what = f"{self.name}: {what}"
        raise OdometryError(f"{what}: {words}" if words else what)

    def _verdict(self, what: str) -> str:
        """Add how the program ended, if it did, and the last lines that it wrote."""
        if self._container is None:
            return what
        for _ in range(10):
            if (ended := self._ended()) is not None:
                what = ended
                break
            time.sleep(0.05)
        words = self._container.last_lines()
        return f"{what}: {words}" if words else what

    def _ended(self) -> str | None:
        """How the program ended; None while it runs."""
        assert self._container is not None
        if (code := self._container.ended()) is None:
            return None
        if self._container.out_of_memory:
            return f"out of isolation.memory = {self._limits.memory:g} GB"
        return hosting.verdict(code)


@cache
def _describe(settings: str, digest: str) -> Description:  # noqa: ARG001 - another image, another
    return announced_by(
        DockerProcess({}, DockerProcessSettings.model_validate_json(settings), Limits())
    )
