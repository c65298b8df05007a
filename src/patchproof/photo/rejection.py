"""The error of a photograph that cannot be measured or judged: a code, the deciding figure, its threshold, and advice.

The codes are those of report.json. A `PhotoRejected` never stops a batch: the report lists the photograph with it.
"""

from patchproof.base.errors import PatchproofError
from patchproof.base.text import printable

REJECTION_CODES = (
    *("unreadable", "too_costly", "empty", "too_few_markers", "blurred", "clipped", "too_small", "tilted"),
    *("out_of_range", "scale_off", "wrong_sheet", "several_sheets", "mirrored", "curled", "cropped", "copy"),
    *("other_design", "wrong_ink", "no_corners"),
)


class PhotoRejected(PatchproofError, ValueError):
    """A rejected photograph; `figure` and `threshold` are in the unit of the code's quantity, None if not measured."""

    def __init__(self, code: str, figure: float | None, threshold: float | None, advice: str):
        if code not in REJECTION_CODES:
            raise ValueError(f"expected one of {', '.join(REJECTION_CODES)}, got {code!r}")
        advice = printable(advice)  # it may name a file
        super().__init__(f"{code}: {advice}")
        self.code, self.figure, self.threshold, self.advice = code, figure, threshold, advice

    def __reduce__(self):
        # exceptions are rebuilt from their message when they come back from another process; this one has four parts
        return PhotoRejected, (self.code, self.figure, self.threshold, self.advice)
