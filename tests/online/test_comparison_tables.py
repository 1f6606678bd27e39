from dataclasses import replace

import numpy as np
import pytest
from tables import with_run

from adaptune.metrics import KittiError
from adaptune.reference.judge import StandardErrors
from online.modes import MODES
from online.statistics import ALL, ORACLE, ComparisonRow
from online.tables import modes_in_words, tables

SHORT = KittiError(np.nan, np.nan, ())


def rows_of(sequence, rte, **more):
    return [
        ComparisonRow(
            sequence, mode, factor * rte, factor,
            standard=StandardErrors(factor * 2.0, factor * 0.1, SHORT, 0.3), **more,
        )
        for mode, factor in {"baseline": 2.0, "fixed": 1.0, "adaptive": 0.5}.items()
    ]  # fmt: skip


ROWS = rows_of("a", 1.0) + rows_of("b", 3.0) + rows_of(ALL, 2.0)


def test_one_table_of_the_modes_one_of_the_sequences_one_of_standard_errors():
    modes, sequences, standard = tables(ROWS, 25.0)
    assert modes.title == "RTE over 25 m on 2 sequences"
    assert [row["mode"] for row in modes.rows] == ["baseline", "fixed", "adaptive"]
    assert [row["RTE [%]"] for row in modes.rows] == [4.0, 2.0, 1.0]
    # Nothing was restarted, and nothing estimated.
    assert not {"restarts", "estimated [%]", "reference"} & modes.rows[0].keys()
    assert [row["95 %"] for row in modes.rows] == ["too few", None, "too few"]
    assert [list(row.values()) for row in sequences.rows] == [
        ["a", 2.0, 1.0, 0.5],
        ["b", 6.0, 3.0, 1.5],
        ["average", 4.0, 2.0, 1.0],
    ]
    assert standard.rows[1] == {"mode": "fixed", "APE [m]": 2.0, "RPE [m]": 0.1, "height [%]": 0.3}
    assert "KITTI" not in f"{standard.title} {standard.caption}"


def test_kittis_errors_are_there_where_they_are_known():
    known = StandardErrors(1.0, 0.1, KittiError(0.5, 0.01, (100.0, 200.0)), 0.1)
    standard = tables([*ROWS[:-1], replace(ROWS[-1], standard=known)], 25.0)[-1]
    assert standard.rows[-1]["over [m]"] == "100-200"
    assert standard.rows[-1]["[deg/100 m]"] == pytest.approx(1.0)
    assert "KITTI over the sub-trajectories" in standard.caption


def test_a_single_sequence_has_no_table_of_sequences():
    modes, standard = tables(rows_of("a", 1.0), 5.0)
    assert modes.title == "RTE over 5 m on a"
    assert "Errors as evo" in standard.title
    assert "Means over" not in standard.caption


def test_references_are_told_where_they_differ():
    rows = rows_of("a", 1.0) + rows_of("b", 3.0, reference="estimated", reference_error=0.1)
    rows += [replace(row, reference="estimated and given") for row in rows_of(ALL, 2.0)]
    modes, sequences, _ = tables(rows, 25.0)
    assert [row["reference"] for row in sequences.rows] == ["given", "estimated", ""]
    assert "is wrong itself" in modes.caption


def test_every_mode_that_may_be_shown_is_put_in_words():
    shown = [ComparisonRow("a", mode, 1.0, 1.0) for mode in (*MODES, ORACLE)]
    made = modes_in_words(shown)
    assert [row["mode"] for row in made.rows] == [*MODES, ORACLE]


def test_oracles_are_among_the_modes_only():
    oracle = ComparisonRow(ALL, ORACLE, 0.4, 0.2)
    switching = [with_run(replace(row, switches=3), restarts=1) for row in ROWS]
    modes, sequences, standard = tables([*switching, oracle], 25.0)
    # It was not driven.
    assert (modes.rows[-1]["switches"], modes.rows[-1]["restarts"]) == (None, None)
    assert "The oracle knows the errors" in modes.caption
    assert "Oracles" not in tables(ROWS, 25.0)[0].caption
    assert modes.rows[-1]["mode"] == ORACLE
    assert ORACLE not in sequences.rows[0]
    assert len(standard.rows) == 3
