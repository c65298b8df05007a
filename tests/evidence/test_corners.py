"""Prints without markers, located by the corners of their design: named exactly or not, and where that breaks."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
import synthetic_photos as paper
from console import command
from PIL import Image
from pypdfium2 import PdfDocument

from patchproof.app.verify import CaptureInfo, verify
from patchproof.base.color import linear_from_srgb
from patchproof.base.errors import Refused
from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.channel.printer import load_printer
from patchproof.evidence.annotations import CORNER_SIGMA_PX, corners_csv, corners_of_photo, find_in_photos, load_corners
from patchproof.evidence.locate import pinhole_photo
from patchproof.evidence.measure import measure
from patchproof.evidence.surface import printed_colors, surface_of
from patchproof.evidence.task import promised_ranges
from patchproof.optimizer.imported_design import import_patch
from patchproof.optimizer.promise import PromiseOptions
from patchproof.photo import read
from patchproof.photo.read import Photo
from patchproof.photo.registration import DesignCorners
from patchproof.reprints.reprint import reprint
from patchproof.reprints.run_sheet import sheet as sheet_of
from patchproof.sheets.content import SheetContent
from patchproof.sheets.manifest import Manifest, load_manifest
from patchproof.sheets.page import refuse_larger_than_page
from patchproof.sheets.template import load_template, page_template
from patchproof.sheets.write import write_sheet
from test_optimize import scene_with, toml

SIZE_PX, DRAFT = (480, 360), PromiseOptions(views=8, controls=("bare",))
PX_FROM_MM = paper.view(25, 15, 480, size_px=SIZE_PX)
CORNERS_PX = apply_homography(PX_FROM_MM, rect_corners(paper.DESIGN_MM))
DIRECTIONS = np.array([[1, 1], [-1, 1], [1, -1], [1, 0.2]]) / 2**0.5


def without_markers(design) -> Manifest:
    data = paper.make_manifest(design=design).model_dump()
    return Manifest.model_validate(data | {"markers": (), "settings": {"sheet": {"markers": False}}})


def design_of(seed: int) -> np.ndarray:
    return (255 * paper.noisy_design(seed)).astype(np.uint8)


def colors_of(design):
    return printed_colors(design, surface_of(without_markers(design)), load_printer("coated"))


@pytest.fixture(scope="module")
def photo():
    """A photograph of the piece as the promise's printer prints it, before gray."""
    page = np.full((2000, 1750, 3), 0.2, np.float32)
    page[600:, 350:] = colors_of(design_of(0)).design.repeat(10, 0).repeat(10, 1)
    return paper.photograph(page, PX_FROM_MM, SIZE_PX, blur_px=0.8, noise=0.004, fine=2)


def entry_of(srgb, corners_px, design=None, sigma_px=CORNER_SIGMA_PX):
    design = design_of(0) if design is None else design
    surface, promised = surface_of(without_markers(design)), colors_of(design)
    corners = None if corners_px is None else DesignCorners(np.array(corners_px), sigma_px)
    view = pinhole_photo(Photo(srgb, None), None)
    return measure(view, "a.jpg", surface, promised, promised_ranges(()), with_pictures=False, corners=corners).entry


@pytest.mark.parametrize("off_px", [0, 1, 3, 10])
def test_corners_that_are_off_are_corrected_by_the_design(photo, off_px):
    """Up to 7 % of its side here, of 135 px; beyond 15 % see below."""
    entry = entry_of(photo, CORNERS_PX + off_px * DIRECTIONS)
    assert entry.status == "measured" and entry.located == "corners" and entry.markers_found == 0
    found = apply_homography(np.array(entry.geometry.homography_px_from_mm), rect_corners(paper.DESIGN_MM))
    error_px = np.linalg.norm(found - CORNERS_PX, axis=1).max()
    assert error_px < 0.7 and error_px / entry.geometry.px_per_mm < entry.geometry.corner_uncertainty_mm
    assert 0.4 < entry.geometry.blur_px < 1.5
    assert entry.geometry.contrast == pytest.approx(0.8, rel=0.1), "of light 0.8 on paper, read from the design"


