"""A stage: a scene's tensors on one device, set up once and photographed many times.

In: a scene of any kind. Out: `Stage`: the piece as a surface of millimeters; for scenes with a mesh, the object with
its textures; and the rendering of designs. Scenes made of pictures have no object.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import torch

from patchproof.base.text import short_repr
from patchproof.channel.printer import load_printer
from patchproof.render.designs import LearnedTextures, PrintedPiece
from patchproof.render.surfaces import ObjectSurface, PieceSurface, object_surface, piece_surface
from patchproof.scene.interface import Scene, require_piece
from patchproof.scene.mesh_scene import require_mesh

if TYPE_CHECKING:
    from patchproof.channel.lens import Camera


@dataclass(frozen=True)
class Stage:
    """A scene on `device`; `object` is None for scenes made of pictures, `piece` if nothing hangs on the object."""

    scene: Scene
    device: torch.device
    object: ObjectSurface | None
    piece: PieceSurface | None
    SHOWN: ClassVar[tuple[str, ...]] = ("scene", "device")
    __repr__ = short_repr

    @property
    def camera(self) -> "Camera | None":
        """The scene's calibrated camera, if any."""
        return self.scene.camera

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

    @property
    def piece_surface(self) -> PieceSurface:
        """The piece's surface; a ValueError if nothing hangs on the object."""
        if self.piece is None:
            raise ValueError("nothing hangs on the object")
        return self.piece


def set_stage(scene: Scene, device: torch.device | str = "cpu") -> Stage:
    """Move a scene's mesh, textures and piece to a device, "cpu" or "cuda"; torch raises RuntimeError without it."""
    device = torch.device(device)
    surface = object_surface(require_mesh(scene).mesh, device) if scene.HAS_OBJECT else None
    return Stage(scene, device, surface, piece_surface(require_piece(scene), device) if scene.HAS_PIECE else None)
