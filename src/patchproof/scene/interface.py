"""The interface of scenes: what every scene offers, and what those with a printed piece offer in addition.

A scene is a mesh with a piece on it (`PatchScene`), one whose piece has no place yet (`UnplacedScene`), one with a
texture of its own that may change (`TextureScene`), or pictures: photographs of the object (`PhotoScene`) or a folder
of images (`ImageScene`). A module's `build` makes each from a `SceneSource`; the module `scene` chooses it. Code that
needs a piece calls `require_piece`, which refuses a scene without one. N is the number of conditions.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self, get_args

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.fingerprint import content_identity
from patchproof.base.geometry import apply_homography, local_scale
from patchproof.base.settings import SceneSettings, identity_settings
from patchproof.base.text import short_repr
from patchproof.base.validation import texts_in
from patchproof.scene.conditions import Conditions, Stream, draw
from patchproof.sheets.piece import Piece, sheet_id

if TYPE_CHECKING:
    from patchproof.channel.lens import Camera
    from patchproof.scene.texture_scene import Canvas

SCALE_VIEWS = 1024  # for quantiles over the views; the rule for the markers' size uses the same
PX_PER_MODULE = 2.5  # markers can be read from about this size on: 45 of 48 at 2.7 px with a blur of 0.7 px
READABLE_SHARE = 0.95  # of the views should show markers at least that large
_DESIGN_PX = (32, 512)


@dataclass(frozen=True)
class SceneSource:
    """The input of a scene: its settings, the folder that paths in them are relative to, and its seed; optionally the
    sheet id of its print, and the GLB of a mesh given in Python.
    """

    settings: SceneSettings
    base: Path
    seed: int
    printed_sheet_id: str | None = None
    mesh_glb: bytes | None = None

    def sheet_id(self, known: Mapping[str, str]) -> str:
        """Return the sheet id of the print, if any, else that of settings, seed and the `known` facts beside them."""
        return self.printed_sheet_id or _sheet_id(self.settings, self.base, known, self.seed)


@dataclass(frozen=True)
class SceneTerm:
    """A term of a scene's model that a simpler scene would leave out: its name, the settings key that governs it, if
    any, and if it needs whole photographs, because reduced ones do not show it as it is.
    """

    name: str
    key: str = ""
    needs_whole_photo: bool = False


@dataclass(frozen=True)
class Scene(ABC):
    """Everything that a photograph depends on except the design and the conditions."""

    settings: SceneSettings
    base: Path
    seed: int
    sheet_id: str
    notes: tuple[str, ...] = field(default=(), kw_only=True)  # warnings about the files that were read
    known: Mapping[str, str] = field(default_factory=dict, kw_only=True)  # enters the sheet id beside the settings
    camera: "Camera | None" = field(default=None, kw_only=True)  # a calibrated camera
    mesh_glb: bytes | None = field(default=None, kw_only=True)  # the mesh, if it was given in Python
    given_models: Mapping[str, Any] = field(default_factory=dict, kw_only=True)  # networks given in Python, by name
    inputs: Mapping[str, str] = field(default_factory=dict, kw_only=True)  # fingerprints by settings key
    recorded: Mapping[str, str] = field(default_factory=dict, kw_only=True)  # those of its run's networks
    received: Path | None = field(default=None, kw_only=True)  # the run's file, if its networks need the user's word

    HAS_OBJECT: ClassVar[bool] = False  # an object's surface before a background
    HAS_PIECE: ClassVar[bool] = False
    HAS_PLACE: ClassVar[bool] = True  # for the design; False if the place has to be searched for
    EFFECT_TABLES: ClassVar[tuple[str, ...]] = ("printer", "camera")  # of the settings: their effects show here
    TERMS: ClassVar[tuple[SceneTerm, ...]] = ()
    OMITTED: ClassVar[tuple[str, ...]] = ()  # effects that are not modeled
    SHOWN: ClassVar[tuple[str, ...]] = ("description", "settings.target.label", "sheet_id", "seed")

    def __init_subclass__(cls):
        cls.__repr__ = short_repr  # a dataclass would list all fields, a mesh among them

    @abstractmethod
    def description(self) -> str:
        """Describe in a few words what the scene is made of."""

    @abstractmethod
    def placement_summary(self) -> dict[str, Any]:
        """Describe how the design lies on the object: `family`, `size_mm`, `reason` and, on a mesh, the fit."""

    @abstractmethod
    def closest_px_per_mm(self, size_px: tuple[int, int]) -> float:
        """Return the pixels per millimeter of the design in the closest view."""

    @abstractmethod
    def px_per_mm(self, size_px: tuple[int, int], shorter: bool = False) -> np.ndarray:
        """Return the pixels per millimeter at the design's middle in each of `SCALE_VIEWS` views that face it: the mean
        over all directions, or that of the `shorter`, foreshortened one.
        """

    @abstractmethod
    def pictures(self, conditions: Conditions, size_px: tuple[int, int]) -> np.ndarray:
        """Return N×H×W×3 uint8 sRGB: the views behind object and piece, before exposure and the camera's effects."""

    def boxes(self, conditions: Conditions) -> np.ndarray | None:
        """Return the object's N×4 (left, top, right, bottom) in shares of the centered square; None if unknown."""
        return None

    @property
    def networks(self) -> list[Any]:
        """The networks that its settings name: those given in Python, and names of the others."""
        return [self.given_models.get(name, name) for name in self.settings.target.models]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings for whoever reads results of the scene."""
        return self.notes

    @property
    def photo_px(self) -> tuple[int, int]:
        """The size of the whole photographs that the scene makes."""
        return self.settings.camera.photo_px

    @property
    def focal_px(self) -> float | None:
        """The focal length of whole photographs; None for scenes made of pictures, which do not know it."""
        return None

    def draw(self, stream: Stream, n: int, seed: int | None = None, start: int = 0, per_session: int = 1) -> Conditions:
        """Draw from one of the scene's streams, with the scene's seed unless another is given; `per_session`
        consecutive draws are one session. The promise's stream depends on everything that the scene file says: a user
        who tries one change after the other does not meet the same few conditions each time.
        """
        seed = self.seed if seed is None else seed
        if stream not in get_args(Stream) or not all(isinstance(value, Integral) and value >= 0 for value in (n, seed)):
            expected = f"a stream ({', '.join(get_args(Stream))}), n and a seed as whole numbers"
            raise Refused(expected, f"{stream}, {n!r}, {seed!r}", "correct these")
        n, seed, start = map(int, (n, seed, start))  # NumPy's numbers, too
        return draw(self.settings, stream, n, seed, start, per_session, self.sheet_id if stream == "promise" else "")

    def with_template(self, name: str) -> Self:
        """Return the scene for a page of another template, with that page's sheet id and, if any, piece."""
        is_same = name == self.settings.sheet.template
        return self if is_same else self._identified(self.settings.changed(sheet={"template": name}), self.known)

    def with_steps(self, steps: int | None) -> Self:
        """Return the scene with another number of optimizer steps; the scene itself for None and its own."""
        is_same = steps in (None, self.settings.optimize.steps)
        return self if is_same else self._identified(self.settings.changed(optimize={"steps": steps}), self.known)

    def for_design(self, sha256: str) -> Self:
        """Return the scene of a design that exists before its run. The design decides its sheet id, and thus its
        markers, which tell photographs of several designs in one scene apart.
        """
        return self._identified(self.settings, {**self.known, "design": sha256})

    def _identified(self, settings: SceneSettings, known: Mapping[str, str]) -> Self:
        """Return the scene with the sheet id of these settings and other known facts."""
        identity = _sheet_id(settings, self.base, known, self.seed)
        return replace(self, settings=settings, known=known, sheet_id=identity)._laid_out()

    def _laid_out(self) -> Self:
        """Return the scene with its piece laid out for its page and sheet id."""
        return self

    def without(self, term: SceneTerm) -> Self | None:
        """Return the scene without one of its `TERMS`; None if it has nothing of it."""
        raise ValueError(f"{self.description()} without {term.name}")

    def picture_blur_and_noise(self, conditions: Conditions) -> tuple[np.ndarray, np.ndarray]:
        """Return N Gaussian sigmas of the base pictures' blur, in pixels of the whole photograph, and N standard
        deviations of their noise at white, in its linear light.
        """
        return np.zeros(len(conditions)), np.zeros(len(conditions))

    def object_canvas(self) -> "Canvas":
        """Return the object's texture, if that is what may change; refused for any other scene."""
        refuse_without_place(self)
        raise Refused("a scene of the object's own texture", "a scene of a patch", 'set patch.kind = "texture"')

    def record(self) -> dict[str, Any] | None:
        """Return run.json's record of the piece and how well it fits; None without a piece."""
        return None

    def facing(self, conditions: Conditions) -> np.ndarray:
        """Return N bool: the views that do not show the design from behind."""
        return np.ones(len(conditions), bool)