def test_cells_of_a_smooth_design_in_other_colors_move_no_exact_corners():
    """The promise's printer shows these colors otherwise, which shifts what is similar by several pixels."""
    codes = np.random.default_rng(3).integers(0, 256, (4, 4, 3), np.uint8)
    design = np.asarray(Image.fromarray(codes).resize((140, 140), Image.Resampling.BICUBIC))
    page = np.full((2000, 1750, 3), 0.2, np.float32)
    page[600:, 350:] = linear_from_srgb(design / 255.0).repeat(10, 0).repeat(10, 1)
    seen = paper.photograph(page, PX_FROM_MM, SIZE_PX, blur_px=0.8, noise=0.004, fine=2)
    entry = entry_of(seen, CORNERS_PX, design)
    found = apply_homography(np.array(entry.geometry.homography_px_from_mm), rect_corners(paper.DESIGN_MM))
    assert np.linalg.norm(found - CORNERS_PX, axis=1).max() < 1
    assert entry.code != "curled"


def test_what_is_said_of_a_print_without_markers_names_none(photo):
    shifted = photo.copy()
    shifted[:180] = np.roll(shifted[:180], 5, 1)
    for entry in (entry_of(shifted, CORNERS_PX, sigma_px=0.1), entry_of(photo, CORNERS_PX, design_of(5))):
        assert entry.code in ("curled", "other_design") and "marker" not in entry.remark.advice


@pytest.mark.parametrize("wrong", ["far off", "another corner first", "another design", "one color"])
def test_what_the_corners_do_not_show_is_said(photo, wrong):
    corners = {"far off": CORNERS_PX + 40 * DIRECTIONS, "another corner first": np.roll(CORNERS_PX, 1, 0)}
    design = {"another design": design_of(5), "one color": np.full((140, 140, 3), 90, np.uint8)}
    seen, sigma_px = (np.full_like(photo, 90), 0.5) if wrong == "one color" else (photo, CORNER_SIGMA_PX)
    entry = entry_of(seen, corners.get(wrong, CORNERS_PX), design.get(wrong), sigma_px)
    code = "no_corners" if wrong == "another corner first" else "other_design"
    assert (entry.status, entry.code) == ("rejected", code) and entry.color is None
    assert code != "other_design" or "between the corners that were named" in entry.remark.advice


def test_without_corners_nothing_says_where_it_is(photo):
    entry = entry_of(photo, None)
    assert (entry.status, entry.code) == ("rejected", "no_corners") and "--corners" in entry.remark.advice


def test_a_sheet_without_markers_says_so_in_its_settings():
    with pytest.raises(ValueError, match="it has no markers"):
        Manifest.model_validate(paper.make_manifest().model_dump() | {"markers": ()})


def coco(path, corners, size=(480, 360), **more):
    """COCO JSON with a polygon, or keypoints if `more` says so, in a.jpg."""
    numbers = np.round(corners, 3).ravel().tolist()
    image = {"id": 1, "file_name": "s\\a.jpg", "width": size[0], "height": size[1]}
    annotation = {"image_id": 1, "segmentation": [numbers]} | more
    path.write_text(json.dumps({"images": [image], "annotations": [annotation, {"image_id": 1, "bbox": [0, 0, 1, 1]}]}))
    return path


