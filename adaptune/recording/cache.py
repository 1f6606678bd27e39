"""Decoded sequences on disk, shared by all processes.

An entry is a folder of arrays that are mapped into memory. Its name is a digest of the files and
settings. It is written to a temporary folder and renamed when whole. A killed writer leaves a
folder whose name begins with a dot, which the next writer removes.
"""

import fcntl
import hashlib
import json
import logging
import os
import secrets
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

from adaptune._system.files import DAMAGED_NPZ, expand_user, replacing
from adaptune.errors import AdaptuneError, MachineError
from adaptune.recording.scan import Scan

_log = logging.getLogger(__name__)
_NOT_KEPT = "%s: not kept in the cache (%s)"

_VERSION = 8
_CAP_GB, _MOST_GB = 50.0, 1e9
# Seconds. A writer that has not written for this long is dead; sooner if it has no lock any more.
_DEAD, _UNLOCKED = 3600.0, 10.0
_INDEX, _ABOUT = "index.npy", "about.json"
# Files of an entry: what they hold of scans one after the other, and in how many columns.
_CACHED_ARRAYS = {
    "points": ("<f4", 3),
    "times": ("<f4", 1),
    "rings": ("<u2", 1),
    "intensities": ("<f4", 1),
}


def folder() -> Path:
    """Where decoded sequences are kept: ``$ADAPTUNE_CACHE``, or in the user's cache folder."""
    if given := os.environ.get("ADAPTUNE_CACHE"):
        try:
            return expand_user(given)
        except AdaptuneError as error:
            raise AdaptuneError(f"ADAPTUNE_CACHE: {error}") from error
    try:
        return platformdirs.user_cache_path("adaptune", appauthor=False)
    except RuntimeError:  # a user without a home, as in a container
        return Path(tempfile.gettempdir()) / f"adaptune-cache-{os.getuid()}"


def cap() -> int:
    """Bytes that all entries together may take: ``$ADAPTUNE_CACHE_GB`` gigabytes, or 50."""
    given = os.environ.get("ADAPTUNE_CACHE_GB", "").strip()
    with suppress(ValueError):
        gigabytes = float(given or _CAP_GB)
        if 0 <= gigabytes <= _MOST_GB:
            return round(gigabytes * 1e9)
    raise AdaptuneError(
        f"ADAPTUNE_CACHE_GB is {given!r}; give gigabytes, 0 or more, or unset it for {_CAP_GB:g}"
    )


def key(files: Sequence[Path], settings: Any) -> str:
    """Digest of the `status_key` of files, and of settings; an OSError if a file cannot be read."""
    about = f"{_VERSION} {settings!r} {' '.join(map(status_key, files))}"
    return hashlib.blake2b(about.encode(), digest_size=_SIZE).hexdigest()


class CachedScans:
    """The scans in the folder of an entry, in any order."""

    def __init__(self, path: Path):
        self.path = path
        # Notes on the sequence from when it was decoded.
        self.about: dict[str, Any] = json.loads((path / _ABOUT).read_text("utf-8"))
        # Of each scan its stamp, and in each array where it begins and ends; -1 if it has none.
        self._index = np.load(path / _INDEX)
        if (self._index[:, 1] < 0).any():
            raise ValueError("a scan has no points")
        ends = self._index[:, 2::2].max(axis=0, initial=0).tolist()
        # All at once: mapped arrays stay even if another process removes the entry.
        self._arrays = [
            self._map(name, end) for name, end in zip(_CACHED_ARRAYS, ends, strict=True)
        ]
        # Records when the entry was last used.
        with suppress(OSError):  # a folder that only others may write to
            os.utime(path / _ABOUT)

    def __len__(self) -> int:
        return len(self._index)

    def __getitem__(self, i: int) -> Scan:
        stamp, *bounds = self._index[i].tolist()
        parts = zip(self._arrays, bounds[::2], bounds[1::2], strict=True)
        columns: list[Any] = [a[low:high] if low >= 0 else None for a, low, high in parts]
        points, times, rings, lights = columns
        return Scan(stamp, points, times, rings, intensities=lights)

    def __iter__(self) -> Iterator[Scan]:
        return (self[i] for i in range(len(self)))

    def since(self, stamp: int) -> Iterator[Scan]:
        """Read the scans from `stamp` on."""
        first = int(np.searchsorted(self._index[:, 0], stamp))
        return (self[i] for i in range(first, len(self)))

    def _map(self, name: str, length: int) -> Any:
        kind, columns = _CACHED_ARRAYS[name]
        shape = (length, columns)[: 2 if columns > 1 else 1]
        if not length:  # an empty file cannot be mapped
            return np.empty(shape, kind)
        # A view of the base class: slices of memmap itself are slow to make.
        return np.memmap(self.path / name, kind, "r", shape=shape).view(np.ndarray)


