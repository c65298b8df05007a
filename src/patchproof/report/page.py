"""Render an HTML page from a template; values are escaped, and a missing one is an error."""

from collections.abc import Iterable
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from patchproof.base.intervals import Estimate
from patchproof.base.text import printable


def render_page(template: str, folder: Path = Path(__file__).parent, **values: object) -> str:
    """Render a template of `folder` (by default this room's) with its values."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    options = {"trim_blocks": True, "lstrip_blocks": True, "undefined": StrictUndefined, "finalize": _printable_lines}
    environment = Environment(autoescape=True, **options)
    environment.loader = FileSystemLoader(folder)
    environment.filters["percent"] = lambda share: "–" if share is None else f"{100 * share:.0f} %"
    environment.filters["figure"] = lambda value, digits=2: "not measured" if value is None else f"{value:.{digits}f}"
    environment.tests["figure"] = lambda value: isinstance(value, (int, float, Estimate)) or value is None
    return environment.get_template(template).render(values)


def _printable_lines(value: object) -> object:
    """Make text `printable`, but for its line ends; what is markup is our own."""
    return "\n".join(map(printable, value.split("\n"))) if type(value) is str else value


def versions_of(libraries: Iterable[str]) -> dict[str, str]:
    """Look up the versions of libraries; those that are not installed are left out."""
    versions = {}
    for name in libraries:
        with suppress(PackageNotFoundError):  # in a checkout, or with another of OpenCV's four wheels
            versions[name] = version(name)
    return versions
