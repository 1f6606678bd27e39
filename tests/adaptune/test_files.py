import errno
import math
import os

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from adaptune.compiled import compiled
from adaptune.errors import AdaptuneError, lacking
from adaptune.files import locked, replacing, write_text
from adaptune.yaml12 import Document, YamlError, dump, scalar


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


def test_two_writers_do_not_meet(tmp_path):
    path = tmp_path / "a.txt"
    with replacing(path) as first, replacing(path) as second:
        assert first != second
        first.write_text("first")
        second.write_text("second")
    assert path.read_text() == "first"
    assert list(tmp_path.iterdir()) == [path]


def test_a_pipe_is_written_to_and_stays(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_text(pipe, "text")
    assert os.read(reader, 10) == b"text"
    os.close(reader)
    assert pipe.is_fifo()
    assert list(tmp_path.iterdir()) == [pipe]


modest = settings(max_examples=80, deadline=None)

words = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=30)
numbers_in_words = st.from_regex(r"[-+]?[0-9._eE]{1,6}", fullmatch=True)
scalars = (
    st.none()
    | st.booleans()
    | st.integers(-(10**20), 10**20)
    | st.floats(allow_nan=False)
    | words
    | st.sampled_from(
        ["1e3", "010", "on", "No", "1:30", "=", "<<", "~", "0x1F", "1_0", "2001-01-01"]
    )
    | numbers_in_words
)
plain = st.recursive(
    scalars,
    lambda children: (
        st.lists(children, max_size=4)
        | st.dictionaries(words | numbers_in_words, children, max_size=4)
    ),
    max_leaves=12,
)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e3", 1000.0),
        (".5", 0.5),
        ("010", 10),
        (".inf", math.inf),
        ("true", True),
        ("null", None),
        ("", None),
        ("on", "on"),
        ("1:30", "1:30"),
        ("1_000", "1_000"),
        (".", "."),
        ("'1e3'", "1e3"),
        ("/velodyne_points", "/velodyne_points"),
        ("[1, 2.0, a]", [1, 2.0, "a"]),
        ("{a: 1e-2, b: }", {"a": 0.01, "b": None}),
        ("{00: 1, 1e3: 2, null: 3, on: 4}", {"00": 1, "1e3": 2, "null": 3, "on": 4}),
    ],
)
def test_scalars(text, value):
    got = scalar(text)
    assert got == value
    assert type(got) is type(value)


# Ten lines of aliases, which stand for ten to the tenth values.
LAUGHS = "a0: &a0 [x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 11)
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nb: 2\na: 3\n", "line 3: 'a' was given before, in line 1"),
        ("- {a: 1,\n   a: 2}\n", "line 2: 'a' was given before, in line 1"),
        ("a: 1\n? [b]\n: 2\n", "line 2: a key must be"),
        ("a: 1\n\tb: 2\n", "line 2: "),
        ("a: 1\nb: *there\n", "line 2: .*there"),
        ("a: !thing 1\n", "line 1: .*!thing"),
        ("a: 1\n---\nb: 1\n", "line 2: "),
        ("[" * 5000, "nested too deeply"),
        ("a: " + "9" * 5000, "a number has thousands of digits"),
        ('b: 1\na: "\\0"\n', "line 2: a text holds a null character"),
        ("a: &a [*a]\n", "an alias of itself"),
        ("a: &a {b: {c: *a}}\n", "an alias of itself"),
        (LAUGHS, "more than 100,000 values"),
    ],
)
def test_mistakes_are_told_with_their_line(text, message):
    with pytest.raises(YamlError, match=message):
        Document(text)
    assert issubclass(YamlError, AdaptuneError)


TEXT = """\
# a study
odometry:
  name: gicp

  parameters:
    interval: {low: 1,
               high: 2}
training:
- cave
- {bag: a.bag,
   stop: 3}
3: three
"""


@pytest.mark.parametrize(
    ("path", "line"),
    [
        ([], None),
        (["odometry", "name"], 3),
        (["odometry", "parameters", "interval", "high"], 7),
        (["odometry", "name", "deeper"], 3),
        (["training", 0], 9),
        (["training", 1, "stop"], 11),
        ([3], 12),
    ],
)
def test_line_of_a_path(path, line):
    assert Document(TEXT).line(path) == line


@modest
@given(plain)
@example(
    {"a": ["1e3", "010", 1e300, -0.0, 1e-7, math.inf, 10**18, "on", "08", "", " x ", "a\n\nb\n"]}
)
def test_what_is_dumped_is_read_back(data):
    back = Document(dump(data)).data
    assert back == data
    # 1 == 1.0 == True, but they are not the same.
    assert repr(back) == repr(data)


@pytest.mark.parametrize("text", ["a\udcff.bag", "a\0", "\ud800"])
def test_what_cannot_be_read_back_is_not_written(text):
    for data in ({text: 1}, [{"bag": text}]):
        with pytest.raises(AdaptuneError, match=r"no character in UTF-8; rename it"):
            dump(data)


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
