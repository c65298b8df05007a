"""One HTML page from a template; values in it are escaped, an unknown one is an error."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from patchproof.base.intervals import Estimate


def page(template: str, folder: Path = Path(__file__).parent, **values: object) -> str:
    """The template of that folder, of this one if none is given, with its values."""
    import jinja2

    loader, strict = jinja2.FileSystemLoader(folder), jinja2.StrictUndefined
    environment = jinja2.Environment(
        loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=strict
    )
    environment.filters |= {"percent": _percent, "figure": _figure}
    environment.tests["figure"] = lambda value: isinstance(value, (int, float, Estimate)) or value is None
    return environment.get_template(template).render(values)


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.0f} %"


def _figure(value: float | None, digits: int = 2) -> str:
    return "not measured" if value is None else f"{value:.{digits}f}"


def versions_of(libraries: Iterable[str]) -> dict[str, str]:
    """The versions of those that are installed."""
    versions = {}
    for name in libraries:
        with suppress(PackageNotFoundError):  # run from a checkout, or another of OpenCV's four wheels
            versions[name] = version(name)
    return versions
