"""Path-traced photographs: light and geometry agree with ours where nothing casts a shadow."""

from __future__ import annotations

import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from console import lab_command

from patchlab.validation import path_traced
from patchlab.validation.path_traced import draw_optics, photograph_traced
from patchproof.base import geometry
from patchproof.base.color import linear_from_srgb
from patchproof.base.errors import Refused
from patchproof.base.output import image_pixels
from patchproof.render.photograph import photograph
from patchproof.render.pixels import PiecePicture
from patchproof.render.stage import set_stage
from patchproof.render.views import lens_frame
from patchproof.reprints.reprint import MountedSheet, ReprintSetup
from patchproof.scene.conditions import with_values
from patchproof.scene.scene import load_scene

PINHOLE = 1.0, 0.0  # the light's radius in degrees, the lens's diameter in mm


@pytest.fixture
def scene(scene_file):
    text = scene_file.read_text("utf-8").replace("photo_px = [800, 600]", "photo_px = [200, 150]")
    scene_file.write_text(text, "utf-8")
    return load_scene(scene_file)


def facing(scene, **values):
    """One view with the lights in front of the piece and nothing random in the camera."""
    quiet = {"light_azimuth_deg": 20.0, "light_elevation_deg": 30.0, "noise": 0.0, "blur_px": 0.0, "exposure_ev": 0.0}
    quiet |= {"distance_mm": 500.0, "look_at_offset": 0.0, "white_balance": 1.0, "veil": 0.0}
    return with_values(scene.draw("reprint", 1), **quiet | values)


def plain(scene, level: float) -> PiecePicture:
    return PiecePicture.of(torch.full((64, 64, 3), level))


def test_what_is_traced_holds_all_of_piece_and_object(scene):
    for i in range(8):
        conditions = scene.draw("reprint", 1, start=i)
        frame = lens_frame(set_stage(scene), scene, scene.settings.camera.photo_px)
        x, y, width, height = path_traced._box(scene, conditions, frame, 0.0)
        points = np.concatenate([scene.mesh.vertices, scene.placement.vertices_mm])
        seen = geometry.project(frame.matrix_px, scene.camera_from_world(conditions)[0], points)
        inside = seen.clip(0, frame.size_px)
        assert (inside >= [x, y]).all() and (inside <= [x + width, y + height]).all()
        assert 0 < width <= 200 and 0 < height <= 150


def test_light_and_lens_follow_from_the_view(scene):
    conditions = scene.draw("reprint", 3)
    drawn = [draw_optics(conditions[[i]]) for i in range(3)]
    assert drawn == [draw_optics(conditions[[i]]) for i in range(3)] and len(set(drawn)) == 3
    for values in drawn:
        for value, (low, high) in zip(values, (path_traced.LIGHT_RADIUS_DEG, path_traced.APERTURE_MM), strict=True):
            assert low <= value <= high


