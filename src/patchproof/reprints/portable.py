"""A sheet's settings and promise without the folders of the machine that made it, and with its printer by value."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from patchproof.base.validation import NETWORK_FILE
from patchproof.channel.printer import carried_printer
from patchproof.scene.interface import Scene
from patchproof.sheets.manifest import Promise


def portable_content(
    settings: dict[str, Any], promise: Promise, scene: Scene, folder: Path
) -> tuple[dict[str, Any], Promise]:
    """Return settings and promise for a sheet in `folder`: files by their names, networks as seen from there."""

    def from_sheet(name: str) -> str:
        match = NETWORK_FILE.fullmatch(name)
        if match is None or "${" in name or Path(scene.base / match[2]).drive != folder.resolve().drive:
            return name
        return match[1] + Path(os.path.relpath(scene.base / match[2], folder)).as_posix()

    carried = {"sheet": settings["sheet"]}
    if Path(profile := scene.settings.printer.profile).suffix:
        carried["printer_file"] = carried_printer(scene.base / profile)
    models = tuple(model.changed(name=from_sheet(model.name)) for model in promise.models)
    return without_folders(settings, from_sheet) | carried, promise.changed(models=models)


def without_folders(value: Any, from_sheet: Callable[[str], str]) -> Any:
    """Copy settings, absolute paths as file names, other texts as `from_sheet` has them."""
    if isinstance(value, dict):
        return {key: without_folders(each, from_sheet) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [without_folders(each, from_sheet) for each in value]
    if not isinstance(value, str):
        return value
    return Path(value).name if Path(value).is_absolute() else from_sheet(value)
