"""A hand-made sheet and photographs of it whose homographies are known; other tests take them from here."""

from __future__ import annotations

import functools
import io
from pathlib import Path

import cv2
import numpy as np

from patchproof.base.color import LINEAR_FROM_CODE, srgb_from_linear
from patchproof.base.geometry import intrinsics, look_at, plane_homography
from patchproof.sheets.content import png_base64
from patchproof.sheets.manifest import Manifest, design_sha256

PX_PER_MM = 10  # of the page raster: every edge of the page lies on a multiple of 0.1 mm
PAGE_MM = (210.0, 297.0)
CUT_MM = (35.0, 60.0, 140.0, 140.0)
DESIGN_MM = CUT_MM  # it fills the piece
MARKER_MM, MODULE_MM = 14.0, 2.0
PIECE_IDS, PAGE_IDS = tuple(range(100, 108)), (200, 201, 202)
CONDITION = dict(px_per_mm=None, tilt_deg=None, azimuth_deg=None, contrast=None, blur_px=None, recognized=True)


def promised_conditions(n: int, rate: float, given=(CONDITION,)) -> list[dict]:
    """The given conditions over and over, `n` in all, of which a share `rate` is recognized."""
    return [given[i % len(given)] | {"recognized": int((i + 1) * rate) > int(i * rate)} for i in range(n)]


def marker_squares() -> dict[int, tuple[float, float]]:
    """Top-left mm of the eight piece markers (corners and middles of its sides) and three page markers."""
    x, y, w, _ = CUT_MM
    near, middle, far = 2.0, w / 2 - MARKER_MM / 2, w - 2.0 - MARKER_MM
    spots = [
        (near, near),
        (middle, near),
        (far, near),
        (near, middle),
        (far, middle),
        (near, far),
        (middle, far),
        (far, far),
    ]
    squares = {i: (x + dx, y + dy) for i, (dx, dy) in zip(PIECE_IDS, spots, strict=True)}
    return squares | {200: (20.0, 20.0), 201: (170.0, 20.0), 202: (20.0, 260.0)}


def some_design(seed: int = 3) -> np.ndarray:
    """A smooth colorful design, uint8 140×140×3."""
    rng = np.random.default_rng(seed)
    return cv2.resize(rng.integers(20, 236, (8, 8, 3), np.uint8), (140, 140), interpolation=cv2.INTER_LINEAR)


def noisy_design(seed: int = 0, colorful: bool = True) -> np.ndarray:
    """As optimizers leave one: noise of all sizes down to 2 mm, in strong colors or grays; float64 140×140×3 sRGB."""
    rng, total = np.random.default_rng(seed), np.zeros((140, 140, 3))
    for n in (4, 8, 16, 32, 70):
        noise = rng.normal(0, 1, (n, n, 3 if colorful else 1)) * np.ones(3)
        total += cv2.resize(noise, (140, 140), interpolation=cv2.INTER_NEAREST)
    return 1 / (1 + np.exp(-total))


@functools.cache
def _printed(pixels: bytes, shape: tuple[int, ...]) -> tuple[str, str]:
    """Hash and PNG of a design, which hundreds of tests ask for."""
    design = np.frombuffer(pixels, np.uint8).reshape(shape)
    return design_sha256(design), png_base64(design)


def make_manifest(promise: dict | None = None, first_id: int = 0, design: np.ndarray | None = None) -> Manifest:
    design = some_design() if design is None else design
    sha256, png = _printed(design.tobytes(), design.shape)
    markers = []
    for marker_id, (x, y) in marker_squares().items():
        corners = [(x, y), (x + MARKER_MM, y), (x + MARKER_MM, y + MARKER_MM), (x, y + MARKER_MM)]
        markers.append(dict(dictionary="DICT_5X5_1000", id=marker_id + first_id, corners_mm=corners, page=1))
    return Manifest.model_validate(
        dict(
            version=2,
            sheet_id="TESTSHEET0",
            kind="design",
            page_mm=PAGE_MM,
            design=dict(
                sha256=sha256,
                rect_mm=DESIGN_MM,
                size_px=design.shape[1::-1],
                page=1,
                png=png,
            ),
            markers=markers,
            chart=(),
            cut_mm=CUT_MM,
            ruler_mm=(100.0, 100.0),
            tiles=(),
            promise=promise,
            settings={"printer": {"profile": "coated"}},
        )
    )


