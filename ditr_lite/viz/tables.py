"""Tables that notebooks print: columns with a heading each, aligned, so that no cell formats numbers by hand."""

from collections.abc import Mapping, Sequence
from typing import Any

# Characters that JupyterLab shows beside its file browser on a screen of 1366 pixels. It breaks a longer line anywhere.
WIDTH = 116


def table(columns: Mapping[str, Sequence[Any]], decimals: int | Mapping[str, int] = 1) -> str:
    """Return a table as text, a line for the headings and one for each row, to be printed.

    Args:
        columns: heading -> values, the same number in every column. Numbers are aligned at the right, text at the left.
        decimals: digits behind the point of values that are not whole numbers, for all columns or by heading (1 where
            it is not named).

    Raises:
        ValueError: for no column, or columns of different lengths.
    """
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) != 1:
        raise ValueError(f"expected at least one column, all of the same length, got {lengths}")
    written = []
    for name, values in columns.items():
        digits = decimals if isinstance(decimals, int) else decimals.get(name, 1)
        cells = [_write(value, digits) for value in values]
        width = max(map(len, [name, *cells]))
        text = any(isinstance(value, str) for value in values)
        written.append([cell.ljust(width) if text else cell.rjust(width) for cell in (name, *cells)])
    return "\n".join("  ".join(line).rstrip() for line in zip(*written, strict=True))


def _write(value: Any, digits: int) -> str:
    if value is None:
        return "-"
    if isinstance(value, str | bool):
        return str(value)
    if float(value).is_integer() and not isinstance(value, float):
        return f"{int(value):,}"
    return f"{float(value):,.{digits}f}"
