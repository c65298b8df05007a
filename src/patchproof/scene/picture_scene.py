"""What scenes made of pictures share: photographs of an object (`photo_scene`) and folders of images (`image_scene`).

They have no mesh. A view is a base picture transformed onto the scene's photograph, and a homography that says where
the piece lies in it. Pictures of any size become `photo_px` so that their *centered squares* agree, because classifiers
see the centered square; beyond it a longer picture is cropped and a shorter one is mirrored at its edge. A square
`size_px` asks for that centered square alone, any other for the whole photograph. Left out on purpose: anything in
front of the piece (a hand, a handle); the new piece covers it.
"""

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.geometry import rect_corners, scaling_about
from patchproof.base.resample import halving_pyramid, index_homography
from patchproof.base.settings import SceneSettings
from patchproof.scene.conditions import Conditions, Stream
from patchproof.scene.interface import PX_PER_MODULE, READABLE_SHARE, PieceScene, measurable_text
from patchproof.sheets.piece import Piece

VIEWS_TRIED = 256  # for statistics over a scene's views
# A picture, uint8 H×W×3 sRGB, no larger than its photograph, and its halvings: a small view does not read megapixels.
PictureLevels = list[np.ndarray]


@dataclass(frozen=True)
class PictureScene(PieceScene):
    """A scene without a mesh, made of pictures; N is the number of conditions."""

    OMITTED = (
        "other viewpoints, backgrounds and lamps than the pictures show; what stands in front of the piece;",
        "curl: the piece is a plane",
    )

    def draw(self, stream: Stream, n: int, seed: int | None = None, start: int = 0, per_session: int = 1) -> Conditions:
        """Draw like `Scene.draw`, but choose the picture for each photograph: it decides the pose, too."""
        conditions = super().draw(stream, n, seed, start, per_session)
        return conditions if per_session == 1 else replace(conditions, pose=super().draw(stream, n, seed, start).pose)

    @abstractmethod
    def piece_light(self, conditions: Conditions) -> np.ndarray:
        """Implement `PieceScene.piece_light` with the light on the pictures' own paper."""

    def placement_summary(self) -> dict[str, Any]:
        """Implement `Scene.placement_summary`: the piece lies in a plane."""
        reason = "pictures say nothing of a surface: the piece is a plane that their homographies carry"
        return {"family": "plane", "size_mm": self.piece.size_mm, "reason": reason}

    def paper(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Implement `PieceScene.paper`: the plane z = 1 of the piece's millimeters, which homographies project."""
        corners = rect_corners((0, 0, *self.piece.size_mm))[[0, 1, 3, 2]]
        return np.concatenate([corners, np.ones((4, 1))], 1), np.broadcast_to([0.0, 0.0, -1.0], (4, 3)), corners

    def piece_azimuth_deg(self, conditions: Conditions) -> np.ndarray:
        """Return N NaN: a picture without a known camera does not say from where it was taken."""
        return np.full(len(conditions), np.nan)

    def white_light(self, conditions: Conditions) -> np.ndarray:
        """Return N: the light on white paper at the piece's middle, mean of the channels."""
        return self.piece_light(conditions)[:, :, 0].mean(1)

    def closest_px_per_mm(self, size_px: tuple[int, int]) -> float:
        """Return the pixels per millimeter of the piece in the closest view."""
        return float(self.piece_scales(self.draw("select", VIEWS_TRIED, 0), size_px).max())

    @property
    def unreadable_share(self) -> float:
        """The share of views in which a marker's module is under `PX_PER_MODULE` along its foreshortened side."""
        if not self.piece.markers:
            return 0.0
        scales = self.piece_scales(self.draw("select", VIEWS_TRIED, 0), self.photo_px, shorter=True)
        return float((scales * self.piece.module_mm < PX_PER_MODULE * 0.999).mean())

    @property
    def warnings(self) -> tuple[str, ...]:
        """The scene's notes, and a warning if more than one view in twenty shows markers that cannot be read."""
        share = self.unreadable_share
        if share <= 1 - READABLE_SHARE:
            return self.notes
        return (*self.notes, f"{measurable_text(share, 'plane')}: {self.piece.marker_mm:.1f} mm markers are too small")


def picture_for(srgb: np.ndarray, photo_px: tuple[int, int]) -> tuple[PictureLevels, np.ndarray]:
    """Return the picture, no larger than the photograph, and `photo_from_picture` 3×3 from pixels of `srgb`."""
    height, width = srgb.shape[:2]
    scale = min(photo_px) / min(width, height)
    size = (width, height)
    if scale < 1:
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        srgb = cv2.resize(srgb, size, interpolation=cv2.INTER_AREA)
    return halving_pyramid(srgb), photo_from(size, photo_px) @ np.diag([size[0] / width, size[1] / height, 1.0])


def photo_from(picture_px: tuple[int, int], photo_px: tuple[int, int]) -> np.ndarray:
    """Return 3×3 from a picture's pixels to the photograph's, with which shorter sides and middles agree."""
    scale = min(photo_px) / min(picture_px)
    shift = (np.array(photo_px) - scale * np.array(picture_px)) / 2
    return np.array([[scale, 0, shift[0]], [0, scale, shift[1]], [0, 0, 1.0]])


def size_from_photo(photo_px: tuple[int, int], size_px: tuple[int, int]) -> np.ndarray:
    """Return 3×3 from the photograph's pixels to a view's: the whole photograph or, if square, its centered square."""
    if size_px[0] == size_px[1]:
        return photo_from(photo_px, size_px)
    return np.diag([size_px[0] / photo_px[0], size_px[1] / photo_px[1], 1.0])


def print_scalings(piece: Piece, conditions: Conditions) -> np.ndarray:
    """Return N×3×3 from the sheet's millimeters to those of a print of another size about the same middle."""
    return scaling_about(np.array(piece.size_mm) / 2, conditions.pose.printed_scale)


def similarity_matrix(roll_deg: float, zoom: float, shift_px, about_px) -> np.ndarray:
    """Return the 3×3 similarity of a picture when its camera turns clockwise: the picture turns the other way."""
    c, s = zoom * np.cos(np.radians(roll_deg)), zoom * np.sin(np.radians(roll_deg))
    rotation = np.array([[c, s], [-s, c]])
    matrix = np.eye(3)
    matrix[:2, :2], matrix[:2, 2] = rotation, np.asarray(about_px) + shift_px - rotation @ about_px
    return matrix


def warp_picture(
    levels: PictureLevels, view_from_photo: np.ndarray, photo_px: tuple[int, int], size_px: tuple[int, int]
) -> np.ndarray:
    """Return the picture, uint8 H×W×3, transformed by `view_from_photo`, reduced by area, mirrored at its edge."""
    samples = 2 if min(size_px) < min(photo_px) else 1  # two per pixel each way prevent aliasing in a reduced picture
    size = (samples * size_px[0], samples * size_px[1])
    height, width = levels[0].shape[:2]
    view_from_picture = size_from_photo(photo_px, size) @ view_from_photo @ photo_from((width, height), photo_px)
    reduced = levels[0]
    for level in levels[1:]:
        # a level must not be coarser than the samples
        if abs(np.linalg.det(view_from_picture[:2, :2])) ** 0.5 * width / level.shape[1] > 1:
            break
        reduced = level
    to_level = np.diag([width / reduced.shape[1], height / reduced.shape[0], 1.0])
    index_from_size = index_homography(np.linalg.inv(view_from_picture @ to_level))
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    view = cv2.warpAffine(reduced, index_from_size[:2], size, flags=flags, borderMode=cv2.BORDER_REFLECT)
    return view if samples == 1 else cv2.resize(view, size_px, interpolation=cv2.INTER_AREA)


def pick_indices(choice: np.ndarray, count: int) -> np.ndarray:
    """Turn numbers in [0, 1) into indices below `count`."""
    return np.minimum((choice * count).astype(np.int64), count - 1)


def refuse_bending(settings: SceneSettings) -> None:
    """Refuse `patch.bend`: pictures do not show a surface that a piece could bend along."""
    if settings.patch.bend:
        expected = "a flat patch where the object is known from pictures alone"
        raise Refused(expected, "bend = true", "give a mesh instead")
