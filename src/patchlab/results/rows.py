"""Tables that the scripts of this folder store beside themselves."""

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any


def write_rows(path: str | Path, rows: Iterable[Mapping[str, Any]], append: bool = False) -> None:
    """Write rows with the same keys as a CSV file under their keys, each as soon as it comes; `append` keeps those that
    an existing file has.
    """
    path = Path(path)
    headed = append and path.exists()
    with path.open("a" if append else "w", newline="", encoding="utf-8") as file:
        for row in rows:
            writer = csv.DictWriter(file, row)
            if not headed:
                writer.writeheader()
            headed = True
            writer.writerow(row)
            file.flush()
