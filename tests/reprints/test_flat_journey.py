"""The journeys without a mesh, small, by the commands a user types: photographs of a blank sheet on an object, and a
folder of images.

The photographs are of a world with a mesh that the scene never sees. What is tested are laws, not rates, which eight
photographs could not show: where the pasted piece lies, how bright it is, that it looks as its print does in that
place, and that fresh photographs of the print can be judged.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from console import command
from PIL import Image

from patchproof.base.color import linear_from_srgb
from patchproof.base.errors import Refused
from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.base.packaged import packaged_path
from patchproof.base.settings import SceneSettings
from patchproof.channel.effects import Print
from patchproof.channel.printer import load_printer
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.run import Run, load_run
from patchproof.optimizer.subject import from_pixels
from patchproof.render.photograph import photograph
from patchproof.render.stage import set_stage
from patchproof.reprints.reprint import MountedSheet, ReprintSetup, sent_pixels
from patchproof.reprints.run_sheet import sheet as sheet_of
from patchproof.scene.conditions import draw, with_values
from patchproof.scene.patch_scene import PatchScene
from patchproof.scene.placement import place_card
from patchproof.scene.scene import build_scene
from patchproof.sheets.manifest import Manifest, load_manifest
from patchproof.sheets.rects import grow_rect

PHOTO_PX = (800, 600)
PHOTOS, REPRINTS = 6, 2
PIECE_MM, MARKER_MM = 120, 14

WORLD = SceneSettings.model_validate(
    {
        "object": {"mesh": "primitive:carton", "length_mm": 300, "up": "y"},
        "patch": {"side": "+z", "width_mm": PIECE_MM, "height_mm": PIECE_MM},
        "target": {"label": "carton", "models": ["builtin"]},
        "background": {"color": (0.5, 0.5, 0.5)},
        "view": {
            "azimuth_deg": (-30, 30),
            "elevation_deg": (0, 25),
            "distance_mm": (420, 540),
            "look_at_jitter": 0.02,
        },
        "camera": {"photo_px": PHOTO_PX, "blur_px": (0.3, 0.8), "exposure_ev": (-0.6, -0.2), "jpeg": (88, 95)},
    }
)
SCENE = """
[object]
{object}
[patch]
{patch}
[target]
label = "carton"
models = ["builtin"]
goal = "{goal}"
[view]
patch_share = [0.35, 0.45]
[camera]
photo_px = [800, 600]
blur_px = [0, 0.5]
noise = [0, 0.005]
exposure_ev = [-0.6, -0.2]  # at 0 the paper of a pasted piece is full white, which is no reference for a gray design
[optimize]
steps = 2
views = 4
"""


@dataclass(frozen=True)
class Journey:
    """A folder with scene.toml, run/, SHEET.pdf and SHEET.json; of photographs also BLANK.pdf, BLANK.json, photos/."""

    folder: Path
    run: Run
    world: PatchScene
    conditions: object  # of the photographs


@pytest.fixture(scope="module", autouse=True)
def few_views():
    """A promise of 18 views, which show each of six photographs; no rate is tested here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("patchproof.optimizer.run.PROMISE_VIEWS", 18)
        patch.setattr("patchproof.optimizer.loop.SELECT_VIEWS", 4)
        patch.setattr("patchproof.evidence.verdict.kept_chance", lambda *_: 0.9)
        yield


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    text = packaged_path("print_templates", "blank_a4.toml").read_text(encoding="utf-8")
    smaller = {"piece_mm = [162.0, 162.0]": f"piece_mm = [{PIECE_MM}, {PIECE_MM}]", "= 19.0": f"= {MARKER_MM}"}
    for old, new in smaller.items():
        assert old in text
        text = text.replace(old, new)
    (folder / "small_blank.toml").write_text(text, encoding="utf-8")
    assert command("sheet", "--template", folder / "small_blank.toml", "--out", folder / "BLANK.pdf") == 0
    world = hang(build_scene(WORLD, folder, 3), load_manifest(folder / "BLANK.json"))
    conditions = with_values(draw(WORLD, "promise", PHOTOS, 3), tone=0)
    shoot(world, folder / "BLANK.pdf", conditions, folder / "photos")
    return optimized(folder, world, conditions, 'photos = "photos"\nsheet = "BLANK.json"', "", "assist")


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    world = build_scene(WORLD, folder, 3)
    conditions = world.draw("evaluate", 3)
    shoot(world, None, conditions, folder / "images")
    rows = [f"photo_{i}.jpg,carton" for i in range(3)]
    (folder / "labels.csv").write_text("\n".join(["file,label", *rows]), encoding="utf-8")
    tables = 'images = "images"\nlabels = "labels.csv"', "width_mm = 135\nheight_mm = 135", "deceive"
    return optimized(folder, world, conditions, *tables)


