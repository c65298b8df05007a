"""Paths of the data files that are installed with the package: `calibration/` and `print_templates/`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from patchproof.base.errors import Refused
from patchproof.base.validation import spelling_hint


def packaged_path(folder: Literal["calibration", "print_templates"], *parts: str) -> Path:
    """Path of a data file: inside the installed package, or at the top of the checkout in an editable install."""
    package = Path(__file__).resolve().parents[1]
    roots = [root for root in (package / folder, package.parents[1] / folder) if root.is_dir()]
    if not roots:
        raise Refused(f"the folder {folder} in {package}", "no such folder", "install patchproof again")
    return roots[0].joinpath(*parts)


def named_path(
    name_or_file: str | Path, base: Path | None, what: str, folder: Path, suffixes: Sequence[str], others=()
) -> Path:
    """The path of a shipped file by its name, or any path with one of the suffixes or in a folder, relative to `base`;
    an unknown name is refused with the nearest one, `others` among them.
    """
    path = Path(name_or_file)
    if path.suffix.lower() in suffixes or len(path.parts) > 1:
        return (base or Path()) / path
    shipped = sorted(file.stem for file in folder.glob(f"*{suffixes[0]}"))
    if str(path) not in shipped:
        raise Refused(f"{what}'s name or file", f'"{path}"', spelling_hint(str(path), [*shipped, *others]))
    return folder / f"{path}{suffixes[0]}"
