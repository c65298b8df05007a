"""The whole journey on the built-in classifier, small: the demo, and what its commands say and load."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest
from conftest import SCENE
from console import command
from loaded import Step, loaded_by
from PIL import Image

from patchproof.base import geometry
from patchproof.base.packaged import packaged_path
from patchproof.base.resample import index_homography
from patchproof.sheets.manifest import load_manifest
from patchproof.sheets.pdf_raster import attached_manifests, rasterize_page

PHOTOS, SCAN_DPI = 6, 100
# libraries of the demo and of `verify`, which a process of both imports once
BOTH_LOAD = ("torch", "cv2", "scipy.stats", "scipy.optimize", "matplotlib", "jinja2", "pydantic")


@pytest.fixture(scope="module")
def loaded(tmp_path_factory):
    """A folder as the demo leaves it, of a smaller scene, and what was loaded by the help, by a page without a design,
    by the demo, and to verify one of its photographs.
    """
    folder = tmp_path_factory.mktemp("journey")
    constants = {
        "patchproof.app.demo.SCENE": SCENE.replace("[800, 600]", "[920, 690]"),
        "patchproof.app.demo.PHOTOS": PHOTOS,
        "patchproof.app.demo.SESSIONS": 1,
        "patchproof.optimizer.run.PROMISE_VIEWS": 24,  # few: what they cost is time
        "patchproof.optimizer.loop.SELECT_VIEWS": 8,
    }
    demo = folder / "demo"
    verify = ("verify", demo / "photos" / "photo_0001.jpg", "--sheet", demo / "sheet.json", "--out", folder / "one")
    steps = {
        "help": Step((("--help",),)),
        "sheet": Step((("sheet", "--template", "chart_a4", "--out", folder / "chart.pdf"),), apart=True),
        "demo": Step((("demo", "--out", demo, "--jobs", 1),), constants, apart=True, libraries=BOTH_LOAD),
        "verify": Step((verify,)),
    }
    return demo, dict(zip(steps, loaded_by(*steps.values()), strict=True))


@pytest.fixture(scope="module")
def journey(loaded):
    """That folder: scene.toml, run/, sheet.pdf, sheet.json, photos/ and report/."""
    return loaded[0]


@pytest.fixture(scope="module")
def report(journey):
    return json.loads((journey / "report" / "report.json").read_text())


def test_the_demo_ends_with_the_page_to_open_and_opens_it(monkeypatch, tmp_path, capsys):
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    monkeypatch.setattr("patchproof.app.demo.run_demo", lambda out, *_, **__: [f"open this in a browser: {out}"])
    for flag in ((), ("--open",)):
        command("demo", "--out", tmp_path, *flag)
    assert opened == [(tmp_path / "report" / "report.html").as_uri()]


def test_every_file_of_the_contract_is_there(journey):
    for name in ("design.png", "run.json", "steps.jsonl", "views.png", "checkpoint.safetensors"):
        assert (journey / "run" / name).stat().st_size > 0, name
    assert (journey / "report" / "report.html").stat().st_size > 10_000
    assert len(list((journey / "photos").glob("*.jpg"))) == PHOTOS
    manifest = load_manifest(journey / "sheet.json")
    assert attached_manifests(journey / "sheet.pdf")[0] == manifest
    assert str(journey) not in (journey / "sheet.json").read_text()
    assert str(journey).encode() not in (journey / "sheet.pdf").read_bytes()


def test_help_imports_nothing_heavy(loaded):
    assert not loaded[1]["help"].names & {"torch", "cv2", "numpy", "scipy", "matplotlib", "multiprocessing"}


def test_a_page_without_a_design_needs_no_run(loaded):
    found = loaded[1]["sheet"]
    assert not found.names & {"torch", "trimesh", "scipy.stats"} and found.rooms == {"app", "base", "sheets"}
    assert found.lines <= 7_000


def test_a_flat_card_on_a_mesh_loads_no_other_kind_of_scene(loaded):
    found = loaded[1]["demo"]
    others = {"bent_scene", "texture_scene", "photo_scene", "image_scene"}
    others |= {"candidate_places"}
    assert not {f"patchproof.scene.{name}" for name in others} & found.names and "trimesh" not in found.names
    assert found.lines <= 21_800 and found.rooms >= {"optimizer", "scene", "mesh", "render", "reprints"}


def test_verify_without_a_run_loads_nothing_of_optimizer_scene_and_mesh(loaded):
    found = loaded[1]["verify"]
    assert not found.rooms & {"optimizer", "scene", "mesh", "render", "reprints", "calibrate"}
    assert found.lines <= 15_000 and "evidence" in found.rooms


def test_a_page_made_twice_is_the_same_bytes_and_says_what_a_print_shop_needs_to_know(journey, tmp_path, capsys):
    assert command("sheet", journey / "run", "--out", tmp_path / "again.pdf", "--check") == 0
    assert "Cut the piece of" in capsys.readouterr().out
    assert (tmp_path / "again.pdf").read_bytes() == (journey / "sheet.pdf").read_bytes()
    assert (tmp_path / "again.json").read_bytes() == (journey / "sheet.json").read_bytes()


def test_photographs_are_judged_and_measured(report):
    assert report["summary"]["judged"] == PHOTOS and report["summary"]["measured"] >= PHOTOS - 1
    for photo in report["photos"]:
        assert photo["scale_x"] is None and photo["scale_y"] is None  # a photograph alone cannot show it
        assert set(photo["predictions"]) == {"builtin"}


def test_design_corners_are_where_the_truth_says(journey, report):
    """Half a millimeter in the median, 1.5 mm at worst, over the photographs that count as measured."""
    truth = json.loads((journey / "photos" / "truth.json").read_text())
    corners = geometry.rect_corners(load_manifest(journey / "sheet.json").design.rect_mm)
    errors = []
    for photo in report["photos"]:
        if photo["status"] == "measured":
            told, true = (np.array(entry["homography_px_from_mm"]) for entry in (photo, truth[photo["file"]]))
            back = geometry.apply_homography(np.linalg.inv(true), geometry.apply_homography(told, corners))
            errors.append(np.linalg.norm(back - corners, axis=1).max())
    assert np.median(errors) < 0.5 and max(errors) < 1.5


@pytest.fixture(scope="module")
def controls(journey, tmp_path_factory):
    """A folder of photographs of the bare object and of a gray control, under the conditions of the design's."""
    folder = tmp_path_factory.mktemp("controls")
    for control in ("bare", "gray"):
        arguments = ("--run", journey / "run", "--n", PHOTOS, "--control", control, "--out", folder / control)
        assert command("reprint", journey / "sheet.pdf", *arguments) == 0
    return folder


