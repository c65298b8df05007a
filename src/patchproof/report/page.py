"""Render a page that needs no other file: HTML from a template, and pictures, difference maps and figures as bytes.

In: a template and values, which are escaped; uint8 sRGB H×W×3, float cells, or functions that draw with matplotlib.
Out: HTML, for which a missing value is an error; the bytes of files. All reports share the map's scale.
"""

import hashlib
import io
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from patchproof.base.color import codes_from_srgb
from patchproof.base.input import is_file, read_file
from patchproof.base.intervals import Estimate
from patchproof.base.output import image_bytes, make_folder, write_atomically
from patchproof.base.text import drawable, printable

if TYPE_CHECKING:
    from jinja2 import Environment
    from matplotlib.figure import Figure

DELTA_TOP = 20.0  # ΔE00 at the map's dark end; 2 is just visible side by side, 20 another color
PICTURE_KINDS = ("photo", "promised", "seen", "fitted", "delta_e00")
_JPEG_QUALITY = 82
_LONGEST_STEM = 220  # bytes; systems take 255, and kind and suffix come after it


def render_page(template: str, folder: Path = Path(__file__).parent, **values: object) -> str:
    """Render a template of `folder` (by default this room's) with its values."""
    return _environment(folder).get_template(template).render(values)


@cache
def _environment(folder: Path) -> "Environment":
    """The templates of a folder, each compiled once."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    lines = lambda value: "\n".join(map(printable, value.split("\n"))) if type(value) is str else value  # noqa: E731  # markup is ours
    options = {"trim_blocks": True, "lstrip_blocks": True, "undefined": StrictUndefined, "finalize": lines}
    environment = Environment(autoescape=True, loader=FileSystemLoader(folder), **options)
    environment.filters["percent"] = lambda share: "–" if share is None else f"{100 * share:.0f} %"
    environment.filters["figure"] = lambda value, digits=2: "not measured" if value is None else f"{value:.{digits}f}"
    environment.tests["figure"] = lambda value: isinstance(value, (int, float, Estimate)) or value is None
    return environment


def versions_of(libraries: Iterable[str]) -> dict[str, str]:
    """Look up the versions of libraries; those that are not installed are left out."""
    versions = {}
    for name in libraries:
        with suppress(PackageNotFoundError):  # in a checkout, or with another of OpenCV's four wheels
            versions[name] = version(name)
    return versions


def jpeg(pixels: np.ndarray) -> bytes:
    """Encode uint8 sRGB as JPEG, for photographs."""
    return image_bytes(pixels, "JPEG", {"quality": _JPEG_QUALITY, "optimize": True})


def png(pixels: np.ndarray) -> bytes:
    """Encode uint8 sRGB, with or without alpha, as PNG, for flat colors."""
    return image_bytes(pixels, "PNG")  # optimized it takes 12 times as long, and is 2 % smaller


def save_pictures(folder: Path, file: str, kinds: Mapping[str, np.ndarray]) -> None:
    """Replace a photograph's pictures FILE.KIND.jpg in `folder`; `delta_e00` cells (NaN: not measured) become a PNG."""
    make_folder(folder)
    for kind in PICTURE_KINDS:
        _path(folder, file, kind).unlink(missing_ok=True)
    for kind, pixels in kinds.items():
        write_atomically(_path(folder, file, kind), png(delta_map(pixels)) if kind == "delta_e00" else jpeg(pixels))


def saved_pictures(folder: Path, file: str) -> dict[str, bytes]:
    """Read the files of a photograph's pictures in `folder`, by kind; missing ones are left out."""
    paths = {kind: path for kind in PICTURE_KINDS if is_file(path := _path(folder, file, kind))}
    return {kind: read_file(path, "a picture of a report") for kind, path in paths.items()}


def stem_of(file: str) -> str:
    """The stem of a photograph's picture files: its encoded name with folder; a long one is cut and gets a hash."""
    stem = file.replace("/", "%2F")
    is_long = len(stem.encode()) > _LONGEST_STEM
    return f"{stem[:40]}-{hashlib.sha256(stem.encode()).hexdigest()[:16]}" if is_long else stem


def _path(folder: Path, file: str, kind: str) -> Path:
    return folder / f"{stem_of(file)}.{kind}.{'png' if kind == 'delta_e00' else 'jpg'}"


def delta_map(delta_e00: np.ndarray, longer_px: int = 192) -> np.ndarray:
    """Draw ΔE00 cells as uint8 RGBA squares: pale is 0, dark is `DELTA_TOP` or more, transparent is not measured."""
    light = 255 - codes_from_srgb(np.nan_to_num(delta_e00) / DELTA_TOP)
    colors = cv2.cvtColor(cv2.applyColorMap(light, cv2.COLORMAP_MAGMA), cv2.COLOR_BGR2RGBA)
    colors[np.isnan(delta_e00), 3] = 0
    zoom = max(1, longer_px // max(delta_e00.shape))
    return np.repeat(np.repeat(colors, zoom, axis=0), zoom, axis=1)


def _escape_undrawable(figure: "Figure") -> None:
    """Escape the characters that the figures' font lacks."""
    from matplotlib import font_manager
    from matplotlib.text import Text

    font = font_manager.get_font(font_manager.findfont("DejaVu Sans"))

    def shown(text: str) -> str:
        return "\n".join(drawable(line, lambda c: bool(font.get_char_index(ord(c)))) for line in text.split("\n"))

    for axis in (axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)):
        labels = [label.get_text() for label in axis.get_ticklabels()]
        if labels != list(map(shown, labels)):
            axis.set_ticklabels(map(shown, labels))
    for text in figure.findobj(Text):
        text.set(text=shown(text.get_text()))


def draw_figure(draw: "Callable[[Figure], None]", size_in: tuple[float, float], kind: str, **options: Any) -> bytes:
    """Draw a figure and encode it as "png" or "svg"; `options` are those of matplotlib's `savefig`."""
    import matplotlib
    from matplotlib.figure import Figure

    # text stays text in the page's own font; ids follow from a fixed salt, so that reports have the same bytes
    settings: Any = {"font.size": 9, "text.parse_math": False, "svg.fonttype": "none", "svg.hashsalt": "patchproof"}
    with matplotlib.rc_context(settings):
        figure, buffer = Figure(figsize=size_in, layout="constrained"), io.BytesIO()
        draw(figure)
        _escape_undrawable(figure)
        figure.savefig(buffer, format=kind, **options)
    return buffer.getvalue()
