"""Simulated photographs of the uncut page with a bank card laid in its outline, for scale.

In: a sheet's PDF and its run. Out: a folder of JPEG photographs and truth.json, as `reprint` writes them. The page lies
flat on a table and fills the picture; the camera (its lens, exposure, noise and JPEG) is the scene's, on draws of the
reprint stream. The card is a rounded rectangle of true size with made-up print, its face 0.76 mm above the page, with a
soft shadow beside it. It is as large as ever where the print is not: on a smaller print it covers its outline.
Left out on purpose: the card's side wall, gloss, and raised digits.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch

from patchproof import geometry
from patchproof.channel import lens
from patchproof.channel.camera import develop
from patchproof.color import linear_from_srgb
from patchproof.optimizer.run import Run
from patchproof.output import new_folder
from patchproof.scene.conditions import fields_of
from patchproof.scene.mesh_scene import MeshScene
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.raster import page_pixels
from patchproof.strict import Refused

CARD_MM, RADIUS_MM, THICKNESS_MM = (85.60, 53.98), 3.18, 0.76  # ISO/IEC 7810, ID-1
MOST_TILT_DEG = 30.0
_FILLED = 0.86  # of the picture by the page, seen straight
_TABLE_LINEAR, _PAPER_LINEAR = 0.12, 0.85
_PAGE_DPI, _CARD_PX_PER_MM, _FINE = 300.0, 12, 2
_SHADOW, _SHADOW_MM = 0.4, 0.8


def photograph_cards(
    pdf_path: str | Path,
    run: Run,
    n: int,
    out: str | Path,
    *,
    seed: int | None = None,
    printer: str | None = None,
    print_scale: tuple[float, float] = (1.0, 1.0),
    overwrite: bool = False,
    on_photo: Callable[[int, int], None] = lambda done, total: None,
) -> dict:
    """Write n photographs of the page printed at `print_scale` with a card on it; returns the truth."""
    from patchproof.reprints import reprint

    manifest, scene = reprint.sheet_scene(pdf_path, run)
    if not isinstance(scene, MeshScene):
        raise Refused("a scene with a mesh, which has a camera", "one of pictures", "leave --card out")
    if manifest.card_mm is None:
        raise Refused("a sheet with a card's outline", f"{pdf_path} without", "make the sheet again")
    pixels = torch.tensor(page_pixels(pdf_path, 1, _PAGE_DPI)).permute(2, 0, 1)[None] / 255
    printed = reprint.printer_of(run, printer).apply(pixels)[0].permute(1, 2, 0).numpy()
    page = (linear_from_srgb(printed) * _PAPER_LINEAR).astype(np.float32)
    conditions, truth = scene.draw("reprint", n, seed), {}
    scale = np.array(print_scale)
    with new_folder(out, reprint.OWN, overwrite) as folder:
        for i in range(n):
            rng = np.random.default_rng([scene.seed if seed is None else seed, i])
            one, name = conditions[i : i + 1], f"photo_{i + 1:04d}.jpg"
            pose, card_from_face = _pose(rng, scene, manifest, scale), _laid(rng, manifest, scale)
            light = float(scene.white_light(one)[0])
            picture = _picture(scene, pose, page, scale, _card_print(rng), card_from_face, one, light)
            reprint.save_photo(picture, scene, int(one.sensor.jpeg[0]), folder / name)
            truth[name] = _truth(scene, manifest, pose, scale, one)
            on_photo(i + 1, n)
        reprint.write_json(folder / "truth.json", truth)
    return truth


def _pose(rng, scene: MeshScene, manifest: Manifest, scale) -> np.ndarray:
    """`camera_from_page` 4×4 (true mm, z into the paper): the page fills the picture, its longer side along the
    picture's.
    """
    page, photo_px = np.array(manifest.page_mm) * scale, scene.settings.camera.photo_px
    turned = (page[0] < page[1]) != (photo_px[0] < photo_px[1])
    shown = page[::-1] if turned else page
    distance = scene.matrix_px(photo_px)[0, 0] * float((shown / photo_px).max()) / _FILLED
    tilt, toward = np.radians(rng.uniform(0, MOST_TILT_DEG)), rng.uniform(0, 2 * np.pi)
    away = np.array([np.sin(tilt) * np.cos(toward), np.sin(tilt) * np.sin(toward), -np.cos(tilt)])
    middle = np.array([*page / 2, 0.0])
    roll = rng.uniform(-4, 4) + (90 if turned else 0)
    return geometry.look_at(middle + distance * (1 + 0.5 * np.sin(tilt)) * away, middle, roll, up=(0.0, -1.0, 0.0))


def _laid(rng, manifest: Manifest, scale) -> np.ndarray:
    """3×3 from the face's millimetres (from its top-left corner) to the page's true ones: within a person's care."""
    x, y, w, h = np.array(manifest.card_mm) * np.tile(scale, 2)
    room = np.maximum(np.abs(np.array([w, h]) - CARD_MM) / 2, 0.3)
    middle = np.array([x + w / 2, y + h / 2]) + rng.uniform(-1, 1, 2) * room
    turn = np.radians(rng.uniform(-1, 1))
    c, s = np.cos(turn), np.sin(turn)
    shift = middle - np.array([[c, -s], [s, c]]) @ (np.array(CARD_MM) / 2)
    return np.array([[c, -s, shift[0]], [s, c, shift[1]], [0, 0, 1.0]])


