"""The study of layouts: what each variant reserves, and one cell after the other on a small scene."""

from __future__ import annotations

import numpy as np
import pytest

from patchlab.study.study import run_study
from patchlab.validation.layouts import Layout, with_layout
from patchproof.optimizer import loop
from patchproof.scene.patch_scene import require_patch
from patchproof.scene.scene import make_scene
from patchproof.sheets.piece import marker_image

SCENE = {
    "object": {"mesh": "primitive:carton", "length_mm": 300},
    "patch": {"width_mm": 120, "height_mm": 120},
    "target": {"label": "red", "models": ["module:fake_networks.red_against_blue"]},
    "view": {"azimuth_deg": [-20, 20], "distance_mm": [400, 500]},
    "camera": {"photo_px": [480, 360]},
}


@pytest.fixture(scope="module")
def scene():
    return require_patch(make_scene(SCENE))


def reserved(scene, **layout) -> np.ndarray:
    return marker_image(with_layout(scene, Layout(**layout)).piece, (240, 240))[1]


def test_a_layout_reserves_what_it_says(scene):
    usual = reserved(scene)
    np.testing.assert_array_equal(usual, marker_image(scene.piece, (240, 240))[1])
    half, twice = reserved(scene, quiet=0.5), reserved(scene, quiet=2.0)
    assert (half <= usual).all() and (usual <= twice).all() and half.sum() < usual.sum() < twice.sum()
    assert (usual <= reserved(scene, markers=8)).all()
    frame = reserved(scene, markers=8, framed=True)
    assert (usual <= frame).all() and not frame[120, 120] and frame[120, 2]
    assert len(with_layout(scene, Layout(markers=8)).piece.markers) == 8
    assert with_layout(scene, Layout(size=0.7)).piece.marker_mm == pytest.approx(0.7 * scene.piece.marker_mm)


def test_cells_are_trained_shown_and_photographed(tmp_path, monkeypatch, a_small_search):
    monkeypatch.setattr(loop, "SELECT_VIEWS", 4)
    (tmp_path / "scene.toml").write_text(
        '[object]\nmesh = "primitive:carton"\nlength_mm = 300\n[patch]\nwidth_mm = 120\nheight_mm = 120\n'
        '[target]\nlabel = "red"\nmodels = ["module:fake_networks.red_against_blue"]\n'
        "[view]\nazimuth_deg = [-20, 20]\ndistance_mm = [400, 500]\n[camera]\nphoto_px = [480, 360]\n"
        "[optimize]\nsteps = 2\nviews = 2\n[background]\ncolor = [0.5, 0.5, 0.5]\n"
    )
    config = tmp_path / "study.toml"
    config.write_text(
        'scenes = ["scene.toml"]\nn = 4\nphotos = 1\n[layouts.whole]\n[layouts.framed]\nmarkers = 8\nframed = true\n'
        "[layouts.smaller.scene.patch]\nwidth_mm = 80\nheight_mm = 80\n"
        '[layouts.anywhere.scene.patch]\nplace = "auto"\n'
    )
    finished = run_study("layouts", config, tmp_path / "out")
    assert not finished.failed
    (whole, framed, smaller, _), (first, second, *_) = finished.tables[0].rows, finished.results
    assert whole[0] == "whole" and whole[1] > framed[1] > 0.2
    assert smaller[1] < whole[1]  # markers do not shrink with the piece
    assert first.answers["status"] == ["measured"] and max(first.answers["error_mm"]) < 0.5
    assert len(second.answers["hits"]["design"][0]) == 4 and (tmp_path / "out" / "layouts.html").is_file()
