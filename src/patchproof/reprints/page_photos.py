"""Simulate photographs of a page that lies flat: any printer, uneven light, and the reprint's camera.

In: a page as pixels, a printer as a function from sRGB to light, a seed. Out: pages as light, photographs as JPEG
files. Their light is less even than that of scenes, so that readers of charts have to correct it: a lamp stands near
the page, and the picture's corners are darker. Blur, noise and clipping are those of `channel`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import torch

from patchproof.base import geometry
from patchproof.base.color import linear_from_srgb, photo_codes_from_srgb
from patchproof.base.geometry import MM_PER_INCH, apply_homography
from patchproof.base.output import image_bytes, image_pixels, new_folder
from patchproof.base.resample import index_homography
from patchproof.base.settings import PrinterSettings
from patchproof.channel.camera import develop
from patchproof.channel.effects import Sensor
from patchproof.channel.printer import Printer, load_printer, printer_output
from patchproof.optimizer.run import Run
from patchproof.photo.read import Photo
from patchproof.reprints.mounted_sheet import DEFAULT_SETUP, PhotoTruth, ReprintSetup, sheet_scene
from patchproof.reprints.reprint import REPRINT_FILES, Reprint, write_truth
from patchproof.sheets.blank import BLANK
from patchproof.sheets.pdf_raster import attached_manifests, page_count, rasterize_page

PrintFunction = Callable[[np.ndarray], np.ndarray]  # N×3 sRGB sent → N×3 light of the print

PX_PER_MM = 8
PHOTO_PX = (1600, 1200)
SCAN_QUALITY, SCAN_BLUR_PX = 95, 0.8  # a flatbed's JPEG and its softness, in pixels of twice the scan's resolution


@dataclass(frozen=True)
class _Sources:
    """Light on a page: ambient, the sun's, and a lamp's on a surface that faces it in the page's middle."""

    ambient: float
    sun: float
    lamp: float
    lamp_mm: np.ndarray  # (3,) from the page's middle; z runs away from the camera


@dataclass(frozen=True)
class Shot:
    """A photograph's file, and the light (3,) of blank paper in the middle of the page at its sensor."""

    file: bytes
    paper: np.ndarray

    @cached_property
    def photo(self) -> Photo:
        """The file's pixels, as a photograph that was read."""
        return Photo(image_pixels(self.file), None)


def page_light(page: np.ndarray, apply_printer: PrintFunction) -> np.ndarray:
    """Convert a page (uint8 H×W×3) to its print's light, relative to blank paper, turned to landscape."""
    page = np.rot90(page) if page.shape[0] > page.shape[1] else page
    white = apply_printer(np.ones((1, 3)))
    packed, index = np.unique(page.reshape(-1, 3) @ np.array([65536, 256, 1]), return_inverse=True)
    colors = np.stack([packed >> 16, packed >> 8 & 255, packed & 255], 1) / 255
    return (apply_printer(colors) / white)[index.reshape(-1)].reshape(page.shape).astype(np.float32)


def reprint_pages(
    pdf: str | Path, n: int, out: str | Path, how: ReprintSetup, *, seed: int | None = None, overwrite: bool = False
) -> None:
    """Write n photographs of the pages of a PDF, in turn, lying flat: for pages that belong to no run, such as blank
    ones, charts and boards. `how` names their printer (None: coated) and the print's scale. Of a blank sheet only the
    piece is photographed, since the rest is cut off: its markers would stand beside the later print's.
    """
    printer = load_printer(how.printer or PrinterSettings().profile)
    with new_folder(out, ("photo_*.jpg",), overwrite, (pdf,)) as folder:
        pages, manifest = [], attached_manifests(pdf)[0]
        for number in range(page_count(pdf)):
            pixels = rasterize_page(pdf, number + 1, PX_PER_MM * MM_PER_INCH)
            if manifest.kind == BLANK:
                x, y, width, height = (round(PX_PER_MM * side) for side in manifest.cut_mm)
                pixels = pixels[y : y + height, x : x + width]
            light = page_light(pixels, lambda colors: linear_from_srgb(printer_output(printer, colors)))
            pages.append(cv2.resize(light, None, fx=how.print_scale[0], fy=how.print_scale[1]))
        for i in range(n):
            shot = photograph_page(pages[i % len(pages)], (seed or 0) + i)
            (folder / f"photo_{i + 1:04d}.jpg").write_bytes(shot.file)


