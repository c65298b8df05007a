"""What every scene answers, whatever it is made of, and what those with a printed piece answer beside that.

A scene is a mesh with a piece on it (`PatchScene`; bent: `BentScene`), one whose piece has no place yet (`OpenScene`),
one with a texture of its own that may change (`TextureScene`), or pictures: photographs of the object (`PhotoScene`) or
a folder of images (`ImageScene`). Each has a module of its own, whose `build` makes it of a `SceneSource`; `scene`
knows which. Who needs a piece asks `require_piece`, which refuses where there is none. N is the number of conditions.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.geometry import apply_homography, local_scales
from patchproof.base.settings import SceneSettings, identity_settings
from patchproof.channel.effects import ViewEffect
from patchproof.scene.conditions import Conditions, Stream, draw
from patchproof.sheets.piece import Piece, sheet_id

if TYPE_CHECKING:
    from patchproof.channel.lens import Camera
    from patchproof.scene.canvas import Canvas

SCALE_VIEWS = 1024  # for quantiles over the views; as many as the marker rule looks at
PX_PER_MODULE = 2.5  # a marker is read from about here on: 45 of 48 at 2.7 px with a blur of 0.7 px
READABLE_SHARE = 0.95  # of the views should show markers at least that large
_DESIGN_PX = (32, 512)


@dataclass(frozen=True)
class SceneSource:
    """What a scene is built from: its settings, the folder that paths in them are relative to, and its seed; where
    there are such, the sheet id that it was printed with, and the mesh that was given in Python.
    """

    settings: SceneSettings
    base: Path
    seed: int
    printed_sheet_id: str | None = None
    mesh_glb: bytes | None = None

    def sheet_id(self, known: Mapping[str, str]) -> str:
        """The one that it was printed with, else that of its settings, seed and of what is `known` beside them."""
        return self.printed_sheet_id or sheet_id(identity_settings(self.settings) | dict(known), self.seed)


@dataclass(frozen=True)
class SceneTerm:
    """What a scene itself models and a simpler one would not: its name, the settings key that governs it, if any,
    and whether it needs whole photographs to be seen as it is.
    """

    name: str
    key: str = ""
    whole: bool = False


@dataclass(frozen=True)
class Scene(ABC):
    """Everything a photograph depends on but what is optimized and the conditions."""

    settings: SceneSettings
    base: Path
    seed: int
    sheet_id: str
    notes: tuple[str, ...] = field(default=(), kw_only=True)  # warnings of what was read
    known: Mapping[str, str] = field(default_factory=dict, kw_only=True)  # beside settings, what the sheet id tells
    camera: Camera | None = field(default=None, kw_only=True)  # a calibrated one
    mesh_glb: bytes | None = field(default=None, kw_only=True)  # the mesh, where it was given in Python
    given_models: Mapping[str, Any] = field(default_factory=dict, kw_only=True)  # networks given in Python, by name

    HAS_OBJECT: ClassVar[bool] = False  # a surface of its own before what is behind it
    HAS_PIECE: ClassVar[bool] = False
    HAS_PLACE: ClassVar[bool] = True  # for what is optimized; False where it has to be searched for
    EFFECT_TABLES: ClassVar[tuple[str, ...]] = ("printer", "camera")  # of the settings, whose effects show in it
    TERMS: ClassVar[tuple[SceneTerm, ...]] = ()
    OMITTED: ClassVar[tuple[str, ...]] = ()  # what is not modeled

    @abstractmethod
    def description(self) -> str:
        """What the scene is made of, in a few words."""

    @abstractmethod
    def lies(self) -> dict[str, Any]:
        """How what is optimized lies on the object: `family`, `size_mm`, `reason` and, of a mesh, how well it fits."""

    @abstractmethod
    def closest_px_per_mm(self, size_px: tuple[int, int]) -> float:
        """Pixels per millimeter of what is optimized in the closest view."""

    @abstractmethod
    def px_per_mm(self, size_px: tuple[int, int], shorter: bool = False) -> np.ndarray:
        """The same at its middle in each of `SCALE_VIEWS` views that face it: the mean of all directions, or along the
        `shorter`, foreshortened one.
        """

    @abstractmethod
    def pictures(self, conditions: Conditions, size_px: tuple[int, int]) -> np.ndarray:
        """N×H×W×3 uint8 sRGB: what the views show behind object and piece, before exposure and the camera's effects."""

    def boxes(self, conditions: Conditions) -> np.ndarray | None:
        """N×4 (left, top, right, bottom) of the object in each photograph's centered square, as shares of its side;
        None where nobody knows.
        """
        return None

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a reader should know."""
        return self.notes

    @property
    def photo_px(self) -> tuple[int, int]:
        """Size of the whole photographs that the scene makes."""
        return self.settings.camera.photo_px

    @property
    def focal_px(self) -> float | None:
        """The focal length of those; None of pictures, of which nobody knows it."""
        return None

    def draw(self, stream: Stream, n: int, seed: int | None = None, start: int = 0, per_session: int = 1) -> Conditions:
        """Draws of one of the scene's streams, from the scene's own seed unless another is given; `per_session` in a
        row are of one session. Those that promise depend on all that the scene file says, so that who tries one change
        after the other does not meet the same few conditions each time.
        """
        seed = self.seed if seed is None else seed
        return draw(self.settings, stream, n, seed, start, per_session, self.sheet_id if stream == "promise" else "")

    def with_template(self, name: str) -> Self:
        """The scene for a page of another template: its sheet id and, where there is one, its piece anew."""
        if name == self.settings.sheet.template:
            return self
        return self._identified(self.settings.changed(sheet={"template": name}), self.known)

    def of_design(self, sha256: str) -> Self:
        """The scene of a design that is there before its run: its sheet id, and so its markers, are the design's own,
        by which photographs of several designs on one scene are told apart.
        """
        return self._identified(self.settings, {**self.known, "design": sha256})

    def _identified(self, settings: SceneSettings, known: Mapping[str, str]) -> Self:
        """The scene with the sheet id of these settings and of what else is known."""
        identity = sheet_id(identity_settings(settings) | dict(known), self.seed)
        return replace(self, settings=settings, known=known, sheet_id=identity)._laid_out()

    def _laid_out(self) -> Self:
        """The scene with its piece laid out for its page and sheet id."""
        return self

    def models(self, effect: ViewEffect) -> bool:
        """Whether an effect shows in the scene's photographs where its settings turn it on."""
        return effect.keys[0].partition(".")[0] in self.EFFECT_TABLES

    def without(self, part: SceneTerm) -> Self | None:
        """The scene without one of its `TERMS`; None where it has nothing of it."""
        raise ValueError(f"{self.description()} without {part.name}")

    def picture_blur_and_noise(self, conditions: Conditions) -> tuple[np.ndarray, np.ndarray]:
        """N Gaussian sigmas of the base pictures' own blur, in pixels of the whole photograph, and N standard
        deviations of their noise at white, in its linear light.
        """
        return np.zeros(len(conditions)), np.zeros(len(conditions))

    def object_canvas(self) -> Canvas:
        """The object's own texture, where that is what may change; refused of any other scene."""
        refuse_without_place(self)
        raise Refused("a scene of the object's own texture", "one of a patch", 'set patch.kind = "texture"')

    def record(self) -> dict[str, Any] | None:
        """What run.json says of the piece and how well it fits; None where there is none."""
        return None

    def facing(self, conditions: Conditions) -> np.ndarray:
        """N bool: the views that do not show what is optimized from behind."""
        return np.ones(len(conditions), bool)