def find(key: str) -> CachedScans | None:
    """The entry of this digest, if it is there and whole."""
    path = folder() / key
    try:
        return CachedScans(path)
    except FileNotFoundError:
        # A process that was killed may have left a part of it.
        shutil.rmtree(path, ignore_errors=True)
        return None
    except (IndexError, *DAMAGED_NPZ) as error:
        _log.warning("%s: is damaged and removed (%s)", path, error)
        shutil.rmtree(path, ignore_errors=True)
        return None


class _Writer:
    """Writes an entry scan by scan to a folder of its own; an OSError where that cannot be."""

    def __init__(self) -> None:
        root = folder()
        root.mkdir(parents=True, exist_ok=True)
        _sweep(root)
        # Others may read it as far as the umask lets them.
        self._folder = root / f".writing-{secrets.token_hex(4)}"
        self._folder.mkdir()
        self._files = {name: (self._folder / name).open("wb") for name in _CACHED_ARRAYS}
        with suppress(OSError):  # a disk without locks
            fcntl.flock(self._files["points"], fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._index: list[list[int]] = []

    def append(self, scan: Scan) -> None:
        row = [scan.stamp]
        for name, file in self._files.items():
            kind, columns = _CACHED_ARRAYS[name]
            begin = file.tell() // (np.dtype(kind).itemsize * columns)
            values = getattr(scan, name)
            if values is not None:
                file.write(np.ascontiguousarray(values, kind).data)
            row += [-1, -1] if values is None else [begin, begin + len(values)]
        self._index.append(row)

    def keep(self, key: str, about: dict[str, Any]) -> None:
        """Put the entry in its place, with notes on the sequence (plain data)."""
        for file in self._files.values():
            file.close()
        index = np.array(self._index, np.int64).reshape(-1, 1 + 2 * len(_CACHED_ARRAYS))
        np.save(self._folder / _INDEX, index)
        (self._folder / _ABOUT).write_text(json.dumps(about, indent=1), "utf-8")
        make_room(_size(self._folder))
        # Another process may have been first; its arrays are the same.
        if not (folder() / key).exists():
            self._folder.rename(folder() / key)

    def remove(self) -> None:
        """Remove what is not in its place."""
        for file in self._files.values():
            with suppress(OSError):
                file.close()
        shutil.rmtree(self._folder, ignore_errors=True)


def tee(scans: Iterable[Scan], key: str, about: dict[str, Any]) -> Iterator[Scan]:
    """Pass scans on and keep them. Nothing is kept unless all of them are read.

    `key` is the entry's digest, `about` notes on the sequence (plain data).
    """
    with ExitStack() as stack:
        writer, total = None, 0
        try:
            writer = _Writer()
            stack.callback(writer.remove)
        except OSError as error:
            _log.warning(_NOT_KEPT, about.get("name"), error)
        for scan in scans:
            arrays = (getattr(scan, name, None) for name in _CACHED_ARRAYS)
            total += sum(array.nbytes for array in arrays if array is not None)
            if writer is not None and total > cap():
                _log.warning(_NOT_KEPT, about.get("name"), "larger than the cache may grow")
                writer = None
            try:
                if writer is not None:
                    writer.append(scan)
            except OSError as error:
                _log.warning(_NOT_KEPT, about.get("name"), error)
                writer = None
            yield scan
        try:
            if writer is not None:
                writer.keep(key, about)
        except OSError as error:
            _log.warning(_NOT_KEPT, about.get("name"), error)


def unpacked(path: Path, room: int, unpack: Callable[[bytes], bytes], packed: bytes) -> bytes:
    """Unpack bytes, unless a file has them from before, in an entry that needs so much room."""
    about = path.with_name(_ABOUT)
    with suppress(OSError):
        found = path.read_bytes()
        about.touch()
        return found
    found = unpack(packed)
    with suppress(OSError, MachineError):
        if not about.exists():
            make_room(room)
        with replacing(path) as temporary:
            temporary.write_bytes(found)
        about.touch()
    return found


def make_room(size: int = 0) -> None:
    """Remove entries, and kept references, that were used least recently, so that this has room."""
    entries = []
    for used in (*folder().glob(f"[!.]*/{_ABOUT}"), *folder().glob("*/[!.]*.npz")):
        with suppress(OSError):  # another process may remove it
            path = used.parent if used.name == _ABOUT else used
            entries.append((used.stat().st_mtime, _size(path), path))
    total = sum(n_bytes for _, n_bytes, _ in entries) + size
    for _, n_bytes, path in sorted(entries):
        if total <= cap():
            return
        # Processes that have mapped it keep their arrays.
        with suppress(OSError):
            path.unlink()
        shutil.rmtree(path, ignore_errors=True)
        total -= n_bytes


def _sweep(root: Path) -> None:
    for path in root.glob(".writing-*"):
        try:
            newest = max(p.stat().st_mtime for p in (path, *path.iterdir()))
        except OSError:
            continue
        if time.time() - newest > (_UNLOCKED if _unlocked(path) else _DEAD):
            shutil.rmtree(path, ignore_errors=True)


def _unlocked(path: Path) -> bool:
    with suppress(OSError), (path / "points").open("rb+") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return True
    return False


def _size(path: Path) -> int:
    return sum(p.stat().st_size for p in (path, *path.glob("*")) if p.is_file())


SMALL = 1 << 24  # bytes of files below which their content is read every time
FINGERPRINTS = "fingerprints.txt"
"""File in the cache's folder: on every line the hash of a file's status, and of its content."""
MANY = 64  # so many files have one hash together
_SLOW_BYTES = 1 << 30  # bytes that take more than a second to read
_SIZE = 16
remembered: dict[str, str] = {}
"""Hashes that this process knows, also where the cache's folder cannot be written."""


def fingerprints(files: Sequence[Path]) -> list[str]:
    """Hash the content of each file, `MANY` or more as one; an AdaptuneError if one changes."""
    new: dict[str, str] = {}
    found = []
    try:
        keys = [status_key(file) for file in files]
        size = sum(file.stat().st_size for file in files)
        known = _recall(keys) if size >= SMALL else {}
        if size > _SLOW_BYTES and len(known) < len(keys):
            _log.info("%s: reading %.1f GB to know it by its content", files[0], size / 1e9)
        for file, key in zip(files, keys, strict=True):
            if key not in known:
                new[key] = hash_file(file, key)
            found.append(new.get(key) or known[key])
    except OSError as error:
        raise AdaptuneError(f"{files[0]}: cannot be read ({error.strerror})") from error
    if size >= SMALL and new:
        _remember(new)
    if len(found) < MANY:
        return found
    return [hashlib.blake2b("".join(found).encode(), digest_size=_SIZE).hexdigest()]


def status_key(file: Path) -> str:
    """Hash of all by which a file shows that it is the same as before."""
    status, path = file.stat(), os.fsencode(file.absolute())
    times = f" {status.st_ino} {status.st_size} {status.st_mtime_ns} {status.st_ctime_ns}"
    return hashlib.blake2b(path + times.encode(), digest_size=_SIZE).hexdigest()


def hash_file(file: Path, key: str) -> str:
    """Hash a file whose status has this key."""
    with file.open("rb") as stream:
        digest = hashlib.file_digest(stream, partial(hashlib.blake2b, digest_size=_SIZE))
    if status_key(file) != key:
        raise AdaptuneError(f"{file}: changes while it is read; run again when it is complete")
    return digest.hexdigest()


def _recall(keys: Sequence[str]) -> dict[str, str]:
    """The hashes that are known for these keys, here or on disk."""
    if not remembered.keys() >= set(keys):
        with suppress(OSError, UnicodeDecodeError):
            for line in (folder() / FINGERPRINTS).read_text("ascii").splitlines():
                key, _, found = line.partition(" ")
                if len(key) == len(found) == 2 * _SIZE:
                    remembered[key] = found
    return {key: remembered[key] for key in keys if key in remembered}


def _remember(new: dict[str, str]) -> None:
    remembered.update(new)
    with suppress(OSError):
        folder().mkdir(parents=True, exist_ok=True)
        # One write: processes that append at the same time do not mix their lines.
        with (folder() / FINGERPRINTS).open("ab", buffering=0) as stream:
            stream.write("".join(f"{key} {found}\n" for key, found in new.items()).encode())
