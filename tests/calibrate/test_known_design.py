"""Printers from photographs of any known design: near the truth where colors were seen, the known printer elsewhere."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import synthetic_photos as paper
import torch
from console import command
from PIL import Image

import patchproof
from patchproof.base.color import ciede2000, lab_from_srgb, linear_from_srgb, srgb_from_linear
from patchproof.base.errors import Refused
from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.base.progress import no_advance
from patchproof.calibrate.chart import prints_of
from patchproof.calibrate.known_design import COVERED_DELTA_E00, UNTOUCHED_DELTA_E00, calibrate_design
from patchproof.channel.print_colors import ShownColors
from patchproof.channel.printer import load_printer, printer_output, vary_print
from patchproof.evidence.annotations import Drawn
from patchproof.evidence.surface import surface_of, with_markers
from patchproof.evidence.task import Options
from patchproof.sheets.manifest import Manifest, dump_manifest

SIZE_PX, KNOWN = (720, 540), load_printer("coated")
PLACES = {"desk": (0.0, 0.8, 0.03), "window": (0.03, 0.6, -0.03)}  # veil, light of paper, tone
NAMES = ("office", "coated", "uncoated")


def truth(srgb: np.ndarray) -> np.ndarray:
    """sRGB N×3 of a print with dot gain .12 and chroma lower by .25."""
    light = torch.tensor(linear_from_srgb(printer_output(KNOWN, srgb)))
    return srgb_from_linear(vary_print(light, torch.tensor([0.12, 0, -0.25, 0, 0, 0])).numpy())


def blocks(colors: np.ndarray | None = None) -> np.ndarray:
    """A design of 14 × 14 blocks, of colors that leave out green and cyan."""
    rng = np.random.default_rng(0)
    if colors is None:
        red, green, blue = rng.random((3, 14, 14))
        colors = np.stack([red, np.minimum(green, red), blue * np.maximum(red, 0.3)], -1)
    return (255 * colors).astype(np.uint8).repeat(10, 0).repeat(10, 1)


def pixels_of(manifest: Manifest) -> np.ndarray:
    assert manifest.design
    return manifest.design.pixels()


def take(folder, manifest: Manifest, distance_mm: float = 430, places=tuple(PLACES)) -> list:
    """Photograph the print in both places; the photographs by place."""
    pixels = pixels_of(manifest)
    light = linear_from_srgb(truth(pixels.reshape(-1, 3) / 255)).reshape(pixels.shape).astype(np.float32)
    ink = linear_from_srgb(truth(np.zeros((1, 3))))[0]
    design = with_markers(light, surface_of(manifest), ink)
    for place in places:
        veil, white, tone = PLACES[place]
        look = ShownColors.of_terms(np.array([*[veil] * 3, *np.log([white, white, 0.95 * white]), *[tone] * 3, 0]))
        page = np.full((2000, 1750, 3), 0.2, np.float32)
        page[600:, 350:] = cv2.resize(look.show(design), (1400, 1400), interpolation=cv2.INTER_NEAREST)
        (folder / place).mkdir(parents=True)
        px_from_mm = paper.view(15, 10, distance_mm, size_px=SIZE_PX)
        srgb = paper.photograph(page, px_from_mm, SIZE_PX, blur_px=0.6, noise=0.004, light=1.0, fine=2)
        Image.fromarray(srgb).save(folder / place / "a.png", compress_level=1)
    return [[folder / place / "a.png"] for place in places]


def calibrated(photos, manifest: Manifest, known=NAMES, **options):
    return calibrate_design(photos, manifest, "mine", Options((), KNOWN, **options), known, no_advance)


def delta(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return ciede2000(lab_from_srgb(a), lab_from_srgb(b))


def errors(printer, sent: np.ndarray) -> tuple[float, float]:
    """Mean ΔE00 from the truth of the calibrated printer and of the known one."""
    after, before = (float(delta(printer_output(each, sent), truth(sent)).mean()) for each in (printer, KNOWN))
    return after, before


def sent_colors(manifest: Manifest) -> np.ndarray:
    return np.unique(pixels_of(manifest).reshape(-1, 3), axis=0) / 255


@pytest.fixture(scope="module")
def printed(tmp_path_factory):
    manifest = paper.make_manifest(design=blocks())
    return manifest, take(tmp_path_factory.mktemp("marked"), manifest)


def test_a_printer_is_near_the_truth_where_colors_were_seen_and_the_known_one_elsewhere(printed):
    """Dot gain .12 and a quarter less chroma, in two places of their own veil, light and tone: ΔE00 8 of coated."""
    manifest, photos = printed
    printer, warnings = calibrated(photos, manifest)
    provenance = printer.provenance
    assert provenance["known_printer"] == "coated" and not warnings and printer.method == "measured"
    error, before = errors(printer, sent_colors(manifest))
    assert error < before / 2
    colors = np.random.default_rng(1).random((1000, 3))
    lab, seen = (
        lab_from_srgb(printer_output(KNOWN, colors)),
        lab_from_srgb(printer_output(KNOWN, sent_colors(manifest))),
    )
    apart = np.min([ciede2000(lab, one) for one in seen], 0)
    error, before = errors(printer, colors[apart < COVERED_DELTA_E00])
    assert error < before / 2, "of colors that the design does not have, but has alike"
    far = colors[apart > UNTOUCHED_DELTA_E00 + 5]
    np.testing.assert_allclose(printer_output(printer, far), printer_output(KNOWN, far), atol=0.01)
    assert 0.5 < provenance["covered_share"] < 0.9 and "a place that was left out" in provenance["uncertainty"]
    assert "black by ΔE00" in provenance["ambiguity"]
    desk, window = provenance["photographs"]
    assert np.subtract(window["veil"], desk["veil"]) == pytest.approx(0.03, abs=0.01)
    assert np.subtract(desk["tone"], window["tone"]) == pytest.approx(0.06, abs=0.015)


def test_a_print_without_markers_is_a_chart_too(tmp_path):
    """Named corners, a pixel off, and paper's light from the design itself."""
    data = paper.make_manifest(design=blocks()).model_dump()
    manifest = Manifest.model_validate(data | {"markers": (), "settings": {"sheet": {"markers": False}}})
    photos = take(tmp_path, manifest)
    with pytest.raises(Refused, match=r"got none of 2: .*nothing says where it is: add --find or --corners FILE"):
        calibrated(photos, manifest)
    px = apply_homography(paper.view(15, 10, 430, size_px=SIZE_PX), rect_corners(paper.DESIGN_MM)) + 1
    for place in ("copied", "unnamed"):
        (tmp_path / place).mkdir()
        photos.append([tmp_path / place / "a.png"])
        photos[-1][0].write_bytes(photos[0][0].read_bytes())
    corners = {f"{place}/a.png": Drawn(tuple(px.ravel())) for place in (*PLACES, "copied", "nowhere")}
    printer, warnings = calibrated(photos, manifest, ("coated",), corners=corners)
    first = photos[0][0].parent.name
    assert warnings[:3] == (
        "corners of nowhere/a.png are left out (it is none of these photographs)",
        f"copied/a.png is left out (its bytes are those of {first}/a.png)",
        "unnamed/a.png is left out (--corners FILE does not name this photograph: add it there, or add --find)",
    )
    error, before = errors(printer, sent_colors(manifest))
    assert error < before / 2 and "photograph a print with markers or with white" in warnings[-1]