@dataclass(frozen=True)
class PieceScene(Scene):
    """A scene in which a printed piece hangs."""

    piece: Piece
    HAS_PIECE = True

    @abstractmethod
    def paper(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The piece as a grid by rows of vertices V×3 in the world, their normals V×3 out of the printed face, and
        their millimeters V×2 on the flat piece.
        """

    @property
    @abstractmethod
    def unreadable_share(self) -> float:
        """The share of the views in which a module of the piece's markers is under `PX_PER_MODULE`."""

    @abstractmethod
    def piece_homographies(self, conditions: Conditions, size_px: tuple[int, int]) -> np.ndarray:
        """N×3×3 from piece millimeters to pixels of the pinhole picture; of a bent piece, its tangent plane's."""

    @abstractmethod
    def piece_azimuth_deg(self, conditions: Conditions) -> np.ndarray:
        """N angles of the camera to the right of the piece's middle, beyond 90 where its face is turned away; NaN of
        pictures, which do not say from where they were taken.
        """

    @abstractmethod
    def white_light(self, conditions: Conditions) -> np.ndarray:
        """N: the light on white paper at the piece's middle, mean of the channels."""

    def piece_px(self, conditions: Conditions, piece_mm: np.ndarray) -> np.ndarray:
        """Pixels M×2 of points M×2 of the piece in the whole photograph of the first condition, through bent paper and
        a bent picture, too; NaN behind the camera.
        """
        return apply_homography(self.piece_homographies(conditions, self.photo_px)[0], piece_mm)

    def piece_light(self, conditions: Conditions) -> np.ndarray | None:
        """N×3×6: linear light of white paper is coefficients · [1, u, v, u², uv, v²], u and v from -1 to 1 over the
        piece, right and down; None where it is the scene's lamps that light it.
        """
        return None

    @property
    def is_flat(self) -> bool:
        """Whether piece and lens are flat, so that photographs are homographies of the sheet."""
        return True

    def with_print_scale(self, scale: tuple[float, float]) -> PieceScene:
        """The scene with a piece printed larger or smaller along x and y, hung up at the same middle; piece millimeters
        stay the sheet's own.
        """
        if scale == (1.0, 1.0):
            return self
        raise Refused("a scene with a mesh for a print of another size", "one of pictures", "leave --print-scale out")

    def facing(self, conditions: Conditions) -> np.ndarray:
        """N bool: the views that do not show the piece from behind; unknown angles are of pictures that show it."""
        return ~(np.abs(self.piece_azimuth_deg(conditions)) >= 90)

    def px_per_mm(self, size_px: tuple[int, int], shorter: bool = False) -> np.ndarray:
        """As in `Scene.px_per_mm`, at the piece's middle."""
        conditions = self.draw("select", SCALE_VIEWS, 0)
        return self.piece_scales(conditions[self.facing(conditions)], size_px, shorter)

    def piece_scales(self, conditions: Conditions, size_px: tuple[int, int], shorter: bool = False) -> np.ndarray:
        """N pixels per millimeter at the piece's middle, along the `shorter` side or the mean of all directions."""
        scales = self.scales_and_tilts(conditions, size_px)
        return np.array([mean * np.sqrt(np.cos(np.radians(tilt))) if shorter else mean for mean, tilt in scales])

    def scales_and_tilts(self, conditions: Conditions, size_px: tuple[int, int]) -> np.ndarray:
        """N×2: pixels per millimeter at the piece's middle, and its tilt in degrees."""
        middle = np.array(self.piece.size_mm) / 2
        return local_scales(self.piece_homographies(conditions, size_px), middle)

    def design_px(self, network_px: int) -> tuple[int, int]:
        """(width, height) of the design in multiples of 8, one texel per pixel of the closest view before the network.

        Finer grids cost time and bought nothing that can be told from chance: after 60 steps before a network of 224 px
        the selection loss was 0.73, 0.79 and 0.75 with 0.7, 1 and 1.5 texels per pixel (one seed).
        """
        (low, high), piece_mm = _DESIGN_PX, self.piece.size_mm
        scale = np.clip(self.closest_px_per_mm((network_px, network_px)), low / min(piece_mm), high / max(piece_mm))
        width, height = (max(8, round(side * scale / 8) * 8) for side in piece_mm)
        return width, height

    def record(self) -> dict[str, Any]:
        """What run.json says of the piece."""
        piece = self.piece
        return {"piece_mm": piece.size_mm, "marker_mm": piece.marker_mm, "unreadable_share": self.unreadable_share}


def require_piece(scene: Scene, do: str = "take object.glb and textures from the run") -> PieceScene:
    """The scene as one with a printed piece; refused where there is only the object's own texture."""
    if isinstance(scene, PieceScene):
        return scene
    refuse_without_place(scene)
    raise Refused("a run of a patch", "one of the object's own texture", do)


def refuse_without_place(scene: Scene) -> None:
    """Refuse a scene whose piece has to be placed first."""
    if not scene.HAS_PLACE:
        do = "choose one with choose_place, or give one"
        raise Refused("a scene whose piece has its place", 'patch.place = "auto"', do)
