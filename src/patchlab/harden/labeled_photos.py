"""Read a folder of labeled photographs in blocks that fit into memory.

In: a folder and a CSV of file names and labels. Out: rows with the name of each photograph's PNG. A heading line is
skipped; missing files and files named twice are refused.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePath

import numpy as np

from patchproof.base.csv_file import csv_lines
from patchproof.base.errors import Refused
from patchproof.base.input import is_file, open_lazily
from patchproof.photo.read import read_photo
from patchproof.photo.rejection import PhotoRejected
from patchproof.scene.image_scene import read_labels

MAX_BLOCK_PHOTOS, MAX_BLOCK_PX = 8, 4_000_000  # of photographs hardened together: some 200 MB with gradients
MIN_SIDE_PX = 8  # of a photograph's shorter side


def list_labeled_files(folder: Path, table: Path) -> list[tuple[str, str, str]]:
    """(file, its PNG's name, label) of every line; files that share a stem keep their suffixes in the PNG's name."""
    rows = read_labels(table, folder)
    outside = next((file for file, _ in rows if PurePath(file).is_absolute() or ".." in PurePath(file).parts), None)
    if outside is not None:  # results are written under these names
        raise Refused(f"names of files within {folder} in {table}", f'"{outside}"', "copy it there, and name it so")
    missing = [file for file, _ in rows if not is_file(folder / file)]
    if missing or not rows:
        got = f"{len(missing)} missing ({missing[0]})" if missing else "a table without rows"
        raise Refused(f"the images that {table.name} names in {folder}", got, "copy them there, or mend the table")
    twice = next((file for file, count in Counter(file for file, _ in rows).items() if count > 1), None)
    if twice:
        raise Refused(f"each file once in {table}", f"{twice} twice", "remove a line")
    stems = [Path(file).with_suffix("").as_posix() for file, _ in rows]
    counts = Counter(stems)
    return [
        (file, (stem if counts[stem] == 1 else file) + ".png", label)
        for (file, label), stem in zip(rows, stems, strict=True)
    ]


def write_labels(rows: Sequence[tuple[str, str | int]], folder: Path) -> Path:
    """Write `labels.csv` of (file, label) into a folder."""
    path = folder / "labels.csv"
    path.write_text(csv_lines([("file", "label"), *rows]), encoding="utf-8")
    return path


def split_into_blocks(folder: Path, rows) -> Iterator[list]:
    """Split rows, in order, into blocks that fit into memory; sizes come from the files' headers."""
    block, pixels = [], 0
    for row in rows:
        try:
            with open_lazily(folder / row[0]) as image:
                size = image.width * image.height
        except Exception:  # a file that is no image is reported when it is read
            size = 0
        if block and (len(block) == MAX_BLOCK_PHOTOS or pixels + size > MAX_BLOCK_PX):
            yield block
            block, pixels = [], 0
        block.append(row)
        pixels += size
    yield block


def read_large_enough(path: Path) -> np.ndarray:
    """Read a photograph as uint8 H×W×3; `PhotoRejected` if it is no picture or too small."""
    srgb = read_photo(path).srgb
    if min(srgb.shape[:2]) < MIN_SIDE_PX:
        shape = "×".join(map(str, srgb.shape[1::-1]))
        raise PhotoRejected("too_small", min(srgb.shape[:2]), MIN_SIDE_PX, f"{shape} px are too few: use a larger one")
    return srgb
