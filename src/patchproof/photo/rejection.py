"""Why a photograph cannot be judged or measured: a code, the figure that decided it, its threshold, and what to do.

The codes are those of report.json. A `PhotoRejected` never stops a batch: the photograph is listed with it.
"""

from __future__ import annotations

from patchproof.base.errors import PatchproofError

CODES = (
    "unreadable",
    "too_costly",
    "empty",
    "too_few_markers",
    "blurred",
    "clipped",
    "too_small",
    "tilted",
    "out_of_range",
    "scale_off",
    "wrong_sheet",
    "several_sheets",
    "mirrored",
    "curled",
    "cropped",
    "copy",
)


class PhotoRejected(PatchproofError, ValueError):
    """Evidence too weak; `figure` and `threshold` are in the unit of what the code names, None if not measured."""

    def __init__(self, code: str, figure: float | None, threshold: float | None, advice: str):
        if code not in CODES:
            raise ValueError(f"expected one of {', '.join(CODES)}, got {code!r}")
        super().__init__(f"{code}: {advice}")
        self.code, self.figure, self.threshold, self.advice = code, figure, threshold, advice

    def __reduce__(self):
        # exceptions are rebuilt from their message when they come back from another process; this one has four parts
        return PhotoRejected, (self.code, self.figure, self.threshold, self.advice)