def hang(world: PatchScene, manifest: Manifest) -> PatchScene:
    """The world with this sheet's piece in the middle of the object's side."""
    return replace(world, placement=place_card(world.mesh, world.frame, tuple(manifest.cut_mm[2:]), 0.0))


def shoot(world: PatchScene, pdf: Path | None, conditions, folder: Path) -> None:
    """photo_0.jpg ... of the world with the PDF's piece on the object, or with nothing."""
    folder.mkdir()
    stage, how, manifest, pixels = set_stage(world), ReprintSetup(control="bare"), None, None
    if pdf is not None:
        manifest, how = load_manifest(pdf.with_suffix(".json")), ReprintSetup()
        pixels = sent_pixels(pdf, manifest, world)
    mounted = MountedSheet(stage, manifest, pixels, load_printer("office"), how)
    for i in range(len(conditions)):
        (folder / f"photo_{i}.jpg").write_bytes(mounted.photograph(conditions[i : i + 1]))


def optimized(folder: Path, world: PatchScene, conditions, object_: str, patch: str, goal: str) -> Journey:
    (folder / "scene.toml").write_text(SCENE.format(object=object_, patch=patch, goal=goal), encoding="utf-8")
    assert command("optimize", folder / "scene.toml", "--out", folder / "run") == 0
    assert command("sheet", folder / "run", "--out", folder / "SHEET.pdf") == 0
    return Journey(folder, load_run(folder / "run"), world, conditions)


def as_taken(scene, n: int):
    """Conditions that show photograph 0, 1, ... with the piece in it and nothing changed."""
    drawn, none, one = scene.draw("promise", n), np.zeros(n), np.ones((n, 3))
    low, high = scene.settings.view.zoom
    background = drawn.pose.background.copy()
    background[:, 0], background[:, 1] = (np.arange(n) + 0.5) / n, np.log(1 / low) / np.log(high / low)
    still = {"background": background, "roll_deg": none, "look_at_offset": np.zeros((n, 3)), "jpeg": none + 95}
    camera = {"exposure_ev": none, "white_balance": one, "blur_px": none, "noise": none}
    return with_values(drawn, **still, **camera, dot_gain=none, density=none, chroma=none, veil=0 * one, tone=0)


def design_pixels(homography, scene, size_px) -> np.ndarray:
    """Boolean H×W: pixels a little inside of the design, and outside of what belongs to markers."""
    import cv2

    mask = np.zeros(size_px[::-1], np.uint8)
    rects = [(grow_rect((0, 0, *scene.piece.size_mm), -3), 1), *((grow_rect(r, 3), 0) for r in scene.piece.reserved_mm)]
    for rect, value in rects:
        corners = apply_homography(homography, rect_corners(rect)) - 0.5
        cv2.fillConvexPoly(mask, np.round(corners).astype(np.int32), value)
    return mask.astype(bool)


def read(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path)) / 255.0


def true_homography(journey: Journey, i: int) -> np.ndarray:
    """Photograph i's pixels from piece millimeters."""
    return journey.world.piece_homographies(journey.conditions[i : i + 1], PHOTO_PX)[0]


