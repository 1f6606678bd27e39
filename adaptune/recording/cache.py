"""Decoded sequences on disk, shared by all processes.

An entry is a folder of arrays that are mapped into memory. Its name is a digest of the files and
settings. It is written to a temporary folder and renamed when whole. A killed writer leaves a
folder whose name begins with a dot, which the next writer removes.
"""

import hashlib
import json
import logging
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np
import platformdirs
from numpy.lib import format as npy
from numpy.typing import NDArray

from adaptune.errors import AdaptuneError
from adaptune.files import expand_user
from adaptune.recording.scan import Scan

_log = logging.getLogger(__name__)
_NOT_KEPT = "%s: not kept in the cache (%s)"

SMALL = 1 << 24
"""Bytes below which all of a file's content counts, and is read every time."""
_VERSION = 5
_SAMPLE = 1 << 16
_CAP_GB, _MOST_GB = 50.0, 1e9
# Seconds. A writer that has not written for this long is dead.
_DEAD = 3600.0
# Fields that a scan may lack.
_OPTIONAL = ("times", "rings", "intensities")
_INDEX = np.dtype([("stamp", "<i8"), ("end", "<i8"), *((name, "?") for name in _OPTIONAL)])
_ARRAYS: dict[str, tuple[str, tuple[int, ...]]] = {
    "points": ("<f4", (3,)),
    "times": ("<f4", ()),
    "rings": ("<u2", ()),
    "intensities": ("<f4", ()),
}


def folder() -> Path:
    """Where decoded sequences are kept: ``$ADAPTUNE_CACHE``, or in the user's cache folder."""
    if given := os.environ.get("ADAPTUNE_CACHE"):
        try:
            return expand_user(given)
        except AdaptuneError as error:
            raise AdaptuneError(f"ADAPTUNE_CACHE: {error}") from error
    return platformdirs.user_cache_path("adaptune", appauthor=False)


def cap() -> int:
    """Bytes that all entries together may take: ``$ADAPTUNE_CACHE_GB`` gigabytes, or 50.

    An AdaptuneError if the variable is no number of gigabytes.
    """
    given = os.environ.get("ADAPTUNE_CACHE_GB", "").strip()
    with suppress(ValueError):
        gigabytes = float(given or _CAP_GB)
        if 0 <= gigabytes <= _MOST_GB:
            return round(gigabytes * 1e9)
    raise AdaptuneError(
        f"ADAPTUNE_CACHE_GB is {given!r}; give gigabytes, 0 or more, or unset it for {_CAP_GB:g}"
    )


def key(paths: Sequence[Path], settings: Any) -> str:
    """Digest of files and settings; an OSError if a file cannot be read.

    A small file counts by its content, a large one by its size, its times of change, its beginning
    and its end, and none by its name. A folder counts by its files.
    """
    digest = hashlib.blake2b(f"{_VERSION} {settings!r}".encode(), digest_size=16)
    for path in paths:
        files = sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [path]
        for file in files:
            status = file.stat()
            digest.update(f"{status.st_size}".encode())
            with file.open("rb") as stream:
                if status.st_size < SMALL:
                    digest.update(stream.read())
                    continue
                digest.update(f" {status.st_mtime_ns} {status.st_ctime_ns}".encode())
                digest.update(stream.read(_SAMPLE))
                stream.seek(max(status.st_size - _SAMPLE, 0))
                digest.update(stream.read(_SAMPLE))
    return digest.hexdigest()


