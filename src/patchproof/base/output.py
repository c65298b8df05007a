"""Write files and folders atomically, and encode pictures.

In: where a command should write. Out: a temporary place to write to that becomes the real one at the end. An existing
file or folder is refused unless the user asked to overwrite it, and only a folder of the command's own files can be
overwritten, so that a mistyped path loses nothing.
"""

from __future__ import annotations

import base64
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
from patchproof.base.folder_lock import lock_folder


@contextmanager
def new_folder(out: str | Path, file_names: tuple[str, ...], overwrite: bool = False) -> Iterator[Path]:
    """A folder to write into that becomes `out` when the block ends without an error; see `check_folder`."""
    out = Path(out)
    with lock_folder(out):
        check_folder(out, file_names, overwrite)
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


def check_folder(out: Path, file_names: tuple[str, ...], overwrite: bool = False, unfinished: bool = False) -> None:
    """Refuse a folder with files in it, unless they may be overwritten and match `file_names`, the patterns that this
    command writes. For an `unfinished` folder the refusal says how to continue.
    """
    if os.path.isfile(out):
        raise Refused("a folder to write to", f"the file {out}", "choose another --out")
    names = sorted(path.name for path in out.iterdir()) if os.path.isdir(out) else []
    names = [name for name in names if not fnmatch(name, ".*.part")]  # temporary files of a killed command
    if names and not overwrite:
        got, do = f"{out} with {len(names)} files", "choose another --out or add --overwrite"
        if unfinished:
            got, do = f"{out}, which is unfinished", "continue with --resume, or start again with --overwrite"
        raise Refused("an empty or new folder", got, do)
    foreign = [name for name in names if not any(fnmatch(name, pattern) for pattern in file_names)]
    if foreign:
        expected = f"a folder with this command's own output only ({', '.join(file_names)})"
        raise Refused(expected, f"{out} with {foreign[0]}", "choose another --out")


def check_file(path: Path, overwrite: bool = False) -> None:
    """Refuse a file that exists unless it may be overwritten."""
    if os.path.exists(path) and not overwrite:
        raise Refused("a new file", f"{path}, which exists", "choose another --out or add --overwrite")


def disk_is_full(error: BaseException | None) -> bool:
    """True if an error, or a cause of it, is a full disk or quota; safetensors states it in the message alone."""
    while error is not None:
        full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
        if full or any(f"(os error {number})" in str(error) for number in (errno.ENOSPC, errno.EDQUOT)):
            return True
        error = error.__cause__ or error.__context__
    return False


def make_folder(path: Path) -> None:
    """Make a folder and its parents; refused if the system does not allow it."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Refused("a folder that can be made", f"{path} ({error.strerror})", "choose another --out") from error


def write_atomically(path: Path, content: str | bytes | Callable[[Path], Any]) -> None:
    """Write `content`, or let it write, beside `path`, and move it there: readers see the complete old or new file."""
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
    """Write several files beside their places, then move all there: a full disk leaves the old files."""
    parts = {path: path.with_name(f".{path.name}.{os.getpid()}.part") for path in contents}
    path = next(iter(contents))
    try:
        for path, data in contents.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.is_dir():
                raise IsADirectoryError(f"{path} is a folder")
            parts[path].write_bytes(data)
        for path, part in parts.items():
            os.replace(part, path)
    except OSError as error:
        reason = error.strerror or str(error)
        raise Refused("a folder that can be written to", f"{path} ({reason})", "choose another --out") from error
    finally:
        for part in parts.values():
            with suppress(OSError):  # it was moved to its place, or never written
                part.unlink()


def image_bytes(pixels: np.ndarray, kind: str, options: Mapping[str, Any] | None = None) -> bytes:
    """Encode uint8 sRGB H×W×3 (or with alpha) as a "PNG", "JPEG" or "WEBP" file, with Pillow's `options` for it."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, kind, **(options or {}))
    return buffer.getvalue()


def write_pictures(pictures: Sequence[np.ndarray], folder: Path) -> Path:
    """Write uint8 H×W×3 sRGB arrays as photo_0001.png and so on into a folder, in place of earlier ones; returns the
    folder. Refused for an empty list, or an array of another type or shape.
    """
    pictures = list(pictures)
    if not pictures:
        raise Refused("a folder of photographs or arrays", "an empty list", "give one array or more")
    for number, array in enumerate(pictures):
        if not isinstance(array, np.ndarray) or array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] != 3:
            got = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else f"a {type(array).__name__}"
            raise Refused("photographs as uint8 H×W×3 arrays", f"{got} at index {number}", "convert it to 8-bit RGB")
    with new_folder(folder, ("photo_*.png",), overwrite=True) as part:
        for number, array in enumerate(pictures, 1):
            (part / f"photo_{number:04d}.png").write_bytes(image_bytes(array, "PNG"))
    return folder


def base64_uri(content: bytes, kind: str) -> str:
    """Encode bytes of a media type (`kind`) as a data URI."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def image_pixels(content: bytes) -> np.ndarray:
    """Decode a picture file's bytes to uint8 sRGB H×W×3."""
    from PIL import Image

    with Image.open(io.BytesIO(content)) as image:
        return np.asarray(image.convert("RGB"))
