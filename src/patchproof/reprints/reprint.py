"""Simulated photographs of a printed sheet on its object, or scans of the uncut page.

In: a sheet's PDF and the run it was made from. Out: a folder of JPEG photographs of that piece on the object, and
`truth.json` with each one's homography, marker corners and conditions (see `hung_sheet`), and `coco.json` with boxes of
object and piece. With `scan` the uncut page is
scanned flat instead. Conditions come from the reprint stream, which nothing else has seen: one print, photographed in
one session or in several, each with a place, light and camera of its own and in a folder of its own.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from patchproof.base import geometry
from patchproof.base.color import photo_codes_of
from patchproof.base.geometry import MM_PER_INCH
from patchproof.base.output import image_bytes, make_folder, new_folder
from patchproof.base.strict import Refused
from patchproof.base.workers import Workers, open_workers, result_of, sharing
from patchproof.channel.printer import Printer
from patchproof.optimizer.run import Run, load_run
from patchproof.report.coco import Labeled, coco_json
from patchproof.reprints.hung_sheet import AS_MADE, Hanging, HungSheet, hang, sheet_scene
from patchproof.reprints.run_sheet import sheet_of
from patchproof.scene.conditions import Conditions
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.raster import page_pixels

SCAN_QUALITY, SCAN_BLUR_PX = 95, 0.8  # a flatbed's JPEG and its softness, in pixels of twice the scan's resolution
OWN = ("photo_*.jpg", "session_*", "scan_*.jpg", "truth.json", "coco.json")


def reprint(
    pdf_path: str | Path,
    run: Run,
    n: int,
    out: str | Path,
    how: Hanging = AS_MADE,
    *,
    sessions: int = 1,
    seed: int | None = None,
    overwrite: bool = False,
    jobs: int = 1,
    cluster: str | None = None,
    on_photo: Callable[[int, int], None] = lambda done, total: None,
) -> dict:
    """Write n photographs of what hangs there, taken in so many sessions, and truth.json into the folder `out`; returns
    the truth by file name.
    """
    if not 1 <= sessions <= n:
        raise Refused(f"1 to {n} sessions of {n} photographs", f"{sessions}", "ask for fewer")
    with _hung_pdf(pdf_path, run, how.control, Path(out)) as pdf:
        sheet = hang(pdf, run, how)
        each, done = -(-n // sessions), 0
        conditions = sheet.scene.draw("reprint", n, seed, per_session=each)
        scale = conditions.pose.printed_scale[[0] * n]  # one print, wherever it is photographed
        pose = replace(conditions.pose, printed_scale=scale)
        conditions = replace(conditions, print=conditions.print[[0] * n], pose=pose)
        views = [conditions[i : i + 1] for i in range(n)]
        names = [f"photo_{i + 1:04d}.jpg" for i in range(n)]
        if sessions > 1:
            names = [f"session_{i // each + 1:02d}/{name}" for i, name in enumerate(names)]
        there = partial(_take_there, Path(pdf).resolve(), run.folder.resolve(), how)
        opened = sharing(sheet.photograph, jobs) if cluster is None else _by_name(there, jobs, cluster)
        with new_folder(out, OWN, overwrite) as folder, opened as (workers, take):
            for i, photo in workers.completed(take, views):
                make_folder((folder / names[i]).parent)
                (folder / names[i]).write_bytes(result_of(photo))
                done += 1
                on_photo(done, n)
            label, size_px = str(sheet.scene.settings.target.label), sheet.scene.photo_px
            photos = [Labeled(name, size_px, sheet.outlines(v)) for name, v in zip(names, views, strict=True)]
            text = coco_json(photos, label, f"simulated photographs of sheet {sheet.manifest.sheet_id}")
            (folder / "coco.json").write_text(text, encoding="utf-8")
            return _write_truth(folder, dict(zip(names, map(sheet.truth, views), strict=True)))


@contextmanager
def _by_name(take: Callable[[Conditions], bytes], jobs: int, cluster: str) -> Iterator[tuple[Workers, Callable]]:
    """A cluster's workers and what they do: each hangs the sheet for itself."""
    with open_workers(jobs, cluster) as workers:
        yield workers, take


