import json
import multiprocessing
import os
import shutil
import signal
import time
from dataclasses import replace

import numpy as np
import pytest
import rec

from adaptune.recording import SequenceConfig, cache
from adaptune.recording.bag import BagSource
from adaptune.recording.recording import open_sequence
from adaptune.recording.scan import Scan


def entries(folder):
    return sorted(p.name for p in folder.iterdir()) if folder.exists() else []


def test_the_second_opening_reads_no_bag_and_gives_the_same(tmp_path, cache_folder, monkeypatch):
    config = SequenceConfig(bag=str(rec.drive(tmp_path / "a.bag")), reference="/poses")
    first = list(open_sequence(config))
    assert len(entries(cache_folder)) == 1

    def refuse(_):
        raise AssertionError("the bag was opened")

    monkeypatch.setattr(BagSource, "open", refuse)
    sequence = open_sequence(config)
    second = list(sequence)
    assert sequence.n_messages == 20
    for a, b in zip(first, second, strict=True):
        assert a.stamp == b.stamp
        for one, other in ((a.points, b.points), (a.times, b.times), (a.rings, b.rings)):
            assert np.array_equal(one, other)
            assert one.dtype == other.dtype
        assert b.points.base is not None, "the points were copied"
        assert not b.points.flags.writeable


def test_half_a_pass_keeps_nothing(tmp_path, cache_folder):
    config = SequenceConfig(bag=str(rec.drive(tmp_path / "a.bag")))
    scans = iter(open_sequence(config))
    next(scans)
    scans.close()
    assert not entries(cache_folder)


@pytest.mark.parametrize(
    "change", [{"start": 0.5}, {"stride": 2}, {"stamp": "end"}, {"time_unit": "ms"}]
)
def test_other_settings_are_another_entry(tmp_path, cache_folder, change):
    bag = str(rec.drive(tmp_path / "a.bag"))
    plain = list(open_sequence(SequenceConfig(bag=bag)))
    changed = list(open_sequence(SequenceConfig(bag=bag, **change)))
    fresh = list(open_sequence(SequenceConfig(bag=bag, cache=False, **change)))
    assert len(entries(cache_folder)) == 2
    assert [s.stamp for s in changed] == [s.stamp for s in fresh]
    assert any(
        a.stamp != b.stamp or not np.array_equal(a.times, b.times)
        for a, b in zip(plain, changed, strict=False)
    )


def test_scans_without_times_rings_intensities_or_points_are_kept_as_they_are():
    points = np.arange(6, dtype=np.float32).reshape(2, 3)
    times, rings = np.array([0, 0.1], np.float32), np.array([1, 2], np.uint16)
    scans = [
        Scan(1, points),
        Scan(2, points[:0]),
        Scan(3, points + 1, times),
        Scan(4, points + 2, None, rings),
        Scan(5, points + 3, times + 1, rings + 1),
        Scan(6, points[:0], times[:0], rings[:0]),
        Scan(7, points + 4, intensities=times + 2),
    ]
    list(cache.tee(scans, "key", {"name": "a"}))
    kept = cache.find("key")
    assert [scan.stamp for scan in kept] == [1, 2, 3, 4, 5, 6, 7]
    for i, scan in enumerate(scans):
        for name in ("points", "times", "rings", "intensities"):
            a, b = getattr(scan, name), getattr(kept[i], name)
            assert (a is None and b is None) or np.array_equal(a, b)


def scans_of(megabytes, n=4):
    size = round(megabytes * 1e6 / 12 / n)
    return [Scan(i, np.ones((size, 3), np.float32)) for i in range(n)]


def test_the_least_recently_used_goes_first(monkeypatch, cache_folder):
    monkeypatch.setenv("ADAPTUNE_CACHE_GB", "0.0045")
    now = time.time()
    for i, name in enumerate("abcd"):
        list(cache.tee(scans_of(1), name, {"name": name}))
        os.utime(cache.folder() / name / "about.json", (now - 100 + i, now - 100 + i))
    assert cache.find("a") is not None, "which makes it the last used"
    list(cache.tee(scans_of(1), "e", {"name": "e"}))
    assert entries(cache_folder) == ["a", "c", "d", "e"]
    assert sum(file.stat().st_size for file in cache_folder.rglob("*")) <= cache.cap() + 4 * 4096


