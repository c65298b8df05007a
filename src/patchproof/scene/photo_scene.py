"""A scene of photographs: the object as it was seen with a blank sheet on it; no mesh, and only light is modeled.

In: a folder of photographs and the blank sheet's manifest. Out: `PhotoScene`. Markers give the homography from the
piece to each photograph, white paper the light on it, marker borders its blur, the paper's grain its noise. The new
piece has the blank's geometry and takes its place. Views vary around the photographs: in the photograph, in zoom, roll
and a shift of the whole picture, and in exposure and white balance as a camera would set them.

A promise of such a scene covers these photographed places and lights and mild changes of them, because all streams draw
from the same few photographs. It does not cover other viewpoints, backgrounds or lamps: photograph them, too.

Light is read from paper alone, since the printer of the swatches is not known. Left out on purpose: shine on the piece
(paper in glare counts as an outlier), veiling glare (black ink is as dark as the printer makes it), and whatever stood
in front of the piece. Photographs that cannot be used get the code that a judged photograph would get.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.fingerprint import files_sha256
from patchproof.base.geometry import is_inside
from patchproof.base.input import is_folder
from patchproof.base.settings import SceneSettings
from patchproof.base.validation import expand_path
from patchproof.photo.detect import find_markers
from patchproof.photo.known_page import complete_markers
from patchproof.photo.limits import run_limited
from patchproof.photo.paper_light import PaperLight, paper_light
from patchproof.photo.quality import blur_px
from patchproof.photo.read import list_images, read_photo, subfolders, summarize_said
from patchproof.photo.rectify import PageFit, corner_uncertainty_mm, fit_page
from patchproof.photo.rejection import PhotoRejected
from patchproof.scene import picture_scene
from patchproof.scene.conditions import Conditions
from patchproof.scene.interface import SceneSource, SceneTerm
from patchproof.scene.picture_scene import PictureLevels, PictureScene
from patchproof.sheets.blank import blank_piece
from patchproof.sheets.manifest import Manifest, load_manifest
from patchproof.sheets.markers import DICTIONARY
from patchproof.sheets.page import refuse_larger_than_page
from patchproof.sheets.piece import Piece, marker_rect, with_ids
from patchproof.sheets.template import page_template

MIN_PHOTOS = 6
_MAX_BLUR_MODULES = 0.4  # Gaussian sigma: up to here it is measured within a tenth, beyond it too small
_MAX_RESIDUAL_SHARE = 0.01  # of the piece's shorter side, as in verify
_MAX_UNCERTAINTY_SHARE = 0.01  # of the piece's shorter side: 95 % point of the worst corner
_UNEVEN_SHARE = 0.05  # of the light: a larger remainder of the quadratic gives a warning


@dataclass(frozen=True)
class BasePhoto:
    """A usable photograph: the homography to its pixels at the scene's `photo_px`, and measurements of its paper."""

    name: str
    picture: PictureLevels
    photo_from_piece: np.ndarray
    light: PaperLight
    blur_px: float
    said: tuple[str, ...] = ()  # see `Photo`


EVEN_LIGHT = SceneTerm("uneven light on paper")
OWN_BLUR = SceneTerm("photographs' own blur", needs_whole_photo=True)
OWN_NOISE = SceneTerm("photographs' own noise", needs_whole_photo=True)


