"""The SUV's painted faces, a number a line: `python suv_paint.py > suv_paint.txt`.

Painted is a face of the body that is light in nine tenths of its own texture; windows, grille and chassis are dark.
"""

import os
from pathlib import Path

import numpy as np

from patchproof.mesh.load_mesh import load_mesh

LIGHT, SHARE = 110, 0.9
mesh = load_mesh(Path(os.environ["PATCHPROOF_DATA"]) / "meshes/gz_suv.glb", 480)
body = int(np.argmax(np.bincount(mesh.face_material)))  # the other material is the wheels'
texture = mesh.materials[body].texture_srgb[..., :3].mean(2)
weights = np.random.default_rng(0).dirichlet([1, 1, 1], 64)
uv = np.einsum("sc,fck->fsk", weights, mesh.corner_uv) % 1
light = texture[tuple((uv[..., 1 - axis] * texture.shape[axis]).astype(int) for axis in (0, 1))] > LIGHT
painted = (light.mean(1) >= SHARE) & (mesh.face_material == body)
print("\n".join(map(str, np.flatnonzero(painted))))
