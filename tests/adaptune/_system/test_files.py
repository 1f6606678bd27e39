import errno
import os
import re
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from adaptune._system.compiled import compiled
from adaptune._system.files import (
    FullError,
    locked,
    make_temporary,
    needing_room,
    replacing,
    replacing_folder,
    temporary_folder,
    write_text,
)
from adaptune.errors import lacking


def test_a_file_appears_when_all_went_well(tmp_path):
    path = tmp_path / "new" / "folder" / "a.txt"
    with replacing(path) as beside:
        beside.write_text("whole")
        assert not path.exists()
        assert beside.parent == path.parent
        assert beside.suffix == ".txt"
    assert path.read_text() == "whole"
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_the_old_file_survives_a_failure(tmp_path, error):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def fail():
        with replacing(path) as beside:
            beside.write_text("half of the ne")
            raise error

    with pytest.raises(error):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def barred(number, path):
    return OSError(number, os.strerror(number), str(path))


@pytest.mark.parametrize("number", [errno.EACCES, errno.EROFS, errno.EPERM])
def test_a_folder_that_cannot_be_written_to_is_named(tmp_path, monkeypatch, number):
    path, words = tmp_path / "ro" / "a.txt", re.escape(os.strerror(number))
    told = (
        f"ro: cannot be written to \\({words}\\); name another folder \\(--folder, --out\\), or cop"
    )
    with pytest.raises(FullError, match=told), replacing(path) as beside:
        raise barred(number, beside)
    with pytest.raises(FullError, match=told), replacing_folder(path) as beside:
        raise barred(number, beside / "inside")
    with pytest.raises(FullError, match=told), needing_room(path):
        raise barred(number, path.parent / "b.txt")
    made = rf"{re.escape(str(tmp_path))}: cannot be written to"
    with pytest.raises(FullError, match=made), needing_room(path):
        raise barred(number, path.parent)  # which would be made
    with pytest.raises(OSError, match=r"other\.txt") as error, replacing(path):
        raise barred(number, tmp_path / "other.txt")
    assert not isinstance(error.value, FullError)
    # On such a disk, even what is not there cannot be removed.
    monkeypatch.setattr(Path, "unlink", lambda self: (_ for _ in ()).throw(barred(number, self)))
    with pytest.raises(FullError, match=told), replacing(path) as beside:
        raise barred(number, beside)


def test_two_writers_do_not_meet(tmp_path):
    path = tmp_path / "a.txt"
    with replacing(path) as first, replacing(path) as second:
        assert first != second
        first.write_text("first")
        second.write_text("second")
    assert path.read_text() == "first"
    assert list(tmp_path.iterdir()) == [path]


LEAVES = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell in the background ignores it
from adaptune._system.files import make_temporary
folder = make_temporary()
(folder / "link").touch()
print(folder, flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_what_a_killed_process_leaves_is_removed_by_the_next_one(tmp_path, monkeypatch, number):
    def begin():
        piped = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        process = subprocess.Popen([sys.executable, "-c", LEAVES], text=True, **piped)
        return process, process.stdout.readline().strip()

    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    other = tmp_path / "adaptune-of-the-user"
    other.mkdir()
    (killed, left), (alive, used) = begin(), begin()
    killed.send_signal(number)
    killed.wait()
    assert sorted(map(str, tmp_path.iterdir())) == sorted([left, used, str(other)])
    own = make_temporary()
    assert sorted(map(str, tmp_path.iterdir())) == sorted([used, str(own), str(other)])
    with temporary_folder() as folder:
        assert folder.is_dir()
    assert not folder.exists()
    alive.communicate("")


def test_a_pipe_is_written_to_and_stays(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_text(pipe, "text")
    assert os.read(reader, 10) == b"text"
    os.close(reader)
    assert pipe.is_fifo()
    assert list(tmp_path.iterdir()) == [pipe]


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EIO])
def test_a_disk_without_locks_is_told_and_used(tmp_path, monkeypatch, caplog, number):
    def flock(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("fcntl.flock", flock)
    with (tmp_path / ".lock").open("w") as file:
        assert locked(file, wait=False)
    (record,) = caplog.records
    assert f"{tmp_path}: this disk has no file locks" in record.getMessage()


def test_what_another_holds_is_not_locked(tmp_path, caplog):
    with (tmp_path / ".lock").open("w") as one, (tmp_path / ".lock").open("w") as other:
        assert locked(one, wait=False)
        assert not locked(other, wait=False)
    assert not caplog.records


@pytest.mark.parametrize("signature", [None, "float64(float64)"])
def test_loops_are_compiled_where_nothing_can_be_kept(monkeypatch, signature):
    monkeypatch.setattr("numba.core.config.CACHE_DIR", "/proc/none")
    half = compiled(lambda x: 0.5 * x, signature)
    assert half(3.0) == 1.5
    assert len(half.signatures) == 1


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.EMFILE, "Too many open files"), "raise `ulimit -n`"),
        (OSError(errno.EDQUOT, "Disk quota exceeded"), "the disk is full"),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), "out of memory"),
        (MemoryError(), ""),
        (OSError(errno.ENOENT, "No such file"), ""),
        (ValueError("odd"), ""),
    ],
)
def test_what_a_machine_lacks_is_found_in_what_led_to_an_error(error, words):
    later = RuntimeError("cannot be read")
    later.__cause__ = error
    for seen in (error, later):
        assert words in lacking(seen)
        assert bool(lacking(seen)) == bool(words)
