"""Check the files that a command names before torch is imported, which takes seconds: a wrong path, a missing file or a
wrong setting is answered at once. What a file holds is checked where it is read.
"""

import os
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from patchproof.base.errors import Refused
from patchproof.base.output import require_finished_run
from patchproof.base.settings import load_scene_settings, named_paths
from patchproof.sheets.manifest import load_manifest


def check_files(arguments: Mapping[str, Any]) -> None:
    """Refuse the first of a command's arguments whose file is missing, and settings and manifests that are wrong."""
    if not (thing := arguments.get("thing", "primitive:")).startswith("primitive:"):
        require_path("a mesh file, primitive:NAME or a folder of pictures", thing)
    if isinstance(path := arguments.get("scene"), Path) and not arguments.get("as_printed"):  # else without its patch
        _check_scene(path)
    for name, value in arguments.items():
        for path in value if isinstance(value, list) else [value]:
            if isinstance(path, Path) and name in _CHECKS:
                _CHECKS[name](path)


def require_path(expected: str, path: str | Path) -> None:
    """Refuse a path at which there is neither a file nor a folder."""
    if not os.path.exists(path):
        raise Refused(expected, f"no file at {path}", "check the path")


def _check_scene(path: Path) -> None:
    settings, base = load_scene_settings(path), path.resolve().parent
    paths = named_paths(settings, base)
    if Path(settings.printer.profile).suffix in (".npz", ".json"):
        paths["printer.profile"] = base / settings.printer.profile
    for key, named in paths.items():
        if ":" not in named.name:  # primitive:NAME
            require_path(f"the file that {key} in {path} names", named)


_CHECKS: Mapping[str, Callable[[Path], object]] = {
    **{name: partial(require_path, f"a file for --{name}") for name in ("icc", "corners", "boxes")},
    "controls": partial(require_path, "a folder of control photographs"),
    **{"run": require_finished_run, "runs": require_finished_run, "sheet": load_manifest},
    **{"pdf": partial(require_path, "a sheet's PDF"), "picture": partial(require_path, "a picture")},
    "photos": partial(require_path, "a folder of photographs"),
}