def _card_print(rng) -> np.ndarray:
    """H×W×4 linear light and coverage: two colors that run into each other, a stripe, a chip, a line of digits."""
    width, height = (round(side * _CARD_PX_PER_MM) for side in CARD_MM)
    y, x = np.mgrid[0:height, 0:width] / _CARD_PX_PER_MM
    first, second = rng.uniform(0.02, 0.6, (2, 3))
    share = 0.5 + 0.5 * np.tanh((x - CARD_MM[0] / 2) * rng.normal(0, 0.06) + (y - CARD_MM[1] / 2) * rng.normal(0, 0.06))
    light = first + (second - first) * share[..., None]
    if rng.random() < 0.5:
        light[(y > 6) & (y < 17)] = 0.03
    light[(np.abs(x - 16) < 6) & (np.abs(y - 26) < 5)] = rng.uniform(0.2, 0.6, 3) * [1.0, 0.8, 0.4]
    light[(np.abs(y - 36) < 2) & (np.abs(x - 43) < 34) & (np.sin(2 * x) > 0)] = 0.75
    inner = np.abs(np.stack([x - CARD_MM[0] / 2, y - CARD_MM[1] / 2])) - np.reshape(CARD_MM, (2, 1, 1)) / 2 + RADIUS_MM
    outside = np.linalg.norm(np.maximum(inner, 0), axis=0) - RADIUS_MM
    covered = np.clip(0.5 - outside * _CARD_PX_PER_MM, 0, 1)
    return np.dstack([light, covered]).astype(np.float32)


def _picture(scene, pose, page, scale, card, card_from_face, conditions, light) -> torch.Tensor:
    """The developed photograph H×W×3 of page, shadow and card."""
    photo_px, camera = scene.settings.camera.photo_px, scene.camera
    if camera is None:
        size_px, matrix = photo_px, scene.matrix_px(photo_px)
    else:
        frame = lens.pinhole_frame(camera, photo_px)
        size_px, matrix = frame.size_px, frame.matrix_px
    page_to_px = geometry.plane_homography(matrix, pose, np.eye(4))
    raised = np.eye(4)
    raised[2, 3] = -THICKNESS_MM
    face_to_px = geometry.plane_homography(matrix, pose, raised) @ card_from_face
    dots = np.diag([*(25.4 / _PAGE_DPI * scale), 1.0])
    paper = _warped(np.dstack([page, np.ones(page.shape[:2], np.float32)]), page_to_px @ dots, size_px)
    shade = _warped(_shadow(card), page_to_px @ card_from_face @ _from_dots(-4.0), size_px)[..., None]
    face = _warped(card, face_to_px @ _from_dots(0.0), size_px)
    linear = _TABLE_LINEAR * (1 - paper[..., 3:]) + paper[..., :3] * paper[..., 3:]
    linear = linear * (1 - _SHADOW * shade)
    linear = linear * (1 - face[..., 3:]) + face[..., :3] * face[..., 3:]
    pictures = torch.from_numpy(np.ascontiguousarray(linear.transpose(2, 0, 1) * np.float32(light)))[None]
    if camera is not None:
        pictures = lens.distorted(pictures, camera, photo_px)
    return develop(pictures, conditions.sensor, 1.0, jpeg=False)[0].permute(1, 2, 0)


def _from_dots(corner_mm: float) -> np.ndarray:
    """Card pixels to its millimetres, with the first pixel's corner at (corner_mm, corner_mm)."""
    step = 1 / _CARD_PX_PER_MM
    return np.array([[step, 0, corner_mm], [0, step, corner_mm], [0, 0, 1.0]])


def _shadow(card: np.ndarray) -> np.ndarray:
    """How much of its light the paper loses, 4 mm round the card: a blurred outline."""
    border = 4 * _CARD_PX_PER_MM
    covered = cv2.copyMakeBorder(card[..., 3], border, border, border, border, cv2.BORDER_CONSTANT, value=0)
    return cv2.GaussianBlur(covered, (0, 0), _SHADOW_MM * _CARD_PX_PER_MM)


def _warped(picture: np.ndarray, px_from_dots: np.ndarray, size_px) -> np.ndarray:
    """The picture through a homography of pixel coordinates with centers at .5, averaged over 2×2 samples of a pixel;
    0 outside of it.
    """
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    fine = np.diag([_FINE, _FINE, 1.0])
    matrix = np.linalg.inv(half) @ fine @ px_from_dots @ half
    size = size_px[0] * _FINE, size_px[1] * _FINE
    warped = cv2.warpPerspective(picture, matrix, size, None, cv2.INTER_LINEAR, cv2.BORDER_CONSTANT)
    return cv2.resize(warped, size_px, interpolation=cv2.INTER_AREA)


def _truth(scene: MeshScene, manifest: Manifest, pose, scale, conditions) -> dict:
    photo_px, camera = scene.settings.camera.photo_px, scene.camera
    homography = geometry.plane_homography(scene.matrix_px(photo_px), pose, np.eye(4)) @ np.diag([*scale, 1.0])
    bends = camera is not None and camera.bends
    corners = {}
    for marker in manifest.markers:
        seen = geometry.apply_homography(homography, np.array(marker.corners_mm))
        corners[str(marker.id)] = (lens.distort_points(seen, camera, photo_px) if bends else seen).tolist()
    drawn = {name: values[0].tolist() for name, values in fields_of(conditions).items()}
    return {
        "homography_px_from_mm": None if bends else geometry.normalized(homography).tolist(),
        "marker_corners_px": corners,
        "conditions": drawn | {"print_scale": scale.tolist(), "card": True},
    }
