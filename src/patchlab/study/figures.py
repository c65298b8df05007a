"""Pictures that a study's cells store, and figures that several studies draw.

In: a problem and an appearance, or pixels; files of pictures; arrays of numbers. Out: tensors N×3×S×S in [0, 1] and PNG
bytes; `Drawing`s for a study's page, or images on axes.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from patchproof.optimizer.problem import Problem
from patchproof.optimizer.subject import as_pixels, from_pixels
from patchproof.render.photograph import Appearance, expose
from patchproof.report.page import png
from patchproof.report.tables import Drawing
from patchproof.scene.conditions import Conditions

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage


EMPTY_COLOR = "#dddddd"  # of cells without an effect


def picture_sheet(
    name: str,
    title: str,
    files: Sequence[tuple[str, Path]],
    size_in: tuple[float, float],
    about: str = "",
    rows: Sequence[str] = (),
    columns: Sequence[str] = (),
) -> Drawing:
    """Draw PNGs one below the other with titles; `rows` and `columns` label equal parts of each picture."""

    def draw(figure: "Figure") -> None:
        from matplotlib.image import imread

        for axes, (caption, path) in zip(figure.subplots(len(files), 1, squeeze=False)[:, 0], files, strict=True):
            picture = imread(path)
            axes.imshow(picture)
            axes.set_title(caption, fontsize=8, loc="left", pad=2)
            axes.spines[:].set_visible(False)
            axes.tick_params(length=0, bottom=False, top=False, labelbottom=False, labeltop=True)
            axes.set_yticks(_middles(picture.shape[0], len(rows)), rows)
            axes.set_xticks(_middles(picture.shape[1], len(columns)), columns)

    return Drawing(name, title, draw, size_in, about)


def number_grid(
    axes: "Axes",
    values: np.ndarray,
    texts: Sequence[Sequence[str]],
    framed: Sequence[tuple[int, int]] = (),
    fontsize: float = 7,
    empty: Sequence[tuple[int, int]] = (),
) -> "AxesImage":
    """Draw R×C colored cells with a text in each; `framed` cells and gray `empty` ones are (row, column)."""
    from matplotlib.patches import Rectangle

    image = axes.imshow(values, cmap="viridis", vmin=0, vmax=1, aspect="auto")
    for row, column in empty:
        axes.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, facecolor=EMPTY_COLOR))
    for (row, column), value in np.ndenumerate(values):
        red, green, blue, _ = image.cmap(image.norm(value))
        ink = "black" if (row, column) in empty or 0.3 * red + 0.6 * green + 0.1 * blue > 0.45 else "white"
        axes.text(column, row, str(texts[row][column]), ha="center", va="center", color=ink, fontsize=fontsize)
    for row, column in framed:
        axes.add_patch(Rectangle((column - 0.46, row - 0.46), 0.92, 0.92, fill=False, edgecolor="red", linewidth=2))
    return image


def _middles(length: int, parts: int) -> list[float]:
    return [length * (i + 0.5) / parts for i in range(parts)]


def photographs(problem: Problem, shown: Appearance, conditions: Conditions, side_px: int) -> Tensor:
    """N×3×S×S square photographs of one appearance; None is the bare object."""
    with torch.no_grad():
        return expose(problem.see(shown, conditions, side_px), shown)


def contact_sheet(rows: Sequence[Sequence[Tensor] | Tensor]) -> bytes:
    """One PNG of rows of pictures 3×S×S."""
    return png(as_pixels(torch.cat([torch.cat(list(row), 2) for row in rows], 1)))


def enlarge_design(pixels: np.ndarray, side_px: int) -> Tensor:
    """A design H×W×3 enlarged, without smoothing, in the middle of a white square 3×S×S."""
    height, width = pixels.shape[:2]
    scale = side_px / max(height, width)
    size = (round(width * scale), round(height * scale))
    tile = Image.new("RGB", (side_px, side_px), "white")
    large = Image.fromarray(pixels).resize(size, Image.Resampling.NEAREST)
    tile.paste(large, ((side_px - size[0]) // 2, (side_px - size[1]) // 2))
    return from_pixels(np.asarray(tile))