@contextmanager
def _hung_pdf(pdf_path: str | Path, run: Run, control: str | None, out: Path) -> Iterator[str | Path]:
    """The PDF of what hangs: the given one, or that of a control for as long as it takes."""
    if control in (None, "bare"):
        yield pdf_path
        return
    # beside the photographs, where other machines may look, too
    make_folder(out.resolve().parent)
    with TemporaryDirectory(dir=out.resolve().parent, prefix=".control.") as folder:
        template = sheet_scene(pdf_path, run)[1].settings.sheet.template
        sheet_of(run, Path(folder) / "control.pdf", template=template, control=control)
        yield Path(folder) / "control.pdf"


def _take_there(pdf: Path, run_folder: Path, how: Hanging, conditions: Conditions) -> bytes:
    return _hung_there(pdf, run_folder, how).photograph(conditions)


@lru_cache(maxsize=1)
def _hung_there(pdf: Path, run_folder: Path, how: Hanging) -> HungSheet:
    """The sheet as another process hangs it up for itself."""
    return hang(pdf, load_run(run_folder), how)


def scan(
    pdf_path: str | Path,
    run: Run,
    n: int,
    out: str | Path,
    dpi: float,
    how: Hanging = AS_MADE,
    *,
    overwrite: bool = False,
) -> dict:
    """Write n flat scans at `dpi` of each uncut page with markers; returns the truth."""
    (manifest, _), truth = sheet_scene(pdf_path, run), {}
    printer, px_from_mm = how.printer_for(run.scene), np.diag([*(dpi / MM_PER_INCH * np.array(how.print_scale)), 1.0])
    with new_folder(out, OWN, overwrite) as folder:
        for page in sorted({marker.page for marker in manifest.markers}):
            picture = _scanned(page_pixels(pdf_path, page, 2 * dpi), manifest.page_mm, dpi, printer, how.print_scale)
            corners = {
                str(m.id): geometry.apply_homography(px_from_mm, m.corners_mm).tolist()
                for m in manifest.markers
                if m.page == page
            }
            content = image_bytes(photo_codes_of(picture), "JPEG", {"quality": SCAN_QUALITY})
            for _ in range(n):
                name = f"scan_{len(truth) + 1:04d}.jpg"
                (folder / name).write_bytes(content)
                truth[name] = {
                    "homography_px_from_mm": (px_from_mm @ _page_from_design(manifest, page)).tolist(),
                    "marker_corners_px": corners,
                    "conditions": {"scan_dpi": dpi, "print_scale": list(how.print_scale)},
                }
        return _write_truth(folder, truth)


def _scanned(page: np.ndarray, page_mm, dpi: float, printer: Printer, print_scale: tuple[float, float]) -> np.ndarray:
    """A page's pixels, twice as fine as the scan, as the scanner shows their print: H×W×3 in [0, 1]."""
    import cv2

    with torch.no_grad():
        light = printer.apply(torch.tensor(page).permute(2, 0, 1)[None] / 255)[0].permute(1, 2, 0).numpy()
    # a pixel (x + ½) of the page falls on scale / 2 · (x + ½) of the scan
    (x, y), (width, height) = print_scale, (round(side * dpi / MM_PER_INCH) for side in page_mm)
    matrix = np.array([[x / 2, 0, x / 4 - 0.5], [0, y / 2, y / 4 - 0.5]])
    blurred = cv2.GaussianBlur(light, (0, 0), SCAN_BLUR_PX)
    return cv2.warpAffine(blurred, matrix, (width, height), borderValue=(1.0, 1.0, 1.0))


def _page_from_design(manifest: Manifest, page: int) -> np.ndarray:
    """3×3 from the millimeters of the design's page to a tile's; pages without a tile keep their own."""
    square = {t.page: np.vstack([np.array(t.page_from_design_mm), [0, 0, 1]]) for t in manifest.tiles}
    if page not in square:
        return np.eye(3)
    own = square[manifest.design.page if manifest.design else manifest.tiles[0].page]
    return square[page] @ np.linalg.inv(own)


def _write_truth(folder: Path, truth: dict) -> dict:
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    return truth
