"""A stage: a scene's tensors on one device, set up once and photographed many times, and how designs look there.

In: a scene of any kind; a design, a float tensor in [0, 1]: 3×h×w of any grid for a piece, 3×1×M (the texels that may
change, texture by texture, by rows) for textures. Out: `Stage`: the piece as a surface of millimeters; for scenes with
a mesh, the object with its textures (scenes made of pictures have none); and of a design an `Appearance` for
`photograph`, differentiable in it: the whole printed piece with its markers, or the object's own textures.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import torch
from torch import Tensor

from patchproof.base.text import short_repr
from patchproof.channel.printer import Printer, load_printer
from patchproof.render.pixels import ObjectTextures, PiecePicture
from patchproof.render.surfaces import ObjectSurface, PieceSurface, object_surface, piece_surface
from patchproof.scene.interface import Scene, require_piece
from patchproof.scene.mesh_scene import require_mesh
from patchproof.sheets.piece import Piece, marker_image, with_ids

if TYPE_CHECKING:
    from patchproof.scene.texture_scene import Canvas


@dataclass(frozen=True, eq=False)
class PrintedPiece:
    """A piece as a printer prints it."""

    piece: Piece
    sheet_id: str
    printer: Printer
    device: torch.device

    def appearance(self, design: Tensor, kind: str = "design") -> PiecePicture:
        """Return the printed piece with a design 3×h×w, on the design's grid, and the markers of that kind of sheet."""
        height, width = design.shape[1:]
        markers, reserved = self._markers(kind, (width, height))
        return PiecePicture.of(torch.where(reserved, markers, self._printed(design)))

    @lru_cache(maxsize=8)  # noqa: B019 - it lives as long as its stage
    def _markers(self, kind: str, design_px: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """Return the printed markers of a kind of sheet, H×W×3, and the mask of them and their white, bool H×W×1."""
        # a control's markers have their own ids, like those that will be printed
        image, reserved = marker_image(with_ids(self.piece, self.sheet_id, kind), design_px)
        sent = torch.tensor(image, device=self.device).permute(2, 0, 1)
        return self._printed(sent), torch.tensor(reserved, device=self.device)[..., None]

    def _printed(self, srgb: Tensor) -> Tensor:
        """Print 3×H×W as sent; return H×W×3 as it looks on paper."""
        return self.printer.apply(srgb[None]).squeeze(0).permute(1, 2, 0)


@dataclass(frozen=True, eq=False)
class LearnedTextures:
    """The object's textures with some texels free to change: those of the canvas's masks."""

    canvas: "Canvas"
    device: torch.device

    def appearance(self, design: Tensor) -> ObjectTextures:
        """Return the object's textures with the texels 3×1×M of a design."""
        return ObjectTextures(tuple(self.filled(design)))

    def filled(self, design: Tensor) -> list[Tensor]:
        """Return the textures with a design's texels, H×W×3 per material."""
        rows = zip(self._originals, self.masks, design[:, 0].T.split(self._counts), strict=True)
        return [original.masked_scatter(mask[..., None], part) for original, mask, part in rows]

    def images(self, design: Tensor) -> list[Tensor]:
        """Return a design's texels as 3×H×W per material, 0 where nothing may change."""
        parts = zip(self.masks, design[:, 0].split(self._counts, 1), strict=True)
        return [part.new_zeros(3, *mask.shape).masked_scatter(mask, part) for mask, part in parts]

    def texels(self, textures: Sequence[np.ndarray]) -> np.ndarray:
        """Return the changeable texels of uint8 textures as uint8 1×M×3."""
        return np.concatenate([texture[mask] for texture, mask in zip(textures, self.canvas.mask, strict=True)])[None]

    def textures(self, pixels: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return whole uint8 textures with a design's pixels 1×M×3 in them."""
        design = torch.tensor(pixels, dtype=torch.float32, device=self.device).permute(2, 0, 1) / 255
        return tuple((texture * 255).round().byte().cpu().numpy() for texture in self.filled(design))

    @cached_property
    def masks(self) -> tuple[Tensor, ...]:
        """Masks of each texture's changeable texels, bool H×W."""
        return tuple(torch.as_tensor(mask, device=self.device) for mask in self.canvas.mask)

    @cached_property
    def _counts(self) -> list[int]:
        return [int(mask.sum()) for mask in self.masks]

    @cached_property
    def _originals(self) -> tuple[Tensor, ...]:
        textures = (material.texture_srgb for material in self.canvas.mesh.materials)  # each has one
        return tuple(torch.tensor(t, dtype=torch.float32, device=self.device) / 255 for t in textures if t is not None)


@dataclass(frozen=True)
class Stage:
    """A scene on `device`; `object` is None for scenes made of pictures."""

    scene: Scene
    device: torch.device
    object: ObjectSurface | None
    SHOWN: ClassVar[tuple[str, ...]] = ("scene", "device")
    __repr__ = short_repr

    @cached_property
    def design_renderer(self) -> PrintedPiece | LearnedTextures:
        """Renders designs as they look here: as the scene's printer prints them, or as textures."""
        if not self.scene.HAS_PIECE:
            return LearnedTextures(self.scene.object_canvas(), self.device)
        scene = require_piece(self.scene)
        printer = load_printer(scene.settings.printer.profile, scene.base)
        return PrintedPiece(scene.piece, scene.sheet_id, printer, self.device)

    @property
    def object_surface(self) -> ObjectSurface:
        """The object's surface; a ValueError if there is none."""
        if self.object is None:
            raise ValueError("a scene made of pictures has no object's surface")
        return self.object

    @cached_property
    def piece_surface(self) -> PieceSurface:
        """The piece's surface; refused for a scene without a piece."""
        return piece_surface(require_piece(self.scene), self.device)


def set_stage(scene: Scene, device: torch.device | str = "cpu") -> Stage:
    """Move a scene's mesh, textures and piece to a device, "cpu" or "cuda"; torch raises RuntimeError without it."""
    device = torch.device(device)
    return Stage(scene, device, object_surface(require_mesh(scene).mesh, device) if scene.HAS_OBJECT else None)
