"""Identity of a scene by what its files hold, not by how their paths are spelled."""

from functools import lru_cache
from pathlib import Path
from typing import Any

from patchproof.base.fingerprint import files_sha256, value_sha256
from patchproof.base.input import is_file, is_folder
from patchproof.base.settings import SceneSettings, identity_settings, named_paths
from patchproof.base.validation import NETWORK_FILE, expand_path


def content_identity(settings: SceneSettings, base: Path) -> dict[str, Any]:
    """The identity of a scene's settings with a hash of the content of each file in place of its name: a draw does not
    depend on how a path is spelled. Of a folder the names and sizes of its files are hashed.
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
