"""Simulate photographs of a page that lies flat: any printer, uneven light, and the reprint's camera.

In: a page as pixels, a printer as a function from sRGB to light, a seed. Out: pages as light, photographs as JPEG
files. Their light is less even than that of scenes, so that readers of charts have to correct it. Blur, noise and
clipping are those of `channel`.
"""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch

from patchproof.base import geometry
from patchproof.base.color import linear_from_srgb, photo_codes_from_srgb
from patchproof.base.geometry import MM_PER_INCH
from patchproof.base.output import image_bytes, new_folder
from patchproof.base.resample import index_homography
from patchproof.base.settings import PrinterSettings
from patchproof.channel.camera import develop
from patchproof.channel.effects import Sensor
from patchproof.channel.printer import load_printer, printer_output
from patchproof.reprints.reprint import ReprintSetup
from patchproof.sheets.blank import BLANK
from patchproof.sheets.pdf_raster import attached_manifests, page_count, rasterize_page

PrintFunction = Callable[[np.ndarray], np.ndarray]  # N×3 sRGB sent → N×3 light of the print

PX_PER_MM = 8
PHOTO_PX = (1600, 1200)


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
    piece is photographed, since the rest is cut off.
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
            pages.append(cv2.resize(light, None, fx=how.print_scale, fy=how.print_scale))
        for i in range(n):
            file, _ = photograph_page(pages[i % len(pages)], (seed or 0) + i)
            (folder / f"photo_{i + 1:04d}.jpg").write_bytes(file)


def photograph_page(page: np.ndarray, seed: int) -> tuple[bytes, np.ndarray]:
    """Photograph a page that lies flat, from above within 25° to each side; the seed determines all conditions. Return
    the file, and the light (3,) of blank paper in the middle of the page at its sensor.
    """
    rng = np.random.default_rng([seed, 4])
    page_mm = np.array(page.shape[1::-1]) / PX_PER_MM
    distance = rng.uniform(1.2, 1.55) * page_mm.max()
    eye = geometry.orbit(rng.uniform(-25, 25), rng.uniform(-25, 25), (0, 0, -1.0), (0, -1.0, 0)) * distance
    pose = geometry.look_at(eye, rng.uniform(-8, 8, 3) * [1, 1, 0], rng.uniform(-8, 8), (0, -1.0, 0))
    flat = np.eye(4)
    flat[:2, 3] = -page_mm / 2
    px_from_mm = geometry.plane_homography(geometry.intrinsics(50, PHOTO_PX), pose, flat)
    light, white_balance = _uneven_light(page.shape, rng), 1 + rng.uniform(-0.15, 0.15, 3)
    exposure = rng.uniform(0.5, 0.85) / (light.max() * white_balance.max())
    # the page on a gray table, averaged over a pixel, which is sampled once
    page_px_per_px = PX_PER_MM / np.sqrt(np.linalg.det((px_from_mm / px_from_mm[2, 2])[:2, :2]))
    blurred = cv2.GaussianBlur(page * light[..., None], (0, 0), 0.35 * float(page_px_per_px))
    matrix = index_homography(px_from_mm @ np.diag([1 / PX_PER_MM, 1 / PX_PER_MM, 1]))
    raw = cv2.warpPerspective(blurred, matrix, PHOTO_PX, flags=cv2.INTER_LINEAR, borderValue=(0.3, 0.28, 0.25))
    ranges = {"blur_px": (0, 1), "noise": (0, 0.01), "jpeg": (60, 95)}
    drawn = {name: np.array([rng.uniform(*ends)]) for name, ends in ranges.items()}
    exposure_ev, noise_seed = np.array([np.log2(exposure)]), np.array([seed])
    sensor = Sensor(exposure_ev=exposure_ev, white_balance=white_balance[None], noise_seed=noise_seed, **drawn)
    picture = torch.tensor(raw.transpose(2, 0, 1)[None], dtype=torch.float32)
    codes = develop(picture, sensor, 1.0, jpeg=False)[0].permute(1, 2, 0).numpy().astype(float)
    return image_bytes(photo_codes_from_srgb(codes), "JPEG", {"quality": int(sensor.jpeg[0])}), exposure * white_balance


def _uneven_light(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Light H×W on a page, 1 in its middle: a lamp makes one corner 1.4 to 2 times as bright as the opposite one."""
    y, x = np.mgrid[-1 : 1 : shape[0] * 1j, -1 : 1 : shape[1] * 1j]
    turn, fall = rng.uniform(0, 2 * np.pi), rng.uniform(1 / 6, 1 / 3)
    return (1 + fall * (np.cos(turn) * x + np.sin(turn) * y) / 2**0.5).astype(np.float32)
