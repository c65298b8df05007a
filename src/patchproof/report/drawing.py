"""A figure by matplotlib as bytes, the same for the same input."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def drawn(draw: Callable[[Figure], None], size_in: tuple[float, float], kind: str, **options: Any) -> bytes:
    """A figure as the bytes of a "png" or "svg"; `options` are those of matplotlib's `savefig`."""
    import matplotlib
    from matplotlib.figure import Figure

    # text stays text in the page's own font; ids follow from a fixed salt, so that reports have the same bytes
    with matplotlib.rc_context({"font.size": 9, "svg.fonttype": "none", "svg.hashsalt": "patchproof"}):
        figure, buffer = Figure(figsize=size_in, layout="constrained"), io.BytesIO()
        draw(figure)
        figure.savefig(buffer, format=kind, **options)
    return buffer.getvalue()
