"""The files: what independent readers (PDFium, OpenCV, pikepdf) find in what was written."""

import io
import json
import os
import subprocess
import sys

import cv2
import numpy as np
import pikepdf
import pytest
from PIL import Image, ImageCms

from patchproof.base.color import linear_from_srgb
from patchproof.base.errors import Refused
from patchproof.sheets.content import SheetContent, piece_words
from patchproof.sheets.manifest import dump_manifest, load_manifest
from patchproof.sheets.pdf import srgb_profile
from patchproof.sheets.pdf_raster import attached_manifests, rasterize_page, rasterize_piece
from patchproof.sheets.piece import control_design, lay_out_piece, marker_image
from patchproof.sheets.print_advice import SHOP_ADVICE, sheet_advice
from patchproof.sheets.template import load_template
from patchproof.sheets.write import write_sheet

ID = "A1B2C3D4E5"
DPI = 150
PX_PER_MM = DPI / 25.4


def sample_design(width=96, height=96):
    rng = np.random.default_rng(0)
    return rng.integers(0, 256, (height, width, 3), np.uint8)


def write(path, piece_mm=(162, 162), marker_mm=19.0, kind="design", design="sample", bends=False):
    if isinstance(design, str):
        design = control_design(kind, sample_design(), ID)
    settings = {"patch": {"width_mm": piece_mm[0], "height_mm": piece_mm[1]}, "seed": 0}
    content = SheetContent(lay_out_piece(piece_mm, marker_mm, ID, kind, bends), ID, kind, design, settings=settings)
    return write_sheet(path, load_template("a4"), content)


def reserved_px(manifest):
    """Which of the design's pixels belong to markers."""
    piece = lay_out_piece(manifest.cut_mm[2:], 19.0, ID, "design")
    return marker_image(piece, manifest.design.size_px)[1]


def words_px(piece, manifest, shape):
    """Which pixels of a picture of the piece may have its words: the outer millimeter of three corners."""
    mask, scale = np.zeros(shape[:2], bool), shape[1] / piece.size_mm[0]
    for box in piece_words(SheetContent(piece, manifest.sheet_id, manifest.kind, None), (0.0, 0.0)).boxes:
        x, y, w, h = box.rect_mm
        assert min(y, piece.size_mm[1] - y - h) == pytest.approx(0.139)
        (left, top), (right, bottom) = ((int(v * scale) for v in p) for p in ((x, y), (x + w, y + h)))
        mask[max(top - 2, 0) : bottom + 4, max(left - 1, 0) : right + 2] = True
    return mask


@pytest.fixture(scope="module")
def sheet(tmp_path_factory):
    path = tmp_path_factory.mktemp("sheet") / "sheet.pdf"
    return path, write(path)


@pytest.fixture(scope="module")
def page(sheet):
    return rasterize_page(sheet[0], 1, DPI)


