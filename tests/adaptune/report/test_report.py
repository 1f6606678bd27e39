import pytest
from rich.console import Console

from adaptune.report.tables import Listing, markdown, table, tables_within, write_tables


def shown(rows, title="t", caption=""):
    console = Console(width=80)
    with console.capture() as capture:
        console.print(table(title, rows, caption))
    return capture.get()


@pytest.mark.parametrize(
    ("value", "cell"),
    [
        *((12.345, "12.3"), (1.2345, "1.234"), (0.5, "0.500"), (0.0183, "0.0183"), (0.0, "0.000")),
        *((None, "-"), (float("nan"), "-"), (3, "3"), (float("inf"), "inf")),
    ],
)
def test_numbers_have_three_digits_or_so(value, cell):
    assert cell in shown([{"a": value}]).split()


def test_columns_that_have_no_room_go_on_below():
    row = {"mode": "oracle, sequence", "_file": 1} | {f"{i} of_all [%]": 0.1234 for i in range(12)}
    said = shown_within(Listing("title", [row] * 2, "The caption, on a line."), 60)
    assert said.split().count("0.123") == 2 * 12
    assert said.count("oracle, sequence") == 2 * 2
    assert "The caption, on a line." in said.splitlines()[-1]
    assert max(map(len, said.splitlines())) <= 60
    assert said.split().count("all") == 12
    # A column that is too wide alone stands alone.
    assert shown_within(Listing("t", [{"a": "b", "c": "d" * 90, "e": 1.0}]), 60).count("a") == 2


def shown_within(listing, width):
    console = Console(width=width)
    with console.capture() as capture:
        console.print(*tables_within(listing, width), sep="\n")
    return capture.get()


LISTING = Listing(
    "RTE_1 & more",
    [{"sequence": "a_1", "fixed": 1.0, "_no": 1}, {"sequence": "b|2", "fixed": None, "_no": 1}],
    "Over 100 % of `all`.",
)


def test_markdown_has_a_line_a_row():
    title, _, head, _, first, second, _, caption = markdown(LISTING).splitlines()
    assert title == "**RTE_1 & more**"
    assert head == "| sequence | fixed |"
    assert first == "| a_1 | 1.000 |"
    assert second == "| b\\|2 | - |"
    assert caption == "Over 100 % of `all`."


def test_tables_are_written_with_words_before_them(tmp_path):
    write_tables(tmp_path, "my study", [LISTING, LISTING], ["First.", "Second."])
    text = (tmp_path / "tables.md").read_text()
    assert text.startswith("# my study\n\n- First.\n- Second.\n\n**RTE_1")
    assert text.count("| a_1 |") == 2