@dataclass(frozen=True)
class PhotoScene(PictureScene):
    """A scene whose base pictures are photographs of the object with a blank sheet on it."""

    photos: tuple[BasePhoto, ...]
    TERMS = (EVEN_LIGHT, OWN_BLUR, OWN_NOISE)

    def description(self) -> str:
        """Return how many photographs there are."""
        return f"{len(self.photos)} photographs"

    def _laid_out(self) -> Self:
        refuse_larger_than_page(page_template(self.settings.sheet.template), self.piece)
        return replace(self, piece=with_ids(self.piece, self.sheet_id, "design"))

    def without(self, term: SceneTerm) -> Self | None:
        """Return the scene with photographs that light their paper evenly, or without their own blur or noise."""
        photos, even = self.photos, [1.0, 0, 0, 0, 0, 0]
        if term == EVEN_LIGHT:
            lights = [replace(photo.light, coefficients=photo.light.coefficients * even) for photo in photos]
        elif term == OWN_NOISE and any(photo.light.noise for photo in photos):
            lights = [replace(photo.light, noise=0.0) for photo in photos]
        elif term == OWN_BLUR and any(photo.blur_px for photo in photos):
            return replace(self, photos=tuple(replace(photo, blur_px=0.0) for photo in photos))
        else:
            return None
        return replace(self, photos=tuple(replace(p, light=light) for p, light in zip(photos, lights, strict=True)))

    def piece_homographies(self, conditions: Conditions, size_px: tuple[int, int]) -> np.ndarray:
        """Return N×3×3 from piece millimeters to pixels."""
        to_size = picture_scene.size_from_photo(self.photo_px, size_px)
        printed = picture_scene.print_scalings(self.piece, conditions)
        views = zip(self._view_from_photo(conditions), self._chosen_photos(conditions), printed, strict=True)
        return np.stack([to_size @ matrix @ photo.photo_from_piece @ scale for matrix, photo, scale in views])

    def pictures(self, conditions: Conditions, size_px: tuple[int, int]) -> np.ndarray:
        """Return N×H×W×3 uint8 sRGB: the photographs, turned, zoomed and shifted, with the blank sheet on them."""
        views = zip(self._chosen_photos(conditions), self._view_from_photo(conditions), strict=True)
        pictures = [picture_scene.warp_picture(shot.picture, matrix, self.photo_px, size_px) for shot, matrix in views]
        return np.stack(pictures)

    def piece_light(self, conditions: Conditions) -> np.ndarray:
        """Return N×3×6 coefficients (see `PieceScene.piece_light`) in light of the photograph: 1 is its full white."""
        return np.stack([photo.light.coefficients for photo in self._chosen_photos(conditions)])

    def picture_blur_and_noise(self, conditions: Conditions) -> tuple[np.ndarray, np.ndarray]:
        """Implement `Scene.picture_blur_and_noise`; zoom enlarges the blur with the picture."""
        photos = self._chosen_photos(conditions)
        blur_px = np.array([photo.blur_px for photo in photos]) * self._zoom(conditions)
        return blur_px, np.array([photo.light.noise for photo in photos])

    def _chosen_photos(self, conditions: Conditions) -> list[BasePhoto]:
        return [self.photos[i] for i in picture_scene.pick_indices(conditions.pose.background[:, 0], len(self.photos))]

    def _zoom(self, conditions: Conditions) -> np.ndarray:
        low, high = self.settings.view.zoom
        return low * (high / low) ** conditions.pose.background[:, 1]

    def _view_from_photo(self, conditions: Conditions) -> list[np.ndarray]:
        middle, side = np.array(self.photo_px) / 2, min(self.photo_px)
        shifts = conditions.pose.look_at_offset[:, :2] * side
        views = zip(conditions.pose.roll_deg, self._zoom(conditions), shifts, strict=True)
        return [picture_scene.similarity_matrix(roll, zoom, shift, middle) for roll, zoom, shift in views]


def build(source: SceneSource) -> PhotoScene:
    """Build the scene of a folder of photographs, with `width_mm` and `height_mm` of the blank. Unusable photographs
    are warned about; fewer than six usable ones are refused.
    """
    settings, base = source.settings, source.base
    picture_scene.refuse_bending(settings)
    photos, sheet = settings.object.photos, settings.object.sheet
    if photos is None or sheet is None:
        raise ValueError("a scene of photographs needs object.photos and object.sheet")
    manifest = load_manifest(expand_path(sheet, base))
    blank = blank_piece(manifest)
    settings = _with_size(settings, blank.size_mm)
    folder = Path(expand_path(photos, base))
    known = {"blank": manifest.sheet_id, "photos": files_sha256(photos_in(folder))}
    identity = replace(source, settings=settings).sheet_id(known)
    piece = with_ids(blank, identity, "design")
    refuse_larger_than_page(page_template(settings.sheet.template), piece)
    base_photos, rejected = _load_all(folder, manifest, piece, settings.camera.photo_px)
    warnings = [f"{name} is left out: {reason}" for name, reason in rejected.items()]
    uneven = ((photo.name, photo.light.unevenness) for photo in base_photos if photo.light.unevenness > _UNEVEN_SHARE)
    warnings += [f"the light on the paper in {name} is uneven: {share:.0%} is unexplained" for name, share in uneven]
    warnings += summarize_said((photo.name, photo.said) for photo in base_photos)
    others: dict[str, Any] = {"known": known, "inputs": {"object.photos": known["photos"]}}
    return PhotoScene(settings, base, source.seed, identity, piece, base_photos, notes=tuple(warnings), **others)