def composites(journey: Journey, design: np.ndarray) -> np.ndarray:
    """N×H×W×3 sRGB: a design pasted into every photograph as it was taken."""
    problem, scene = set_problem(journey.run.scene), journey.run.scene
    shown = problem.subject.appearance(from_pixels(design, "cpu"))
    conditions = as_taken(scene, PHOTOS)
    with torch.no_grad():
        parts = [photograph(problem.stage, shown, conditions[i : i + 1], PHOTO_PX, jpeg=False) for i in range(PHOTOS)]
    return torch.cat(parts).permute(0, 2, 3, 1).numpy()


def test_the_piece_is_pasted_where_it_was_photographed(photos):
    """Corners of the cut line within half a pixel of where the world's camera saw them."""
    scene = photos.run.scene
    assert len(scene.photos) == PHOTOS and scene.piece.size_mm == pytest.approx(photos.world.placement.size_mm)
    corners = rect_corners((0, 0, *scene.piece.size_mm))
    for i, where in enumerate(scene.piece_homographies(as_taken(scene, PHOTOS), PHOTO_PX)):
        miss = apply_homography(where, corners) - apply_homography(true_homography(photos, i), corners)
        assert np.linalg.norm(miss, axis=1).max() < 0.5


def test_white_paper_is_pasted_as_bright_as_it_was_photographed(photos):
    """Mean light of the middle within 2 % in every channel."""
    white = np.full_like(photos.run.design, 255)
    for i, picture in enumerate(composites(photos, white)):
        middle = design_pixels(true_homography(photos, i), photos.run.scene, PHOTO_PX)
        pasted = linear_from_srgb(picture.astype(float))[middle].mean(0)
        photographed = linear_from_srgb(read(photos.folder / "photos" / f"photo_{i}.jpg"))[middle].mean(0)
        assert pasted / photographed == pytest.approx(np.ones(3), abs=0.02)


def test_a_pasted_design_looks_as_its_print_does_in_that_place(photos, tmp_path):
    """Over the design at least 29 dB (measured: 30 to 34) against photographs of the print, mean light within 3 %."""
    fixed = replace(photos.conditions, print=Print())
    shoot(photos.world, photos.folder / "SHEET.pdf", fixed, tmp_path / "prints")
    for i, pasted in enumerate(composites(photos, photos.run.design)):
        printed = read(tmp_path / "prints" / f"photo_{i}.jpg")
        middle = design_pixels(true_homography(photos, i), photos.run.scene, PHOTO_PX)
        error = ((pasted - printed)[middle] ** 2).mean()
        ratio = linear_from_srgb(pasted.astype(float))[middle].mean() / linear_from_srgb(printed)[middle].mean()
        assert -10 * np.log10(error) > 29 and ratio == pytest.approx(1, abs=0.03)


def test_fresh_photographs_of_the_print_are_judged(photos, tmp_path):
    """From nearly the photographed places, some of them darker: all are measured, none is out of range. The very
    photographs of the blank are the control.
    """
    near = with_values(photos.conditions, azimuth_deg=photos.conditions.pose.azimuth_deg + 1.5)
    near = with_values(near, exposure_ev=near.sensor.exposure_ev - 0.3 * (np.arange(PHOTOS) % 2))
    near = with_values(near, distance_mm=near.pose.distance_mm * 1.03)
    shoot(photos.world, photos.folder / "SHEET.pdf", near, tmp_path / "fresh")
    sheet, controls = photos.folder / "SHEET.json", photos.folder / "photos"
    arguments = ("--sheet", sheet, "--out", tmp_path / "report", "--controls", controls, "--ledger", 0)
    assert command("verify", tmp_path / "fresh", *arguments) == 0
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    assert [photo["code"] for photo in report["photos"]] == [None] * PHOTOS
    assert report["summary"]["measured"] == report["summary"]["judged"] == PHOTOS
    (control,) = report["controls"]
    assert control["pairs"] == control["n"] == PHOTOS
    assert control["difference"] == pytest.approx(report["summary"]["rate"] - control["recognized"] / PHOTOS)
    # six pairs show an effect only where all of them differ: p = 2 / 2^6
    assert report["summary"]["worth"]["source"] == "photographed"


