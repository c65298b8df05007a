"""A gallery of objects of the package: design, page and two photographs of each, on one HTML page.

In: a folder. Out: `gallery.html` there, and a folder for each object with its scene, as `patchproof new` writes it, its
run, a draft, and its sheet. Left out on purpose: verdicts, which drafts on default views are not made for.
"""

from pathlib import Path

import cv2
import numpy as np

from patchproof.app.begin.new import new_scene
from patchproof.base.output import data_uri, new_folder, write_atomically
from patchproof.base.progress import Compute, Progress, no_progress
from patchproof.optimizer.run import Run, optimize
from patchproof.optimizer.subject import as_pixels
from patchproof.render.photograph import photograph
from patchproof.render.stage import set_stage
from patchproof.report.page import jpeg, render_page
from patchproof.report.tables import Drawing, Results, cell_text
from patchproof.reprints.run_sheet import sheet
from patchproof.sheets.pdf_raster import rasterize_page

OBJECTS = "box_truck carton mailbox mug bottle traffic_cone street_sign table_lamp watering_can chair".split()
LENGTH_MM, _TILE_PX = 400, 420  # models, of which a page covers enough to be seen


def make_gallery(out: Path, jobs: int = 1, overwrite: bool = False, progress: Progress = no_progress) -> Path:
    """Draft a design for each of `OBJECTS`, write its sheet, and return the page that shows them."""
    shown = []
    with new_folder(out, ("gallery.html", *OBJECTS), overwrite) as folder:
        for number, name in enumerate(OBJECTS):
            progress("gallery", number, len(OBJECTS))
            place = folder / name
            place.mkdir()
            new_scene(f"primitive:{name}", place / "scene.toml", length_mm=LENGTH_MM)
            run = optimize(place / "scene.toml", place / "run", draft=True, compute=Compute(jobs=jobs))
            sheet(run, place / "sheet.pdf")
            drawing = Drawing(name, name.replace("_", " "), lambda figure: None, about=run.promise.headline)
            picture = data_uri(jpeg(_tiles(run, rasterize_page(place / "sheet.pdf", dpi=60))))
            shown.append((drawing, picture, picture))
        about = "Designs, the pages they are printed on, and photographs of the print on its object, all simulated."
        results = Results("gallery", "gallery", about, f"{len(shown)} objects, drafts", {}, (), (), {}, {}, "patchlab")
        text = render_page(
            "results.html.j2",
            results=results,
            pictures=shown,
            settings="patchlab gallery",
            versions={},
            cell_text=cell_text,
        )
        write_atomically(folder / "gallery.html", text)
    return out / "gallery.html"


def _tiles(run: Run, page: np.ndarray) -> np.ndarray:
    """Design and page above two photographs that nothing was chosen by, as squares of a picture."""
    size_px, views = (_TILE_PX, _TILE_PX), run.scene.draw("reprint", 2, per_session=1)
    photos = [as_pixels(each) for each in photograph(set_stage(run.scene), run.design, views, size_px)]
    side, tall = _TILE_PX, cv2.resize(page, (round(_TILE_PX * page.shape[1] / page.shape[0]), _TILE_PX))
    sheet_tile = np.full((side, side, 3), 255, np.uint8)
    sheet_tile[:, (side - tall.shape[1]) // 2 :][:, : tall.shape[1]] = tall
    design = cv2.resize(run.design, size_px, interpolation=cv2.INTER_NEAREST)
    return np.vstack([np.hstack([design, sheet_tile]), np.hstack(photos)])
