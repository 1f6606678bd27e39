import os
import subprocess

import kills
import pytest
from commands import refused, succeeded


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


def test_a_full_disk_is_told_and_nothing_is_lost(study_file, trained_folder, small_disk):
    folder, written = small_disk / "study", {}
    ballast = small_disk / "ballast"
    for free in (0, 60_000, 60_000):
        ballast.unlink(missing_ok=True)
        status = os.statvfs(small_disk)
        ballast.write_bytes(bytes(max(0, status.f_bavail * status.f_frsize - free)))
        said = refused("offline", study_file, "--folder", folder)
        assert "error: " in said
        assert "No space left on device" in said
        assert said.endswith("make room, and run the same command again")
        assert not list(folder.rglob(".*.npz"))
        now = kills.files(folder)
        assert now.items() >= written.items()
        written = now
    assert 0 < len(written) < len(kills.files(trained_folder))
    ballast.unlink()
    succeeded("offline", study_file, "--folder", folder)
    assert kills.files(folder).items() >= written.items()
    assert kills.contents(folder) == kills.contents(trained_folder)
    kills.check_once(folder, 10, ["one", "two"])
    assert not list(folder.rglob(".*.npz"))