def detect(pixels):
    """{id: 4×2 corners in px, pixel centers at .5}."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.minMarkerPerimeterRate = 100 / max(pixels.shape)  # not in every letter
    parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax  # light is even on a page
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_1000)
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(
        cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    )
    ids = [] if ids is None else np.asarray(ids).reshape(-1).tolist()
    return {i: c.reshape(4, 2) + 0.5 for i, c in zip(ids, corners, strict=True)}


@pytest.mark.parametrize(
    ("piece_mm", "marker_mm", "bends", "count"),
    [((162, 162), 19, True, 8), ((39, 39), 8, False, 4), ((166, 50), 8.7, False, 6), ((60, 140), 11.7, True, 6)],
)
def test_opencv_finds_every_marker_within_a_tenth_of_a_millimeter(tmp_path, piece_mm, marker_mm, bends, count):
    manifest = write(tmp_path / "s.pdf", piece_mm, marker_mm, bends=bends)
    found = detect(rasterize_page(tmp_path / "s.pdf", 1, DPI))
    assert set(found) == {marker.id for marker in manifest.markers}
    assert len(manifest.markers) == count + 4
    for marker in manifest.markers:
        # measured 0.02 to 0.05 mm at 150 dpi
        assert np.abs(found[marker.id] / PX_PER_MM - np.array(marker.corners_mm)).max() < 0.1


def test_a_hidden_corner_leaves_three_piece_markers(page, sheet):
    x, y, w, _ = sheet[1].cut_mm
    hidden = page.copy()
    hidden[: int((y + 40) * PX_PER_MM), int((x + w - 40) * PX_PER_MM) :] = 90
    assert len(set(detect(hidden)) & {m.id for m in sheet[1].markers[:4]}) == 3


def test_qr_code_can_be_read(page, sheet):
    text, _, _ = cv2.QRCodeDetector().detectAndDecode(page)
    assert text == f"patchproof:{ID}:{sheet[1].design.sha256[:16]}"


def test_rulers_measure_100_mm_on_the_page(sheet):
    template, pixels = load_template("a4"), rasterize_page(sheet[0], 1, 600)
    scale = 600 / 25.4

    def ends(strip):
        dark = np.flatnonzero(strip.min(2).mean(0) < 128)
        edges = np.split(dark, np.flatnonzero(np.diff(dark) > 1) + 1)
        assert len(edges) == 11  # the long ticks alone reach this deep
        return (edges[-1].mean() - edges[0].mean()) / scale, (edges[0].mean() + 0.5) / scale

    x, y = template.ruler.x_start_mm
    length, start = ends(
        pixels[int((y + 3.3) * scale) : int((y + 3.8) * scale), int((x - 2) * scale) : int((x + 102) * scale)]
    )
    assert length == pytest.approx(100, abs=0.05) and start == pytest.approx(2, abs=0.05)
    x, y = template.ruler.y_start_mm
    strip = pixels[int((y - 2) * scale) : int((y + 102) * scale), int((x + 3.3) * scale) : int((x + 3.8) * scale)]
    length, start = ends(strip.swapaxes(0, 1))
    assert length == pytest.approx(100, abs=0.05) and start == pytest.approx(2, abs=0.05)


def test_swatches_have_their_colors_on_the_page(page, sheet):
    for swatch in sheet[1].chart:
        x, y, w, h = swatch.rect_mm
        center = page[int((y + h / 2) * PX_PER_MM), int((x + w / 2) * PX_PER_MM)]
        assert np.array_equal(center, np.rint(np.array(swatch.srgb) * 255))
    assert len(sheet[1].chart) == 72


def test_design_is_in_the_pdf_pixel_for_pixel_but_for_its_white_corners(sheet):
    reserved = reserved_px(sheet[1])
    # 19 mm markers take 25.43 mm of a corner, 96 pixels on 162 mm: 15.07, so 16 pixels
    assert reserved[:16, :16].all() and reserved.sum() == 4 * 16 * 16
    with pikepdf.open(sheet[0]) as pdf:
        (image,) = pdf.pages[0].obj.Resources.XObject.values()
        assert image.Filter in ("/FlateDecode", ["/FlateDecode"])
        assert "/SMask" not in image and not image.get("/Interpolate", False)
        pixels = np.frombuffer(image.read_bytes(), np.uint8).reshape(image.Height, image.Width, 3)
        assert np.array_equal(pixels[~reserved], sample_design()[~reserved]) and (pixels[reserved] == 255).all()
        assert image.ColorSpace[0] == "/ICCBased"
        assert image.ColorSpace[1].read_bytes() == srgb_profile()
        assert image.ColorSpace[1].N == 3


def test_design_lies_exactly_where_the_manifest_says(page, sheet):
    """Each texel's middle, looked up through the manifest's millimeters, has the texel's color in PDFium's picture."""
    assert sheet[1].design.rect_mm == sheet[1].cut_mm
    free, (x, y, w, h) = ~reserved_px(sheet[1]), sheet[1].design.rect_mm
    columns = ((x + (np.arange(96) + 0.5) * w / 96) * PX_PER_MM).astype(int)
    rows = ((y + (np.arange(96) + 0.5) * h / 96) * PX_PER_MM).astype(int)
    seen = page[np.ix_(rows, columns)].astype(int)
    # PDFium interpolates between texels 10 px wide: the pixel nearest the middle may take a little of a neighbor
    assert np.median(np.abs(seen - sample_design())[free]) <= 16
    shifted = np.roll(seen, 1, 1)
    assert np.median(np.abs(shifted - sample_design())[free]) > 60


def test_srgb_profile_is_srgb_and_has_no_date():

    profile = ImageCms.ImageCmsProfile(io.BytesIO(srgb_profile()))
    same = ImageCms.profileToProfile(Image.fromarray(sample_design()), profile, ImageCms.createProfile("sRGB"))
    assert np.abs(np.asarray(same).astype(int) - sample_design()).max() <= 1
    assert srgb_profile()[24:36] == bytes([7, 208, 0, 1, 0, 1, 0, 0, 0, 0, 0, 0])


def test_fonts_are_embedded_and_pages_say_their_boxes(sheet):
    with pikepdf.open(sheet[0]) as pdf:
        fonts = pdf.pages[0].obj.Resources.Font
        assert len(fonts) == 2 and all("/FontFile2" in font.FontDescriptor for font in fonts.values())
        selected = {str(ops[0]) for ops, op in pikepdf.parse_content_stream(pdf.pages[0]) if str(op) == "Tf"}
        assert selected == set(fonts)
        assert b"Helvetica" not in b"".join(bytes(str(dict(o)), "utf8") for o in pdf.objects if hasattr(o, "keys"))
        for name in ("/MediaBox", "/TrimBox", "/BleedBox"):
            box = [float(v) for v in pdf.pages[0].obj[name]]
            assert box == pytest.approx([0, 0, 210 / 25.4 * 72, 297 / 25.4 * 72], abs=1e-3)
        assert pdf.Root.ViewerPreferences.PrintScaling == "/None"
        assert pdf.pdf_version == "1.7"


def test_metadata_has_no_time_and_no_path(sheet):
    raw = sheet[0].read_bytes()
    for word in (b"CreationDate", b"ModDate", str(sheet[0].parent).encode(), b"/tmp"):
        assert word not in raw
    with pikepdf.open(sheet[0]) as pdf:
        assert str(pdf.docinfo.Title) == f"patchproof sheet {ID} design"


def test_each_marker_is_one_path(sheet):
    """Eight markers, one QR code, and swatches: as many fills as parts, text aside."""
    with pikepdf.open(sheet[0]) as pdf:
        operators = [str(op) for _, op in pikepdf.parse_content_stream(pdf.pages[0])]
    fills = sum(op in ("f", "f*", "F") for op in operators)
    assert fills == len(sheet[1].markers) + 1 + len(sheet[1].chart)


def test_attachment_is_the_json_file(sheet):
    path, manifest = sheet
    with pikepdf.open(path) as pdf:
        assert list(pdf.attachments) == ["sheet.json"]
        attached = pdf.attachments["sheet.json"].get_file().read_bytes()
    assert attached == path.with_suffix(".json").read_bytes() == dump_manifest(manifest).encode()
    assert attached_manifests(path)[0] == load_manifest(path.with_suffix(".json")) == manifest
    free = ~reserved_px(manifest)
    assert np.array_equal(manifest.design.pixels()[free], sample_design()[free])


def test_the_same_sheet_twice_is_the_same_bytes_in_two_processes(tmp_path):
    code = (
        "import sys; sys.path[:0] = sys.argv[2:]; from pathlib import Path; import test_sheet_write as t; "
        "t.write(Path(sys.argv[1]))"
    )
    ours, theirs = tmp_path / "here.pdf", tmp_path / "there" / "another_name.pdf"
    environment = {"PYTHONHASHSEED": "1", "PYTHONPATH": ":".join(sys.path), "TZ": "UTC5"}
    subprocess.run([sys.executable, "-c", code, str(theirs), os.path.dirname(__file__)], check=True, env=environment)
    write(ours)
    assert ours.read_bytes() == theirs.read_bytes()
    assert ours.with_suffix(".json").read_bytes() == theirs.with_suffix(".json").read_bytes()


def test_another_design_is_another_file(tmp_path, sheet):
    design = sample_design()
    design[0, 0, 0] ^= 1  # what markers cover is no part of it
    write(tmp_path / "s.pdf", design=design)
    assert (tmp_path / "s.pdf").read_bytes() == sheet[0].read_bytes()
    design[0, 48, 0] ^= 1
    write(tmp_path / "s.pdf", design=design)
    assert (tmp_path / "s.pdf").read_bytes() != sheet[0].read_bytes()


@pytest.mark.parametrize(
    ("marker_mm", "mean", "most"),
    [
        (14, 1e-4, 0.002),  # modules of 4 px that begin at 6
        # PDFium's antialiasing is of sRGB values in 1/8 px: up to an eighth of an edge pixel
        (13, 0.006, 0.13),
    ],
)
def test_marker_image_agrees_with_the_pdf(tmp_path, marker_mm, mean, most):
    """PDFium at 8 × the design's resolution, box-averaged in light, against the exact coverage of `marker_image`."""
    path = tmp_path / "s.pdf"
    gray = np.full((168, 168, 3), 128, np.uint8)  # 2 px/mm
    manifest = write(path, (84, 84), marker_mm, design=gray, bends=True)
    image, reserved = marker_image(lay_out_piece((84, 84), marker_mm, ID, "design", bends=True), (168, 168))
    fine = rasterize_piece(path, manifest, 16 * 25.4)
    assert fine.shape == (168 * 8, 168 * 8, 3)
    linear = linear_from_srgb(fine / 255).reshape(168, 8, 168, 8, 3).mean((1, 3))
    difference = np.abs(linear - linear_from_srgb(image.astype(float)))
    words = words_px(lay_out_piece((84, 84), marker_mm, ID, "design", bends=True), manifest, reserved.shape)
    difference[words] = 0
    assert words.sum() < 0.01 * words.size
    # PDFium smooths between texels: a pixel from where gray and white meet
    kernel = np.ones((3, 3))
    inner, outer = (cv2.erode(part.astype(np.uint8), kernel, borderValue=1) > 0 for part in (reserved, ~reserved))
    assert np.abs(linear[outer] - linear_from_srgb(np.array(128 / 255))).max() < 0.001
    assert difference[inner].mean() < mean and difference[inner].max() < most


