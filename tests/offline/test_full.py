import os
import subprocess

import kills
import pytest
from commands import call


def run(study_file, folder):
    return call("offline", study_file, "--folder", folder)


def assert_full(done, words):
    assert done.exit_code == 2, done.stderr
    (said,) = [line for line in done.stderr.splitlines() if line.startswith("error:")]
    assert words in said
    assert said.endswith("make room, and run the same command again")


def assert_as(folder, trained_folder):
    assert kills.contents(folder) == kills.contents(trained_folder)
    kills.check_once(folder, 10, ["one", "two"])
    assert not list(folder.rglob(".*.npz"))


@pytest.fixture
def small_disk(tmp_path):
    """A disk of one megabyte."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(disk)],
        capture_output=True,
        check=False,
    )
    if mounted.returncode:
        pytest.skip(f"no disk may be mounted: {mounted.stderr.decode().strip()}")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


def leave(disk, free):
    """Fill a disk but for so many bytes."""
    ballast = disk / "ballast"
    ballast.unlink(missing_ok=True)
    status = os.statvfs(disk)
    ballast.write_bytes(bytes(max(0, status.f_bavail * status.f_frsize - free)))


def test_a_full_disk_is_told_and_nothing_is_lost(study_file, trained_folder, small_disk):
    folder, written = small_disk / "study", {}
    for free in (0, 60_000, 60_000):
        leave(small_disk, free)
        assert_full(run(study_file, folder), "No space left on device")
        assert not list(folder.rglob(".*.npz"))
        now = kills.files(folder)
        assert now.items() >= written.items()
        written = now
    assert 0 < len(written) < len(kills.files(trained_folder))
    (small_disk / "ballast").unlink()
    assert run(study_file, folder).exit_code == 0
    assert kills.files(folder).items() >= written.items()
    assert_as(folder, trained_folder)