@pytest.mark.parametrize("kind", ["photos", "images"])
def test_reprints_are_judged_where_the_truth_says(request, kind, tmp_path):
    """The design's corners within half a pixel, or what is stated where a small photograph hides a marker."""
    folder = request.getfixturevalue(kind).folder
    arguments = ("--run", folder / "run", "--n", REPRINTS, "--out", tmp_path / "reprints")
    assert command("reprint", folder / "SHEET.pdf", *arguments) == 0
    sheet = folder / "SHEET.json"
    assert command("verify", tmp_path / "reprints", "--sheet", sheet, "--ledger", 0, "--out", tmp_path / "report") == 0
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    truth = json.loads((tmp_path / "reprints" / "truth.json").read_text())
    corners, near = rect_corners(load_manifest(sheet).design.rect_mm), 0
    for photo in report["photos"]:
        assert (photo["status"], photo["code"]) == ("measured", None)
        assert photo["azimuth_deg"] is None and photo["distance_mm"] is None  # nobody knows the focal length
        told, true = (np.array(one["homography_px_from_mm"]) for one in (photo, truth[photo["file"]]))
        miss = np.linalg.norm(apply_homography(told, corners) - apply_homography(true, corners), axis=1)
        assert miss.max() < max(0.5, photo["corner_uncertainty_mm"] * photo["px_per_mm"])
        near += miss.max() < 0.5
    assert near >= REPRINTS - 1


@pytest.mark.parametrize("kind", ["photos", "images"])
def test_evaluate_knows_scenes_without_a_mesh(request, kind):
    run = request.getfixturevalue(kind).folder / "run"
    assert command("evaluate", run, "--n", 4) == 0
    result = json.loads((run / "evaluate.json").read_text())
    assert set(result["models"]["builtin"]["controls"]) == {"bare", "mean", "gray", "noise"}


def test_another_page_keeps_the_piece_and_its_promise_or_is_refused(photos, tmp_path):
    """The piece is as large as the blank that was photographed, whatever page it is printed on."""
    text = packaged_path("print_templates", "a4.toml").read_text(encoding="utf-8")
    zone = "167.0, 180.0]"
    assert zone in text
    for name, room in (("other", "160.0, 170.0]"), ("small", "100.0, 100.0]")):
        (tmp_path / f"{name}.toml").write_text(text.replace(zone, room), encoding="utf-8")
    before = load_manifest(photos.folder / "SHEET.json")
    after = sheet_of(photos.run, tmp_path / "other.pdf", template=str(tmp_path / "other.toml"))
    assert after.cut_mm[2:] == before.cut_mm[2:] and after.promise == before.promise
    with pytest.raises(Refused, match=r"Expected a piece of at most 99\.6 × 99\.6 mm on this page, got 120 × 120 mm"):
        sheet_of(photos.run, tmp_path / "small.pdf", template=str(tmp_path / "small.toml"))
    assert not (tmp_path / "small.pdf").exists()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--template", "a4"), "Expected a template with a [blank] table"),
        ((), "Expected a run, or the template of a blank page, got neither"),
        (("--template", "blank_a4", "--control", "mean"), "Expected a run, whose mean control to print"),
    ],
)
def test_pages_that_need_a_run_are_refused_without_one(tmp_path, capsys, arguments, sentence):
    assert command("sheet", *arguments, "--out", tmp_path / "x.pdf") == 1
    error = capsys.readouterr().err.strip()
    assert error.startswith(sentence) and "\n" not in error and not list(tmp_path.iterdir())
