"""Write files and folders atomically, and encode pictures.

In: where a command should write. Out: a temporary place to write to that becomes the real one at the end. An existing
file or folder is refused unless the user asked to overwrite it, and only a folder whose listing (`base.folder_lock`)
names all of its files can be overwritten: neither a mistyped path nor a received folder deletes anything else.
"""

import base64
import errno
import io
import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.folder_lock import LISTING_FILE, append_listing, list_file, listed_names, lock_folder
from patchproof.base.input import is_file, is_folder

RUN_FILE, CHECKPOINT_FILE = "run.json", "checkpoint.safetensors"  # that tell how far a run got
_ANOTHER = "choose another --out"


@contextmanager
def new_folder(
    out: str | Path, file_names: tuple[str, ...], overwrite: bool = False, inputs: Iterable[object] = ()
) -> Iterator[Path]:
    """A folder to write into that becomes `out` when the block ends without an error; see `check_folder`."""
    out = Path(out)
    if out.name in ("", ".."):
        raise Refused("a folder by its name", f"{out}", _ANOTHER)
    with lock_folder(out):
        check_folder(out, file_names, overwrite, inputs=inputs)
        part, old = (out.with_name(f".{out.name}.{kind}") for kind in ("part", "old"))
        _remove(part)
        make_folder(part)
        try:
            yield part
            append_listing(part, _files_in(part))
            check_folder(out, file_names, overwrite)  # once more: what came in between is not deleted
            try:
                _remove_listed(old)  # of a process that was killed in the next lines
                if out.is_dir():
                    out.rename(old)
                part.rename(out)
                _remove_listed(old)
            except OSError as error:
                got = f"{error.filename2 or error.filename} ({error.strerror})"
                raise Refused("a folder that can be replaced", got, "remove that, or choose another --out") from error
            list_file(out / LISTING_FILE)
        finally:
            _remove(part)


def check_folder(
    out: Path,
    file_names: tuple[str, ...],
    overwrite: bool = False,
    unfinished: bool = False,
    inputs: Iterable[object] = (),
) -> None:
    """Refuse a folder with files in it, unless they may be overwritten: its listing and `file_names`, the patterns that
    this command writes, cover them all, and no `inputs` are among them. If `unfinished`, say how to continue.
    """
    if os.path.lexists(out) and not is_folder(out):
        raise Refused("a folder to write to", f"{out}, which is not a folder", _ANOTHER)
    names = _files_in(out)
    if names and not overwrite:
        if unfinished:
            do = "continue with --resume, or start again with --overwrite"
            raise Refused("an empty or new folder", f"{out}, which is unfinished", do)
        raise Refused("an empty or new folder", f"{out} with {len(names)} files", f"{_ANOTHER} or add --overwrite")
    refuse_inputs_in(out, inputs)
    own = _listed(out, names)
    foreign = [n for n in names if n not in own or not _matches(n, file_names) or (out / n).is_symlink()]
    if foreign or (names and out.is_symlink()):
        got = f"{out} with {foreign[0]}" if foreign else f"{out}, a link to another folder"
        raise Refused(f"a folder that holds nothing but what this command wrote ({LISTING_FILE})", got, _ANOTHER)


def refuse_inputs_in(out: Path, inputs: Iterable[object]) -> None:
    """Refuse inputs of a command that are, or lie in, what it writes."""
    for path in inputs:  # objects in memory have no path
        if isinstance(path, str | Path) and os.path.exists(path) and Path(path).resolve().is_relative_to(out.resolve()):
            raise Refused("inputs that lie outside of what is written", f"{path} in {out}", _ANOTHER)


def refuse_other_files(out: Path, file_names: tuple[str, ...]) -> None:
    """Refuse to continue a folder that contains links, or files that match none of the patterns."""
    foreign = [n for n in _files_in(out) if not _matches(n, file_names) or (out / n).is_symlink()]
    if foreign:
        expected = f"a folder with this command's own output only ({', '.join(file_names) or 'none'})"
        raise Refused(expected, f"{out} with {foreign[0]}", _ANOTHER)


def require_finished_run(folder: Path) -> None:
    """Refuse a folder that holds no run, or an unfinished one."""
    if not is_file(folder / RUN_FILE):
        has_checkpoint = is_file(folder / CHECKPOINT_FILE)
        do = "finish it with --resume" if has_checkpoint else "name the folder that optimize wrote"
        raise Refused("a finished run", f"{'an unfinished one' if has_checkpoint else 'none'} at {folder}", do)


def clear_folder(folder: Path, keep: Callable[[str], bool] = lambda name: False) -> None:
    """Delete the files that a folder's listing names, except those to keep, and folders that this leaves empty."""
    names = _files_in(folder)
    for name in {*names} & _listed(folder, names):
        if not keep(name):
            (folder / name).unlink()
            with suppress(OSError):  # there is none, or a folder
                (folder / name).with_name(f".{name.rpartition('/')[2]}.part").unlink()
    if not _files_in(folder):
        (folder / LISTING_FILE).unlink(missing_ok=True)
    for path, _, _ in os.walk(folder, topdown=False):
        with suppress(OSError):  # it has files
            os.rmdir(path)


