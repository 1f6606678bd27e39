"""Hashes of the content of files, remembered on disk.

The hash of a large file is kept in the cache's folder, under the file's path, inode, size and times
of change. Small files are read every time.
"""

import hashlib
import logging
import os
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from adaptune.errors import AdaptuneError
from adaptune.sequence import cache

SMALL = cache.SMALL
"""Bytes below which files are read every time, one or several together."""
FILE = "fingerprints.txt"
"""File in the cache's folder: on every line the hash of a file's status, and of its content."""
MANY = 64
"""So many files have one hash together."""

_BLOCK = 1 << 20
_LONG = 1 << 30
"""Bytes that take more than a second to read."""
_SIZE = 16

_log = logging.getLogger(__name__)
remembered: dict[str, str] = {}
"""Hashes that this process knows, also where the cache's folder cannot be written."""


class FingerprintError(AdaptuneError):
    """A file that cannot be read, or that changes while it is read."""


class _StoppedError(Exception):
    """Nobody waits for the hash any more."""


def fingerprints(files: Sequence[Path]) -> list[str]:
    """Hash the content of each file; `MANY` or more files are hashed as one.

    Raises
    ------
    FingerprintError
        If a file cannot be read, or changes while it is read.
    """
    found = _fingerprints(files, threading.Event(), tell=True)
    if len(found) < MANY:
        return found
    return [hashlib.blake2b("".join(found).encode(), digest_size=_SIZE).hexdigest()]


def fingerprint(file: Path) -> str:
    """Hash the content of one file, see `fingerprints`."""
    return fingerprints([file])[0]


@contextmanager
def alongside(files: Sequence[Path]) -> Iterator[None]:
    """Hash large files, if they are not known, in a thread while the block reads them.

    Files are thus read from disk once. A block that ends early ends the thread.
    """
    unknown = False
    with suppress(OSError):
        unknown = _total(files) >= SMALL and not _known(files)
    if not unknown:
        yield
        return
    stop = threading.Event()

    def run() -> None:
        # Whoever asks for the hash reports what is wrong.
        with suppress(FingerprintError, _StoppedError):
            _fingerprints(files, stop)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield
    except BaseException:
        stop.set()
        raise
    finally:
        thread.join()


def _fingerprints(files: Sequence[Path], stop: threading.Event, tell: bool = False) -> list[str]:
    if not files:
        return []
    file = files[0]
    try:
        remember, keys = _total(files) >= SMALL, [status_key(file) for file in files]
        known = remember and _known(files)
        if tell and remember and not known and (size := _total(files)) > _LONG:
            _log.info("%s: reading %.1f GB to know it by its content", file, size / 1e9)
        new: dict[str, str] = {}
        found = []
        for file, key in zip(files, keys, strict=True):
            if not remember or key not in remembered:
                new[key] = hash_file(file, key, stop)
            found.append(new.get(key) or remembered[key])
    except OSError as error:
        raise FingerprintError(f"{file}: cannot be read ({error.strerror})") from error
    if remember and new:
        _remember(new)
    return found


def _total(files: Sequence[Path]) -> int:
    return sum(file.stat().st_size for file in files)


def status_key(file: Path) -> str:
    """Hash of all by which a file shows that it is the same as before."""
    status, path = file.stat(), os.fsencode(file.absolute())
    times = f" {status.st_ino} {status.st_size} {status.st_mtime_ns} {status.st_ctime_ns}"
    return hashlib.blake2b(path + times.encode(), digest_size=_SIZE).hexdigest()


def hash_file(file: Path, key: str, stop: threading.Event) -> str:
    """Hash a file whose status has this key, unless somebody stops it."""
    digest = hashlib.blake2b(digest_size=_SIZE)
    with file.open("rb", buffering=0) as stream:
        while block := stream.read(_BLOCK):
            digest.update(block)
            if stop.is_set():
                raise _StoppedError
    if status_key(file) != key:
        raise FingerprintError(f"{file}: changes while it is read; run again when it is complete")
    return digest.hexdigest()


def _known(files: Sequence[Path]) -> bool:
    """Whether the hashes of all files are known, here or on disk."""
    keys = set(map(status_key, files))
    if not keys <= remembered.keys():
        with suppress(OSError, UnicodeDecodeError):
            for line in (cache.folder() / FILE).read_text("ascii").splitlines():
                key, _, found = line.partition(" ")
                if len(key) == len(found) == 2 * _SIZE:
                    remembered[key] = found
    return keys <= remembered.keys()


def _remember(new: dict[str, str]) -> None:
    remembered.update(new)
    with suppress(OSError):
        cache.folder().mkdir(parents=True, exist_ok=True)
        # One write: processes that append at the same time do not mix their lines.
        with (cache.folder() / FILE).open("ab", buffering=0) as stream:
            stream.write("".join(f"{key} {found}\n" for key, found in new.items()).encode())
