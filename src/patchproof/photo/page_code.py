"""What a page says of itself: the QR code beside the piece, read in a photograph or scan.

In: pixels. Out: a `PageCode` (sheet id, and the design's SHA-256 in short, or the kind of a sheet without a design), or
None where no code of ours can be read. Marker ids tell sheets apart, too, but two designs of one scene and seed share
them, and only the code says which of the two was printed. It lies outside of the cut: a piece on an object has none.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import cv2
import numpy as np

from patchproof.base.resample import downscale
from patchproof.photo.limits import finder_lines_in, squares_in
from patchproof.photo.rectify import rectify
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.manifest import PAGE_CODE, Manifest

_LARGEST_PX = 2000  # of a whole photograph's longer side: a code that needs more is too far away to be of use
_MOST_SQUARES = 1000  # of 900 finder patterns, three squares each, one detector makes codes for 10 s; pages have 300
_MOST_LINES = 100_000  # the other takes 1.6 s for so many, and 5.7 s for twice as many; photographs have some thousands
_PAGE_PX_PER_MM = 8.0  # of the page seen from above: 6.6 px for a module of the A4 template


@dataclass(frozen=True)
class PageCode:
    """`printed` is 16 digits of the design's SHA-256, or the kind of a sheet without one; a page of several designs has
    an id of its own and digits of all their hashes.
    """

    sheet_id: str
    printed: str


def manifest_page_code(manifest: Manifest) -> PageCode:
    """What the code on this manifest's page says."""
    if manifest.page_code is not None:
        return PageCode(*manifest.page_code.split(":")[1:])
    return PageCode(manifest.sheet_id, manifest.design.sha256[:16] if manifest.design else manifest.kind)


def parse_page_code(text: str) -> PageCode | None:
    """The label in a code's text; None where the code is not ours."""
    match = re.match(PAGE_CODE, text)
    return PageCode(match[1], match[2]) if match else None


def read_page_code(srgb: np.ndarray) -> PageCode | None:
    """The code that a picture shows; a detector that it would keep busy for long is not asked."""
    gray = cv2.cvtColor(downscale(srgb, _LARGEST_PX), cv2.COLOR_RGB2GRAY)
    # of 7 oblique pages of either size they read 6 and 1 (A4), 5 and 7 (labels): neither is enough
    for detector, count, most in (
        (cv2.QRCodeDetectorAruco, squares_in, _MOST_SQUARES),
        (cv2.QRCodeDetector, finder_lines_in, _MOST_LINES),
    ):
        if count(gray) > most:
            continue
        try:
            label = parse_page_code(detector().detectAndDecode(gray)[0])
        except cv2.error:  # some quadrangles that are no code make its decoder stumble
            continue
        if label is not None:
            return label
    return None


def refuse_other_page(srgb: np.ndarray, px_from_mm: np.ndarray, page_mm: tuple[float, float], label: PageCode) -> None:
    """`PhotoRejected("wrong_sheet")` where the page under this homography carries another code than `label`."""
    scale = min(_PAGE_PX_PER_MM, _LARGEST_PX / max(page_mm))
    read = read_page_code(rectify(srgb, px_from_mm, (0.0, 0.0, *page_mm), scale))
    if read is None or read == label:
        return
    advice = f"its code says sheet {read.sheet_id}, the JSON is of {label.sheet_id}: name that sheet's JSON"
    if read.sheet_id == label.sheet_id:
        advice = (
            f"it is sheet {read.sheet_id} with another design: its code says {read.printed}, the JSON {label.printed}; "
            "name the JSON that was written with this PDF"
        )
    raise PhotoRejected("wrong_sheet", None, None, advice)
