"""Simulate flat scans of a sheet's uncut page."""

from pathlib import Path

import cv2
import numpy as np
import torch

from patchproof.base.color import photo_codes_from_srgb
from patchproof.base.geometry import MM_PER_INCH, apply_homography
from patchproof.base.output import image_bytes, new_folder
from patchproof.base.resample import index_homography
from patchproof.channel.printer import Printer
from patchproof.optimizer.run import Run
from patchproof.reprints.mounted_sheet import DEFAULT_SETUP, PhotoTruth, ReprintSetup, sheet_scene
from patchproof.reprints.reprint import REPRINT_FILES, Reprint, write_truth
from patchproof.sheets.pdf_raster import rasterize_page

SCAN_QUALITY, SCAN_BLUR_PX = 95, 0.8  # a flatbed's JPEG and its softness, in pixels of twice the scan's resolution


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
