"""One HTML page of a study: what was asked, tables, figures, what failed, and the settings to repeat it.

In: the study's name and tables, figures as PNG bytes, failures as sentences. Out: HTML that needs nothing from outside
of itself. The same input gives the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from patchproof.report.images import data_uri
from patchproof.report.tables import Drawing, Estimate, Table, shown


def study_page(
    name: str,
    about: str,
    tables: Sequence[Table],
    figures: Sequence[tuple[Drawing, bytes]],
    failed: Mapping[str, str],
    cells: int,
    settings: Mapping[str, Any],
    versions: Mapping[str, str],
) -> str:
    """The page's HTML; `failed` are sentences by cell, `cells` how many there are in all."""
    import jinja2

    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(
        loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.filters["shown"] = shown
    environment.tests["figure"] = lambda value: isinstance(value, (int, float, Estimate)) or value is None
    return environment.get_template("study.html.j2").render(
        name=name,
        about=about,
        tables=tables,
        figures=[(drawing, data_uri(content)) for drawing, content in figures],
        failed=failed,
        cells=cells,
        settings=json.dumps(settings, indent=1, ensure_ascii=False),
        versions=versions,
    )
