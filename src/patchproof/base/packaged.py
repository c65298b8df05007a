"""Paths of the data files that are installed with the package: `calibration/` and `print_templates/`."""

from pathlib import Path
from typing import Literal

from patchproof.base.errors import Refused


def packaged_path(folder: Literal["calibration", "print_templates"], *parts: str) -> Path:
    """Path of a data file: inside the installed package, or at the top of the checkout in an editable install."""
    package = Path(__file__).resolve().parents[1]
    roots = [root for root in (package / folder, package.parents[1] / folder) if root.is_dir()]
    if not roots:
        raise Refused(f"the folder {folder} in {package}", "no such folder", "install patchproof again")
    return roots[0].joinpath(*parts)
