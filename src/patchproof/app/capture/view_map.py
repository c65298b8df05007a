"""Map the promise's views, and the photographs that show them, by azimuth and size of the piece in the picture.

In: the promise's conditions and the photographs' entries. Out: a `ViewMap` of counts. Cells are equal steps of azimuth
and of distance (1 over pixels per millimeter); a cell needs photographs in proportion to its share of the conditions.
Distance itself is not on the map: only cameras of known focal length measure it, and a network does not see it.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from patchproof.evidence.ranges import figures_of
from patchproof.evidence.results import PhotoEntry
from patchproof.sheets.manifest import ConditionClaim

_ROWS, _MOST_COLUMNS = 3, 5
_LEAST_COLUMN_DEG = 12.0  # about the error of a person who aims a phone by hand


@dataclass(frozen=True)
class ViewMap:
    """Edges of columns (degrees, from left to right) and rows (pixels per millimeter, from near to far), and by row the
    photographs that there are and that are wanted; `elsewhere` counts those whose view is unknown.
    """

    azimuth_deg: tuple[float, ...]
    px_per_mm: tuple[float, ...]
    photos: tuple[tuple[int, ...], ...]
    wanted: tuple[tuple[int, ...], ...]
    elsewhere: int

    @property
    def most_missing(self) -> tuple[int, int] | None:
        """(row, column) of the cell that lacks the most photographs; None where none does."""
        lack = np.subtract(self.wanted, self.photos)
        row, column = np.unravel_index(int(lack.argmax()), lack.shape)
        return (int(row), int(column)) if lack.max() > 0 else None


def map_views(
    conditions: Sequence[ConditionClaim], entries: Iterable[PhotoEntry], wanted: int, side_px: float | None
) -> ViewMap | None:
    """Map counted photographs, of which `wanted` are needed in total; None if the conditions have no views.
    Photographs beyond the edges, which the promise's margin allows, count in the outermost cells.
    """
    views = np.array([(c.azimuth_deg, c.px_per_mm) for c in conditions if c.azimuth_deg is not None and c.px_per_mm])
    if not len(views):
        return None
    (left, smallest), (right, largest) = views.min(0), views.max(0)
    columns = int(np.clip((right - left) // _LEAST_COLUMN_DEG, 1, _MOST_COLUMNS))
    azimuth_deg, distance = np.linspace(left, right, columns + 1), np.linspace(1 / largest, 1 / smallest, _ROWS + 1)

    def counts(points: np.ndarray) -> np.ndarray:
        row, column = 1 / points[:, 1], points[:, 0]
        inside = np.clip(row, distance[0], distance[-1]), np.clip(column, left, right)
        return np.histogram2d(*inside, (distance, azimuth_deg))[0]

    def rows(table: np.ndarray) -> tuple[tuple[int, ...], ...]:
        return tuple(map(tuple, table.astype(int).tolist()))

    figures = [figures_of(entry, side_px) for entry in entries]
    photo_views = [(each.get("azimuth_deg"), each.get("px_per_mm")) for each in figures]
    known_views = np.array([view for view in photo_views if None not in view]).reshape(-1, 2)
    return ViewMap(
        azimuth_deg=tuple(map(float, azimuth_deg)),
        px_per_mm=tuple(float(1 / d) for d in distance),
        photos=rows(counts(known_views)),
        wanted=rows(np.rint(wanted * counts(views) / len(views))),
        elsewhere=len(photo_views) - len(known_views),
    )
