"""The drives that a study has learned from, as every command loads them."""

import pytest

from adaptune.strict import ConfigurationError
from adaptune.study.loading import LearnedDrives
from offline.config import load_study


@pytest.fixture
def load(study_file, tmp_path):
    """Load the study with a file of learned drives."""

    def make(text, *overrides):
        (tmp_path / "learned.yaml").write_text(text.replace("DRIVES", str(study_file.parent)))
        return load_study(study_file, overrides, tmp_path)

    return make


MORE = """\
sequences:
  more: {bag: DRIVES/three.bag, points: /points, reference: /truth, start: 1}
training: [more]
"""


def failure(load, text, *overrides):
    with pytest.raises(ConfigurationError) as caught:
        load(text, *overrides)
    return str(caught.value)


def test_drives_are_trained_on(load):
    study = load(MORE, "test=[]")
    assert study.training == ["one", "two", "more"]
    assert study.config.sequences["more"].start == 1.0


def test_a_test_sequence_that_was_learned_is_none_any_more(load):
    study = load("training: [three]")
    assert (study.training, study.config.test) == (["one", "two", "three"], ())
    # A recording proves nothing under another name either.
    assert "test.0: 'three' is the recording of the training sequence 'more'" in failure(load, MORE)


def test_so_with_a_part(load):
    overrides = ["training=[one: 0-60%]", "test=[one: 60-100%, three]"]
    study = load("training: []", *overrides)
    assert study.sequences.entry("one_60-100") == {"one": "60-100%"}
    assert study.sequences.entry("three") == "three"
    # What an override says counts.
    text = failure(load, "training: [{one: 60-100%}]", "test=[one: 60-100%]")
    assert "-o: test.0: one_60-100 overlaps one of training" in text


def test_overrides_have_the_last_word(load):
    assert load("training: [three]", "training=[two]").training == ["two"]
    assert load(MORE, "test=[]", "sequences.more.start=2").config.sequences["more"].start == 2.0


def test_an_entry_that_the_study_names_too_counts_once(load):
    assert load("training: [two]").training == ["one", "two"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "sequences:\n  two: {bag: DRIVES/two.bag}\n",
            "learned.yaml, line 2: sequences.two: {study} names another one, sequences.two; give ",
        ),
        ("training:\n- three\n- gone\n", "learned.yaml, line 3: training.1: there is no sequence"),
        (
            "sequences:\n  a: {bag: DRIVES/two.bag}\n  b: {bag: DRIVES/gone.bag}\n",
            "learned.yaml, line 3: sequences.b: ",
        ),
        ("sequences: {b: {bags: 3}}", "learned.yaml, line 1: sequences.b"),
        ("test: [one]", "learned.yaml: needs `sequences` by name, a list `training`, and nothing"),
        ("training: one", "learned.yaml: needs `sequences` by name"),
        ("training: [", "learned.yaml: cannot be read (line 1: "),
    ],
)
def test_mistakes_are_told_with_file_and_line(load, study_file, text, said):
    assert said.format(study=study_file) in failure(load, text)


def test_mistakes_in_the_studys_own_lists_keep_their_line(load):
    assert ": training.1: 'one' is named twice" in failure(
        load, "training: [three]", "training=[one, one]"
    )


def test_what_is_written_is_read_and_can_be_taken_back(tmp_path):
    empty = LearnedDrives.read(tmp_path)
    one = empty.adding("drive", {"drive": {"bag": "/a.bag"}})
    two = one.adding({"hall": "60-100%"}, {})
    two.write()
    found = LearnedDrives.read(tmp_path)
    assert found.sequences == {"drive": {"bag": "/a.bag"}}
    assert found.training == ["drive", {"hall": "60-100%"}]
    assert found.without("hall_60-100").training == ["drive"]
    assert found.without("drive").sequences == {}
    one.without("drive").write()
    assert not (tmp_path / "learned.yaml").exists()
    empty.write()