@dataclass(frozen=True)
class PieceScene(Scene):
    """A scene with a printed piece."""

    piece: Piece
    HAS_PIECE = True

    @abstractmethod
    def paper(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the piece as a grid by rows: vertices V×3 in the world, their normals V×3 out of the printed face, and
        their millimeters V×2 on the flat piece.
        """

    @property
    @abstractmethod
    def unreadable_share(self) -> float:
        """The share of views in which a module of the piece's markers is under `PX_PER_MODULE`."""

    @abstractmethod
    def piece_homographies(self, conditions: Conditions, size_px: tuple[int, int]) -> np.ndarray:
        """Return N×3×3 from piece millimeters (if bent, its tangent plane's) to pixels of the pinhole picture."""

    @abstractmethod
    def piece_azimuth_deg(self, conditions: Conditions) -> np.ndarray:
        """Return N angles of the camera to the right of the piece's middle, beyond 90 if its face is turned away; NaN
        for pictures, which do not say from where they were taken.
        """

    @abstractmethod
    def white_light(self, conditions: Conditions) -> np.ndarray:
        """Return N: the light on white paper at the piece's middle, mean of the channels."""

    def piece_px(self, conditions: Conditions, piece_mm: np.ndarray) -> np.ndarray:
        """Return the pixels M×2 of points M×2 of the piece in the whole photograph of the first condition, also through
        bent paper and a lens that bends; NaN behind the camera.
        """
        return apply_homography(self.piece_homographies(conditions, self.photo_px)[0], piece_mm)

    def piece_light(self, conditions: Conditions) -> np.ndarray | None:
        """Return N×3×6: linear light of white paper is coefficients · [1, u, v, u², uv, v²], u and v from -1 to 1 over
        the piece, right and down; None if the scene's lamps light it.
        """
        return None

    @property
    def is_flat(self) -> bool:
        """True if piece and lens are flat, so that photographs are homographies of the sheet."""
        return True

    def facing(self, conditions: Conditions) -> np.ndarray:
        """Return N bool: the views that do not show the piece from behind; pictures with unknown angles do not."""
        return ~(np.abs(self.piece_azimuth_deg(conditions)) >= 90)

    def px_per_mm(self, size_px: tuple[int, int], shorter: bool = False) -> np.ndarray:
        """Implement `Scene.px_per_mm` at the piece's middle."""
        conditions = self.draw("select", SCALE_VIEWS, 0)
        return self.piece_scales(conditions[self.facing(conditions)], size_px, shorter)

    def piece_scales(self, conditions: Conditions, size_px: tuple[int, int], shorter: bool = False) -> np.ndarray:
        """Return N pixels per millimeter at the piece's middle: mean of all directions, or the `shorter` one's."""
        scales = self.scales_and_tilts(conditions, size_px)
        return np.array([mean * np.sqrt(np.cos(np.radians(tilt))) if shorter else mean for mean, tilt in scales])

    def scales_and_tilts(self, conditions: Conditions, size_px: tuple[int, int]) -> np.ndarray:
        """Return N×2: pixels per millimeter at the piece's middle, and its tilt in degrees."""
        return local_scale(self.piece_homographies(conditions, size_px), np.array(self.piece.size_mm) / 2)

    def design_px(self, network_px: int) -> tuple[int, int]:
        """Return (width, height) of the design in multiples of 8, one texel per pixel of the closest view at the
        network's size.

        Finer grids cost time and gained nothing beyond chance: after 60 steps with a network of 224 px the selection
        loss was 0.73, 0.79 and 0.75 with 0.7, 1 and 1.5 texels per pixel (one seed).
        """
        (low, high), piece_mm = _DESIGN_PX, self.piece.size_mm
        scale = np.clip(self.closest_px_per_mm((network_px, network_px)), low / min(piece_mm), high / max(piece_mm))
        width, height = (max(8, round(side * scale / 8) * 8) for side in piece_mm)
        return width, height

    def record(self) -> dict[str, Any]:
        """Return run.json's record of the piece."""
        piece = self.piece
        return {"piece_mm": piece.size_mm, "marker_mm": piece.marker_mm, "unreadable_share": self.unreadable_share}


def _sheet_id(settings: SceneSettings, base: Path, known: Mapping[str, str], seed: int) -> str:
    identity = identity_settings(settings)
    is_primitive = (settings.object.mesh or "").startswith("primitive:") and settings.background.images is None
    if not is_primitive or any("." in text or "/" in text for text in texts_in(identity)):  # a file's name
        identity = content_identity(settings, base)
    return sheet_id(identity | dict(known), seed)


def fit_text(fit: Mapping[str, Any]) -> str:
    """Say how a piece lies on its surface, by the scene's `placement_summary`."""
    gaps = f"gap {fit['gap_mm']:.2f} mm at most, {fit['gap_mean_mm']:.2f} mm on average"
    return f"{gaps}; {fit['overhang_share']:.1%} overhangs"


def measurable_text(unreadable_share: float, family: str) -> str:
    """Say how many photographs of a piece on a surface of that family can be measured."""
    return f"{'at most' if family == 'cylinder' else 'about'} {1 - unreadable_share:.0%} of photographs can be measured"


def require_piece(scene: Scene, do: str = "take object.glb and textures from the run") -> PieceScene:
    """Return the scene as one with a printed piece; refused if only the object's own texture changes."""
    if isinstance(scene, PieceScene):
        return scene
    refuse_without_place(scene)
    raise Refused("a run of a patch", "a run of the object's own texture", do)


def refuse_without_place(scene: Scene) -> None:
    """Refuse a scene whose piece has no place yet."""
    if not scene.HAS_PLACE:
        remedy = "choose a place with choose_place, or give one"
        raise Refused("a scene whose piece has a place", 'patch.place = "auto"', remedy)
