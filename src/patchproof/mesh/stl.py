"""Read STL files, as text or binary, as one part in the file's axes; several solids are one object.

In: a file. Out: its triangles. Left out on purpose: colors, which programs write in different ways.
"""

import re

import numpy as np

from patchproof.mesh.assets import Assets
from patchproof.mesh.mesh import MeshPart

_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(assets: Assets) -> list[MeshPart]:
    """Read an STL file as one part."""
    data = assets.data
    if len(data) >= 84 and len(data) == 84 + _FACET.itemsize * int.from_bytes(data[80:84], "little"):
        facets = np.frombuffer(data, _FACET, offset=84)
        corners = facets["corners"].reshape(-1, 3).astype(float)
        if facets["attribute"].any() or b"COLOR=" in data[:80]:
            assets.say("colors in the STL file are left out")
    elif b"endsolid" in data.lower():
        rows = re.findall(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", data.lower())
        corners = np.array([[*map(float, row)] for row in rows]).reshape(-1, 3)
    else:
        raise ValueError("neither text nor of the size that it states")
    return [MeshPart(corners, np.arange(len(corners)).reshape(-1, 3), assets.gray())]