def test_corners_are_read_from_csv_and_coco(tmp_path):
    picture = tmp_path / "a.jpg"
    exif = Image.Exif()
    exif[0x0112] = 6  # stored lying, shown upright: 480 × 360
    Image.new("RGB", (360, 480)).save(picture, exif=exif)
    (tmp_path / "c.csv").write_text(corners_csv({"s/a.jpg": CORNERS_PX}))
    keypoints = [v for x, y in CORNERS_PX.tolist() for v in (x, y, 2)]
    for path, precision in (
        (tmp_path / "c.csv", 0.006),
        (coco(tmp_path / "p.json", CORNERS_PX), 0.001),
        (coco(tmp_path / "k.json", CORNERS_PX, keypoints=keypoints), 0.001),
        (coco(tmp_path / "h.json", CORNERS_PX / 2, size=(240, 180)), 0.001),
    ):
        corners = load_corners(path)
        for name in ("s/a.jpg", "a.jpg"):
            photos = [(name, picture), ("elsewhere/a.jpg", picture)]
            (found, none), _ = find_in_photos("corners", corners, corners_of_photo, photos)
            assert found.px == pytest.approx(CORNERS_PX, abs=precision) and none is None
    with pytest.raises(Refused, match="upright, 480 × 360 pixels, got corners in a picture of 360 × 480"):
        (named,) = load_corners(coco(tmp_path / "t.json", CORNERS_PX, size=(360, 480))).values()
        corners_of_photo(named, "s/a.jpg", picture)


def test_blanks_round_a_photographs_name_are_none_of_it(tmp_path):
    (tmp_path / "c.csv").write_text("file, x1, y1, x2, y2, x3, y3, x4, y4\n a.jpg , 0, 0, 9, 0, 9, 9, 0, 9\n")
    assert list(load_corners(tmp_path / "c.csv")) == ["a.jpg"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a.jpg,0,0,9,0,9,9,0,9", "that begins with"),
        ("HEAD\na.jpg,0,0,9,0,9,9", "3 points of a.jpg"),
        ("HEAD\na.jpg,0,0,9,0,9,nan,0,9", "eight numbers"),
        ("HEAD\na.jpg,0.1,0.1,0.4,0.1,0.4,0.5,0.1,0.5", "shares of the picture"),
        ("HEAD\na.jpg,0,0,9,0,x,9,0,9", "eight numbers"),
        ("HEAD\na.jpg,9,0,0,0,0,9,9,9", "mirrored"),
        ("HEAD\na.jpg,0,0,9,9,9,0,0,9", "not convex"),
        ("HEAD\na.jpg,0,0,9,0,9,9,0,9\na.jpg,0,0,9,0,9,9,0,9", "two rows of a.jpg"),
    ],
)
def test_what_is_not_four_corners_is_refused(tmp_path, text, message):
    path = tmp_path / "c.csv"
    path.write_text(text.replace("HEAD", "file,x1,y1,x2,y2,x3,y3,x4,y4"))
    with pytest.raises(Refused, match=message):
        load_corners(path)
    with pytest.raises(Refused, match=r"2.5 points|4.5 points|four points"):
        load_corners(coco(tmp_path / "p.json", CORNERS_PX, segmentation=[[0, 0, 9, 0, 9]]))


UNLABELED = [v for x, y in CORNERS_PX.tolist()[:3] for v in (x, y, 2)] + [0, 0, 0]


@pytest.mark.parametrize(
    "more",
    [
        None,
        {"segmentation": {"counts": [3, 5], "size": [480, 360]}},
        {"image_id": 7},
        {"keypoints": UNLABELED},
        {"keypoints": [0] * 12},
    ],
)
def test_a_file_without_any_corners_is_refused(tmp_path, more):
    path = tmp_path / "c.csv"
    path.write_text(corners_csv({})) if more is None else coco(path := tmp_path / "c.json", CORNERS_PX, **more)
    with pytest.raises(Refused, match=r"corners of the design in .*c\.(csv|json), got none of any photograph: name"):
        load_corners(path)


@pytest.fixture(scope="module")
def printed(tmp_path_factory):
    """A print that exists, larger than its scene's page, on which the scene's own piece would not lie either: run/,
    print.json, and photographs with corners.csv.
    """
    folder = tmp_path_factory.mktemp("printed")
    toml(folder / "scene.toml", camera__photo_px=[480, 360], patch__width_mm=900, patch__height_mm=900)
    run = import_patch(design_of(0), folder / "scene.toml", folder / "run", as_printed=(160, 160), promise=DRAFT)
    sheet_of(run, folder / "print.json")
    reprint(folder / "print.json", run, 4, folder / "photos", sessions=2)
    return folder, run


