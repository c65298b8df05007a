"""Read a page's QR code, which lies beside the piece, in a photograph or scan.

In: pixels. Out: the code's text, as in `Manifest.code`, or None if no code of a sheet can be read. Marker ids identify
sheets, too, but two designs of one scene and seed share them, and only the code tells which of the two was printed. It
lies outside of the cut line, so a piece on an object has none.
"""

import re

import cv2
import numpy as np

from patchproof.base.resample import downscale
from patchproof.photo.limits import count_finder_lines, find_squares
from patchproof.photo.rectify import rectify
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.manifest import PAGE_CODE_PATTERN

_LARGEST_PX = 2000  # of a whole photograph's longer side: a code that needs more is too far away to be useful
_MAX_SQUARES = 1000  # with 900 finder patterns of three squares one detector takes 10 s; pages have 300 squares
_MAX_LINES = 100_000  # for these the other takes 1.6 s, for twice as many 5.7 s; photographs have some thousands
_PAGE_PX_PER_MM = 8.0  # of the rectified page: 6.6 px for a module of the A4 template


def read_page_code(srgb: np.ndarray) -> str | None:
    """Read the code in a uint8 picture; None without one. A detector that would take too long is skipped."""
    gray = cv2.cvtColor(downscale(srgb, _LARGEST_PX), cv2.COLOR_RGB2GRAY)
    # of 7 oblique pages of A4 they read 6 and 1, of 7 labels 5 and 7: neither detector is enough
    by_squares = cv2.QRCodeDetectorAruco, lambda gray: len(find_squares(gray)), _MAX_SQUARES
    by_lines = cv2.QRCodeDetector, count_finder_lines, _MAX_LINES
    for detector, count, max_count in (by_squares, by_lines):
        if count(gray) > max_count:
            continue
        try:
            code = detector().detectAndDecode(gray)[0]
        except cv2.error:  # some quadrangles that are no code make the decoder fail
            continue
        if re.fullmatch(PAGE_CODE_PATTERN, code):
            return code
    return None


def refuse_other_page(srgb: np.ndarray, px_from_mm: np.ndarray, page_mm: tuple[float, float], code: str) -> None:
    """Raise `PhotoRejected("wrong_sheet")` if the page under this homography has a code other than `code`."""
    scale = min(_PAGE_PX_PER_MM, _LARGEST_PX / max(page_mm))
    found = read_page_code(rectify(srgb, px_from_mm, (0.0, 0.0, *page_mm), scale))
    if found is None or found == code:
        return
    (_, sheet_id, content), (_, own_id, own_content) = found.split(":"), code.split(":")
    advice = f"its code says sheet {sheet_id}, the JSON is of {own_id}: name that sheet's JSON"
    if sheet_id == own_id:
        codes = f"{content}, the JSON {own_content}; name the JSON that was written with this PDF"
        advice = f"it is sheet {sheet_id} with another design: its code says {codes}"
    raise PhotoRejected("wrong_sheet", None, None, advice)