def test_piece_pixels_end_at_the_cut_line(sheet, tmp_path):
    path, manifest = sheet
    pixels = rasterize_piece(path, manifest, 200)
    height, width = pixels.shape[:2]
    assert (width, height) == (round(162 / 25.4 * 200),) * 2
    found = detect(pixels)
    for marker in manifest.markers[:4]:
        mm = found[marker.id] * np.array(manifest.cut_mm[2:]) / (width, height) + manifest.cut_mm[:2]
        assert np.abs(mm - np.array(marker.corners_mm)).max() < 0.1
    # no ink of the dashed line, which lies outside: a blank piece is white all round
    # (PDFium counts coverage in 1/256: one code value of it may show)
    blank = rasterize_piece(tmp_path / "b.pdf", write(tmp_path / "b.pdf", kind="blank", design=None), 200)
    blank[words_px(lay_out_piece((162, 162), 19.0, ID, "blank"), manifest, blank.shape)] = 255
    assert min(blank[:7].min(), blank[-7:].min(), blank[:, :7].min(), blank[:, -7:].min()) >= 254
    # and the design's outermost texels, 13 px wide, reach up to it
    at, free = ((np.arange(16, 80) + 0.5) * width / 96).astype(int), sample_design()[:, 16:80]
    for line, texels in ((pixels[0, at], free[0]), (pixels[-1, at], free[-1])):
        assert np.median(np.abs(line.astype(int) - texels)) <= 16