def test_refused_in_a_sentence(scene, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setitem(sys.modules, "mitsuba", None)
        with pytest.raises(Refused, match=r"Mitsuba 3.*pip install 'patchproof\[pathtrace\]'"):
            path_traced.mitsuba()
    with pytest.raises(Refused, match="scene with a mesh"):
        photograph_traced(replace(set_stage(scene), scene=None), None, facing(scene))


@pytest.mark.parametrize(
    "lights",
    [
        {"ambient": 0.6, "directional": 0.0},
        {"ambient": 0.2, "directional": 0.5},
    ],
)
def test_levels_are_ours_where_nothing_is_in_the_way(scene, lights, monkeypatch):
    pytest.importorskip("mitsuba")
    monkeypatch.setattr(path_traced, "PASSES", 1)
    monkeypatch.setattr(path_traced, "draw_optics", lambda conditions: PINHOLE)
    conditions, stage = facing(scene, **lights), set_stage(scene)
    for name in ("dot_gain", "density", "chroma"):
        conditions = with_values(conditions, **{name: 0.0})
    piece = plain(scene, 0.5)
    ours = photograph(stage, piece, conditions, (200, 150), jpeg=False)[0].numpy()
    traced = photograph_traced(stage, piece, conditions)[0].numpy()
    bare = photograph(stage, None, conditions, (200, 150), jpeg=False)[0].numpy()
    middle = np.abs(ours - bare).max(0) > 0.01  # the piece
    assert middle.sum() > 500
    assert abs(traced[:, middle].mean() - ours[:, middle].mean()) < 0.015  # the object shades it a little


def test_mottle_is_that_of_our_views(scene, monkeypatch):
    pytest.importorskip("mitsuba")
    monkeypatch.setattr(path_traced, "PASSES", 1)
    monkeypatch.setattr(path_traced, "draw_optics", lambda conditions: PINHOLE)
    conditions, stage = facing(scene, ambient=0.8, directional=0.0), set_stage(scene)
    piece = PiecePicture.of(torch.full((200, 200, 3), 0.5))  # cells of the mottle have several of its pixels
    even, uneven = (with_values(conditions, mottle=rms, mottle_seed=3) for rms in (0.0, 0.1))
    ours, traced = (
        np.subtract(*(render(stage, piece, each)[0].numpy() for each in (uneven, even)))
        for render in (lambda *seen: photograph(*seen, (200, 150), jpeg=False), photograph_traced)
    )
    shown = np.abs(ours).max(0) > 0
    assert shown.sum() > 500 and np.corrcoef(ours[:, shown].ravel(), traced[:, shown].ravel())[0, 1] > 0.9
    assert np.std(traced[:, shown]) == pytest.approx(np.std(ours[:, shown]), rel=0.15)


def test_the_piece_lies_where_the_truth_has_it(scene, monkeypatch):
    pytest.importorskip("mitsuba")
    monkeypatch.setattr(path_traced, "PASSES", 2)
    monkeypatch.setattr(path_traced, "draw_optics", lambda conditions: PINHOLE)
    conditions, stage = facing(scene, ambient=0.8, directional=0.0, azimuth_deg=35.0, roll_deg=10.0), set_stage(scene)
    srgb = torch.ones(64, 64, 3)
    srgb[8:20, 36:56] = 0.0  # a black field on white, off the middle in both axes
    traced = photograph_traced(stage, PiecePicture.of(srgb), conditions)
    homography = scene.piece_homographies(conditions, (200, 150))[0]
    field_mm = geometry.rect_corners([36, 8, 20, 12]) * np.array(scene.piece.size_mm) / 64
    around_mm = geometry.rect_corners([32, 4, 28, 20]) * np.array(scene.piece.size_mm) / 64
    corners, around = (geometry.apply_homography(homography, mm) for mm in (field_mm, around_mm))
    mask = cv2.fillPoly(np.zeros((150, 200), np.uint8), [np.round(around - 0.5).astype(np.int32)], 1) > 0
    light = linear_from_srgb(traced[0].numpy().mean(0).astype(float))
    white = np.mean(light[mask & (light > 0.9 * np.quantile(light[mask], 0.75))])  # 4 of 7 parts are white
    dark = np.where(mask, white - light, 0.0)
    rows, columns = np.mgrid[:150, :200] + 0.5
    found = np.array([(dark * columns).sum(), (dark * rows).sum()]) / dark.sum()
    moments = cv2.moments(corners.astype(np.float32)[:, None])
    true = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
    assert np.abs(found - true).max() < 0.2  # light falls off a little towards the card's foot
    assert dark.sum() / white == pytest.approx(moments["m00"], rel=0.05)


def test_a_mounted_sheet_is_photographed_by_the_renderer_that_is_given(scene):
    seen = []

    def render(stage, piece, conditions):
        seen.append((stage.scene, piece))
        return torch.full((1, 3, 8, 16), 0.5)

    how = ReprintSetup(control="bare", render=render)
    mounted = MountedSheet(set_stage(scene), None, None, None, how)
    photo = image_pixels(mounted.photograph(facing(scene)))
    assert photo.shape == (8, 16, 3) and np.abs(photo.astype(int) - 128).max() <= 1 and seen == [(scene, None)]


def test_a_verb_photographs_a_sheet_by_path_tracing(monkeypatch, tmp_path, capsys):
    taken = []
    monkeypatch.setattr("patchproof.optimizer.run.load_run", lambda folder, trust: folder.name)
    monkeypatch.setattr("patchproof.reprints.reprint.reprint", lambda *args, **options: taken.append((args, options)))
    out = tmp_path / "photos"
    assert lab_command("trace", "sheet.pdf", "--run", "run", "--n", 6, "--sessions", 2, "--out", out) == 0
    ((pdf, run, n, folder, how), options) = taken[0]
    assert (pdf.name, run, n, folder, how) == ("sheet.pdf", "run", 6, out, ReprintSetup(render=photograph_traced))
    assert options["sessions"] == 2 and "6 photographs" in capsys.readouterr().out
