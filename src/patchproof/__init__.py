"""patchproof: optimize a patch on a 3D object, print it at true size, photograph it, judge the photographs.

The public names tell the story in order: scene → optimize → sheet → photographs → verify. They are listed in
`__init__.pyi`, for type checkers as for Python, and imported when first used, so that `import patchproof` and
`patchproof --help` stay quick.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
