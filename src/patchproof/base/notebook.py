"""Results as HTML for notebooks: a heading, rows of figures, a picture.

In: plain text and uint8 pixels. Out: a fragment for `_repr_html_`, all text escaped. Left out on purpose: styles, which
are the notebook's; whole pages, which `report` writes.
"""

import html
from collections.abc import Mapping

import numpy as np

from patchproof.base.output import base64_uri, image_bytes
from patchproof.base.text import printable

_PICTURE_PX = 160  # side at which a design is shown; its own pixels are larger blocks


def notebook_html(heading: str, rows: Mapping[str, str], picture: np.ndarray | None = None) -> str:
    """Return a heading and a table of `rows`, with `picture` (uint8 H×W×3 sRGB) beside it."""
    escaped = ((html.escape(printable(key)), html.escape(printable(value))) for key, value in rows.items())
    cells = "".join(f"<tr><th>{key}</th><td>{value}</td></tr>" for key, value in escaped)
    image = ""
    if picture is not None:
        uri = base64_uri(image_bytes(picture, "PNG"), "image/png")
        style = f"height:{_PICTURE_PX}px;image-rendering:pixelated"
        image = f'<img alt="design" src="{uri}" style="{style}">'
    return f"<div><b>{html.escape(printable(heading))}</b><table>{cells}</table>{image}</div>"


def rate_text(rate: float, interval: tuple[float, float]) -> str:
    """Return "86.0% [80.1%, 90.4%]"."""
    return f"{rate:.1%} [{interval[0]:.1%}, {interval[1]:.1%}]"
