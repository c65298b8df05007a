"""Read mesh files: OBJ (with MTL), GLB, glTF, PLY and STL as parts, with warnings about what is not shown as declared.

In: a file and the rotation into the world's axes. Out: parts, and warnings. Refused: a file that cannot be parsed, and
a texture that the file names but that is missing or broken. `declarations` lists what each format can declare.
"""

from importlib import import_module
from pathlib import Path

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.input import is_file, run_within_seconds
from patchproof.mesh.assets import Assets
from patchproof.mesh.mesh import MeshPart, topology_warnings, transform_part

SECONDS = 40.0  # of processor time to read a mesh, and more for long files, of which text takes longest:
_BYTES_PER_SECOND = 500_000
FORMATS = {".obj": "obj", ".glb": "gltf", ".gltf": "gltf", ".ply": "ply", ".stl": "stl"}


def read_parts(path: Path, world_from_file: np.ndarray) -> tuple[list[MeshPart], list[str], list[Path]]:
    """Read every placed geometry with faces, its vertices and normals turned by `world_from_file` 3×3; warnings; and
    the files that were read.
    """
    if not is_file(path) or not path.stat().st_size:  # some files of the system are empty, and never end
        raise Refused("a mesh file", f"no file at {path}, or an empty one", "check the path")
    kind = FORMATS.get(path.suffix.lower())
    if kind is None:
        raise Refused(f"a mesh file ({', '.join(FORMATS)})", path.name, "export the mesh in one of these formats")
    try:
        assets, read = Assets(path), getattr(import_module(f"patchproof.mesh.{kind}"), f"read_{kind}")
        parts = run_within_seconds(SECONDS + len(assets.data) / _BYTES_PER_SECOND, lambda: read(assets))
        world_from_file = np.column_stack([world_from_file, np.zeros(3)])
        parts = [transform_part(part, world_from_file) for part in parts if len(part.faces)]
        if not parts:
            raise Refused("a mesh with faces", f"no face in {path.name}", "export the object as triangles")
        return parts, [*assets.warnings, *topology_warnings(parts)], assets.files
    except Refused:
        raise
    except Exception as error:  # broken files raise many types of error
        got = f"{path.name} that cannot be read ({f'{type(error).__name__}: {error}'[:120]})"
        raise Refused(f"a mesh as {path.suffix[1:].upper()}", got, "export it again") from error
