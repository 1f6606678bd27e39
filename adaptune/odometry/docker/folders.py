"""Folders that containers write to, and what is kept of them. Nothing in them is trusted."""

import contextlib
import hashlib
import json
import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from adaptune import yaml12
from adaptune.errors import OdometryError
from adaptune.files import replacing_folder
from adaptune.odometry.docker.engine import Container, ContainerSettings, Mount, image_digest

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
            container.wait(_SECONDS)
    shutil.rmtree(folder, ignore_errors=True)


@contextmanager
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
