"""Paths of the data files that are installed with the package: `calibration/` and `print_templates/`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from patchproof.base.errors import Refused


def packaged_path(folder: Literal["calibration", "print_templates"], *parts: str) -> Path:
    """A file of the data that travels with the program: inside the installed package, else in the checkout."""
    package = Path(__file__).resolve().parents[1]
    # an editable install keeps these folders at the top of the checkout, two levels up
    roots = [root for root in (package / folder, package.parents[1] / folder) if root.is_dir()]
    if not roots:
        raise Refused(f"the folder {folder} beside the program", "none", "install patchproof again")
    return roots[0].joinpath(*parts)