class CachedScans:
    """The scans in the folder of an entry, in any order."""

    def __init__(self, path: Path):
        self.path = path
        # Notes on the sequence from when it was decoded.
        self.about: dict[str, Any] = json.loads((path / "about.json").read_text("utf-8"))
        self._index = np.load(path / "index.npy")
        self._ends: list[int] = self._index["end"].tolist()
        # All at once: mapped arrays stay even if another process removes the entry.
        self._points = self._map("points")
        self._optional = [self._map(name) for name in _OPTIONAL]
        # Records when the entry was last used.
        os.utime(path / "about.json")

    def __len__(self) -> int:
        return len(self._index)

    def __getitem__(self, i: int) -> Scan:
        stamp, end, *given = self._index[i].item()
        part = slice(self._ends[i - 1] if i else 0, end)
        columns = zip(self._optional, given, strict=True)
        times, rings, intensities = (column[part] if there else None for column, there in columns)
        return Scan(stamp, self._points[part], times, rings, intensities=intensities)

    def __iter__(self) -> Iterator[Scan]:
        return (self[i] for i in range(len(self)))

    @property
    def stamps(self) -> NDArray[np.int64]:
        """Stamps of the scans, of shape (n,)."""
        return np.asarray(self._index["stamp"])

    def _map(self, name: str) -> NDArray[Any]:
        # An empty file cannot be mapped.
        mode: Any = "r" if self._ends and self._ends[-1] else None
        array: NDArray[Any] = np.load(self.path / f"{name}.npy", mmap_mode=mode)
        # A view of the base class: slices of memmap itself are slow to make.
        return array.view(np.ndarray)


def find(key: str) -> CachedScans | None:
    """The entry of this digest, if it is there and whole."""
    path = folder() / key
    try:
        return CachedScans(path)
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        _log.warning("%s: is damaged and removed (%s)", path, error)
        shutil.rmtree(path, ignore_errors=True)
        return None


class _Growing:
    """A .npy file whose length is not known before it is closed."""

    def __init__(self, path: Path, dtype: np.dtype[Any], shape: tuple[int, ...]):
        self._dtype, self._shape, self.length = dtype, shape, 0
        self._file: BinaryIO = path.open("wb")
        self._header()

    def append(self, array: NDArray[Any]) -> None:
        self._file.write(np.ascontiguousarray(array, self._dtype).data)
        self.length += len(array)

    def close(self) -> None:
        self._file.seek(0)
        self._header()
        self._file.close()

    def _header(self) -> None:
        # numpy leaves room for the first axis to grow, so the header keeps its size.
        header = {"descr": npy.dtype_to_descr(self._dtype), "fortran_order": False}
        npy.write_array_header_1_0(self._file, header | {"shape": (self.length, *self._shape)})


class Writer:
    """Writes an entry scan by scan, as a context: it is there when the block ends well.

    `key` is the entry's digest, `about` notes on the sequence (plain data).
    """

    def __init__(self, key: str, about: dict[str, Any]):
        self._key, self._about = key, about
        self._done = False
        root = folder()
        root.mkdir(parents=True, exist_ok=True)
        _sweep(root)
        self._temporary = Path(tempfile.mkdtemp(prefix=".writing-", dir=root))
        self._arrays = {
            name: _Growing(self._temporary / f"{name}.npy", np.dtype(kind), shape)
            for name, (kind, shape) in _ARRAYS.items()
        }
        self._index: list[tuple[int | bool, ...]] = []

    def __enter__(self) -> Self:
        return self

    def append(self, scan: Scan) -> None:
        """Add a scan."""
        n = len(scan)
        self._arrays["points"].append(scan.points)
        given = [getattr(scan, name) for name in _OPTIONAL]
        for name, values in zip(_OPTIONAL, given, strict=True):
            array = self._arrays[name]
            if values is not None:
                # Scans before had none: their share stays empty.
                array.append(np.zeros(self._arrays["points"].length - n - array.length))
                array.append(values)
        there = (values is not None for values in given)
        self._index.append((scan.stamp, self._arrays["points"].length, *there))

    def done(self, **about: Any) -> None:
        """Mark the entry as complete, and note more of the sequence."""
        self._about |= about
        self._done = True

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        try:
            for array in self._arrays.values():
                array.close()
            if self._done and error is None:
                np.save(self._temporary / "index.npy", np.array(self._index, _INDEX))
                about = json.dumps(self._about, indent=1)
                (self._temporary / "about.json").write_text(about, "utf-8")
                _make_room(_size(self._temporary))
                # Another process may have been first; its arrays are the same.
                if not (folder() / self._key).exists():
                    self._temporary.rename(folder() / self._key)
        except OSError as problem:
            _log.warning(_NOT_KEPT, self._about.get("name"), problem)
        finally:
            shutil.rmtree(self._temporary, ignore_errors=True)


