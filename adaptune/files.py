"""Files that are there whole or not at all."""

import errno
import os
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from adaptune.errors import AdaptuneError

DAMAGED_NPZ = (
    OSError,
    ValueError,
    TypeError,
    EOFError,
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What numpy and zipfile raise on ``.npz`` files that are not what they say."""


class FullError(AdaptuneError, OSError):
    """There is no room for a file."""


@contextmanager
def needing_room(path: Path) -> Iterator[None]:
    """Tell which file there is no room for.

    Raises
    ------
    FullError
        If the block finds the disk or a quota full, or the file too large.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise
        raise FullError(
            f"{path}: cannot be written ({error.strerror}); make room, and run the same command "
            f"again"
        ) from error


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Write a file beside its place and rename it there when all went well.

    Parameters
    ----------
    path
        Where the file shall be; its folder is made when there is none.

    Yields
    ------
    Path
        An unused name in the same folder with the same suffix. The file there replaces `path` in
        one step when the block ends, and is removed when the block raises.

    Raises
    ------
    FullError
        If there is no room for it.
    """
    with needing_room(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        stem, suffix = f".{path.stem}.", path.suffix
        handle, name = tempfile.mkstemp(prefix=stem, suffix=suffix, dir=path.parent)
    os.close(handle)
    beside = Path(name)
    try:
        with needing_room(path):
            yield beside
        # mkstemp makes the file private; what a user receives is as readable as any new file.
        umask = os.umask(0)
        os.umask(umask)
        beside.chmod(0o666 & ~umask)
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Fill a folder beside its place and rename it there when all went well.

    Parameters
    ----------
    path
        Where the folder shall be; one that is there is replaced.

    Yields
    ------
    Path
        An unused name in the same folder, for the block to make a folder of.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as name:
        beside = Path(name) / "new"
        yield beside
        if path.exists():
            path.rename(Path(name) / "old")
        beside.rename(path)


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` in UTF-8, whole or not at all."""
    with replacing(path) as beside:
        beside.write_text(text, encoding="utf-8")
