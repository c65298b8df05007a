"""The error of a photograph that cannot be measured or judged: a code, the deciding figure, its threshold, and advice.

The codes are those of report.json. A `PhotoRejected` never stops a batch: the report lists the photograph with it.
"""

from patchproof.base.errors import PatchproofError
from patchproof.base.text import printable

# what each code says of a photograph, and what helps; printed for users by `patchproof keys --codes`
REJECTION_CODES = {
    "unreadable": ("no picture, damaged, or of a color space that is not read", "save it as JPEG or PNG"),
    "too_costly": ("the picture is larger than limits of size and time allow", "save it smaller"),
    "empty": ("the picture holds no pixels, or one color", "take it again"),
    "too_few_markers": ("too little of the piece is in view, uncovered and readable", "show all of it, sharp and lit"),
    "blurred": ("motion or focus merges neighboring cells of markers", "hold still, focus on it, use more light"),
    "clipped": ("highlights are cut off, so colors cannot be compared", "expose one or two stops less"),
    "noisy": ("noise or darkness alone would change colors too much", "use more light, come closer"),
    "too_small": ("the piece has too few pixels for its corners or its cells", "come closer, use the full resolution"),
    "tilted": ("the piece is foreshortened to less than a fifth", "look at it less from the side"),
    "out_of_range": ("the view lies outside of what the promise covers", "stay within the ranges of the scene"),
    "scale_off": ("a scan shows another size than the page's", 'print again at 100 %, not "fit to page"'),
    "wrong_sheet": ("markers or QR code are those of another sheet", "name that sheet's JSON"),
    "several_sheets": ("more than one print is in view", "photograph one at a time"),
    "mirrored": ("the picture is mirrored", "switch the camera's mirror setting off"),
    "curled": ("paper or design lie neither in a plane nor on rolled paper", "press it flat, glue it down"),
    "cropped": ("an undeclared crop moved the picture's center", "use the photograph as the camera wrote it"),
    "copy": ("another file shows the same photograph", "leave one of them"),
    "other_design": ("what is printed is not this design", "name the sheet that was printed"),
    "wrong_ink": ("an ink or all color is missing, or red and blue are swapped", "print and photograph in color"),
    "no_corners": ("a print without markers was not found", "add --find or --corners"),
}
MIRRORED_ADVICE = "the photo is mirrored: switch off the camera's mirror setting and save it again"


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
