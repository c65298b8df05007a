"""What a study or a benchmark leaves behind: NAME.json, a CSV per table, a PNG per figure, and one HTML page.

In: tables, drawings, what failed, and the settings to repeat it. Out: files, each written whole; the page needs nothing
from outside of itself. The same input gives the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from patchproof.base.output import write_whole
from patchproof.report.images import data_uri
from patchproof.report.page import page, versions_of
from patchproof.report.tables import Drawing, Table, csv_text, png, shown

_LIBRARIES = ("patchproof", "torch", "numpy")


@dataclass(frozen=True)
class Results:
    """A page's content. `program` and `kind` ("patchlab", "study") head it, `extent` says how much was done,
    `failed` are sentences by what they are about; `more` stands in the JSON alone.
    """

    kind: str
    name: str
    about: str
    extent: str
    settings: Mapping[str, Any]
    tables: Sequence[Table]
    figures: Sequence[Drawing]
    failed: Mapping[str, str]
    more: Mapping[str, Any]
    program: str = "patchproof"


def write_results(folder: Path, results: Results) -> None:
    """Write all of it into the folder."""
    versions = versions_of(_LIBRARIES)
    pictures = [(drawing, png(drawing)) for drawing in results.figures]
    for table in results.tables:
        write_whole(folder / f"{results.name}_{table.name}.csv", csv_text(table))
    for drawing, content in pictures:
        write_whole(folder / f"{results.name}_{drawing.name}.png", content)
    text = page(
        "results.html.j2",
        results=results,
        pictures=[(drawing, data_uri(content)) for drawing, content in pictures],
        settings=json.dumps(results.settings, indent=1, ensure_ascii=False),
        versions=versions,
        shown=shown,
    )
    write_whole(folder / f"{results.name}.html", text)
    data = {
        results.kind: results.name,
        "settings": results.settings,
        "versions": versions,
        "tables": {table.name: asdict(table) for table in results.tables},
        **results.more,
        "failed": results.failed,
    }
    write_json(folder / f"{results.name}.json", data)


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """The data as a JSON file, written whole."""
    write_whole(path, json.dumps(data, indent=1, allow_nan=False) + "\n")
