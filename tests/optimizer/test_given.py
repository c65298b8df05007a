"""Designs made elsewhere: pixels come through unchanged, what does not fit is refused, and all that follows works."""

from __future__ import annotations

import json
from contextlib import closing

import cv2
import numpy as np
import pytest
from console import command
from PIL import Image
from pycocotools.coco import COCO
from pypdfium2 import PdfDocument

from patchproof.app import compare
from patchproof.app.compare import compare as compare_runs
from patchproof.base.errors import Refused
from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.channel.printer import load_printer
from patchproof.optimizer import imported_design
from patchproof.optimizer import run as run_module
from patchproof.optimizer.imported_design import fit_to_piece, import_patch
from patchproof.optimizer.promise import PromiseOptions
from patchproof.optimizer.run import load_run
from patchproof.report.coco import PATCH
from patchproof.reprints.run_sheet import sheet as sheet_of
from patchproof.sheets.manifest import load_manifest
from patchproof.sheets.markers import DICTIONARY
from patchproof.sheets.pdf_raster import attached_manifests
from patchproof.sheets.piece import marker_image
from test_optimize import scene_with, toml

RNG = np.random.default_rng(0)
SMALL = {"camera__photo_px": [64, 64]}
DRAFT = {"promise": PromiseOptions(views=8, controls=("bare",))}


def noise(width: int, height: int) -> np.ndarray:
    return RNG.integers(0, 256, (height, width, 3), np.uint8)