def test_page_pixels_are_not_stretched_to_whole_pixels(page, sheet):
    """A4 is 1240.16 px wide at 150 dpi; stretched to 1241, markers at the right edge would lie 0.14 mm off."""
    assert page.shape == (1754, 1241, 3)
    found = detect(page)
    errors = [found[m.id] / PX_PER_MM - np.array(m.corners_mm) for m in sheet[1].markers if m.corners_mm[0][0] > 180]
    assert len(errors) == 2
    assert np.abs(np.mean(errors, axis=(0, 1))).max() < 0.03


def test_blank_sheet_has_no_design_and_white_in_its_middle(tmp_path):
    path = tmp_path / "blank.pdf"
    manifest = write(path, kind="blank", design=None)
    assert manifest.design is None and manifest.kind == "blank"
    pixels = rasterize_piece(path, manifest, 100)
    low = int(27 / 25.4 * 100)  # corners of 25.4 mm are the markers'
    assert (pixels[low:-low, 1:-1] == 255).all() and (pixels[1:-1, low:-low] == 255).all()
    assert cv2.QRCodeDetector().detectAndDecode(rasterize_page(path, 1, DPI))[0] == f"patchproof:{ID}:blank"
    assert any("no design" in line for line in sheet_advice(manifest))


def test_check_sheet_tells_the_print_shop(sheet):
    lines = (*sheet_advice(sheet[1]), *SHOP_ADVICE)
    text = " ".join(lines)
    for word in (
        "210 × 297 mm",
        "100 %",
        "bleed",
        "162.0 × 162.0 mm",
        "sRGB",
        "15 ppi",
        "embedded",
        "matte",
        "100 mm",
        "lossless",
    ):
        assert word in text
    assert all(line.endswith(".") for line in lines)


