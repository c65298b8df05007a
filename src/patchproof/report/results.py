"""What a study or a benchmark leaves behind: NAME.json, a CSV per table, a PNG per figure, and one HTML page.

In: tables, drawings, what failed, and the settings to repeat it. Out: files, each written whole; the page needs nothing
from outside of itself. The same input gives the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from patchproof.claims import Estimate
from patchproof.output import write_whole
from patchproof.report.images import data_uri
from patchproof.report.tables import Drawing, Table, csv_text, png, shown

_LIBRARIES = ("patchproof", "torch", "numpy")


@dataclass(frozen=True)
class Results:
    """A page's content. `kind` ("study", "bench") heads it, `extent` says how much was done, `failed` are sentences by
    what they are about; `more` stands in the JSON alone.
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


def write_results(folder: Path, results: Results) -> None:
    """Write all of it into the folder."""
    versions = versions_of(_LIBRARIES)
    pictures = [(drawing, png(drawing)) for drawing in results.figures]
    for table in results.tables:
        _write(folder / f"{results.name}_{table.name}.csv", csv_text(table).encode())
    for drawing, content in pictures:
        _write(folder / f"{results.name}_{drawing.name}.png", content)
    _write(folder / f"{results.name}.html", _page(results, pictures, versions).encode())
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
    _write(path, (json.dumps(data, indent=1, allow_nan=False) + "\n").encode())


def _write(path: Path, content: bytes) -> None:
    write_whole(path, lambda part: part.write_bytes(content))


def _page(results: Results, pictures: Sequence[tuple[Drawing, bytes]], versions: Mapping[str, str]) -> str:
    import jinja2

    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(
        loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.filters["shown"] = shown
    environment.tests["figure"] = lambda value: isinstance(value, (int, float, Estimate)) or value is None
    return environment.get_template("results.html.j2").render(
        results=results,
        pictures=[(drawing, data_uri(content)) for drawing, content in pictures],
        settings=json.dumps(results.settings, indent=1, ensure_ascii=False),
        versions=versions,
    )


def versions_of(libraries: Iterable[str]) -> dict[str, str]:
    """The versions of those that are installed."""
    versions = {}
    for name in libraries:
        with suppress(PackageNotFoundError):  # run from a checkout, or another of OpenCV's four wheels
            versions[name] = version(name)
    return versions
