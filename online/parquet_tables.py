"""The tables of replays as Parquet, with types."""

import csv
from pathlib import Path
from typing import Any

from adaptune.errors import import_extra
from adaptune.files import replacing
from online.record import damaged

_WORDS = ("why_not", "fallen_back")
TABLES = ("selections", "frames")
"""Names of the tables of a replay, without their suffix."""
_TRUTHS = ("lost", "registered", "restarted")
_WEIGHTS = "weights"
_MEASURES = (
    *("predicted_error_percent", "predicted_fixed_percent", "familiarity", "sequences"),
    *("estimated_error_percent", "estimated_low_percent", "estimated_high_percent"),
    *("ms", "prepare_ms", "register_ms", "late_ms"),
)


def write_parquet(path: Path, table: Path) -> None:
    """Write a table of a replay as Parquet, whole or not at all.

    Stamps and trials are integers, measures are floating-point numbers, and what is yes or no is
    Boolean. Weights are a map from the trial to its weight. A parameter is of the first type that
    holds all of its values: integer, floating point, Boolean, text. An empty cell is null.

    Parameters
    ----------
    path
        Of the new file.
    table
        The replay's CSV.

    Raises
    ------
    NotInstalledError
        Without PyArrow.
    StoredReplayError
        If the table is damaged.
    """
    arrow, parquet = import_extra("parquet", "pyarrow", "pyarrow.parquet")
    try:
        with table.open(newline="", encoding="utf-8") as read:
            names, *rows = csv.reader(read)
        columns = zip(*rows, strict=True) if rows else [()] * len(names)
        made = arrow.table(
            {
                name: _column(arrow, name, [text or None for text in texts])
                for name, texts in zip(names, columns, strict=True)
            }
        )
    except (OSError, ValueError) as error:  # Arrow's own derive from ValueError
        raise damaged(table, error) from error
    # PyArrow's own files do not say in which words a disk is full.
    with replacing(path) as temporary, temporary.open("wb") as file:
        parquet.write_table(made, file)


def _column(arrow: Any, name: str, cells: list[str | None]) -> Any:
    texts = arrow.array(cells, arrow.string())
    if name == _WEIGHTS:
        return _weights(arrow, cells)
    if name in _WORDS:
        return texts
    if name in _TRUTHS:
        return texts.cast(arrow.int64()).cast(arrow.bool_())
    if name in _MEASURES:
        return texts.cast(arrow.float64())
    for kind in (arrow.int64(), arrow.float64(), arrow.bool_()):
        try:
            return texts.cast(kind)
        except arrow.ArrowInvalid:
            continue
    return texts


def _weights(arrow: Any, cells: list[str | None]) -> Any:
    pairs = [[pair.split(":") for pair in (text or "").split()] for text in cells]
    rows = [[(int(trial), float(weight)) for trial, weight in row] or None for row in pairs]
    return arrow.array(rows, arrow.map_(arrow.int64(), arrow.float64()))
