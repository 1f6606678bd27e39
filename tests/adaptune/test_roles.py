import pytest
import yaml
from setups import failure

from adaptune._system.strict import ConfigurationError
from offline.config import load_study

COURSES = "courses.cave={scenes: [cave], length: 10, seed: 1}"


def written(study_file, name, **changes):
    """The study with other values, in a file of its own beside its bags."""
    study = yaml.safe_load(study_file.read_text()) | changes
    file = study_file.with_name(f"{name}.yaml")
    file.write_text(yaml.safe_dump(study, sort_keys=False))
    return file


def test_parts_become_sequences_of_their_own(study_file, tmp_path):
    overrides = ["training=[one: 0-60%, two]", "test=[one: 60-100%]"]
    study = load_study(study_file, overrides, tmp_path)
    assert study.training == ["one_0-60", "two"]
    assert study.config.test == ("one_60-100",)
    assert study.config.sequences["one_0-60"].part == (0.0, 0.6)
    first, second = (
        [scan.stamp for scan in study.sequences.open(name)] for name in ("one_0-60", "one_60-100")
    )
    assert first + second == [scan.stamp for scan in study.sequences.open("one")]
    assert len(first) == pytest.approx(24, abs=1)
    recorded_in = study.sequences.recorded_in
    assert recorded_in("one_0-60") == recorded_in("one_60-100") == recorded_in("one")
    assert recorded_in("one") != recorded_in("two")


def test_a_part_may_be_given_by_its_name(study_file, tmp_path):
    parts = {"training": [{"one": "0-30%"}, {"one": "30-60%"}], "test": [{"one": "60-100%"}]}
    file = written(study_file, "by_name", **parts)
    study = load_study(file, ["training=[one_0-30]", "test=[one_30-60, one_60-100]"], tmp_path)
    assert study.training == ["one_0-30"]
    assert study.config.test == ("one_30-60", "one_60-100")
    assert study.config.sequences["one_30-60"].part == (0.3, 0.6)


def test_a_name_may_look_like_a_number(study_file):
    text = study_file.read_text().replace("one:", "00:").replace("two:", "1e3:")
    file = study_file.with_name("numbers.yaml")
    file.write_text(text.replace("[one, two]", "[00: 0-60%, 1e3]"))
    assert load_study(file).training == ["00_0-60", "1e3"]


def test_parts_of_a_course_share_its_recording(study_file, tmp_path):
    overrides = [COURSES, "training=[cave: 0-50%]", "test=[cave: 50-100%]"]
    sequences = load_study(study_file, overrides, tmp_path).sequences
    assert sequences.recording("cave_0-50") == sequences.recording("cave")
    assert sequences.recorded_in("cave_0-50") == sequences.recorded_in("cave")
    assert sequences.config("cave_0-50").part == (0.0, 0.5)
    with pytest.raises(ConfigurationError, match="adaptune simulate"):
        sequences.open("cave_0-50")


@pytest.mark.parametrize(
    ("roles", "key", "words"),
    [
        ({"training": [{"one": "60-0%"}]}, "training.0", "60-0% of one is no part"),
        ({"training": [{"one": "0-60%", "two": "0-60%"}]}, "training.0", "an entry of its own"),
        ({"training": [{"one": "0-60%"}] * 2}, "training.1", "named twice"),
        ({"training": ["one_60-0"]}, "training.0", "60-0% of one is no part"),
        ({"training": ["one_0-60", {"one": "0-60%"}]}, "training.1", "named twice"),
        ({"training": [{"one_0-60": "0-50%"}]}, "training.0", "there is no sequence 'one_0-60'"),
        ({"training": ["on_0-60"]}, "training.0", "there is no sequence 'on_0-60'"),
        (
            {"training": [{"one": "0-60%"}, {"one": "50-100%"}]},
            "training.1",
            "overlaps one_0-60; name parts that share no scan",
        ),
        ({"training": ["one"], "test": ["one"]}, "test.0", "[one: 0-60%], test: [one: 60-100%]"),
        (
            {"training": [{"one": "0-60%"}], "test": [{"one": "50-100%"}]},
            "test.0",
            "overlaps one_0-60",
        ),
    ],
)
def test_mistakes_in_roles_are_told_once_with_their_line(study_file, roles, key, words):
    text = failure(written(study_file, "roles", **roles))
    assert words in text
    assert f": {key}: " in text
    assert "line" in text
    assert len(text.splitlines()) == 1


def test_a_name_that_is_taken(study_file):
    taken = "sequences.one_0-60={bag: two.bag, points: /points, reference: /truth}"
    text = failure(study_file, taken, "training=[one: 0-60%]")
    assert "training.0: there is another sequence one_0-60" in text