def page_raster(manifest: Manifest, only_piece: bool) -> np.ndarray:
    """The page as float32 linear light at 10 px/mm; `only_piece` leaves the rest of the page white paper out (gray)."""
    page = np.ones((round(PAGE_MM[1] * PX_PER_MM), round(PAGE_MM[0] * PX_PER_MM), 3), np.float32)
    printed = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_1000)
    design = LINEAR_FROM_CODE.astype(np.float32)[manifest.design.pixels()]
    _paste(page, cv2.resize(design, (1400, 1400), interpolation=cv2.INTER_NEAREST), *DESIGN_MM[:2])
    for marker in manifest.markers:
        (x, y), side = marker.corners_mm[0], round(MARKER_MM * PX_PER_MM)
        quiet = round((MARKER_MM + 2 * MODULE_MM) * PX_PER_MM)
        code = cv2.aruco.generateImageMarker(printed, marker.id, side)
        _paste(page, np.ones((quiet, quiet, 3)), x - MODULE_MM, y - MODULE_MM)
        _paste(page, np.repeat(code[..., None] / 255.0, 3, 2), x, y)
    if only_piece:
        x, y, w, h = (round(v * PX_PER_MM) for v in CUT_MM)
        cut = page[y : y + h, x : x + w].copy()
        page[:] = 0.2
        page[y : y + h, x : x + w] = cut
    return page


def _paste(page, pixels, x, y):
    row, column = round(y * PX_PER_MM), round(x * PX_PER_MM)
    page[row : row + pixels.shape[0], column : column + pixels.shape[1]] = pixels


def view(azimuth_deg=0.0, elevation_deg=0.0, distance_mm=500.0, roll_deg=0.0, size_px=(1200, 900), fov_deg=40.0):
    """px_from_mm of a camera that looks at the design's center from the given side."""
    center = np.array([DESIGN_MM[0] + DESIGN_MM[2] / 2, DESIGN_MM[1] + DESIGN_MM[3] / 2])
    az, el = np.radians([azimuth_deg, elevation_deg])
    eye = distance_mm * np.array([np.cos(el) * np.sin(az), np.sin(el), np.cos(el) * np.cos(az)])
    world_from_page = np.diag([1.0, -1.0, -1.0, 1.0])  # page y down; its z points into the paper
    world_from_page[:2, 3] = [-center[0], center[1]]
    return plane_homography(intrinsics(fov_deg, size_px), look_at(eye, [0, 0, 0], roll_deg), world_from_page)


@functools.lru_cache(maxsize=2)  # most photographs of a test have one seed and size
def _grain(seed: int, shape: tuple[int, ...]) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape)


def photograph(page, px_from_mm, size_px=(1200, 900), blur_px=0.0, noise=0.0, light=0.8, jpeg=None, seed=0, fine=3):
    """uint8 sRGB photo: `fine`² samples per pixel, Gaussian blur, light and noise in linear light, JPEG if asked."""
    width, height = size_px
    raster_from_px = np.diag([PX_PER_MM, PX_PER_MM, 1.0]) @ np.linalg.inv(px_from_mm)
    # warpPerspective wants index-based matrices: index i of the fine grid lies at (i + 0.5) / fine px
    to_px = np.array([[1 / fine, 0, 0.5 / fine], [0, 1 / fine, 0.5 / fine], [0, 0, 1.0]])
    to_index = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]])
    matrix = to_index @ raster_from_px @ to_px
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    linear = np.empty((height, width, 3), np.float32)
    for first in range(0, height, 60):  # rows at a time that a processor's own memory holds
        rows = min(60, height - first)
        down, size = np.array([[1, 0, 0], [0, 1, first * fine], [0, 0, 1.0]]), (width * fine, rows * fine)
        seen = cv2.warpPerspective(page, matrix @ down, size, None, flags, cv2.BORDER_CONSTANT, (0.2, 0.2, 0.2))
        linear[first : first + rows] = cv2.resize(seen, (width, rows), interpolation=cv2.INTER_AREA)
    linear = linear * light
    if blur_px > 0:
        linear = cv2.GaussianBlur(linear, (0, 0), blur_px)
    if noise:
        linear = linear + (_grain(seed, linear.shape) * noise).astype(np.float32)
    srgb = np.clip(srgb_from_linear(np.clip(linear, 0, 1)) * 255 + 0.5, 0, 255).astype(np.uint8)
    if jpeg is None:
        return srgb
    code = cv2.imencode(".jpg", srgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, jpeg])[1]
    return np.ascontiguousarray(cv2.imdecode(code, cv2.IMREAD_COLOR)[..., ::-1])


