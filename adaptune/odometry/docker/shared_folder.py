"""Folders that containers write to. Nothing that is in them is trusted."""

import contextlib
import os
import shutil
import stat
import time
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from adaptune.odometry.base import OdometryError
from adaptune.odometry.docker.engine import Container, ContainerSettings, Mount

_SECONDS = 20.0
"""Seconds that a container may take to remove what its user has written."""


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
            begin = time.monotonic()
            while container.ended() is None and time.monotonic() - begin < _SECONDS:
                time.sleep(0.05)
    shutil.rmtree(folder, ignore_errors=True)