@pytest.fixture(scope="module")
def again(journey, controls, tmp_path_factory):
    """The report of the same photographs beside the controls'."""
    folder, sheet = tmp_path_factory.mktemp("again"), journey / "sheet.json"
    given = ("--controls", controls, "--out", folder / "report")
    assert command("verify", journey / "photos", "--sheet", sheet, *given) == 0
    return json.loads((folder / "report" / "report.json").read_text())


def test_an_effect_estimated_from_photographs_is_that_of_the_photographed_control(again):
    """One photograph of the control at most is judged otherwise than its estimate."""
    _, photographed = again["controls"]
    estimated = {control["name"]: control for control in again["summary"]["estimated"]["controls"]}
    assert set(estimated) == {"mean", "gray", "noise"} and again["summary"]["estimated"]["agree"] >= 0.8
    gray = estimated["gray"]
    assert abs(gray["rates"][1] - photographed["recognized"] / photographed["n"]) <= 1 / PHOTOS
    assert gray["difference_interval"][0] <= photographed["difference"] <= gray["difference_interval"][1]


def test_the_promise_predicts_the_photographs_it_is_a_promise_of(journey, report):
    """The conditions of these very photographs, rendered as for a promise: none is judged otherwise."""
    from patchproof.optimizer.problem import set_problem
    from patchproof.optimizer.promise import pictures_with_controls
    from patchproof.optimizer.responses import responses
    from patchproof.optimizer.run import load_run

    run = load_run(journey / "run")
    problem = set_problem(run.scene)
    shown = pictures_with_controls(problem, run.design, ())
    answers = responses(problem, shown, run.scene.draw("reprint", PHOTOS))["design"]
    seen = [photo["predictions"]["builtin"] for photo in report["photos"]]
    differ = answers.recognized[0] != np.array([one["recognized"] for one in seen])
    confidence = np.array([one["target_confidence"] for one in seen])
    assert not differ.any()
    assert abs(answers.confidence[0].mean() - confidence.mean()) < 0.05


