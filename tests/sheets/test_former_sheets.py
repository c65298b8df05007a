"""Sheets of the former kind, whose design lay in a frame of markers and swatches, hang on walls: they are read as ever.

`former_sheets` holds what such sheets' manifests said, as the version that printed them wrote it; the pieces are drawn
from that.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from patchproof.base.color import linear_from_srgb
from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.channel.printer import identity_printer
from patchproof.evidence.camera import view_of
from patchproof.evidence.measure import measure
from patchproof.evidence.ranges import promised_ranges
from patchproof.evidence.surface import promised_of, surface_of
from patchproof.photo.read import Photo
from patchproof.scene.paper_light import quadratic_terms
from patchproof.scene.scene import build_scene
from patchproof.sheets.manifest import Manifest, dump_manifest, load_manifest
from patchproof.sheets.piece import Piece, PieceMarker, marker_image, marker_rect, moved_marker
from patchproof.sheets.rects import holds
from test_photo_scene import NOISE, SIZE, VIEWS, homography, light_of, photograph, settings_of, still

FOLDER = Path(__file__).parent / "former_sheets"
PX_PER_MM = 10


def drawn(manifest: Manifest) -> np.ndarray:
    """The piece in linear light, 10 px per mm; markers to a fraction of a pixel."""
    left, top, *size_mm = manifest.cut_mm
    width, height = (round(side * PX_PER_MM) for side in size_mm)
    light = np.ones((height, width, 3))

    def paste(rect_mm, pixels):
        if holds(manifest.cut_mm, rect_mm):
            x0, y0 = (round((v - v0) * PX_PER_MM) for v, v0 in zip(rect_mm[:2], (left, top), strict=True))
            w, h = (round(side * PX_PER_MM) for side in rect_mm[2:])
            light[y0 : y0 + h, x0 : x0 + w] = cv2.resize(pixels, (w, h), interpolation=cv2.INTER_NEAREST)

    for swatch in manifest.chart:
        paste(swatch.rect_mm, linear_from_srgb(np.array(swatch.srgb))[None, None])
    if manifest.design is not None:
        paste(manifest.design.rect_mm, linear_from_srgb(manifest.design.pixels() / 255.0))
    markers = [PieceMarker(m.id, m.corners_mm) for m in manifest.markers]
    own = [moved_marker(m, (-left, -top)) for m in markers if holds(manifest.cut_mm, marker_rect(m))]
    image, _ = marker_image(Piece((size_mm[0], size_mm[1]), tuple(own), 1.0), (width, height))
    return (light * linear_from_srgb(image.astype(float))).astype(np.float32)


@pytest.mark.parametrize("name", ["design", "blank"])
def test_they_are_the_first_version_and_are_written_as_such(name):
    manifest = load_manifest(FOLDER / f"{name}.json")
    assert manifest.version == 1 and manifest.tiles == ()
    assert '"version": 1' in dump_manifest(manifest)


@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 0), (30, 12), (-45, 5)])
def test_a_photograph_of_a_framed_design_still_measures_right(azimuth, elevation):
    """Corners within 0.1 mm, colors within 2 ΔE00 in the mean, in light that is neither even nor white."""
    manifest = load_manifest(FOLDER / "design.json")
    surface, size_mm = surface_of(manifest), np.array(manifest.cut_mm[2:])
    assert surface.piece_ids == {m.id for m in manifest.markers[:8]} and surface.rect_mm == manifest.design.rect_mm
    where = homography(size_mm, azimuth, elevation, 420, 4)
    picture = photograph(drawn(manifest), where, size_mm, light_of(1, 0.7), 0.7, 0)
    promised = promised_of(manifest, surface, identity_printer())
    # its markers lie beside it: the whole rectangle is the design
    assert promised.design == pytest.approx(linear_from_srgb(manifest.design.pixels() / 255.0), abs=1e-6)
    measured = measure(view_of(Photo(picture, None), None), "p", surface, promised, promised_ranges(()))
    entry = measured.entry
    assert (entry.status, entry.code, entry.markers_found) == ("measured", None, 8)
    corners = rect_corners(manifest.design.rect_mm)
    true = apply_homography(where, corners - np.array(manifest.cut_mm[:2]))
    back = np.linalg.inv(np.array(entry.geometry.homography_px_from_mm))
    assert np.abs(apply_homography(back, true) - corners).max() < 0.1
    assert entry.color.delta_e00_mean < 2


def test_photographs_of_a_framed_blank_still_make_a_scene(tmp_path):
    """As of one without swatches: corners within 0.1 px, light within 2 %, blur within 0.3 px, noise within 15 %."""
    manifest = load_manifest(FOLDER / "blank.json")
    (tmp_path / "BLANK.json").write_bytes((FOLDER / "blank.json").read_bytes())
    (tmp_path / "photos").mkdir()
    raster, size_mm, truth = drawn(manifest), np.array(manifest.cut_mm[2:]), []
    for i, (*pose, blur, exposure) in enumerate(VIEWS):
        where, light = homography(size_mm, *pose), light_of(i, exposure)
        Image.fromarray(photograph(raster, where, size_mm, light, blur, i)).save(tmp_path / "photos" / f"{i}.png")
        truth.append((where, light, blur))
    scene = build_scene(settings_of(None), tmp_path, 0)
    assert scene.piece.size_mm == pytest.approx(size_mm) and len(scene.piece.markers) == 8
    conditions = still(scene, len(VIEWS))
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9)), -1).reshape(-1, 2)
    terms, corners = quadratic_terms(grid * size_mm, scene.piece.size_mm), rect_corners((0, 0, *size_mm))
    found = (scene.piece_homographies(conditions, SIZE), scene.piece_light(conditions))
    for where, light, blur, noise, (true_where, true_light, true_blur) in zip(
        *found, *scene.own_blur_and_noise(conditions), truth, strict=True
    ):
        miss = np.linalg.norm(apply_homography(where, corners) - apply_homography(true_where, corners), axis=1)
        assert miss.max() < 0.1
        assert np.abs((terms @ light.T) / (terms @ true_light.T) - 1).max() < 0.02
        assert blur == pytest.approx(true_blur, abs=0.3)
        assert noise == pytest.approx(NOISE, rel=0.15)