def judged(folder, corners, out):
    options = {"models": ["module:fake_networks.red_against_blue"], "ledger_photos": 2}
    capture = CaptureInfo(corners=corners)
    return verify(folder / "photos", folder / "print.json", folder / out, capture=capture, **options)


def test_a_print_that_exists_is_promised_photographed_and_judged(printed):
    folder, run = printed
    manifest, text = load_manifest(folder / "print.json"), (folder / "photos" / "corners.csv").read_text()
    assert manifest.markers == () and manifest.page_mm == manifest.cut_mm[2:] == manifest.ruler_mm == (160, 160)
    assert (manifest.design.pixels() == run.design).all() and run.scene.sheet_id == manifest.sheet_id
    rows = text.splitlines()
    (folder / "some.csv").write_text("\n".join([rows[0], *rows[1:4], rows[4].replace("photo", "other")]))
    report = judged(folder, folder / "some.csv", "report")
    assert [photo.status for photo in report.photos] == ["measured"] * 3 + ["rejected"]
    assert report.photos[3].code == "no_corners" and report.summary.judged == 3
    assert "FILE does not name this photograph: add it there" in report.photos[3].remark.advice
    assert any(line.startswith("corners of 1 other photographs (") for line in report.summary.left_out)
    assert "3 photographs were located by the design alone" in "".join(report.summary.not_measured.values())
    data = json.loads((folder / "report" / "coco.json").read_text())
    assert {a["attributes"]["located"] for a in data["annotations"] if "attributes" in a} == {"corners"}
    assert "named corners" in (folder / "report" / "report.html").read_text()
    assert json.loads((folder / "report" / "report.json").read_text())["photos"][0]["located"] == "corners"
    for corners, message in (("c.csv", "corners of these photographs"),):
        (folder / corners).write_text(corners_csv({"x.jpg": CORNERS_PX}))
        with pytest.raises(Refused, match=message):
            judged(folder, folder / corners, "none")


def test_the_one_file_of_a_print_without_a_page_is_named_once(printed, tmp_path, capsys):
    (_, run), out = printed, tmp_path / "print.json"
    assert command("sheet", run.folder, "--out", out) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"sheet {run.scene.sheet_id} (design): {out}"


def test_what_needs_a_page_is_refused_for_a_print_without_one(printed, tmp_path, capsys):
    (folder, run), out = printed, tmp_path / "print.json"
    sheet_of(run, tmp_path / "there.json")
    picture, scene = folder / "run" / "design.png", folder / "scene.toml"
    for words, code, said in (
        (["sheet", run.folder, "--out", out, "--check"], 1, "Expected a page for --check and --copies, got"),
        (["sheet", run.folder, "--out", out, "--copies", 3], 1, "a print without one: leave them out"),
        (["sheet", run.folder, run.folder, "--out", out], 1, "a page for a sheet together, got prints without one"),
        (["reprint", tmp_path / "there.json", "--n", 1, "--out", out], 2, "prints without a page need --run RUN"),
        (["import", picture, scene, "--out", tmp_path / "o", "--as-printed", "120x120mm"], 2, "mm, without the unit"),
        (["import", picture, scene, "--out", out, "--as-printed", "120x60"], 1, "such as --as-printed 120x120."),
        (
            ["verify", folder, "--sheet", folder / "print.json", "--out", out],
            1,
            "or --corners FILE for a print without",
        ),
    ):
        assert command(*words) == code
        assert said in " ".join(capsys.readouterr().err.replace("│", " ").split()), words
    with pytest.raises(Refused, match=r"a page to repeat, got a print without one: leave copies out\.$"):
        sheet_of(run, out, copies=3)
    assert [path.name for path in tmp_path.iterdir()] == ["there.json"]


def test_corners_outside_of_the_picture_are_said(printed):
    folder = printed[0]
    head, first, *_ = (folder / "photos" / "corners.csv").read_text().splitlines()
    name = first.split(",")[0]
    (folder / "out.csv").write_text(f"{head}\n{name},-90,0,300,0,300,300,0,300")
    photo = judged(folder, folder / "out.csv", "outside").photos[0]
    assert (photo.code, photo.remark.figure) == ("no_corners", 90) and "480 × 360" in photo.remark.advice


