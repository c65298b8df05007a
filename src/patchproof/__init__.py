"""patchproof: optimize a patch on a 3D object, print it at true size, photograph it, judge the photographs.

The public names tell the story in order: scene → optimize → sheet → photographs → verify. They are listed in
`__init__.pyi`, which type checkers read; here they are imported when first used, so that `import patchproof` and
`patchproof --help` stay quick.
"""

from __future__ import annotations

import ast
from importlib import import_module
from pathlib import Path
from typing import Any

from patchproof.base.version import __version__ as __version__

_LISTED = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
# by public name the module that it comes from, and what it is called there
_HOME = {
    str(alias.asname): (str(node.module), alias.name)
    for node in _LISTED
    if isinstance(node, ast.ImportFrom)
    for alias in node.names
}
__all__ = sorted(_HOME.keys() - {"__version__"})  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'patchproof' has no attribute {name!r}")
    module, attribute = _HOME[name]
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
