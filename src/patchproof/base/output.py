"""Output that replaces what was there only when it is complete, and pictures as the bytes of a file.

In: where a command should write. Out: a place to write to that becomes the real one at the end. What exists is refused
unless the user asked to overwrite it, and overwriting a folder removes only what the command itself writes: a mistyped
folder loses nothing.
"""

from __future__ import annotations

import errno
import io
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np

from patchproof.base.errors import Refused


@contextmanager
def new_folder(out: str | Path, own: tuple[str, ...], overwrite: bool = False) -> Iterator[Path]:
    """A folder to write into that becomes `out` when the block ends well; `own` are the names this command writes."""
    out = Path(out)
    check_folder(out, own, overwrite)
    part = out.with_name(f".{out.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    make_folder(part)
    try:
        yield part
        old = out.with_name(f".{out.name}.old")
        shutil.rmtree(old, ignore_errors=True)
        if out.is_dir():
            out.rename(old)
        part.rename(out)
        shutil.rmtree(old, ignore_errors=True)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def check_folder(out: Path, own: tuple[str, ...], overwrite: bool = False, unfinished: bool = False) -> None:
    """Refuse a folder with files in it unless they may be overwritten and are all this command's own; of `unfinished`
    ones it is said how to go on.
    """
    if os.path.isfile(out):
        raise Refused("a folder to write to", f"the file {out}", "choose another --out")
    names = sorted(path.name for path in out.iterdir()) if os.path.isdir(out) else []
    names = [name for name in names if not fnmatch(name, ".*.part")]  # what a killed command did not get to name
    if names and not overwrite:
        got, do = f"{out} with {len(names)} files", "choose another --out or add --overwrite"
        if unfinished:
            got, do = f"{out}, which is unfinished", "go on with --resume, or start anew with --overwrite"
        raise Refused("an empty or new folder", got, do)
    strange = [name for name in names if not any(fnmatch(name, pattern) for pattern in own)]
    if strange:
        expected = f"a folder with this command's own output only ({', '.join(own)})"
        raise Refused(expected, f"{out} with {strange[0]}", "choose another --out")


def check_file(path: Path, overwrite: bool = False) -> None:
    """Refuse a file that exists unless it may be overwritten."""
    if os.path.exists(path) and not overwrite:
        raise Refused("a new file", f"{path}, which exists", "choose another --out or add --overwrite")


def disk_is_full(error: BaseException | None) -> bool:
    """Whether an error, or one that led to it, is of a full disk or quota; safetensors has it in its words alone."""
    while error is not None:
        full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
        if full or any(f"(os error {number})" in str(error) for number in (errno.ENOSPC, errno.EDQUOT)):
            return True
        error = error.__cause__ or error.__context__
    return False


def make_folder(path: Path) -> None:
    """Make a folder and those above it; refused where that cannot be."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Refused("a folder that can be made", f"{path} ({error.strerror})", "choose another --out") from error


def write_atomically(path: Path, content: str | bytes | Callable[[Path], Any]) -> None:
    """Put the content, or what a function fills a file with, beside `path` and move it there: a reader sees the old
    file or the new one, whole.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        if callable(content):
            content(part)
        else:
            part.write_bytes(content.encode() if isinstance(content, str) else content)
        os.replace(part, path)
    except OSError as error:
        got = f"{path} ({error.strerror or error})"
        raise Refused("a file that can be written", got, "make room or choose another --out") from error
    finally:
        part.unlink(missing_ok=True)


def write_files_atomically(contents: dict[Path, bytes]) -> None:
    """Write several files, all beside their places first: a full disk leaves what was there before."""
    waiting = {path: path.with_name(f".{path.name}.{os.getpid()}.part") for path in contents}
    path = next(iter(contents))
    try:
        for path, data in contents.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.is_dir():
                raise IsADirectoryError(f"{path} is a folder")
            waiting[path].write_bytes(data)
        for path, part in waiting.items():
            os.replace(part, path)
    except OSError as error:
        reason = error.strerror or str(error)
        raise Refused("a folder that can be written to", f"{path} ({reason})", "choose another --out") from error
    finally:
        for part in waiting.values():
            with suppress(OSError):  # moved to its place, or never written
                part.unlink()


def image_bytes(pixels: np.ndarray, kind: str, options: Mapping[str, Any] | None = None) -> bytes:
    """uint8 sRGB H×W×3 (or with alpha) as a "PNG", "JPEG" or "WEBP" file; `options` are Pillow's of that kind."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, kind, **(options or {}))
    return buffer.getvalue()


def write_pictures(pictures: Sequence[np.ndarray], folder: Path) -> Path:
    """Write uint8 H×W×3 sRGB arrays as photo_0001.png and so on into `folder`, in place of others; returns the folder.

    Raises Refused where there is no array, or one of another type or shape.
    """
    pictures = list(pictures)
    if not pictures:
        raise Refused("a folder of photographs or arrays", "an empty list", "give one array or more")
    for number, array in enumerate(pictures):
        if not isinstance(array, np.ndarray) or array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] != 3:
            what = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else f"a {type(array).__name__}"
            raise Refused("photographs as uint8 H×W×3 arrays", f"{what} at index {number}", "convert it to 8-bit RGB")
    with new_folder(folder, ("photo_*.png",), overwrite=True) as part:
        for number, array in enumerate(pictures, 1):
            (part / f"photo_{number:04d}.png").write_bytes(image_bytes(array, "PNG"))
    return folder


def image_pixels(content: bytes) -> np.ndarray:
    """uint8 sRGB H×W×3 of a picture file's bytes."""
    from PIL import Image

    with Image.open(io.BytesIO(content)) as image:
        return np.asarray(image.convert("RGB"))
