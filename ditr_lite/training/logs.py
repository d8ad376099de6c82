"""The curve of a training for other programs: CSV for spreadsheets, event files for TensorBoard.

``fit`` returns the curve and writes it as JSON, a row a line; both functions take either.
"""

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..files import written_whole

Curve = Sequence[dict[str, Any]]


def rows_of(curve: Curve | Path | str) -> list[dict[str, Any]]:
    """Return the rows of a curve or of the log that ``fit`` wrote.

    Raises:
        ValueError: for a file that is not such a log.
    """
    if not isinstance(curve, Path | str):
        return list(curve)
    try:
        return [json.loads(line) for line in Path(curve).read_text(encoding="utf-8").splitlines()]
    except (OSError, json.JSONDecodeError) as error:
        raise ValueError(
            f"{curve} is no log of a training ({error}): expected PART.jsonl of its --work folder"
        ) from None


def to_csv(curve: Curve | Path | str, path: Path | str) -> None:
    """Write a curve as CSV, a column for each figure; a figure that a row lacks is left empty."""
    rows = rows_of(curve)
    names = list(dict.fromkeys(name for row in rows for name in row))
    with written_whole(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)


def to_tensorboard(curve: Curve | Path | str, folder: Path | str) -> None:
    """Write a curve as event files, each figure by its step: ``tensorboard --logdir FOLDER`` shows them.

    Raises:
        ImportError: without tensorboard.
    """
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise ImportError("event files need tensorboard: pip install -e '.[logs]'") from None
    with SummaryWriter(str(folder)) as writer:
        for row in rows_of(curve):
            for name, value in row.items():
                if name != "step" and isinstance(value, int | float):
                    writer.add_scalar(name, value, row["step"])
