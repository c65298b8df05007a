"""patchproof: optimize a patch on a 3D object, print it at true size, photograph it, judge the photographs.

The public names tell the story in order: scene → optimize → sheet → photographs → verify. They are listed in
`__init__.pyi`, for type checkers as for Python, and imported when first used, so that `import patchproof` and
`patchproof --help` stay quick.
"""

from types import FunctionType
from typing import Any

import lazy_loader

_import_name, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    value = _import_name(name)
    if name in __all__ and isinstance(value, FunctionType):
        from patchproof.app.arguments import checked

        value = globals()[name] = checked(value, name)
    return value
