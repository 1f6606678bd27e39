import pytest
import rec
from pydantic import ValidationError

from adaptune.odometry.program import program_input
from adaptune.recording import SequenceConfig
from adaptune.recording.recording import check_sequence, open_sequence
from adaptune.recording.scan import part_name, read_part


@pytest.mark.parametrize(
    ("text", "part", "name"),
    [
        ("0-60%", (0.0, 0.6), "a_0-60"),
        ("60-100%", (0.6, 1.0), "a_60-100"),
        (" 12.5 - 50 % ", (0.125, 0.5), "a_12.5-50"),
        ([0.25, 0.5], (0.25, 0.5), "a_25-50"),
    ],
)
def test_parts_are_read_and_named(text, part, name):
    assert read_part(text) == part
    assert part_name("a", part) == name


@pytest.mark.parametrize("text", ["abc", "60-0%", "0-120%", "", 60, [0, "a"]])
def test_what_is_no_part_is_refused_with_an_example(text):
    with pytest.raises(ValueError, match="as in 0-60%"):
        read_part(text)
    with pytest.raises(ValidationError, match="as in 0-60%"):
        SequenceConfig(bag="a.bag", part=text or "")


def tenths(sequence):
    return [round((scan.stamp - rec.START) / 1e8) for scan in sequence]


def test_the_parts_of_a_bag_are_the_bag(tmp_path):
    bag = str(rec.drive(tmp_path / "a.bag"))
    for _ in range(2):  # read, and from the cache
        first = open_sequence(SequenceConfig(bag=bag, part="0-60%"))
        second = open_sequence(SequenceConfig(bag=bag, part="60-100%"))
        begin, end = tenths(first), tenths(second)
        assert begin + end == list(range(20))
        assert len(begin) == pytest.approx(12, abs=1)
    assert first.n_messages == pytest.approx(12, abs=1)
    check_sequence(SequenceConfig(bag=bag, part="0-60%"))
    within = open_sequence(SequenceConfig(bag=bag, start=0.5, stop=1.5, part="50-100%"))
    assert tenths(within) == list(range(10, 15))


def test_a_program_reads_the_part_alone(tmp_path):
    bag = rec.drive(tmp_path / "a.bag")
    for part, own in ((None, True), ("0-60%", False)):
        config = SequenceConfig(bag=str(bag), reference="/poses", part=part)
        folder = tmp_path / "inputs" / str(part)
        found = program_input(open_sequence(config), config, {}, folder, "bag")
        assert (found.path == bag) is own