def test_corners_are_the_file_s_pixels_at_half_its_size_and_a_refusal_keeps_the_report(printed, monkeypatch):
    folder = printed[0]
    head, first, *_ = (folder / "photos" / "corners.csv").read_text().splitlines()
    (folder / "first.csv").write_text(f"{head}\n{first}")  # the others are not looked at
    whole = judged(folder, folder / "first.csv", "whole").photos[0]
    monkeypatch.setattr(read, "WHOLE_PX", 480 * 360 - 1)
    half = judged(folder, folder / "first.csv", "half").photos[0]
    assert (half.status, half.photo_px) == ("measured", (240, 180)) and whole.photo_px == (480, 360)
    whole_px, half_px = (
        apply_homography(np.array(photo.geometry.homography_px_from_mm), np.array([(80.0, 80.0)]))
        for photo in (whole, half)
    )
    np.testing.assert_allclose(half_px, whole_px / 2, atol=0.3)
    # a refusal of other corners keeps that report
    before = {path.name: path.read_bytes() for path in (folder / "half").iterdir() if path.is_file()}
    (folder / "others.csv").write_text((folder / "photos" / "corners.csv").read_text().replace("photo", "other"))
    options = {"models": ["module:fake_networks.red_against_blue"], "overwrite": True}
    with pytest.raises(Refused, match="corners"):
        verify(
            folder / "photos",
            folder / "print.json",
            folder / "half",
            capture=CaptureInfo(corners=folder / "others.csv"),
            **options,
        )
    assert {path.name: path.read_bytes() for path in (folder / "half").iterdir() if path.is_file()} == before


@pytest.mark.parametrize("size", ["1x1", "1e9x1e9"])
def test_absurd_sizes_are_refused(printed, size, capsys):
    folder, _ = printed
    picture = folder / "p.png"
    Image.fromarray(design_of(0)).save(picture)
    assert command("import", picture, folder / "scene.toml", "--as-printed", size, "--out", folder / "absurd") != 0
    assert "Expected" in capsys.readouterr().err and not (folder / "absurd").exists()


def test_a_page_without_markers_keeps_its_cut_its_rulers_and_the_design_s_pixels(tmp_path):
    scene, bare = scene_with(tmp_path), scene_with(tmp_path, sheet__markers=False)
    assert scene.piece.markers and not bare.piece.markers and bare.unreadable_share == 0.0
    assert scene.sheet_id != bare.sheet_id and "markers" not in scene.settings.model_dump()["sheet"]
    content = SheetContent(bare.piece, bare.sheet_id, "design", design_of(0), settings=bare.settings.model_dump())
    manifest = write_sheet(tmp_path / "b.pdf", load_template("a4"), content)
    with_markers = write_sheet(tmp_path / "m.pdf", load_template("a4"), replace(content, piece=scene.piece))
    assert manifest.markers == () and with_markers.markers and with_markers.cut_mm == manifest.cut_mm
    assert (manifest.design.pixels() == design_of(0)).all(), "none is white for a marker"
    for name, keeps in (("b.pdf", False), ("m.pdf", True)):
        with closing(PdfDocument(tmp_path / name)) as pdf:
            text = pdf[0].get_textpage().get_text_range()
        assert "100" in text and ("Keep the squares" in text) == keeps, "the rulers' digits, and what to keep"
    for template, message in (("a4_tiles", "markers on a piece in tiles"), ("none", "a print of 5 mm to 20 m")):
        with pytest.raises(Refused, match=message):
            refuse_larger_than_page(page_template(template), replace(bare.piece, size_mm=(4.0, 250.0)))
    with pytest.raises(Refused, match="takes markers"):
        bare.settings.changed(sheet={"template": "none", "markers": True})
    with pytest.raises(Refused, match="ends in"):
        write_sheet(tmp_path / "n.pdf", None, content)