def measure_photo(path: Path, manifest: Manifest, piece: Piece, photo_px: tuple[int, int]) -> BasePhoto:
    """Measure one photograph of the blank sheet; `PhotoRejected` if it cannot be used."""
    photo = read_photo(path)
    srgb = photo.srgb
    fit, blur = _locate(srgb, manifest, min(piece.size_mm))
    x, y, *_ = manifest.cut_mm
    picture, photo_from_srgb = picture_scene.picture_for(srgb, photo_px)
    px_from_piece = fit.px_from_mm @ np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]])
    photo_from_piece = photo_from_srgb @ px_from_piece
    scale = photo_from_srgb[0, 0]
    # enlarging adds the width of the picture's own pixels: 1/12 px², and the interpolation's 1/6 px²
    blur = float(np.sqrt((blur * scale) ** 2 + max(0.0, scale**2 - 1) / 4))
    height, width = picture[0].shape[:2]
    picture_from_photo = np.linalg.inv(picture_scene.photo_from((width, height), photo_px))
    area, printed = (0.0, 0.0, *piece.size_mm), map(marker_rect, piece.markers)
    light = paper_light(picture[0], picture_from_photo @ photo_from_piece, area, printed, blur)
    return BasePhoto(path.name, picture, photo_from_piece, light, blur, photo.said)


def photos_in(folder: Path) -> list[Path]:
    """List a folder's photographs and those of the folders in it, which hold sessions as for `verify`."""
    folders = (folder, *subfolders(folder)) if is_folder(folder) else ()
    return sorted(path for each in folders for path in list_images(each))


def _load_all(folder: Path, manifest: Manifest, piece: Piece, photo_px) -> tuple[tuple[BasePhoto, ...], dict[str, str]]:
    """Return the usable photographs of a folder in the order of their names, and the rejection codes of the others."""
    files, photos, rejected = photos_in(folder), [], {}
    for path in files:
        try:
            photos.append(run_limited(measure_photo, path, manifest, piece, photo_px))
        except PhotoRejected as rejection:
            rejected[path.relative_to(folder).as_posix()] = rejection.code
    if len(photos) < MIN_PHOTOS:
        reasons = f" ({'; '.join(f'{name}: {code}' for name, code in rejected.items())})" if rejected else ""
        expected = f"at least {MIN_PHOTOS} photographs of the blank sheet on the object"
        got = f"{len(photos)} usable of {len(files)} in {folder}{reasons}"
        raise Refused(expected, got, "take more, sharp, with the whole flat sheet in view")
    return tuple(photos), rejected


def _locate(srgb: np.ndarray, manifest: Manifest, side_mm: float) -> tuple[PageFit, float]:
    """Return where the sheet's piece lies in a photograph, and the blur of its markers' borders in px."""
    markers = {m.id: np.array(m.corners_mm) for m in manifest.markers}
    on_piece = {i: c for i, c in markers.items() if is_inside(c, manifest.cut_mm).all()}
    detection = find_markers(srgb, frozenset(on_piece), frozenset(markers), DICTIONARY)
    if not detection.markers.keys() & on_piece.keys():
        if detection.another_sheet:
            raise PhotoRejected("wrong_sheet", len(detection.foreign), 0, "these are the markers of another sheet")
        raise PhotoRejected("too_few_markers", 0, 3, "no marker of the piece is readable")
    detection = complete_markers(srgb, detection, on_piece)
    borders = {i: b for i, b in detection.markers.items() if b.fitted and i in on_piece}
    if len(borders) < 3:
        raise PhotoRejected("too_few_markers", len(borders), 3, "show the whole piece, sharp and well lit")
    fit, blur = fit_page({i: b.corners_px for i, b in borders.items()}, on_piece), blur_px(borders.values())
    if blur > _MAX_BLUR_MODULES * (module_px := float(np.median([b.module_px for b in borders.values()]))):
        raise PhotoRejected("blurred", blur, _MAX_BLUR_MODULES * module_px, "hold still and focus on the sheet")
    if fit.residual_mm > _MAX_RESIDUAL_SHARE * side_mm:
        raise PhotoRejected("too_few_markers", len(fit.inlier_ids), len(on_piece), "press the sheet flat")
    uncertain = corner_uncertainty_mm(fit, manifest.cut_mm)
    if uncertain > _MAX_UNCERTAINTY_SHARE * side_mm:
        raise PhotoRejected("too_small", uncertain, _MAX_UNCERTAINTY_SHARE * side_mm, "come closer")
    return fit, blur


def _with_size(settings: SceneSettings, size_mm: tuple[float, float]) -> SceneSettings:
    patch = settings.patch
    if patch.width_mm is not None and not np.allclose(patch.size_mm, size_mm, atol=0.01):
        expected = f"a patch as large as the blank sheet's ({size_mm[0]:g} × {size_mm[1]:g} mm)"
        got = f"{patch.size_mm[0]:g} × {patch.size_mm[1]:g} mm"
        raise Refused(expected, got, "leave out width_mm and height_mm, or print a blank of that size")
    return settings.changed(patch={"width_mm": size_mm[0], "height_mm": size_mm[1]})
