"""patchproof: optimize a patch on a 3D object, print it at true size, photograph it, judge the photographs.

The public names tell the story in order: scene → optimize → sheet → photographs → verify. They are imported when first
used, so that `import patchproof` and `patchproof --help` stay quick.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOME = {
    "load_scene": "patchproof.scene.scene",
    "load_classifier": "patchproof.classifier.load",
    "load_printer": "patchproof.channel.printer",
    "photograph": "patchproof.render.photograph",
    "set_stage": "patchproof.render.stage",
    "optimize_scene": "patchproof.optimizer.run",
    "evaluate_run": "patchproof.optimizer.evaluate",
    "load_run": "patchproof.optimizer.run",
    "sheet_of": "patchproof.printing.sheet",
    "reprint": "patchproof.reprints.reprint",
    "load_manifest": "patchproof.sheets.manifest",
    "verify_photos": "patchproof.journey.verify",
    "Refused": "patchproof.strict",
}

__all__ = list(_HOME)
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'patchproof' has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