def test_distance_and_angle_come_from_the_focal_length_in_exif(journey, report):
    """EXIF holds the 35 mm equivalent as a whole number, 2 % at 28 mm; distance is from the patch, not the object's
    middle.
    """
    from patchproof.optimizer.run import load_run
    from patchproof.scene.conditions import conditions_from_fields

    scene = load_run(journey / "run").scene
    truth = json.loads((journey / "photos" / "truth.json").read_text())
    for photo in report["photos"]:
        if photo["status"] != "measured":
            continue
        drawn = truth[photo["file"]]["conditions"]
        conditions = conditions_from_fields({k: np.array([v]) for k, v in drawn.items()})
        pose = scene.camera_from_world(conditions)[0] @ scene.placement.world_from_piece
        azimuth, _, distance = geometry.view_angles(pose, np.array(scene.placement.size_mm) / 2)
        assert photo["azimuth_deg"] == pytest.approx(azimuth, abs=2)
        if photo["focal"] == "confirmed":
            assert photo["distance_mm"] == pytest.approx(distance, rel=0.04)
        else:  # nearly frontal views, whose perspective tells crops from nothing
            assert photo["distance_mm"] is None


def scan(pdf, manifest, folder, scale=1.0) -> dict[str, dict]:
    """Scan each page with markers, printed at `scale`; returns the truth as `reprint` writes it, by file."""
    folder.mkdir()
    truth = {}
    for page in sorted({marker.page for marker in manifest.markers}):
        pixels = rasterize_page(pdf, page, SCAN_DPI)
        matrix = index_homography(np.diag([scale, scale, 1.0]))[:2]
        picture = cv2.warpAffine(pixels, matrix, pixels.shape[1::-1], borderValue=(255, 255, 255))
        Image.fromarray(picture).save(folder / f"scan_{page}.png")
        px_from_mm = np.diag([scale * SCAN_DPI / 25.4, scale * SCAN_DPI / 25.4, 1.0])
        truth[f"scan_{page}.png"] = {"homography_px_from_mm": px_from_mm @ manifest.page_from_design_page(page)}
    return truth


def test_scans_of_tiles_are_page_checks_that_lie_where_the_truth_says(journey, tmp_path):
    small = packaged_path("print_templates", "a4_tiles.toml").read_text(encoding="utf-8")
    assert "177.0, 262.4]" in small
    (tmp_path / "small.toml").write_text(small.replace("177.0, 262.4]", "177.0, 60.0]"), encoding="utf-8")
    pdf, run = tmp_path / "tiles.pdf", journey / "run"
    # a control, for which no promise is made anew
    assert command("sheet", run, "--out", pdf, "--template", tmp_path / "small.toml", "--control", "mean") == 0
    manifest = load_manifest(tmp_path / "tiles.json")
    scans, truth = tmp_path / "scans", scan(pdf, manifest, tmp_path / "scans")
    sheet = ("--sheet", tmp_path / "tiles.json", "--models", "builtin", "--ledger", 0)
    assert command("verify", scans, *sheet, "--out", tmp_path / "report", "--scan-dpi", SCAN_DPI) == 0
    photos = json.loads((tmp_path / "report" / "report.json").read_text())["photos"]
    assert len(photos) == len(manifest.tiles) + 1 >= 3
    for photo, tile in zip(photos[1:], manifest.tiles, strict=True):
        assert photo["status"] == "measured" and photo["scale_x"] == pytest.approx(1, abs=0.003)
        own = np.array(tile.page_from_design_mm)[:, 2] - np.array(manifest.tiles[0].page_from_design_mm)[:, 2]
        corners = geometry.rect_corners(tile.cut_mm) - own
        at = [
            geometry.apply_homography(np.array(one["homography_px_from_mm"]), corners)
            for one in (photo, truth[photo["file"]])
        ]
        assert np.abs(at[0] - at[1]).max() / SCAN_DPI * 25.4 < 0.25