def test_control_sheets_share_the_geometry_but_no_id(tmp_path, sheet):
    gray = write(tmp_path / "gray.pdf", kind="gray")
    assert gray.cut_mm == sheet[1].cut_mm and gray.design.rect_mm == sheet[1].design.rect_mm
    assert not {m.id for m in gray.markers} & {m.id for m in sheet[1].markers}
    assert gray.sheet_id == sheet[1].sheet_id and gray.chart == sheet[1].chart


def test_what_cannot_be_written_is_refused(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("x")
    with pytest.raises(Refused, match="a folder that can be written to"):
        write(blocked / "sheet.pdf")
    with pytest.raises(Refused, match=r"ends in \.pdf"):
        write(tmp_path / "sheet.png")
    assert os.listdir(tmp_path) == ["file"]


def test_a_failed_write_leaves_the_old_sheet(tmp_path):
    path = tmp_path / "s.pdf"
    path.write_bytes(b"old")
    path.with_suffix(".json").mkdir()
    with pytest.raises(Refused, match="is a folder"):
        write(path)
    assert path.read_bytes() == b"old"
    assert sorted(os.listdir(tmp_path)) == ["s.json", "s.pdf"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_read_only_folder_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(Refused, match="a folder that can be written to"):
        write(tmp_path / "sheet.pdf")


def test_what_is_no_sheet_is_refused(tmp_path, sheet):
    broken = tmp_path / "broken.pdf"
    broken.write_bytes(b"%PDF-1.7\nnot really")
    for read in (rasterize_page, attached_manifests):
        with pytest.raises(Refused, match="cannot be read"):
            read(broken)
        with pytest.raises(Refused, match="no file at"):
            read(tmp_path / "none.pdf")
    with pytest.raises(Refused, match="a page from 1 to 1"):
        rasterize_page(sheet[0], 2)
    with pytest.raises(Refused, match="1 to 20000 pixels"):
        rasterize_page(sheet[0], 1, 3000)
    plain = tmp_path / "plain.pdf"
    with pikepdf.new() as pdf:
        pdf.add_blank_page()
        pdf.save(plain)
    with pytest.raises(Refused, match=r"sheet\.json attached"):
        attached_manifests(plain)


def test_a_tampered_attachment_is_refused(tmp_path, sheet):
    path = tmp_path / "tampered.pdf"
    with pikepdf.open(sheet[0]) as pdf:
        data = json.loads(pdf.attachments["sheet.json"].get_file().read_bytes())
        data["page_mm"] = [-1, 297]
        pdf.attachments["sheet.json"] = pikepdf.AttachedFileSpec(pdf, json.dumps(data).encode(), filename="sheet.json")
        pdf.save(path)
    with pytest.raises(Refused, match="page_mm"):
        attached_manifests(path)


def test_a_manifest_of_another_form_is_refused_by_its_key(tmp_path, sheet):
    path, data = tmp_path / "sheet.json", json.loads(dump_manifest(sheet[1]))
    x, y, w, h = data["cut_mm"]
    for change, words in (
        ({"version": 1}, 'a usable "version" in .*, got 1'),
        ({"card_mm": None}, 'only known keys in .*, got "card_mm"'),
        ({"design": data["design"] | {"rect_mm": [x + 9, y + 9, w - 18, h - 18]}}, "a design fills its piece"),
    ):
        path.write_text(json.dumps(data | change), encoding="utf-8")
        with pytest.raises(Refused, match=words):
            load_manifest(path)
    del data["version"]
    path.write_text(json.dumps(data), encoding="utf-8")
    with pytest.raises(Refused, match='the key "version"'):
        load_manifest(path)


def test_the_package_imports_without_heavy_libraries():
    code = (
        "import sys; from patchproof.sheets import page, pdf, piece, pdf_raster, template, write; "
        "print([m for m in ('torch', 'scipy', 'cv2', 'reportlab', 'pikepdf', 'pypdfium2') if m in sys.modules])"
    )
    run = subprocess.run(
        [sys.executable, "-c", code],
        env={"PYTHONPATH": ":".join(sys.path)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert run.stdout.strip() == "[]"
