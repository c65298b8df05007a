"""The painted faces of a mesh, a number a line: `python paint.py gz_suv > suv_paint.txt` (also gz_pickup, gz_postbox).

Painted is a face of the largest material of which nine tenths are near the material's commonest color by area that is
not dark; windows, lamps, grille and chassis have others.
"""

import os
import sys
from pathlib import Path

import numpy as np

from patchproof.mesh.load_mesh import load_mesh

NEAR_CODES, SHARE, BINS, DARK = 60, 0.9, 8, 60
mesh = load_mesh(Path(os.environ["PATCHPROOF_DATA"]) / f"meshes/{sys.argv[1]}.glb", 480)
corners = mesh.vertices[mesh.faces]
area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
body = mesh.face_material == np.argmax(np.bincount(mesh.face_material))  # the other material is the wheels'
texture = mesh.materials[mesh.face_material[body][0]].texture_srgb[..., :3].astype(int)
weights = np.random.default_rng(0).dirichlet([1, 1, 1], 64)
uv = np.einsum("sc,fck->fsk", weights, mesh.corner_uv) % 1
colors = texture[tuple((uv[..., 1 - axis] * texture.shape[axis]).astype(int) for axis in (0, 1))]
bins = (colors // (256 // BINS) @ (1, BINS, BINS**2)).ravel()
light = colors.reshape(-1, 3).mean(1) > DARK
common = np.argmax(np.bincount(bins[light], (area * body).repeat(64)[light]))
near = np.abs(colors - colors.reshape(-1, 3)[bins == common].mean(0)).max(2) <= NEAR_CODES
print("\n".join(map(str, np.flatnonzero(body & (near.mean(1) >= SHARE)))))
print(f"{area[body & (near.mean(1) >= SHARE)].sum() / area.sum():.0%} of the surface", file=sys.stderr)