def save(srgb: np.ndarray, path: Path, focal_35mm: int | None = None) -> Path:
    from PIL import Image

    image, exif = Image.fromarray(srgb), Image.Exif()
    if focal_35mm is not None:
        exif.get_ifd(0x8769)[0xA405] = focal_35mm
    buffer = io.BytesIO()
    kind = "JPEG" if path.suffix.lower() in {".jpg", ".jpeg"} else "PNG"
    image.save(buffer, kind, quality=95, exif=exif, compress_level=1)
    path.write_bytes(buffer.getvalue())
    return path


def curled_photograph(page, camera_from_page, matrix_px, curvature, size_px=(1200, 900), fine=3, blur_px=0.6, seed=0):
    """uint8 sRGB photo of the piece rolled round an upright cylinder that touches the page's plane at the design's
    center: each ray of `fine`² per pixel is met with the cylinder, so nothing of the tool's own model is used.
    """
    center, radius = np.array(DESIGN_MM[:2]) + np.array(DESIGN_MM[2:]) / 2, 1 / curvature
    rotation, eye = camera_from_page[:3, :3], -camera_from_page[:3, :3].T @ camera_from_page[:3, 3]
    width, height = size_px
    light = np.empty((height * fine, width * fine, 3), np.float32)
    for first in range(0, height * fine, 60):  # rows at a time that a processor's own memory holds
        v, u = np.mgrid[first : min(first + 60, height * fine), 0 : width * fine]
        pixels = np.stack([(u + 0.5) / fine, (v + 0.5) / fine, np.ones(u.shape)], -1)
        ray = pixels @ (np.linalg.inv(matrix_px).T @ rotation)
        a, b = (ray[..., [0, 2]] ** 2).sum(-1), ray[..., 0] * eye[0] + ray[..., 2] * (eye[2] - radius)
        rest = b * b - a * (eye[0] ** 2 + (eye[2] - radius) ** 2 - radius**2)
        far = (-b - np.sign(radius) * np.sqrt(np.where(rest > 0, rest, np.nan))) / a
        x, y, z = (eye[i] + far * ray[..., i] for i in range(3))
        along = radius * np.arctan2(x / radius, (radius - z) / radius) + center[0]
        left, top, w, h = CUT_MM
        inside = (along > left) & (along < left + w) & (y + center[1] > top) & (y + center[1] < top + h)
        maps = [np.where(inside, m * PX_PER_MM - 0.5, 0).astype(np.float32) for m in (along, y + center[1])]
        seen = cv2.remap(page, *maps, cv2.INTER_NEAREST)
        light[first : first + 60] = np.where(inside[..., None], seen, np.float32(0.2))
    linear = cv2.GaussianBlur(cv2.resize(light, size_px, interpolation=cv2.INTER_AREA), (0, 0), blur_px)
    noisy = linear * 0.8 + np.random.default_rng(seed).normal(0, 0.004, linear.shape)
    return np.clip(srgb_from_linear(np.clip(noisy, 0, 1)) * 255 + 0.5, 0, 255).astype(np.uint8)
