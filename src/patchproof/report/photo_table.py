"""report.csv: one row per photograph with every figure that report.json has of it, for spreadsheets and statistics.

In: entries of a report as plain data. Out: CSV text. The nine entries of a homography and the predictions of every
network get columns of their own; what was not measured is an empty cell.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

_FIRST = ("file", "status", "code", "figure", "threshold", "advice")


def photos_csv(photos: Sequence[Mapping[str, Any]]) -> str:
    """The rows with a head; only the head's first columns where there are no photographs."""
    rows = [_flat(photo) for photo in photos]
    head = list(dict.fromkeys((*_FIRST, *(name for row in rows for name in row))))
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, head, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return buffer.getvalue()


def _flat(photo: Mapping[str, Any]) -> dict[str, Any]:
    row = {}
    for name, value in photo.items():
        if name == "homography_px_from_mm":
            numbers = [None] * 9 if value is None else [number for line in value for number in line]
            row |= {f"{name}_{i // 3}{i % 3}": number for i, number in enumerate(numbers)}
        elif name == "predictions":
            row |= {f"{model} {key}": _plain(v) for model, prediction in value.items() for key, v in prediction.items()}
        else:
            row[name] = _plain(value)
    return row


def _plain(value: Any) -> Any:
    """The value; text that a spreadsheet would take for a formula gets an apostrophe."""
    return f"'{value}" if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r")) else value
