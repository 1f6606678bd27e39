import pytest
from rich.console import Console

from adaptune.report.tables import Listing, latex, markdown, table, tables_within, write_tables


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
    [
        {"sequence": "a_1", "gicp: fixed": 1.0, "gicp: adaptive": 0.5, "ndt: fixed": 2.0, "_no": 1},
        {
            "sequence": "b|2",
            "gicp: fixed": 1.0,
            "gicp: adaptive": None,
            "ndt: fixed": 0.25,
            "_no": 1,
        },
    ],
    "Over 100 % of `all`.",
    "row",
)


def test_markdown_has_a_line_a_row_and_the_least_in_bold():
    title, _, head, _, first, second, _, caption = markdown(LISTING).splitlines()
    assert title == "**RTE_1 & more**"
    assert head == "| sequence | gicp: fixed | gicp: adaptive | ndt: fixed |"
    # In each group; of a single number nothing is said.
    assert first == "| a_1 | 1.000 | **0.500** | 2.000 |"
    assert second == "| b\\|2 | 1.000 | - | 0.250 |"
    assert caption == "Over 100 % of `all`."


def test_latex_has_rules_groups_and_escaped_texts():
    lines = latex(LISTING, "toy-1").splitlines()
    assert r"\caption{RTE\_1 \& more. Over 100 \% of all.}" in lines
    assert r"\label{tab:toy-1}" in lines
    assert r"\begin{tabular}{lrrr}" in lines
    at = lines.index(r"\toprule")
    assert lines[at + 1 : at + 8] == [
        r"\multicolumn{1}{c}{} & \multicolumn{2}{c}{gicp} & \multicolumn{1}{c}{ndt} \\",
        r"\cmidrule(lr){2-3} \cmidrule(lr){4-4}",
        r"sequence & fixed & adaptive & fixed \\",
        r"\midrule",
        r"a\_1 & 1.000 & \textbf{0.500} & 2.000 \\",
        r"b|2 & 1.000 & - & 0.250 \\",
        r"\bottomrule",
    ]
    plain = latex(Listing("t", [{"mode": "a", "RTE [%]": 1.0}]), "x")
    assert "multicolumn" not in plain
    assert r"\caption{t}" in plain


def test_the_least_of_a_column_is_bold_where_there_is_a_choice():
    rows = [
        {"mode": "a", "x": 2.0, "y": None, "ms": 1.0, "_in_hindsight": False},
        {"mode": "b", "x": 1.0, "y": 3.0, "ms": 2.0, "_in_hindsight": False},
        {"mode": "c", "x": 0.5, "y": None, "ms": 2.0, "_in_hindsight": True},
    ]
    text = markdown(Listing("t", rows, "", ("x", "y")))
    assert "| a | 2.000 | - | 1.000 |" in text
    assert "| b | **1.000** | 3.000 | 2.000 |" in text
    assert "| c | 0.500 | - | 2.000 |" in text


def test_tables_are_written_with_words_before_them(tmp_path):
    write_tables(tmp_path, "my study", [LISTING, LISTING], ["First.", "Second."])
    text = (tmp_path / "tables.md").read_text()
    assert text.startswith("# my study\n\n- First.\n- Second.\n\n**RTE_1")
    tex = (tmp_path / "tables.tex").read_text()
    assert r"\label{tab:my-study-2}" in tex
    assert tex.count(r"\begin{table}") == tex.count(r"\end{table}") == 2
