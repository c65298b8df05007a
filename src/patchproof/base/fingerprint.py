"""Fingerprints of what a run is made from, and their comparison wherever it is used.

In: files, or values. Out: SHA-256 as text. Of a long list of files, such as 100,000 backgrounds, only names, sizes and
the first and last 64 kB of each are read: an exchanged picture shows, a single retouched pixel may not. A scene's own
identity is by what its files hold, not by how their paths are spelled.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from patchproof.base.errors import Refused
from patchproof.base.input import hash_file, is_file, is_folder
from patchproof.base.settings import SceneSettings, identity_settings, named_paths
from patchproof.base.validation import NETWORK_FILE, expand_path

_END_BYTES = 1 << 16


def files_sha256(paths: Sequence[Path], whole: bool = True) -> str:
    """SHA-256 of one file's bytes, or of several files; unless `whole`, of their names, sizes and ends."""
    digest = hashlib.sha256()
    for path in filter(is_file, paths):  # readers refuse what is none
        status = path.stat()
        if whole:
            content = _file_sha256(path, status.st_size, status.st_mtime_ns)
            if len(paths) == 1:
                return content
            digest.update(content.encode())
            continue
        with open(path, "rb") as file:
            digest.update(f"{path.name}\0{status.st_size}\0".encode() + file.read(_END_BYTES))
            file.seek(max(_END_BYTES, status.st_size - _END_BYTES))
            digest.update(file.read(_END_BYTES))
    return digest.hexdigest()


@lru_cache(maxsize=1000)  # once a process: size and time of the last change tell versions apart
def _file_sha256(path: Path, size: int, changed_ns: int) -> str:
    return hash_file(path, size)


def value_sha256(value: Any) -> str:
    """SHA-256 of JSON values."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def refuse_other_inputs(
    recorded: Mapping[str, str], inputs: Mapping[str, str], source: str | Path, settings: Mapping[str, Any]
) -> None:
    """Refuse inputs, by settings key, whose fingerprints differ from those that `source` recorded of itself."""
    for key, sha256 in recorded.items():
        if inputs.get(key) != sha256:
            value: Any = settings
            for part in key.split("."):  # a network's key ends with its name, which may hold points
                value = value.get(part) if isinstance(value, Mapping) else None
            expected = f"the {key}{f' {value}' if isinstance(value, str) else ''} that {source} was made with"
            got = f"another (sha256 {inputs[key][:8]}...)" if key in inputs else "none"
            raise Refused(f"{expected} (sha256 {sha256[:8]}...)", got, "restore the original file, or optimize again")


def content_identity(settings: SceneSettings, base: Path) -> dict[str, Any]:
    """The identity of a scene's settings: a hash of content stands for each file's name (of a folder: the names and
    sizes of its files), so that draws do not depend on how a path is spelled.
    """
    identity, printer, file = identity_settings(settings), settings.printer.profile, settings.camera.file
    contents = {key: [path] for key, path in named_paths(settings, base).items()}
    contents |= {} if file is None else {"camera.file": [base / file]}
    if Path(printer).suffix:
        contents["printer.profile"] = [(base / printer).with_suffix(suffix) for suffix in (".npz", ".json")]
    for key, paths in contents.items():
        *tables, name = key.split(".")
        table = identity
        for each in tables:
            table = table[each]
        table[name] = _content_sha256(paths) or table[name]
    matches = {name: NETWORK_FILE.fullmatch(expand_path(name, base)) for name in settings.target.models}
    identity["target"]["models"] = [(match and _content_sha256([Path(match[2])])) or n for n, match in matches.items()]
    return identity


def _content_sha256(paths: list[Path]) -> str | None:
    """A hash of files, or of one folder's names and sizes; None if there is none."""
    if is_folder(paths[0]):
        return _folder_sha256(paths[0], paths[0].stat().st_mtime_ns)
    return files_sha256(paths) if is_file(paths[0]) else None


@lru_cache(maxsize=100)  # once a process: a search for a place asks a hundred times
def _folder_sha256(folder: Path, changed_ns: int) -> str:
    files = (path for path in folder.rglob("*") if path.is_file())
    return value_sha256(sorted((path.relative_to(folder).as_posix(), path.stat().st_size) for path in files))
