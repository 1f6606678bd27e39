"""Write files whole or not at all."""

import errno
import os
import shutil
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from adaptune.errors import AdaptuneError

DAMAGED_NPZ = (
    *(OSError, ValueError, TypeError, EOFError, RuntimeError),
    *(zipfile.BadZipFile, zlib.error),
)
"""What numpy and zipfile raise on damaged ``.npz`` files."""


def expand_user(path: str) -> Path:
    """Replace ``~`` and ``~user``; an AdaptuneError if there is no such user."""
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        raise AdaptuneError(f"{path}: there is no such user; give the whole path") from error


class FullError(AdaptuneError, OSError):
    """There is no room for a file."""


def temporary_prefix() -> str:
    """Path with which the names of this process's temporary folders begin."""
    return str(Path(tempfile.gettempdir()) / f"adaptune-{os.getpid()}-")


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """A folder for the block; what cannot be removed afterwards stays."""
    folder = Path(tempfile.mkdtemp(prefix=temporary_prefix()))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def needing_room(path: Path) -> Iterator[None]:
    """Raise a FullError that names the file for which there is no room in the block."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise
        help_ = "make room, and run the same command again"
        raise FullError(f"{path}: cannot be written ({error.strerror}); {help_}") from error


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Write a temporary file and rename it into place when the block ends well.

    The block receives an unused name in the same folder, which is made if needed, with the same
    suffix. The file there replaces `path` in one step. It is removed if the block raises. See
    `needing_room`.
    """
    with needing_room(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(path.suffix, f".{path.stem}.", path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        with needing_room(path):
            yield temporary
        # mkstemp makes the file private. Users receive it as readable as any new file.
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Rename a folder into place, also over an existing one, when the block ends well.

    The block receives an unused path, whose name is that of `path`, and makes a folder of it. See
    `needing_room`.
    """
    with needing_room(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as name:
            temporary = Path(name) / path.name
            yield temporary
            if path.exists():
                path.rename(temporary.with_name(f"{path.name}.old"))
            temporary.rename(path)


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` in UTF-8, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