def test_a_page_printed_too_small_shows_in_a_scan_and_in_the_ruler(journey, tmp_path):
    sheet = journey / "sheet.json"
    scan(journey / "sheet.pdf", load_manifest(sheet), tmp_path / "scans", 0.97)
    judged = ("--sheet", sheet, "--ledger", 0, "--out", tmp_path / "scan", "--scan-dpi", SCAN_DPI)
    assert command("verify", tmp_path / "scans", *judged) == 0
    scanned = json.loads((tmp_path / "scan" / "report.json").read_text())
    (photo,) = scanned["photos"]
    assert photo["scale_x"] == pytest.approx(0.97, abs=0.003) and photo["scale_y"] == pytest.approx(0.97, abs=0.003)
    assert photo["code"] == "scale_off" and scanned["summary"]["rate"] is None
    assert not any("uncut" in each for each in scanned["summary"]["left_out"]), "it is a scan, which says so itself"
    (tmp_path / "photo").mkdir()
    shutil.copy(journey / "photos" / "photo_0001.jpg", tmp_path / "photo")
    arguments = ("--sheet", sheet, "--out", tmp_path / "ruler", "--ruler-mm", "97.1x97.3", "--ledger", 0)
    with pytest.warns(UserWarning, match=r"the print has 0\.971 × 0\.973 of its size"):
        assert command("verify", tmp_path / "photo", *arguments) == 0
    (typed,) = json.loads((tmp_path / "ruler" / "report.json").read_text())["photos"]
    assert (typed["scale_x"], typed["scale_y"]) == pytest.approx((0.971, 0.973))
    assert "The print has 0.971 × 0.973 of its size" in (tmp_path / "ruler" / "report.html").read_text("utf-8")


def test_control_photographs_test_the_effect(report, again):
    """A carton is recognized with or without the patch: an effect is tested, and none is shown."""
    bare, gray = again["controls"]
    assert (bare["name"], gray["name"]) == ("bare", "gray")
    for control in (bare, gray):
        assert control["pairs"] == control["n"] == PHOTOS
        assert control["difference"] == pytest.approx(again["summary"]["rate"] - control["recognized"] / PHOTOS)
    assert bare["recognized"] >= PHOTOS - 1 and bare["shown"] is False
    assert report["summary"]["worth"]["source"] != "photographed" == again["summary"]["worth"]["source"]


def test_a_smaller_print_looks_like_a_farther_one(journey, tmp_path):
    arguments = ("--run", journey / "run", "--n", 1, "--out", tmp_path / "photos", "--print-scale", 0.9)
    assert command("reprint", journey / "sheet.pdf", *arguments) == 0
    full, small = (
        json.loads((folder / "truth.json").read_text())["photo_0001.jpg"]
        for folder in (journey / "photos", tmp_path / "photos")
    )
    marker, sides = load_manifest(journey / "sheet.json").markers[0], []
    for photo in (full, small):
        corners = geometry.apply_homography(np.array(photo["homography_px_from_mm"]), np.array(marker.corners_mm))
        sides.append(np.linalg.norm(corners[0] - corners[1]))
    assert sides[1] / sides[0] == pytest.approx(0.9, rel=0.02)


def test_evaluate_writes_fresh_rates(journey, capsys):
    assert command("evaluate", journey / "run", "--n", 8) == 0
    result = json.loads((journey / "run" / "evaluate.json").read_text())
    assert result["n"] == 8 and set(result["models"]["builtin"]["controls"]) == {"bare", "mean", "gray", "noise"}
    assert command("evaluate", journey / "run", "--n", 4) == 1  # not without --overwrite
    assert "which exists: add --overwrite" in capsys.readouterr().err
    assert json.loads((journey / "run" / "evaluate.json").read_text()) == result