def test_photographs_that_do_not_show_paper_between_the_markers_cells_are_refused(tmp_path):
    """Last good and first bad: 1.8 and 1.7 pixels a cell; at 1.4 a printer was farther from the truth than coated."""
    manifest = paper.make_manifest(design=blocks())
    printer, _ = calibrated(take(tmp_path / "near", manifest, 800, ("desk",)), manifest, ("coated",))
    assert "one place does not show how places differ" in printer.provenance["uncertainty"]
    error, before = errors(printer, sent_colors(manifest))
    assert error < before / 2
    with pytest.raises(Refused, match=r"none of 1: see the first: desk/a.png is left out \(1.7 px of a marker's cell"):
        calibrated(take(tmp_path / "far", manifest, 860, ("desk",)), manifest)


def test_a_folder_of_places_is_told_from_one_place(printed):
    _, photos = printed
    with pytest.raises(Refused, match=r"none in .* itself: name its folders, one for each place or print"):
        prints_of([photos[0][0].parents[1]])


def test_four_colors_are_too_few(tmp_path):
    palette, which = np.random.default_rng(2).random((4, 3)), np.random.default_rng(0).integers(0, 4, (14, 14))
    few = paper.make_manifest(design=blocks(palette[which]))
    with pytest.raises(Refused, match="enough colors to tell a printer, got 4 that differ by an eighth"):
        calibrated(take(tmp_path, few, places=("desk",)), few, ("coated",))


def test_readmes_line_writes_a_printer_and_ways_that_contradict_each_other_are_refused(printed, monkeypatch, capsys):
    manifest, photos = printed
    monkeypatch.chdir(photos[0][0].parents[1])
    Path("sheet.json").write_text(dump_manifest(manifest), "utf-8")
    readme = Path(patchproof.__file__).parents[2] / "README.md"
    line = re.search(r"`patchproof (calibrate printer [^`]* --design [^`]*)`", readme.read_text("utf-8"))
    assert line and command(*line[1].split(), "--known", "coated") == 0
    said = capsys.readouterr().out
    assert "covered: " in said and "ambiguity: " in said and "uncertainty: " in said
    assert load_printer("mine.npz").provenance["source"].startswith("2 photographs of a known design")
    assert 'with profile = "mine.npz" in its [printer]' in said
    start = "calibrate", "printer", "--out", "mine", "--sheet", "sheet.json", "desk"
    assert command(*start, "--find") == 2 and "--known are for" in capsys.readouterr().err
    assert command(*start, "--icc", "sheet.json") == 2 == command(*start[:-1]) and "--icc" in capsys.readouterr().err
