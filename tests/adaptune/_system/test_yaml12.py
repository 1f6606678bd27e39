import math

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from adaptune._system.yaml12 import Document, YamlError, dump
from adaptune.errors import AdaptuneError

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
    got = Document(text).data
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


@pytest.mark.parametrize(
    ("text", "path", "added", "changed"),
    [
        ("a:\n- 00  # x\n# y\n- 1\n\n# of b\nb: 1\n", ["a"], ["c"], ("- 1\n", "- 1\n- c\n")),
        ("a: &x\n  - b\nc: *x\n# end\n", [], {"d": 1}, ("*x\n", "*x\nd: 1\n")),
        ("a: &x\n  - b\nc: *x\n", ["a"], ["c"], ("- b\n", "- b\n  - c\n")),
        ("a: [b, # x\n  'c'  # y\n ]\n", ["a"], ["d"], ("'c'", "'c', d")),
        ("a: {b: {c: 1e-3}}", ["a"], {"d": {"e": "01"}}, ("}}", "}, d: {e: '01'}}")),
        ("a: {b: 1, }", ["a"], {"c": 1}, ("1,", "1, c: 1,")),
        ("a:  # x\nb: 1\n", ["a"], ["c"], ("a:", "a: [c]")),
        ("a: []\n", ["a"], ["c", {"d": [1]}], ("[]", "[c, {d: [1]}]")),
        ("a:\n    b:\n      c: 1", ["a"], {"d": {"e": 1}}, ("1", "1\n    d:\n      e: 1\n")),
        ("a:\n  b: 1\n", ["a", "c"], 48, ("1\n", "1\n  c: 48\n")),
        ("a: {b: 1} # x\n", ["a", "b"], 48, ("1", "48")),
        ("a: 1\n", ["c", "d"], 48, ("1\n", "1\nc:\n  d: 48\n")),
    ],
)
def test_nothing_else_changes_where_something_is_added(text, path, added, changed):
    assert Document(text).with_added(path, added) == text.replace(*changed)


@pytest.mark.parametrize("text", ["a\udcff.bag", "a\0", "\ud800"])
def test_what_cannot_be_read_back_is_not_written(text):
    for data in ({text: 1}, [{"bag": text}]):
        with pytest.raises(AdaptuneError, match=r"no character in UTF-8; rename it"):
            dump(data)