def test_other_processes_take_and_judge_the_same_photographs(journey, tmp_path):
    pdf, run = journey / "sheet.pdf", journey / "run"
    assert command("reprint", pdf, "--run", run, "--n", 2, "--out", tmp_path / "photos", "--jobs", 2) == 0
    for name in ("photo_0001.jpg", "photo_0002.jpg"):
        assert (tmp_path / "photos" / name).read_bytes() == (journey / "photos" / name).read_bytes()
    written = []
    for jobs in (1, 2):
        assert command("evaluate", run, "--n", 4, "--jobs", jobs, "--overwrite") == 0
        written.append((run / "evaluate.json").read_bytes())
    assert written[0] == written[1]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("optimize", "no.toml", "--out", "x"), "no file at no.toml"),
        (("optimize", "{j}/scene.toml", "--out", "{j}/run"), "--overwrite"),
        (("evaluate", "{j}"), "a finished run"),
        (("sheet", "{j}/photos", "--out", "x.pdf"), "a finished run"),
        (("sheet", "{j}/run", "--out", "{j}/sheet.pdf"), "which exists"),
        (("sheet", "{j}/run", "--out", "x.pdf", "--template", "a5"), "a4"),
        (("reprint", "{j}/sheet.json", "--run", "{j}/run", "--n", "1", "--out", "x"), "a PDF of a sheet"),
        (("reprint", "{j}/sheet.pdf", "--run", "{j}/run", "--n", "1", "--out", "x", "--printer", "cotaed"), '"coated"'),
        (("verify", "{j}/photos", "--sheet", "{j}/run/run.json", "--out", "x"), "run.json"),
        (("verify", "{j}/photos", "--sheet", "{j}/nothing.json", "--out", "x"), "no file"),
        (("verify", "{j}/nowhere", "--sheet", "{j}/sheet.json", "--out", "x"), "a folder of photographs"),
        (("verify", "{j}/photos", "--sheet", "{j}/sheet.json", "--out", "{j}/report"), "--overwrite"),
        (("verify", "{j}/photos", "--sheet", "{j}/sheet.json", "--out", "x", "--models", "file:no.onnx"), "no.onnx"),
        (("verify", "{j}/photos", "--sheet", "{j}/sheet.json", "--out", "x", "--models", "file:no.pt2"), "onnx.export"),
        (("verify", "{j}/photos", "--sheet", "{j}/sheet.json", "--out", "x", "--models", "resnet"), '"resnet"'),
    ],
)
def test_bad_input_ends_in_one_sentence_and_exit_code_1(journey, tmp_path, monkeypatch, capsys, arguments, sentence):
    monkeypatch.chdir(tmp_path)
    assert command(*(argument.replace("{j}", str(journey)) for argument in arguments)) == 1
    error = capsys.readouterr().err.strip()
    assert sentence in error.splitlines()[-1] and error.splitlines()[-1].startswith("Expected ")
    assert "Traceback" not in error
    assert not (tmp_path / "x").exists() and not list(tmp_path.glob("*.pdf"))


def test_a_folder_in_which_nothing_can_be_judged_exits_with_1_and_still_reports(journey, tmp_path, capsys):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "note.jpg").write_text("this is no picture")
    arguments = ("verify", tmp_path / "photos", "--sheet", journey / "sheet.json", "--out", tmp_path / "report")
    assert command(*arguments) == 1
    assert "got none" in capsys.readouterr().err
    (photo,) = json.loads((tmp_path / "report" / "report.json").read_text())["photos"]
    assert (photo["status"], photo["code"]) == ("rejected", "unreadable")


def test_require_kept_makes_any_other_verdict_exit_with_1(journey, tmp_path):
    few = tmp_path / "few"
    few.mkdir()
    for name in ("photo_0001.jpg", "photo_0002.jpg"):
        shutil.copy(journey / "photos" / name, few)
    sheet = ("--sheet", journey / "sheet.json", "--ledger", 0)
    assert command("verify", few, *sheet, "--out", tmp_path / "a", "--require", "kept") == 1
    assert json.loads((tmp_path / "a" / "report.json").read_text())["summary"]["verdict"] == "cannot_tell"


def test_bad_meshes_end_in_one_sentence_or_a_warning(data, tmp_path, capsys):
    from patchproof.base.errors import Refused
    from patchproof.mesh.load_mesh import load_mesh

    names = sorted(path.name for path in (data / "meshes" / "bad").iterdir() if path.suffix in {".obj", ".glb", ".stl"})
    refused = 0
    for name in names:
        mesh = data / "meshes" / "bad" / name
        scene = tmp_path / f"{name}.toml"
        scene.write_text(SCENE.replace("primitive:carton", str(mesh)), encoding="utf-8")
        try:
            assert load_mesh(mesh, 300, "y").warnings, f"{name} is taken as if it were whole"
        except Refused:
            refused += 1
            assert command("optimize", scene, "--out", tmp_path / name) == 1
            assert capsys.readouterr().err.strip().splitlines()[-1].startswith("Expected ")
            assert not (tmp_path / name).exists()
    assert refused >= 5 and len(names) == 20