def photograph_page(page: np.ndarray, seed: int) -> Shot:
    """Photograph a page that lies flat, from above within 25° to each side; the seed determines all conditions."""
    rng = np.random.default_rng([seed, 4])
    page_mm = np.array(page.shape[1::-1]) / PX_PER_MM
    distance = rng.uniform(1.2, 1.55) * page_mm.max()
    eye = geometry.orbit(rng.uniform(-25, 25), rng.uniform(-25, 25), (0, 0, -1.0), (0, -1.0, 0)) * distance
    pose = geometry.look_at(eye, rng.uniform(-8, 8, 3) * [1, 1, 0], rng.uniform(-8, 8), (0, -1.0, 0))
    flat = np.eye(4)
    flat[:2, 3] = -page_mm / 2
    px_from_mm = geometry.plane_homography(geometry.intrinsics(50, PHOTO_PX), pose, flat)
    sources = _draw_sources(rng)
    white_balance = 1 + rng.uniform(-0.15, 0.15, 3)
    corners = geometry.rect_corners((0, 0, *page_mm))
    middle_light, corner_light = (_light_at(mm - page_mm / 2, sources) for mm in (corners.mean(0)[None], corners))
    exposure = rng.uniform(0.5, 0.85) / (corner_light.max() * white_balance.max())
    light = _light_in_picture(px_from_mm, page_mm / 2, sources)
    raw = _warp_page(page, px_from_mm) * (light * _vignetting(rng.uniform(0, 0.2)))[..., None]
    ranges = {"blur_px": (0, 1), "noise": (0, 0.01), "jpeg": (60, 95)}
    drawn = {name: np.array([rng.uniform(*ends)]) for name, ends in ranges.items()}
    exposure_ev, noise_seed = np.array([np.log2(exposure)]), np.array([seed])
    sensor = Sensor(exposure_ev=exposure_ev, white_balance=white_balance[None], noise_seed=noise_seed, **drawn)
    picture = torch.tensor(raw.transpose(2, 0, 1)[None], dtype=torch.float32)
    codes = develop(picture, sensor, 1.0, jpeg=False)[0].permute(1, 2, 0).numpy().astype(float)
    file = image_bytes(photo_codes_from_srgb(codes), "JPEG", {"quality": int(sensor.jpeg[0])})
    return Shot(file, middle_light * exposure * white_balance)


def _draw_sources(rng: np.random.Generator) -> _Sources:
    """Draw the sources; the lamp is 300 to 600 mm away, so that one side of the page is up to twice as bright."""
    front, up = (0, 0, -1.0), (0, -1.0, 0)
    lamp = geometry.orbit(rng.uniform(-60, 60), rng.uniform(-60, 60), front, up) * rng.uniform(300, 600)
    toward = geometry.orbit(rng.uniform(-50, 50), rng.uniform(-50, 50), front, up)
    lamp_light = rng.uniform(0.2, 0.8)
    return _Sources(rng.uniform(0.3, 0.7), rng.uniform(0, 0.5) * -toward[2], lamp_light, lamp)


def _light_at(from_middle_mm: np.ndarray, sources: _Sources) -> np.ndarray:
    """Light (N) at points N×2 of the page's plane; the lamp's falls with the square of its distance."""
    to_lamp = sources.lamp_mm - np.column_stack([from_middle_mm, np.zeros(len(from_middle_mm))])
    distance = np.linalg.norm(to_lamp, axis=1)
    lamp = sources.lamp * (np.linalg.norm(sources.lamp_mm) / distance) ** 2 * -to_lamp[:, 2] / distance
    return sources.ambient + sources.sun + lamp