def test_what_is_kept_besides_counts_and_goes_by_its_last_use(monkeypatch, cache_folder):
    monkeypatch.setenv("ADAPTUNE_CACHE_GB", "0.0045")
    now, besides = time.time(), cache_folder / "references"
    besides.mkdir(parents=True)
    for i, name in enumerate(["old", "a", "new", "b"]):
        if i % 2:
            list(cache.tee(scans_of(1), name, {"name": name}))
            path = cache_folder / name / "about.json"
        else:
            path = besides / f"{name}.npz"
            path.write_bytes(bytes(10**6))
        os.utime(path, (now - 100 + i, now - 100 + i))
    list(cache.tee(scans_of(1), "c", {"name": "c"}))
    assert entries(cache_folder) == ["a", "b", "c", "references"]
    assert [path.name for path in besides.iterdir()] == ["new.npz"]
    monkeypatch.setenv("ADAPTUNE_CACHE_GB", "0.0025")
    cache.make_room()
    assert entries(cache_folder) == ["b", "c", "references"]
    assert not list(besides.iterdir())


def test_an_entry_that_is_removed_while_it_is_read_can_be_read_on():
    list(cache.tee(scans_of(1), "a", {"name": "a"}))
    kept = cache.find("a")
    assert kept is not None
    shutil.rmtree(kept.path)
    assert cache.find("a") is None
    assert [len(scan) for scan in kept] == [len(scan) for scan in scans_of(1)]


def test_what_is_larger_than_the_cap_is_passed_on_and_not_kept(monkeypatch, caplog):
    monkeypatch.setenv("ADAPTUNE_CACHE_GB", "0.001")
    assert len(list(cache.tee(scans_of(2), "a", {"name": "a"}))) == 4
    assert cache.find("a") is None
    assert "not kept" in caplog.text
    # Intensities count, too: 0.9 MB of points and 0.3 MB of these.
    list(cache.tee(scans_of(0.9), "b", {"name": "b"}))
    assert cache.find("b") is not None
    lit = [replace(scan, intensities=np.ones(len(scan), np.float32)) for scan in scans_of(0.9)]
    list(cache.tee(lit, "c", {"name": "c"}))
    assert cache.find("c") is None
    assert cache.find("b") is not None


def test_a_damaged_entry_is_made_anew(tmp_path, cache_folder, caplog):
    config = SequenceConfig(bag=str(rec.drive(tmp_path / "a.bag")), cache=True)
    whole = list(open_sequence(config))
    (entry,) = cache_folder.iterdir()
    for name in ("about.json", "index.npy", "points"):
        caplog.clear()
        (entry / name).write_bytes(b"{")
        again = list(open_sequence(config))
        assert [s.stamp for s in again] == [s.stamp for s in whole]
        assert "damaged" in caplog.text
    index = np.load(entry / "index.npy")
    index[1, 1] = -1  # a scan without points
    np.save(entry / "index.npy", index)
    assert [len(s.points) for s in open_sequence(config)] == [len(s.points) for s in whole]
    (entry / "index.npy").unlink()  # as a killed process leaves an entry that it removes
    list(open_sequence(config))
    assert (entry / "index.npy").exists()


def _write_slowly(ready):
    def scans():
        yield from scans_of(1)
        ready.set()
        time.sleep(60)

    list(cache.tee(scans(), "a", {"name": "a"}))


def test_a_killed_writer_leaves_no_half_entry(cache_folder):
    context = multiprocessing.get_context("fork")
    ready = context.Event()
    process = context.Process(target=_write_slowly, args=(ready,))
    process.start()
    assert ready.wait(20)
    assert process.pid is not None
    (left,) = cache_folder.iterdir()
    for path in (left, *left.iterdir()):
        os.utime(path, (time.time() - 60,) * 2)
    # It stays while its writer waits for the next scan.
    list(cache.tee(scans_of(1), "b", {"name": "b"}))
    assert left.exists()
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert cache.find("a") is None
    list(cache.tee(scans_of(1), "c", {"name": "c"}))
    assert entries(cache_folder) == ["b", "c"]


def test_two_writers_of_the_same_do_not_meet(cache_folder):
    one, two = (cache.tee(scans_of(1), "a", {"name": "a"}) for _ in range(2))
    next(one)
    assert len(list(two)) == 4
    assert len(list(one)) == 3
    assert entries(cache_folder) == ["a"]
    assert json.loads((cache_folder / "a" / "about.json").read_text()) == {"name": "a"}


def test_others_may_read_an_entry_as_far_as_the_umask_lets_them(cache_folder):
    before = os.umask(0o022)
    try:
        list(cache.tee(scans_of(1), "a", {"name": "a"}))
    finally:
        os.umask(before)
    assert {path.stat().st_mode & 0o444 for path in cache_folder.rglob("*")} == {0o444}
