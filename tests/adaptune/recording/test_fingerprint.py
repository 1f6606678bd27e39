import os
import shutil

import numpy as np
import pytest
import rec

from adaptune.recording import SequenceConfig, cache
from adaptune.recording.cache import fingerprints
from adaptune.recording.recording import open_sequence


@pytest.fixture(autouse=True)
def _fresh(monkeypatch):
    """Every file counts as large, and this process knows nothing."""
    monkeypatch.setattr(cache, "SMALL", 1)
    forget(monkeypatch)


def forget(monkeypatch):
    """As in a new process."""
    monkeypatch.setattr(cache, "remembered", {})


@pytest.fixture
def hashed(monkeypatch):
    """The files whose content is read."""
    files, real = [], cache.hash_file

    def count(file, *rest):
        files.append(file.name)
        return real(file, *rest)

    monkeypatch.setattr(cache, "hash_file", count)
    return files


def write(path, content):
    path.write_bytes(content)
    return path


def test_a_large_file_is_read_once_by_all_processes(tmp_path, hashed, monkeypatch):
    files = [write(tmp_path / "a", b"one"), write(tmp_path / "b", b"two")]
    first = fingerprints(files)
    forget(monkeypatch)
    assert fingerprints(files) == first
    assert hashed == ["a", "b"]
    assert len(set(first)) == 2


def test_small_files_are_read_every_time(tmp_path, hashed, monkeypatch):
    monkeypatch.setattr(cache, "SMALL", 10)
    file = write(tmp_path / "a", b"one")
    assert fingerprints([file]) == fingerprints([file])
    assert hashed == ["a", "a"]


def test_another_file_of_the_same_size_and_time_is_noticed(tmp_path):
    file = write(tmp_path / "a", b"one")
    before, times = fingerprints([file]), (file.stat().st_atime_ns, file.stat().st_mtime_ns)
    file.write_bytes(b"two")
    os.utime(file, ns=times)
    assert fingerprints([file]) != before


def test_a_cache_that_cannot_be_written_breaks_nothing(tmp_path, monkeypatch, hashed):
    monkeypatch.setenv("ADAPTUNE_CACHE", str(write(tmp_path / "file", b"") / "cache"))
    file = write(tmp_path / "a", b"one")
    assert fingerprints([file]) == fingerprints([file])
    assert hashed == ["a"]


def test_damaged_lines_do_not_count(tmp_path, cache_folder, monkeypatch):
    file = write(tmp_path / "a", b"one")
    before = fingerprints([file])
    forget(monkeypatch)
    path = cache_folder / cache.FINGERPRINTS
    path.write_bytes(b"\xff\n" + path.read_bytes()[:40])
    assert fingerprints([file]) == before


def test_many_files_have_one_hash(tmp_path):
    files = [write(tmp_path / str(i), bytes([i])) for i in range(cache.MANY)]
    (before,) = fingerprints(files)
    files[7].write_bytes(b"other")
    assert fingerprints(files) != [before]


def test_a_decoded_bag_is_that_of_its_content(tmp_path):
    path = rec.drive(tmp_path / "a.bag", n=300)
    config = SequenceConfig(bag=str(path))
    before = [scan.points for scan in open_sequence(config)]
    data, times = bytearray(path.read_bytes()), (path.stat().st_atime_ns, path.stat().st_mtime_ns)
    at = data.find(before[150][50].tobytes())
    data[at : at + 12] = np.float32([1, 2, 3]).tobytes()
    assert at > 1 << 16
    assert len(data) - at > 1 << 17
    copy = tmp_path / "copy"
    copy.write_bytes(data)
    shutil.copyfile(copy, path)
    os.utime(path, ns=times)
    after = [scan.points for scan in open_sequence(config)]
    assert (before[150] != after[150]).any()
