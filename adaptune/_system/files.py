"""Write files whole or not at all."""

import errno
import fcntl
import logging
import os
import secrets
import shutil
import tempfile
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import IO

from adaptune.errors import AdaptuneError

_log = logging.getLogger(__name__)

DAMAGED_NPZ = (
    *(OSError, ValueError, TypeError, EOFError, RuntimeError, OverflowError),
    *(SyntaxError, tokenize.TokenError, zipfile.BadZipFile, zlib.error),
)
"""What numpy and zipfile raise on damaged ``.npy`` and ``.npz`` files."""
_BARRED = (errno.EACCES, errno.EPERM, errno.EROFS)
_ELSEWHERE = "name another folder (--folder, --out), or copy it to where you may write"


def expand_user(path: str) -> Path:
    """Replace ``~`` and ``~user``; an AdaptuneError if there is no such user."""
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        raise AdaptuneError(f"{path}: there is no such user; give the whole path") from error


class FullError(AdaptuneError, OSError):
    """There is no room for a file, or its folder cannot be written to."""


def process_name(pid: int) -> str | None:
    """What names a process for good; None if there is none."""
    try:
        started = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except OSError:
        return None
    boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    # Processes of another container have other numbers.
    space = os.stat("/proc/self/ns/pid").st_ino  # noqa: PTH116
    return f"{boot}.{space}.{pid}.{started}"


def temporary_prefix() -> str:
    """Path with which the names of this process's temporary folders begin."""
    return str(Path(tempfile.gettempdir()) / f"adaptune-{process_name(os.getpid())}-")


@cache
def _remove_left(folder: Path) -> None:
    """Remove temporary folders of processes of this machine that were killed."""
    here = str(process_name(os.getpid())).rsplit(".", 2)[0]
    for left in folder.glob(f"adaptune-{here}.*"):
        owner = left.name.removeprefix("adaptune-").rpartition("-")[0]
        if process_name(int(owner.split(".")[-2])) != owner:
            shutil.rmtree(left, ignore_errors=True)


def make_temporary() -> Path:
    """Make a folder, which the caller removes; if it is killed, the next adaptune does."""
    _remove_left(Path(tempfile.gettempdir()))
    return Path(tempfile.mkdtemp(prefix=temporary_prefix()))


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """A folder for the block; what cannot be removed afterwards stays."""
    folder = make_temporary()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def entries(folder: Path, suffix: str = "") -> list[Path]:
    """What a folder holds, by name, without what a system or a file manager keeps there."""
    own = (".", "@eaDir", "$RECYCLE.BIN")  # as ._drive.bag
    return sorted(path for path in folder.glob(f"*{suffix}") if not path.name.startswith(own))


@contextmanager
def needing_room(path: Path) -> Iterator[None]:
    """Raise a FullError where there is no room for a file, or its folder cannot be written to."""
    try:
        yield
    except OSError as error:
        named = Path(error.filename) if isinstance(error.filename, str) else path / ".."
        above = named in path.parents  # a folder that was to be made
        beside = named.parent == path.parent or f".{path.stem}." in str(named)
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            what = f"{path}: cannot be written"
            help_ = "make room, and run the same command again"
        elif error.errno in _BARRED and (above or beside):
            what = f"{named.parent if above else path.parent}: cannot be written to"
            help_ = _ELSEWHERE
        elif above and error.errno in (errno.ENOTDIR, errno.EEXIST):
            what, help_ = f"{path.parent}: cannot be written to", _ELSEWHERE
        else:
            raise
        raise FullError(f"{what} ({error.strerror}); {help_}") from error


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Write a temporary file and rename it into place when the block ends well.

    The block receives an unused name in the same folder, which is made if needed, with the same
    suffix. The file there replaces `path` in one step. It is removed if the block raises. A device
    or a pipe, such as ``/dev/null``, is written to instead. See `needing_room`.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        yield path
        return
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}{path.suffix}")
    try:
        with needing_room(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            yield temporary
            temporary.replace(path)
    finally:
        with suppress(OSError):  # a disk without writing says so, whatever is there
            temporary.unlink()


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
    """Write `text` to `path` in UTF-8, whole or not at all; bytes that are no UTF-8 stay."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="surrogateescape")


def locked(file: IO[str], wait: bool = True) -> bool:
    """Lock an open file; False where another process holds it, and nobody is to wait for that.

    Some network disks have no locks: a warning says so, and the file counts as locked.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError as error:
        if error.errno in (errno.EAGAIN, errno.EACCES):
            return False
        what = "%s: this disk has no file locks (%s); run one adaptune at a time in this folder"
        _log.warning(what, Path(file.name).parent, error.strerror)
    return True


def plain_name(path: Path) -> str:
    """Name of a sequence for a recording: letters, digits, _ . and - of the file's."""
    name = "".join(c if c.isalnum() or c in "_.-" else "_" for c in path.stem).lstrip(".-")
    # A study's names have 100 bytes at most, those of parts too.
    return name.encode()[:80].decode(errors="ignore") or "recording"
