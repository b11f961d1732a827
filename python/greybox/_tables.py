"""Tables of recordings from what Python has."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Union

from . import _native
from ._errors import InputError

if TYPE_CHECKING:
    import pandas

#: A table of recordings: a CSV file, a dict of columns, or a frame.
RunsLike = Union[str, "os.PathLike[str]", Mapping[str, Sequence[Any]], "pandas.DataFrame"]


def table(runs: RunsLike | None) -> tuple[str, str] | None:
    """The table as CSV, and what errors call it."""
    if runs is None:
        return None
    if isinstance(runs, (str, os.PathLike)):
        place = os.fspath(runs)
        try:
            return _native.content(place).decode("utf-8-sig"), place
        except UnicodeDecodeError as error:
            raise InputError(f"{place}: the table is not UTF-8 text: {error}") from None
    frame: Any = runs
    columns = {str(name): list(frame[name]) for name in frame}
    lengths = {len(values) for values in columns.values()}
    if len(lengths) > 1:
        raise InputError(f"runs: its columns have {' and '.join(map(str, sorted(lengths)))} rows; give one row a recording")
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([_cell(value) for value in row] for row in zip(*columns.values()))
    return text.getvalue(), "runs"


def _cell(value: Any) -> str:
    """A value as the table has it; what is missing is empty."""
    missing = value is None or value != value
    return "" if missing else value.isoformat() if hasattr(value, "isoformat") else str(value)
