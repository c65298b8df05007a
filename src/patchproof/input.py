"""Files that anybody may have made, read within bounds: JSON and pictures.

In: a path, or bytes, and what is expected there. Out: its content, or one `Refused`, whatever a decoder stumbles over.
Sizes are looked at before memory is taken, and of pictures only formats are opened that hold pictures: Pillow knows
some that start other programs. Photographs have limits of their own (`photo.limits`), and so has every archive.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from patchproof.strict import Refused

if TYPE_CHECKING:
    from PIL.Image import Image

# an allow-list, because Pillow also opens formats that start other programs (EPS) or hold no photograph
FORMATS = ("JPEG", "MPO", "PNG", "TIFF", "WEBP", "BMP", "GIF", "AVIF", "HEIF")
LARGEST_PX = 120_000_000  # 360 MB as pixels; the largest phone sensors in common use give 50 to 108 million
LARGEST_JSON = 16 << 20  # bytes; a manifest has 0.3 million, and lists of nothing take 25 times their text in memory


def is_file(path: str | Path) -> bool:
    """Whether a file is there; at a path that no system takes (300 letters, a NUL) there is none."""
    return os.path.isfile(path)


def is_folder(path: str | Path) -> bool:
    """Whether a folder is there; see `is_file`."""
    return os.path.isdir(path)


def read_json(path: str | Path, expected: str, do: str, missing: str = "check the path") -> Any:
    """A JSON file's content; refused with `do` where it is broken, with `missing` where there is none."""
    path = Path(path)
    if not is_file(path):
        raise Refused(expected, f"no file at {path}", missing)
    try:
        if path.stat().st_size > LARGEST_JSON:
            raise ValueError(f"more than {LARGEST_JSON >> 20} MiB")
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:  # RecursionError: thousands of lists in each other
        raise Refused(expected, f"{path} that cannot be read ({error})", do) from error


@contextmanager
def opened_picture(source: Path | bytes, expected: str, do: str) -> Iterator[Image]:
    """A Pillow image of a file, or of a file's bytes; what fails in decoding it is refused with `do`."""
    from PIL import Image

    where = "one" if isinstance(source, bytes) else f"{source.name}"
    try:
        opened = io.BytesIO(source) if isinstance(source, bytes) else source
        with Image.open(opened, formats=readable_formats()) as image:
            if image.width * image.height > LARGEST_PX:
                raise ValueError(f"{image.width} × {image.height} pixels")
            yield image
    except Refused:
        raise
    except Exception as error:  # decoders fail in many ways (OSError, SyntaxError, struct.error...), all alike here
        reason = " ".join(str(error).split())[:100] or type(error).__name__
        raise Refused(expected, f"{where} that cannot be read ({reason})", do) from error


def readable_formats() -> list[str]:
    """Those of `FORMATS` that this Pillow reads."""
    from PIL import Image

    Image.init()
    return [name for name in FORMATS if name in Image.OPEN]
