"""A card whose left and right edges curl off the object, as badly glued paper does."""

from dataclasses import replace

import numpy as np

from patchproof.base.errors import Refused
from patchproof.mesh.surface_chart import piece_grid
from patchproof.scene.bend import PIECE_GRID, grid_faces
from patchproof.scene.placement import Placement


def curl_card(card: Placement, radius_mm: float) -> Placement:
    """Curl the left and right edges of a flat card off the object, on a cylinder that touches it along its middle.

    Nothing is fitted to the surface, and no gap is refused: badly glued paper does this.
    """
    if not card.is_flat:
        raise Refused("a flat card to curl", f"a piece on a {card.family}", "leave out bend")
    across, inward = card.world_from_piece[:3, [0, 2]].T
    points, width = piece_grid(card.size_mm, PIECE_GRID) * [1, -1] + np.array(card.size_mm) / 2, card.size_mm[0]
    scale = float(np.linalg.norm(across))  # a print may be larger than its millimeters say
    angle = (points[:, :1] - width / 2) * scale / radius_mm
    flat = np.concatenate([width / 2 + radius_mm / scale * np.sin(angle), points[:, 1:]], 1)
    offsets = radius_mm * (1 - np.cos(angle)) * inward
    normals = -np.sin(angle) * across / scale - np.cos(angle) * inward
    curled = replace(card, vertices_mm=card.world(flat) - offsets, faces=grid_faces(PIECE_GRID), normals=normals)
    return replace(curled, family="curled", piece_mm=points, reason=f"curled to a radius of {radius_mm:.0f} mm")