def _remove_listed(folder: Path) -> None:
    """Remove the listed files of a folder that was replaced; of a link only the link, not its target."""
    if folder.is_symlink():
        folder.unlink()
    clear_folder(folder)


def _files_in(folder: Path) -> list[str]:
    """Names of all files in a folder and its subfolders; links count as files, temporary and hidden lists do not."""
    found = []
    for root, folders, files in os.walk(folder):
        links = [name for name in folders if os.path.islink(os.path.join(root, name))]
        found += [Path(root, name).relative_to(folder).as_posix() for name in (*files, *links)]
    return sorted(n for n in found if n != LISTING_FILE and not fnmatch(n.rpartition("/")[2], ".*.part"))


def _listed(folder: Path, names: Iterable[str]) -> set[str]:
    """Names in a folder's listing, and in those of its subfolders among `names` that it lists itself."""
    listed = listed_names(folder)
    for name in names:
        inner, slash, last = name.rpartition("/")
        if slash and last == LISTING_FILE and name in listed:
            below = [each.removeprefix(f"{inner}/") for each in names if each.startswith(f"{inner}/")]
            listed |= {f"{inner}/{each}" for each in _listed(folder / inner, set(below) - {LISTING_FILE})}
    return listed


def _matches(name: str, patterns: Iterable[str]) -> bool:
    return any(fnmatch(name.partition("/")[0], pattern) for pattern in patterns)


def _remove(part: Path) -> None:
    """Remove a temporary folder, or a link in its place."""
    if part.is_symlink() or is_file(part):
        part.unlink()
    shutil.rmtree(part, ignore_errors=True)


def check_file(path: Path, overwrite: bool = False, inputs: Iterable[object] = ()) -> None:
    """Refuse a file that exists unless it may be overwritten and is none of the command's inputs."""
    refuse_inputs_in(path, inputs)
    if os.path.exists(path) and not overwrite:
        raise Refused("a new file", f"{path}, which exists", f"{_ANOTHER} or add --overwrite")


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
    _write_beside({path: path.with_name(f".{path.name}.part")}, {path: content})


def json_text(data: Any) -> str:
    """Data as the text of a JSON file; equal data give equal bytes, and NaN is refused."""
    return json.dumps(data, indent=1, allow_nan=False) + "\n"


def write_json(path: Path, data: Any) -> None:
    """Write data as a JSON file, whole or not at all."""
    write_atomically(path, json_text(data))


def write_files_atomically(contents: Mapping[Path, bytes]) -> None:
    """Write several files beside their places, making folders, and then move all: a full disk leaves the old files."""
    for path in contents:
        with suppress(OSError):  # writing says why
            path.parent.mkdir(parents=True, exist_ok=True)
    _write_beside({path: path.with_name(f".{path.name}.{os.getpid()}.part") for path in contents}, contents)


def _write_beside(parts: Mapping[Path, Path], contents: Mapping[Path, Any]) -> None:
    path = next(iter(contents))
    try:
        for path, content in contents.items():
            if path.is_dir():
                raise IsADirectoryError(f"{path} is a folder")
            parts[path].unlink(missing_ok=True)  # a link there would lead the content elsewhere
            list_file(path)
            if callable(content):
                content(parts[path])
                continue
            with open(parts[path], "xb") as file:
                file.write(content.encode() if isinstance(content, str) else content)
        for path, part in parts.items():
            os.replace(part, path)
    except OSError as error:
        got = f"{path} ({error.strerror or error})"
        raise Refused("a folder that can be written to", got, "make room or choose another --out") from error
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
    if not len(pictures):
        raise Refused("a folder of photographs or arrays", "an empty list", "give one array or more")
    for number, array in enumerate(pictures):
        if not isinstance(array, np.ndarray) or array.dtype != np.uint8 or array.shape[2:] != (3,) or not array.size:
            got = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else f"a {type(array).__name__}"
            raise Refused("photographs as uint8 H×W×3 arrays", f"{got} at index {number}", "convert it to 8-bit RGB")
    with new_folder(folder, ("photo_*.png",), overwrite=True) as part:
        for number, array in enumerate(pictures, 1):
            (part / f"photo_{number:04d}.png").write_bytes(image_bytes(array, "PNG"))
    return folder


def data_uri(content: bytes) -> str:
    """Encode the bytes of a JPEG or PNG as a data URI for `<img src>`."""
    kind = "png" if content.startswith(b"\x89PNG") else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def image_pixels(content: bytes) -> np.ndarray:
    """Decode a picture file's bytes to uint8 sRGB H×W×3."""
    from PIL import Image

    with Image.open(io.BytesIO(content)) as image:
        return np.asarray(image.convert("RGB"))


def rate_text(rate: float, interval: tuple[float, float]) -> str:
    """Return "86.0% [80.1%, 90.4%]"."""
    return f"{rate:.1%} [{interval[0]:.1%}, {interval[1]:.1%}]"
