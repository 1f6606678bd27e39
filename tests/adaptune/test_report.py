import pytest
from rich.console import Console

from adaptune.report import table


def shown(rows, title="t", caption=""):
    console = Console(width=80)
    with console.capture() as capture:
        console.print(table(title, rows, caption))
    return capture.get()


@pytest.mark.parametrize("name", ["my[v2]", "[/b]", ":x:", "[red]a[/red]"])
def test_texts_are_printed_literally(name):
    text = shown([{name: name}], title=f"of {name}", caption=f"by {name}")
    assert text.count(name) == 4


@pytest.mark.parametrize(
    ("value", "cell"),
    [
        *((12.345, "12.3"), (1.2345, "1.234"), (0.5, "0.500"), (0.0183, "0.0183"), (0.0, "0.000")),
        *((None, "-"), (float("nan"), "-"), (3, "3"), (float("inf"), "inf")),
    ],
)
def test_numbers_have_three_digits_or_so(value, cell):
    assert cell in shown([{"a": value}]).split()


def test_long_headings_break_at_underscores():
    row = {"max_correspondence_distance": 1.0, "voxel_size": 3.0}
    text = shown([row | {f"column {i}": 0.5 for i in range(7)}])
    for word in ("max_", "correspondence_", "distance", "voxel_", "size"):
        assert word in text.split()