def _vignetting(loss: float) -> np.ndarray:
    """Factors H×W of a picture's light, which falls as cos⁴ of an angle does, down to 1 - `loss` in the corners."""
    x, y = (np.arange(side) + 0.5 - side / 2 for side in PHOTO_PX)
    square = (y[:, None] ** 2 + x**2) * 4 / (PHOTO_PX[0] ** 2 + PHOTO_PX[1] ** 2)
    return (1 + ((1 - loss) ** -0.5 - 1) * square) ** -2


def _light_in_picture(px_from_mm: np.ndarray, middle_mm: np.ndarray, sources: _Sources) -> np.ndarray:
    """Light on the page's plane at each pixel of the photograph, H×W; computed at every 8th, since it is smooth."""
    width, height = PHOTO_PX
    x, y = np.meshgrid(np.arange(4.0, width, 8), np.arange(4.0, height, 8))
    mm = geometry.apply_homography(np.linalg.inv(px_from_mm), np.stack([x.ravel(), y.ravel()], 1))
    return cv2.resize(_light_at(mm - middle_mm, sources).reshape(x.shape), PHOTO_PX, interpolation=cv2.INTER_LINEAR)


def _warp_page(page: np.ndarray, px_from_mm: np.ndarray) -> np.ndarray:
    """Warp a page to the picture, on a gray table, averaged over pixels."""
    page_px_per_px = PX_PER_MM / np.sqrt(np.linalg.det((px_from_mm / px_from_mm[2, 2])[:2, :2]))
    blurred = cv2.GaussianBlur(page, (0, 0), 0.35 * float(page_px_per_px))  # over a pixel, which is sampled once
    matrix = index_homography(px_from_mm @ np.diag([1 / PX_PER_MM, 1 / PX_PER_MM, 1]))
    return cv2.warpPerspective(blurred, matrix, PHOTO_PX, flags=cv2.INTER_LINEAR, borderValue=(0.3, 0.28, 0.25))


def scan(
    pdf_path: str | Path,
    run: Run,
    n: int,
    out: str | Path,
    dpi: float,
    how: ReprintSetup = DEFAULT_SETUP,
    *,
    overwrite: bool = False,
) -> Reprint:
    """Scan each uncut page with markers n times at `dpi`, in simulation, into the folder `out`."""
    manifest, truth = sheet_scene(pdf_path, run)[0], {}
    printer, px_from_mm = how.printer_for(run.scene), np.diag([*(dpi / MM_PER_INCH * np.array(how.print_scale)), 1.0])
    with new_folder(out, REPRINT_FILES, overwrite, (pdf_path, run.folder)) as folder:
        for page in sorted({marker.page for marker in manifest.markers}):
            pixels = rasterize_page(pdf_path, page, 2 * dpi)
            picture = _scan_page(pixels, manifest.page_mm, dpi, printer, how.print_scale)
            corners = {m.id: apply_homography(px_from_mm, m.corners_mm) for m in manifest.markers if m.page == page}
            content = image_bytes(photo_codes_from_srgb(picture), "JPEG", {"quality": SCAN_QUALITY})
            for _ in range(n):
                name = f"scan_{len(truth) + 1:04d}.jpg"
                (folder / name).write_bytes(content)
                conditions = {"scan_dpi": dpi, "print_scale": list(how.print_scale)}
                truth[name] = PhotoTruth(px_from_mm @ manifest.page_from_design_page(page), corners, conditions)
        write_truth(folder, truth)
    return Reprint(Path(out), truth)


def _scan_page(page: np.ndarray, page_mm, dpi: float, printer: Printer, print_scale: tuple[float, float]) -> np.ndarray:
    """Print and scan a page's pixels, which are twice as fine as the scan: H×W×3 sRGB in [0, 1]."""
    with torch.no_grad():
        light = printer.apply(torch.tensor(page).permute(2, 0, 1)[None] / 255)[0].permute(1, 2, 0).numpy()
    (x, y), (width, height) = print_scale, (round(side * dpi / MM_PER_INCH) for side in page_mm)
    matrix = index_homography(np.diag([x / 2, y / 2, 1.0]))
    blurred = cv2.GaussianBlur(light, (0, 0), SCAN_BLUR_PX)
    return cv2.warpAffine(blurred, matrix[:2], (width, height), borderValue=(1.0, 1.0, 1.0))