def slopes(width: int, height: int) -> np.ndarray:
    """A picture without edges, in which a detector of markers has little to look at, and with a little grain."""
    y, x = np.mgrid[:height, :width]
    smooth = np.stack([250 * x // width, 250 * y // height, 250 * (x + y) // (width + height)], 2)
    return (smooth + RNG.integers(0, 4, smooth.shape)).astype(np.uint8)


def free(run) -> np.ndarray:
    """The pixels of a run's design that no marker needs."""
    height, width = run.design.shape[:2]
    return ~marker_image(run.scene.piece, (width, height))[1]


@pytest.fixture(scope="module")
def journey(tmp_path_factory):
    """A folder with picture.png, scene.toml, run/, sheet.pdf, sheet.json, photos/ and report/."""
    folder = tmp_path_factory.mktemp("given")
    Image.fromarray(noise(230, 230)).save(folder / "picture.png")  # 2 px per mm: as fine as designs are printed
    toml(folder / "scene.toml", camera__photo_px=[800, 600])
    run, pdf, photos = folder / "run", folder / "sheet.pdf", folder / "photos"
    assert command("import", folder / "picture.png", folder / "scene.toml", "--out", run, "--promise", 8) == 0
    assert command("sheet", run, "--out", pdf) == 0
    assert command("reprint", pdf, "--run", run, "--n", 2, "--out", photos) == 0
    judged = ("--models", "module:fake_networks.red_against_blue", "--ledger", 0)
    assert command("verify", photos, "--sheet", folder / "sheet.json", "--out", folder / "report", *judged) == 0
    return folder


def test_pixels_come_through_unchanged_where_no_marker_lies(journey):
    run, picture = load_run(journey / "run"), np.asarray(Image.open(journey / "picture.png"))
    assert (run.design[free(run)] == picture[free(run)]).all() and 0.5 < free(run).mean() < 1
    assert (run.design[~free(run)] == 255).all()


def test_pixels_of_a_coarse_picture_become_blocks(tmp_path):
    picture = slopes(50, 50)
    run = import_patch(picture, scene_with(tmp_path, **SMALL), tmp_path / "run", **DRAFT)
    assert run.design.shape == (250, 250, 3)  # 115 mm at 2 px per mm or more
    assert (run.design[free(run)] == picture.repeat(5, 0).repeat(5, 1)[free(run)]).all()
    assert run.details["imported"]["dpi"] == pytest.approx(25.4 * 50 / 115, abs=0.05)


def test_sheet_plan_and_report_say_that_it_was_imported(journey):
    record = json.loads((journey / "run" / "run.json").read_text())["imported"]
    assert record["file"] == "picture.png" and len(record["sha256"]) == 64
    origin = {"file": record["file"], "sha256": record["sha256"]}
    manifest = load_manifest(journey / "sheet.json")
    assert manifest.settings["imported"] == origin and attached_manifests(journey / "sheet.pdf")[0] == manifest
    with closing(PdfDocument(journey / "sheet.pdf")) as pdf:
        text = pdf[manifest.plan_page - 1].get_textpage().get_text_bounded()
    assert "Imported from picture.png (SHA-256" in text and "it was not optimized here" in text
    assert f"picture.png, SHA-256 <code>{record['sha256']}" in (journey / "report" / "report.html").read_text("utf-8")
    assert json.loads((journey / "report" / "report.json").read_text())["summary"]["judged"] == 2


def test_the_sheet_of_another_template_belongs_to_the_same_run_read_anew(journey, tmp_path):
    run = load_run(journey / "run")
    manifest = sheet_of(run, tmp_path / "letter.pdf", template="letter")
    fresh = import_patch(journey / "picture.png", journey / "scene.toml", tmp_path / "run", **DRAFT)
    assert manifest.sheet_id == fresh.scene.with_template("letter").sheet_id != run.scene.sheet_id
    assert fresh.scene.sheet_id == run.scene.sheet_id


def test_designs_on_one_scene_have_markers_of_their_own(tmp_path):
    scene = scene_with(tmp_path, **SMALL)
    runs = [import_patch(slopes(64, 64), scene, tmp_path / name, **DRAFT) for name in "ab"]
    a, b = ({marker.id for marker in run.scene.piece.markers} for run in runs)
    assert not a & b and runs[0].scene.sheet_id != scene.sheet_id


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # of pycocotools under NumPy 2
def test_boxes_of_reprints_and_reports_are_read_by_the_formats_own_reader(journey, capsys):
    truth = json.loads((journey / "photos" / "truth.json").read_text())
    cut = rect_corners(load_manifest(journey / "sheet.json").cut_mm)
    for folder, most_px in (("photos", 0.02), ("report", 1.5)):
        coco = COCO(journey / folder / "coco.json")
        assert [each["name"] for each in coco.loadCats(coco.getCatIds())] == ["red", PATCH]
        (patch,) = coco.getCatIds(catNms=[PATCH])
        for image in coco.loadImgs(coco.getImgIds()):
            (found,) = coco.loadAnns(coco.getAnnIds(imgIds=[image["id"]], catIds=[patch]))
            px = apply_homography(np.array(truth[image["file_name"]]["homography_px_from_mm"]), cut)
            assert found["bbox"] == pytest.approx([*px.min(0), *np.ptp(px, axis=0)], abs=most_px)
            assert coco.annToMask(found).sum() == pytest.approx(found["area"], rel=0.02)
            others = coco.loadAnns(coco.getAnnIds(imgIds=[image["id"]], catIds=coco.getCatIds(catNms=["red"])))
            assert len(others) == (folder == "photos")  # only the renderer knows where the object ends
            for whole in others:  # but for 3 % of overhang the piece lies on it
                overlap = [min(a + c, b + d) - max(a, b) for a, c, b, d in _sides(found["bbox"], whole["bbox"])]
                assert np.prod(overlap) > 0.9 * np.prod(found["bbox"][2:]) and whole["area"] > 2 * found["area"]


def _sides(a: list[float], b: list[float]) -> list[tuple[float, float, float, float]]:
    """(start, length) of two boxes along x and y."""
    return [(a[i], a[i + 2], b[i], b[i + 2]) for i in range(2)]


@pytest.mark.parametrize(("width", "height"), [(102, 100), (32, 32), (1024, 1024)])
def test_the_last_pictures_that_fit(tmp_path, width, height):
    picture = noise(width, height)
    assert fit_to_piece(picture, scene_with(tmp_path)) is picture


@pytest.mark.parametrize(
    ("width", "height", "sentence"),
    [
        (
            103,
            100,
            r"got 103 × 100 pixels: crop it to 100 × 100, or pad it to 103 × 103, or set patch.height_mm = 111.7",
        ),
        (100, 103, r"crop it to 100 × 100, or pad it to 103 × 103, or set patch.height_mm = 118.5"),
        (31, 32, "32 pixels or more along its shorter side, got 31 × 32: enlarge it yourself"),
    ],
)
def test_the_first_pictures_that_do_not(tmp_path, width, height, sentence):
    with pytest.raises(Refused, match=sentence):
        fit_to_piece(noise(width, height), scene_with(tmp_path))


def test_a_picture_made_smaller_keeps_its_light(tmp_path):
    """Black and white columns: half the light is code 188, half the code values would be 128."""
    columns = np.zeros((2048, 2048, 3), np.uint8)
    columns[:, ::2] = 255
    smaller = fit_to_piece(columns, scene_with(tmp_path))
    assert smaller.shape == (1024, 1024, 3) and (smaller == 188).all()


@pytest.mark.parametrize("kind", ["turned", "see-through", "16 bit"])
def test_pictures_are_read_like_photographs(tmp_path, kind):
    picture, path = noise(64, 40), tmp_path / "picture.png"
    if kind == "turned":
        exif = Image.Exif()
        exif[0x0112] = 6
        Image.fromarray(np.ascontiguousarray(np.rot90(picture))).save(path, exif=exif)
    elif kind == "see-through":
        clear = np.dstack([picture, np.where(picture[..., 0] > 128, 255, 0).astype(np.uint8)])
        Image.fromarray(clear).save(path)
        picture = np.where(clear[..., 3:] == 255, picture, np.uint8(255))
    else:
        cv2.imwrite(str(path), picture[..., ::-1].astype(np.uint16) * 257)
    assert (imported_design._read_picture(path)[2] == picture).all()


def test_gamut_is_the_printers_own_table(tmp_path):
    picture = np.full((64, 64, 3), (0, 255, 0), np.uint8)
    large = {"camera__photo_px": [96, 96]}  # photographs that show the whole picture
    record = import_patch(picture, scene_with(tmp_path, **large), tmp_path / "run", **DRAFT).details
    green = float(load_printer("office").gamut[0, -1, 0])
    assert green > 2 and record["imported"]["out_of_gamut"] == 1
    assert record["imported"]["delta_e00"] == pytest.approx(green, abs=0.01)
    exact = scene_with(tmp_path, **large, printer__profile="identity")
    record = import_patch(picture, exact, tmp_path / "exact", **DRAFT).details["imported"]
    assert record["out_of_gamut"] == record["delta_e00"] == 0
    assert not list(record["notes"])


def with_markers(scene, count: int, ours: bool = False) -> np.ndarray:
    """A picture that shows markers which are not the piece's, or more of its own, in its middle."""
    known = {marker.id for marker in scene.piece.markers}
    ids = sorted(known) if ours else [i for i in range(1000) if i not in known]
    picture = np.full((460, 460, 3), 255, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))
    for i, (x, y) in zip(ids[:count], ((150, 200), (260, 200)), strict=False):
        picture[y : y + 70, x : x + 70] = cv2.aruco.generateImageMarker(dictionary, i, 70)[..., None]
    return picture


def test_a_picture_of_markers_is_refused_and_a_single_one_said(tmp_path):
    piece = (scene := scene_with(tmp_path)).piece
    (note,) = imported_design._marker_notes(with_markers(scene, 1), piece)
    assert note.startswith("the detector takes a part of it for marker ")
    for ours in (False, True):
        with pytest.raises(Refused, match="one that shows markers of its own"):
            list(imported_design._marker_notes(with_markers(scene, 2, ours), piece))
    assert not list(imported_design._marker_notes(with_markers(scene, 0), piece))


@pytest.mark.parametrize(
    ("picture", "changes", "sentence"),
    [
        ("gone.png", {}, "Expected a picture, got no file at"),
        ("text.png", {}, "text.png is not a picture of a known kind: save it as JPEG or PNG"),
        ("wide.png", {}, "with the proportions of the piece"),
        ("good.png", {"patch__place": "auto"}, 'got patch.place = "auto"'),
        ("good.png", {"patch__kind": "texture"}, "got a run of the object's own texture: leave patch.kind out"),
    ],
)
def test_what_cannot_be_imported_is_one_sentence_and_leaves_nothing(tmp_path, capsys, picture, changes, sentence):
    (tmp_path / "text.png").write_text("no picture")
    for name, width in (("wide.png", 90), ("good.png", 64)):
        Image.fromarray(noise(width, 64)).save(tmp_path / name)
    scene = toml(tmp_path / "scene.toml", **changes)
    if changes:
        text = scene.read_text("utf-8").replace('side = "+z"\n', "")
        if "patch__kind" in changes:
            text = text.replace("width_mm = 115\n", "").replace("height_mm = 115\n", "")
        scene.write_text(text, "utf-8")
    assert command("import", tmp_path / picture, scene, "--out", tmp_path / "run") == 1
    assert sentence in capsys.readouterr().err and not (tmp_path / "run").exists()


def test_pixels_of_another_kind_are_refused(tmp_path):
    with pytest.raises(Refused, match=r"uint8 H×W×3 pixels, got float64 \(64, 64, 3\): convert it to 8-bit RGB"):
        import_patch(np.zeros((64, 64, 3)), scene_with(tmp_path), tmp_path / "run")


def test_a_stopped_import_leaves_an_earlier_run_as_it_was(tmp_path, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    scene, out = scene_with(tmp_path, **SMALL), tmp_path / "run"
    import_patch(slopes(64, 64), scene, out, **DRAFT)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    monkeypatch.setattr(run_module, "promise_of", stop)
    with pytest.raises(KeyboardInterrupt):
        import_patch(slopes(64, 64), scene, out, overwrite=True, **DRAFT)
    assert before == {path.name: path.read_bytes() for path in out.iterdir()}
    with pytest.raises(Refused, match="add --overwrite"):
        import_patch(slopes(64, 64), scene, out, **DRAFT)


@pytest.fixture(scope="module")
def several(tmp_path_factory):
    """A folder with scene.toml and runs/ of pictures: red, as the network wants it, gray and blue."""
    folder = tmp_path_factory.mktemp("several")
    scene = toml(folder / "scene.toml")
    for name, color in (("red", (220, 30, 30)), ("gray", (128, 128, 128)), ("blue", (30, 30, 220))):
        import_patch(np.full((64, 64, 3), color, np.uint8), scene, folder / "runs" / name, **DRAFT)
    return folder


def test_several_designs_are_compared_on_the_same_conditions(several, capsys):
    runs, out = [several / "runs" / name for name in ("blue", "gray", "red")], several / "compared"
    assert command("evaluate", *runs, "--out", out, "--n", 6, "--trust") == 0
    assert "The best two, under conditions that had no say in choosing them" in capsys.readouterr().out
    tables = json.loads((out / "designs.json").read_text())["tables"]
    order = [row[0] for row in tables["designs"]["rows"]]
    assert order[0] == "red" and order[-1] == "blue"
    assert [row[0] for row in tables["fresh"]["rows"]] == order[:2] and tables["fresh"]["rows"][0][5] is None
    rates = {row[0]: row[2]["value"] for row in tables["designs"]["rows"]}
    for row in tables["designs"]["rows"][1:]:
        assert row[5]["value"] == pytest.approx(rates[row[0]] - rates["red"]) and row[5]["n"] == 6
    assert "data:image/png" in (out / "designs.html").read_text("utf-8")
    assert command("evaluate", *runs) == 2 and "--out" in capsys.readouterr().err
    assert command("evaluate", runs[0], "--out", out) == 2


def test_runs_of_one_scene_in_two_folders_are_compared_unless_their_networks_are_other_files(tmp_path, monkeypatch):
    monkeypatch.setattr("patchproof.report.tables.draw_figure", lambda *_, **__: b"drawn above")
    for folder in "ab":
        import_patch(slopes(64, 64), scene_with(tmp_path / folder, **SMALL), tmp_path / folder / "run", **DRAFT)
    assert compare_runs([tmp_path / folder / "run" for folder in "ab"], tmp_path / "out", n=4, trust=True).tables
    here, there = (scene_with(tmp_path / folder, **SMALL, target__models=["file:net.onnx"]) for folder in "ab")
    assert compare._views_of(here, True) != compare._views_of(there, True)
    assert compare._views_of(here, False) == compare._views_of(there, False)


def test_runs_that_are_not_seen_alike_are_not_compared(several, tmp_path):
    other = scene_with(several, **SMALL | {"camera__photo_px": [96, 64]})
    import_patch(slopes(64, 64), other, tmp_path / "other", **DRAFT)
    with pytest.raises(Refused, match=r"runs with the same views as red, got other with other settings of its views"):
        compare_runs([several / "runs" / "red", tmp_path / "other"], tmp_path / "out", n=4)
    with pytest.raises(Refused, match="two runs or more to compare, each once"):
        compare_runs([several / "runs" / "red"] * 2, tmp_path / "out", n=4)
