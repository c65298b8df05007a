"""What may be optimized: a design, of a printed piece or of the object's own texture.

In: a scene. Out: a `Subject`, which says where a design starts, what may become of it, what it costs, how it looks and
what files a run keeps of it. A design is a float tensor 3×h×w in [0, 1], its `pixels` are uint8 h×w×3. Patches and
textures have a module each, of which a scene loads its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import ClassVar, Protocol, Self

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from patchproof.base.input import open_image
from patchproof.base.output import write_atomically
from patchproof.channel.printer import Printer
from patchproof.render.pixels import Appearance
from patchproof.scene.interface import Scene

DESIGN_FILE, OBJECT_FILE, TEXTURE_FILES, MASK_FILE = "design.png", "object.glb", "texture_*.png", "mask.png"


@dataclass(frozen=True)
class Grid:
    """How fine a design is: its pixels, as optimized and as printed (None of textures, which keep their own sizes and
    are not printed), and how many there are, in all and per millimeter of a side.
    """

    design_px: tuple[int, int] | None
    printed_px: tuple[int, int] | None
    printed_px_per_mm: float | None
    texels: int
    texels_per_mm: float


class Subject(Protocol):
    """What the loop, the promise and studies ask of what is optimized; what is not printed is shown as it is."""

    STAGE_NAME: ClassVar[str]  # what turns a design into what is shown

    def start(self) -> Tensor:
        """The design before the first step."""
        ...

    def clipped(self, design: Tensor) -> Tensor:
        """The nearest design that is allowed."""
        ...

    def levels(self, gradient: Tensor) -> tuple[Tensor, ...]:
        """The gradient's pyramid."""
        ...

    def joined(self, updates: Sequence[Tensor]) -> Tensor:
        """The update of a design that the pyramid's own add up to."""
        ...

    def penalty(self, design: Tensor) -> Tensor | float:
        """What the scene's settings charge a design for."""
        ...

    def pixels(self, design: Tensor) -> np.ndarray:
        """What is printed or stored of a design."""
        ...

    def control(self, kind: str, pixels: np.ndarray) -> np.ndarray:
        """What the control of this kind has in place of the design's pixels."""
        ...

    def shown(self, design: Tensor, kind: str = "design") -> Appearance:
        """What photographs show of a design, or of a control with the markers of its own sheet; differentiable."""
        ...

    def printed(self, design: Tensor) -> Tensor:
        """What all pictures of an optimized design have in common, so that a step makes it once; differentiable."""
        return design

    def showing(self, printed: Tensor) -> Appearance:
        """What photographs show of that; differentiable."""
        return self.shown(printed)

    def with_printer(self, printer: Printer) -> Self:
        """The same subject as another printer prints it."""
        return self

    @property
    def grid(self) -> Grid:
        """How fine designs are."""
        ...

    def save(self, pixels: np.ndarray, folder: Path) -> None:
        """Write the files that a run keeps of its design; earlier ones are replaced only by complete ones."""
        ...

    def file(self, pixels: np.ndarray) -> tuple[str, bytes]:
        """A file name's suffix, and the one file that shows the design to others."""
        ...


def subject_of(scene: Scene, printer: Printer, network_px: int, device: torch.device) -> Subject:
    """What a scene leaves open, before networks whose largest input has that side."""
    return _module_of(scene).subject_of(scene, printer, network_px, device)


def read_design(scene: Scene, folder: Path) -> np.ndarray:
    """The pixels that `Subject.save` wrote, to the bit; refused where they are not of this scene."""
    return _module_of(scene).read_design(scene, folder)


def _module_of(scene: Scene) -> ModuleType:
    return import_module(f"patchproof.optimizer.{'patch' if scene.HAS_PIECE else 'texture'}")


def write_png(path: Path, pixels: np.ndarray) -> None:
    """Replace a picture by uint8 pixels."""
    write_atomically(path, lambda part: Image.fromarray(pixels).save(part, "PNG"))


def read_png(path: Path) -> np.ndarray:
    """uint8 H×W×3 of a picture file that a run wrote."""
    with open_image(path, "a picture of this run", "optimize again") as image:
        return np.asarray(image.convert("RGB"))