def tee(scans: Iterable[Scan], key: str, about: dict[str, Any]) -> Iterator[Scan]:
    """Pass scans on and keep them. Nothing is kept unless all of them are read."""
    try:
        writer = Writer(key, about)
    except OSError as error:
        _log.warning(_NOT_KEPT, about.get("name"), error)
        yield from scans
        return
    with writer:
        keeping, total = True, 0
        for scan in scans:
            total += scan.points.nbytes
            if keeping and total > cap():
                _log.warning(_NOT_KEPT, about.get("name"), "larger than the cache may grow")
                keeping = False
            if keeping:
                try:
                    writer.append(scan)
                except OSError as error:
                    _log.warning(_NOT_KEPT, about.get("name"), error)
                    keeping = False
            yield scan
        if keeping:
            writer.done()


@dataclass(frozen=True)
class CacheEntry:
    """A decoded sequence on disk."""

    name: str  # the recording
    path: Path  # folder of the entry
    size: int  # bytes
    used: float  # when it was last opened, in seconds since 1970
    n_scans: int


def list_cache() -> list[CacheEntry]:
    """All entries, the last used first."""
    entries = []
    for path in folder().glob("[!.]*"):
        try:
            about = path / "about.json"
            name = json.loads(about.read_text("utf-8"))["name"]
            n_scans = len(np.load(path / "index.npy", mmap_mode="r"))
            entry = CacheEntry(name, path, _size(path), about.stat().st_mtime, n_scans)
        except (OSError, ValueError, KeyError):
            continue
        entries.append(entry)
    return sorted(entries, key=lambda entry: -entry.used)


def clear_cache() -> int:
    """Remove all entries and the remains of dead writers, and return the freed bytes."""
    freed = 0
    for path in folder().glob("*"):
        # Other files in a shared folder stay.
        if path.name.startswith(".writing-") or (path / "index.npy").exists():
            freed += _size(path)
            shutil.rmtree(path, ignore_errors=True)
    return freed


def _make_room(size: int) -> None:
    entries = list_cache()
    total = sum(entry.size for entry in entries) + size
    for entry in reversed(entries):
        if total <= cap():
            return
        # Processes that have mapped it keep their arrays.
        shutil.rmtree(entry.path, ignore_errors=True)
        total -= entry.size


def _sweep(root: Path) -> None:
    for path in root.glob(".writing-*"):
        try:
            newest = max(p.stat().st_mtime for p in (path, *path.iterdir()))
        except OSError:
            continue
        if time.time() - newest > _DEAD:
            shutil.rmtree(path, ignore_errors=True)


def _size(path: Path) -> int:
    return sum(p.stat().st_size for p in path.iterdir() if p.is_file())


# Hashes of the content of files, remembered on disk.
#
# The hash of a large file is kept in the cache's folder, under the file's path, inode, size and
# times
# of change. Small files are read every time.


FILE = "fingerprints.txt"
"""File in the cache's folder: on every line the hash of a file's status, and of its content."""
MANY = 64
"""So many files have one hash together."""

_BLOCK = 1 << 20
_LONG = 1 << 30
"""Bytes that take more than a second to read."""
_SIZE = 16

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
            for line in (folder() / FILE).read_text("ascii").splitlines():
                key, _, found = line.partition(" ")
                if len(key) == len(found) == 2 * _SIZE:
                    remembered[key] = found
    return keys <= remembered.keys()


def _remember(new: dict[str, str]) -> None:
    remembered.update(new)
    with suppress(OSError):
        folder().mkdir(parents=True, exist_ok=True)
        # One write: processes that append at the same time do not mix their lines.
        with (folder() / FILE).open("ab", buffering=0) as stream:
            stream.write("".join(f"{key} {found}\n" for key, found in new.items()).encode())
