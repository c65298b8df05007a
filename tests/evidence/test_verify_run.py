"""Whole folders of photographs: every code, every count, and nothing that stops the batch."""

from __future__ import annotations

import functools
import os
from contextlib import nullcontext
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from synthetic_photos import (
    CONDITION,
    make_manifest,
    noisy_design,
    page_raster,
    photograph,
    promised_conditions,
    save,
    some_design,
    view,
)

from patchproof.base.color import ciede2000, lab_from_linear, linear_from_srgb, srgb_from_linear
from patchproof.base.errors import Refused
from patchproof.base.intervals import wilson
from patchproof.base.progress import Compute
from patchproof.channel.printer import identity_printer, load_printer
from patchproof.classifier import Classifier
from patchproof.evidence import batch, gather
from patchproof.evidence.appearance import _cross_fitted_cells, fit_cells, match_design
from patchproof.evidence.classify import judges_of
from patchproof.evidence.gather import gather_evidence
from patchproof.evidence.locate import pinhole_photo
from patchproof.evidence.measure import measure
from patchproof.evidence.results import CameraPose, PhotoEntry, Remark, Scale
from patchproof.evidence.surface import promised_of, surface_of
from patchproof.evidence.task import Options, promised_ranges
from patchproof.photo.quality import FrameLight, is_featureless
from patchproof.photo.read import GONE_ADVICE, MORE_PAGES, Photo
from patchproof.report.words import verdict_lines
from patchproof.sheets.markers import DICTIONARY, aruco_dictionary
from patchproof.sheets.piece import marker_ids


def promise(conditions=(CONDITION,)):
    """90 % of 400 conditions, which are the given ones over and over."""
    model = dict(name="net", sha256="ab" * 32, rate=0.9, interval=[0.85, 0.93], confidence=0.8)
    target = dict(label="bright", indices=[0], goal="assist")
    rate, said = dict(rate=0.9, interval=[0.85, 0.93], n=400), promised_conditions(400, 0.9, conditions)
    return dict(target=target, models=[model], controls={}, conditions=said) | rate


def brightness(photos):
    level = photos.mean((1, 2, 3))
    return torch.stack([level * 20, torch.full_like(level, 5.0)], 1)  # "bright" above a mean of 0.25


NET = Classifier("net", "ab" * 32, 32, ("bright", "dark"), brightness)


@functools.cache
def raster(only_piece: bool, first_id: int = 0):
    return page_raster(make_manifest(first_id=first_id), only_piece)


def shot(azimuth=10, distance=550, only_piece=True, first_id=0, **look):
    homography = view(azimuth, 5, distance, size_px=(800, 600))
    return photograph(raster(only_piece, first_id), homography, (800, 600), **{"blur_px": 0.5, **look})


def measured(srgb, conditions=(), focal_px=None, scan_dpi=None, manifest=None, step=1):
    manifest = manifest or make_manifest()
    surface = surface_of(manifest)
    promised = promised_of(manifest, surface, identity_printer())
    photo = pinhole_photo(Photo(srgb, focal_px, step=step), None)
    return measure(photo, "a", surface, promised, promised_ranges(conditions), scan_dpi)


def test_a_good_photo_is_measured_and_its_pose_is_right():
    # 800×600 at 40° across the short side: focal length 300 / tan 20° = 824.2 px
    look = measured(shot(30, 550, jpeg=92, noise=0.003), focal_px=824.2)
    entry = look.entry
    assert (entry.status, entry.code, entry.markers_found, look.counted) == ("measured", None, 8, True)
    geometry, pose = entry.geometry, entry.pose
    assert pose.azimuth_deg == pytest.approx(30, abs=0.5) and pose.distance_mm == pytest.approx(550, rel=0.01)
    assert geometry.tilt_deg == pytest.approx(30.4, abs=1) and geometry.blur_px == pytest.approx(0.5, abs=0.2)
    assert geometry.px_per_mm == pytest.approx(824.2 / 550 * np.sqrt(np.cos(np.radians(30.4))), rel=0.02)
    assert entry.color.color_fit == "affine12" and entry.color.delta_e00_mean < 2.5 and entry.scale is None
    assert geometry.contrast == pytest.approx(0.8, abs=0.05)


def test_light_and_white_balance_are_no_color_difference_but_another_design_is():
    plain = measured(shot()).entry.color.delta_e00_mean
    tinted = measured(shot(light=np.array([0.8, 0.6, 0.45]))).entry.color.delta_e00_mean
    assert tinted == pytest.approx(plain, abs=0.5)


def without_ink(channel: int, design: np.ndarray) -> np.ndarray:
    """What an ink's own channel has where that ink is missing: the light that the others let through."""
    light = linear_from_srgb(design / 255)
    light[..., channel] = 0.75 + 0.25 * np.delete(light, channel, -1).mean(-1)
    return (srgb_from_linear(light) * 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("printed", "code"),
    [
        (lambda design: some_design(9), "other_design"),
        (lambda design: np.full_like(design, design.mean((0, 1)).astype(np.uint8)), "other_design"),
        (lambda design: design[:, ::-1], "other_design"),
        (lambda design: 255 - design, "other_design"),
        (functools.partial(without_ink, 0), "wrong_ink"),
        (functools.partial(without_ink, 1), "wrong_ink"),
        (functools.partial(without_ink, 2), "wrong_ink"),
        (lambda design: np.repeat(design.mean(-1, keepdims=True), 3, -1).astype(np.uint8), "wrong_ink"),
    ],
)
def test_another_design_and_a_print_without_an_ink_do_not_count(printed, code):
    page = page_raster(make_manifest(design=np.ascontiguousarray(printed(some_design()))), True)
    photo = measured(photograph(page, view(10, 5, 550, size_px=(800, 600)), (800, 600), blur_px=0.5, fine=2))
    assert not photo.counted and (photo.entry.status, photo.entry.code) == ("rejected", code)
    assert photo.entry.remark.figure < photo.entry.remark.threshold


def test_gray_and_swapped_colors_of_a_design_in_two_inks_do_not_count():
    """Such a design tells no ink from another, but color from none."""
    share = np.random.default_rng(4).random((14, 14, 2)).repeat(10, 0).repeat(10, 1)
    design = (255 - share[..., :1] * [220, 60, 20] - share[..., 1:] * [20, 130, 60]).clip(0, 255).astype(np.uint8)
    gray = np.repeat(design.mean(-1, keepdims=True), 3, -1).astype(np.uint8)
    for printed, swap, said in ((design, 1, None), (gray, 1, "are gray"), (design, -1, "red and blue are swapped")):
        page = page_raster(make_manifest(design=np.ascontiguousarray(printed)), True)
        photo = photograph(page, view(10, 5, 550, size_px=(800, 600)), (800, 600), blur_px=0.5, fine=2)
        photo = np.ascontiguousarray(photo[..., ::swap])
        entry = measured(photo, manifest=make_manifest(design=design)).entry
        assert entry.code == (said and "wrong_ink") and (said is None or said in entry.remark.advice)


def test_a_design_of_one_color_is_told_from_others_by_structure_ink_and_color():
    gray, black = np.full((140, 140, 3), 150, np.uint8), np.full((140, 140, 3), 20, np.uint8)
    page = page_raster(make_manifest(design=gray), True)
    photo = photograph(page, view(10, 5, 550, size_px=(800, 600)), (800, 600), blur_px=0.5, fine=2)
    assert measured(photo, manifest=make_manifest(design=gray)).entry.code is None
    for design, shown, code in (
        (gray, shot(), "other_design"),
        (some_design(), photo, "other_design"),
        (black, photo, "other_design"),
    ):
        assert measured(shown, manifest=make_manifest(design=design)).entry.code == code
    page = page_raster(make_manifest(design=without_ink(0, gray)), True)
    photo = photograph(page, view(10, 5, 550, size_px=(800, 600)), (800, 600), blur_px=0.5, fine=2)
    assert measured(photo, manifest=make_manifest(design=gray)).entry.code == "wrong_ink"


@pytest.mark.parametrize(
    ("ink", "code"), [((190, 30, 40), None), ((40, 150, 60), "other_design"), ((30, 50, 160), "other_design")]
)
def test_a_logo_in_one_ink_on_white_is_told_from_itself_in_another_ink(ink, code):
    logo = np.full((140, 140, 3), 255, np.uint8)
    cv2.putText(logo, "GO", (12, 95), cv2.FONT_HERSHEY_SIMPLEX, 2.4, (0, 0, 0), 22)
    as_printed = lambda color: np.where(logo < 128, np.uint8(color), logo)  # noqa: E731
    page = page_raster(make_manifest(design=as_printed(ink)), True)
    photo = photograph(page, view(10, 5, 550, size_px=(800, 600)), (800, 600), blur_px=0.5, fine=2)
    assert measured(photo, manifest=make_manifest(design=as_printed((190, 30, 40)))).entry.code == code


@pytest.mark.parametrize(("shown", "code"), [(0.23, None), (0.9, "other_design")])
def test_a_plain_design_whose_small_markers_look_lighter_by_blur_is_no_other(shown, code):
    """Their ink shows 0.24 of the paper's light, as under a veil; without one the design is a little light."""
    paper, cells = np.full(3, 0.3), np.ones((40, 40, 3))
    light = FrameLight(paper, 0.24 * paper, 0.23, 0.0)
    trouble = match_design(shown * paper * cells, 0.13 * cells, cells[..., 0] > 0, light).trouble
    assert (trouble and trouble.code) == code


def coated(srgb: np.ndarray) -> np.ndarray:
    """What a shipped printer makes of sRGB H×W×3."""
    seen = load_printer("coated").apply(torch.from_numpy(srgb).permute(2, 0, 1)[None].float())
    return seen[0].permute(1, 2, 0).double().numpy()


def weak(srgb: np.ndarray) -> np.ndarray:
    """Magenta and yellow that lack density."""
    return srgb_from_linear(linear_from_srgb(coated(srgb)) ** [1, 0.8, 0.55])


def faded(srgb: np.ndarray) -> np.ndarray:
    """Half way to gray, in light."""
    light = linear_from_srgb(coated(srgb))
    return srgb_from_linear((light + light.mean(-1, keepdims=True)) / 2)


def dot_gain(srgb: np.ndarray) -> np.ndarray:
    """Midtones a fourth too dark."""
    return coated(srgb - srgb * (1 - srgb) / 4)


@pytest.mark.parametrize(
    ("design", "printed", "differs", "shown"),
    [
        ("smooth", coated, 0.0, 0.9),
        ("smooth", dot_gain, 4.9, 2.4),
        ("smooth", weak, 11.3, 5.7),
        ("smooth", faded, 8.5, 1.2),  # what mixes light linearly is taken for the camera's
        ("noisy", coated, 0.0, 1.5),  # cells of many colors differ by a share of a pixel
        ("noisy", weak, 9.5, 5.0),
    ],
)
def test_another_print_than_promised_is_seen_as_far_as_no_affine_map_explains_it(design, printed, differs, shown):
    """ΔE00 of the prints themselves, and what a photograph says."""
    sent = some_design() / 255 if design == "smooth" else noisy_design()
    promise, hanging = coated(sent), printed(sent)
    delta = ciede2000(*(lab_from_linear(linear_from_srgb(srgb)) for srgb in (promise, hanging)))
    assert delta.mean() == pytest.approx(differs, abs=0.2)
    manifests = [make_manifest(design=np.rint(srgb * 255).astype(np.uint8)) for srgb in (promise, hanging)]
    page, from_mm = page_raster(manifests[1], True), view(10, 5, 550, size_px=(800, 600))
    srgb = photograph(page, from_mm, (800, 600), 0.5, 0.003, fine=4)
    color = measured(srgb, manifest=manifests[0]).entry.color
    assert color.color_fit == "affine12" and color.delta_e00_mean == pytest.approx(shown, abs=0.4)


def light_on(paper: float) -> FrameLight:
    return FrameLight(np.full(3, paper), np.zeros(3), paper, 0.0)


def test_no_cell_is_fitted_to_itself():
    """36 cells with noise of 0.05: a fit to themselves brings them nearer to the promise than they are."""
    usable, errors = np.zeros((8, 8), bool), []
    usable[1:-1, 1:-1] = True
    for seed in range(30):
        rng = np.random.default_rng(seed)
        promised = rng.uniform(0.05, 0.9, (8, 8, 3))
        lit = promised + rng.normal(0, 0.05, promised.shape)
        fit = fit_cells(lit[usable], promised[usable], light_on(1.0), np.zeros(3))
        fitted = _cross_fitted_cells(lit, promised, usable, fit, light_on(1.0), np.zeros(3))
        errors.append([np.sqrt(((cells - promised)[usable] ** 2).mean()) for cells in (lit, fit.undo(lit), fitted)])
    truth, own, others = np.mean(errors, 0)
    assert own < 0.98 * truth < truth < others < 1.15 * truth


def test_gloss_on_part_of_the_design_does_not_turn_the_map():
    promised = cv2.resize(linear_from_srgb(noisy_design()), (46, 46), interpolation=cv2.INTER_AREA)
    lit = 0.5 * promised
    lit[10:24, 5:19] += 0.25  # on 9 % of it
    fit = fit_cells(lit.reshape(-1, 3), promised.reshape(-1, 3), light_on(0.5), np.zeros(3))
    assert fit.kind == "affine12" and fit.matrix == pytest.approx(np.column_stack([np.eye(3) / 2, np.zeros(3)]))


def test_gloss_on_the_design_is_left_out_and_counted():
    plain = measured(shot(light=0.5)).entry
    assert plain.color.glossy_share == 0 and plain.color.clipped_share == 0
    srgb = shot(light=0.5)
    spot = cv2.warpPerspective(
        np.pad(np.full((42, 42), 0.25, np.float32), ((115, 140), (84, 84))),
        np.array(plain.geometry.homography_px_from_mm),
        srgb.shape[1::-1],
    )
    shiny = srgb_from_linear(linear_from_srgb(srgb / 255) + spot[..., None]) * 255
    entry = measured(np.clip(shiny + 0.5, 0, 255).astype(np.uint8)).entry
    assert entry.color.glossy_share == pytest.approx(0.09, abs=0.03) and entry.code is None
    assert entry.color.delta_e00_mean < plain.color.delta_e00_mean + 0.8  # 2.5 with gloss in it


@pytest.mark.parametrize("design", ["one gray", "grays"])
def test_where_a_design_has_too_few_colors_paper_and_ink_fix_the_color(design):
    srgb = noisy_design(colorful=False) if design == "grays" else np.full((140, 140, 3), 0.5)
    manifest = make_manifest(design=np.rint(srgb * 255).astype(np.uint8))
    tint, homography = np.array([0.8, 0.6, 0.45]), view(10, 5, 550, size_px=(800, 600))
    photo = photograph(page_raster(manifest, True), homography, (800, 600), 0.5, light=tint)
    color = measured(photo, manifest=manifest).entry.color
    assert color.color_fit == "white_black" and color.delta_e00_mean < 2.5


def one_marker(marker_id):
    picture = np.full((300, 400, 3), 230, np.uint8)
    picture[100:170, 100:170] = cv2.aruco.generateImageMarker(aruco_dictionary(DICTIONARY), marker_id, 70)[..., None]
    return picture


@pytest.mark.parametrize(
    ("srgb", "status", "code"),
    [
        (lambda: np.full((300, 400, 3), 120, np.uint8), "rejected", "too_few_markers"),
        (lambda: np.ascontiguousarray(shot()[:, ::-1]), "rejected", "mirrored"),
        (lambda: shot(first_id=300), "rejected", "wrong_sheet"),
        (lambda: one_marker(300), "rejected", "too_few_markers"),  # clutter, too, may resemble one of a thousand
        (lambda: np.concatenate([shot(), shot()], 1), "rejected", "several_sheets"),
        (lambda: np.concatenate([shot(), shot(first_id=300)], 1), "rejected", "several_sheets"),
        (lambda: shot(light=3.0), "judged", "clipped"),
        (lambda: shot(82, 250), "judged", "tilted"),
    ],
)
def test_each_trouble_has_its_code_and_advice(srgb, status, code):
    look = measured(srgb())
    assert (look.entry.status, look.entry.code) == (status, code)
    assert look.entry.remark.advice and look.counted == (status != "rejected")


def test_what_is_not_clipped_is_measured_even_where_paper_is():
    color = measured(shot(light=2.0)).entry.color
    assert color.clipped_share == pytest.approx(0.36, abs=0.03) and color.delta_e00_mean < 1


def test_a_corner_of_the_piece_identifies_the_sheet_but_is_not_measured():
    photo = shot(0, 400)
    photo[:, 330:] = 120  # only the left markers stay
    photo[200:] = 120
    look = measured(photo)
    assert (look.entry.status, look.entry.code, look.counted) == ("judged", "too_few_markers", True)


def test_bent_paper_is_never_measured_as_flat():
    import cv2

    photo = shot(0, 400)
    rows, columns = np.mgrid[0:600, 0:800].astype(np.float32)
    bent = cv2.remap(photo, columns, rows + 14 * np.sin(columns / 90), cv2.INTER_LINEAR)
    entry = measured(bent).entry
    assert entry.status == "judged" or entry.geometry.residual_mm > 0.3


def test_views_outside_of_the_promise_are_not_counted():
    claims = make_manifest(
        promise([dict(px_per_mm=s, tilt_deg=t, azimuth_deg=t, contrast=None, blur_px=None, recognized=True)
                 for s, t in ((1.2, 0.0), (2.0, 30.0))])
    ).promise.conditions  # fmt: skip
    assert measured(shot(10, 550), claims).entry.code is None
    for outside in (shot(10, 1100), shot(50, 450)):
        look = measured(outside, claims)
        assert (look.entry.status, look.entry.code, look.counted) == ("rejected", "out_of_range", False)


def test_the_uncut_page_and_scans_are_measured_but_not_counted():
    page = measured(shot(10, 900, only_piece=False))
    assert page.entry.status == "measured" and not page.counted and page.entry.scale is None
    for sx, sy, code in ((1.0, 1.0, None), (0.97, 0.965, "scale_off"), (1.003, 0.997, None)):
        homography = np.diag([75 / 25.4 * sx, 75 / 25.4 * sy, 1.0])
        homography[:2, 2] = 7.3, 4.9
        scan = photograph(raster(False), homography, (640, 900), blur_px=0.5, light=0.9)
        look = measured(scan, scan_dpi=75)
        assert (look.entry.status, look.entry.code, look.counted) == ("measured", code, False)
        scale = look.entry.scale
        assert (scale.scale_x, scale.scale_y) == pytest.approx((sx, sy), abs=0.002)
    assert measured(scan, scan_dpi=150, step=2).entry.scale == scale  # of which each pixel was made of four


def test_that_an_uncut_page_is_not_counted_is_said(tmp_path):
    save(shot(10, 900, only_piece=False), tmp_path / "page.png")
    report = verified(tmp_path)
    assert report.summary.judged == 0
    said = "photographs of the uncut page, which check the print and are not counted (cut the piece out): page.png"
    assert report.summary.left_out == (said,)


@pytest.mark.parametrize(("dpi", "stretch"), [(150, 1), (75, 2)])
def test_a_scan_at_another_resolution_than_stated_has_no_scale_and_says_so(dpi, stretch):
    scan = photograph(raster(False), np.diag([75 / 25.4, 75 / 25.4 * stretch, 1.0]), (640, 900 * stretch), light=0.9)
    look = measured(scan, scan_dpi=dpi)
    assert (look.entry.code, look.entry.scale, look.counted) == ("scale_off", None, False)
    assert f"cannot be a scan at {dpi} dpi" in look.entry.remark.advice and "no scale" in look.entry.remark.advice


PHOTOS = 6  # of the piece, in the folder: fewer pairs than six show no effect


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    photos = tmp_path_factory.mktemp("photos")
    for i in range(PHOTOS):
        save(shot(8 * i - 20, 500 + 20 * i, seed=i, noise=0.003), photos / f"b{i}.jpg")
    (photos / "a.JPG").write_text("no picture")
    save(np.full((200, 300, 3), 99, np.uint8), photos / "c.png")
    (photos / "truth.json").write_text("{ broken")
    (photos / "notes.txt").write_text("x")
    (photos / ".hidden.jpg").write_text("x")
    return photos


def verified(folder, jobs=1, progress=lambda done, total: None, journal=None, resume=False, **options):
    options = Options([NET], identity_printer(), **{"ledger_photos": 0} | options)
    by = {"compute": Compute(jobs=jobs), "advance": progress, "journal": journal, "resume": resume}
    return gather_evidence(folder, make_manifest(promise()), options, **by)


def test_a_folder_is_listed_in_full_and_counted_as_the_contract_says(folder):
    calls = []
    report = verified(folder, progress=lambda done, total: calls.append((done, total)), ledger_photos=2)
    assert [p.file for p in report.photos] == ["a.JPG", *(f"b{i}.jpg" for i in range(PHOTOS)), "c.png"]
    assert [p.code for p in report.photos] == ["unreadable", *[None] * PHOTOS, "too_few_markers"]
    summary = report.summary
    assert (summary.photos, summary.judged, summary.measured, summary.rate) == (PHOTOS + 2, PHOTOS, PHOTOS, 1.0)
    # one of seven readable photographs shows no marker: more than 10 %
    assert (summary.verdict, summary.worth.word, summary.ledger) == ("cannot_tell", "cannot_tell", None)
    assert calls[-1] == (PHOTOS + 2,) * 2
    prediction = report.photos[1].predictions["net"]
    assert prediction.label == "bright" and prediction.recognized
    assert prediction.confidence == prediction.target_confidence > 0.5
    assert report.photos[0].predictions == {} and report.photos[-1].predictions


def test_photographs_that_show_nothing_never_count_whatever_the_network_answers(folder, tmp_path):
    """A network may have one answer for everything: pure noise, a black picture and a white one are no evidence."""
    rng = np.random.default_rng(0)
    always = Classifier("net", "ab" * 32, 32, ("bright", "dark"), lambda p: torch.tensor([[9.0, 0]]).expand(len(p), 2))
    pictures = {
        "noise": rng.integers(0, 256, (240, 320, 3)),
        "faint": rng.normal(128, 3, (240, 320, 3)),
        "black": np.zeros((240, 320, 3)),
        "white": np.full((240, 320, 3), 255),
    }
    for name, picture in pictures.items():
        save(picture.astype(np.uint8), tmp_path / f"{name}.png")

    def report(**kept):
        options, journal = Options([always], identity_printer(), ledger_photos=0), tmp_path / "out" / "photos.jsonl"
        return gather_evidence(tmp_path, make_manifest(promise()), options, journal=journal, **kept)

    nothing = report()
    for photo in nothing.photos:
        assert photo.predictions["net"].recognized
        assert (photo.status, photo.code, photo.markers_found) == ("rejected", "too_few_markers", 0)
    summary = nothing.summary
    assert (summary.judged, summary.measured, summary.rate, summary.verdict) == (0, 0, None, "cannot_tell")
    assert [(s.recognized, s.judged) for s in summary.sessions] == [(0, 0)] * len(summary.sessions)
    (tmp_path / "b0.jpg").write_bytes((folder / "b0.jpg").read_bytes())  # beside one that shows the sheet
    summary = report(resume=True).summary  # what they are is known
    assert (summary.judged, summary.models["net"].interval) == (1, wilson(1, 1))
    assert sum(s.recognized for s in summary.sessions) == 1 and summary.verdict == "cannot_tell"


@pytest.fixture(scope="module")
def few(folder, tmp_path_factory):
    """One of the folder's photographs, and what is none."""
    photos = tmp_path_factory.mktemp("few")
    for name in ("a.JPG", "b0.jpg"):
        (photos / name).write_bytes((folder / name).read_bytes())
    return photos


def test_two_processes_give_the_same_bytes_as_one(few, folder, tmp_path):
    for photo in (*few.iterdir(), folder / "b3.jpg"):
        (tmp_path / photo.name).write_bytes(photo.read_bytes())
    assert verified(tmp_path, jobs=2).model_dump_json() == verified(tmp_path).model_dump_json()


def test_controls_of_one_session_are_paired_and_cannot_decide_the_effect(folder, tmp_path):
    for i in range(PHOTOS):
        save(half_lit(20 + i), tmp_path / f"b{i}.jpg")
    evidence = verified(folder, controls=tmp_path)
    assert evidence.summary.worth.word != "helps" and not evidence.summary.meets("helps")
    (control,) = evidence.controls
    assert (control.recognized, control.n, control.pairs, control.sessions) == (0, PHOTOS, PHOTOS, 1)
    assert "two places" in control.advice and "This cannot tell" in "".join(verdict_lines(evidence))


def half_lit(code):
    """A picture of something: two tones."""
    picture = np.full((100, 100, 3), code, np.uint8)
    picture[:, 50:] += 10
    return picture


def test_controls_that_show_nothing_never_count_and_are_named(few, tmp_path, tmp_path_factory):
    """Lens caps, black frames and noise are no bare object: with them alone no effect is tested."""
    rng = np.random.default_rng(0)
    nothing = {
        "b0": rng.integers(0, 256, (100, 100, 3)),
        "b1": rng.normal(3, 2, (100, 100, 3)).clip(0, 255),
        "b2": np.zeros((100, 100, 3)),
        "b3": np.full((100, 100, 3), 255),
    }
    for name, picture in nothing.items():
        save(picture.astype(np.uint8), tmp_path / f"{name}.jpg")
    (tmp_path / "b9.jpg").write_bytes(b"no picture")
    journal = tmp_path_factory.mktemp("out") / "photos.jsonl"
    evidence = verified(few, controls=tmp_path, journal=journal)
    (control,) = evidence.controls
    assert (control.n, control.shown, control.rates) == (0, None, None)
    said = evidence.summary.left_out
    assert sum("one tone or noise" in sentence for sentence in said) == 4 and any("b9.jpg" in each for each in said)
    save(half_lit(20), tmp_path / "b4.jpg")  # beside one of something
    (control,) = verified(few, controls=tmp_path, journal=journal, resume=True).controls
    assert (control.recognized, control.n) == (0, 1)


def test_the_patch_s_own_photographs_are_no_control(few, tmp_path):
    (tmp_path / "mean").mkdir()
    for name, as_name in (("a.JPG", "copied.jpg"), ("b0.jpg", "b0.jpg")):
        (tmp_path / "mean" / as_name).write_bytes((few / name).read_bytes())
    Image.open(few / "b0.jpg").resize((640, 480)).save(tmp_path / "mean/sent.jpg", quality=60)  # as messengers do
    save(half_lit(20), tmp_path / "mean/own.jpg")
    evidence = verified(few, controls=tmp_path)
    (control,) = evidence.controls
    assert control.n == 1
    said = evidence.summary.left_out
    assert "mean/copied.jpg has the bytes of a.JPG, which counts once" in said
    assert any("mean/sent.jpg does not count: it shows the patch, not the control mean" in each for each in said)


def test_a_photograph_that_only_workers_miss_ends_the_run_and_is_not_kept(few, tmp_path, monkeypatch):
    def missing(task, item):
        return batch._rejected(item, Remark(code="unreadable", advice=GONE_ADVICE))

    monkeypatch.setattr(batch, "_measure_or_reject", missing)
    journal = tmp_path / "out" / "photos.jsonl"
    with pytest.raises(Refused, match=r"cluster's machines, too, got none at /.*a\.JPG: let all its"):
        gather_evidence(few, make_manifest(promise()), Options([NET], identity_printer()), journal=journal)
    assert "b0.jpg" not in journal.read_text()


def test_workers_get_whole_paths(few, tmp_path, monkeypatch):
    """Those of a cluster may stand in another folder."""
    (tmp_path / "mean").mkdir()
    (tmp_path / "mean" / "a.jpg").write_bytes((few / "b0.jpg").read_bytes())
    monkeypatch.chdir(few.parent)
    given, measure_all = [], gather.measure_all
    monkeypatch.setattr(
        gather, "measure_all", lambda task, items, *rest: given.extend(items) or measure_all(task, items, *rest)
    )
    verified(Path(few.name), controls=Path(os.path.relpath(tmp_path)))
    assert len(given) == 3 and all(item.path.is_absolute() for item in given)


def test_without_its_workers_no_journal_is_begun(few, tmp_path, monkeypatch):
    def unreachable(*settings):
        raise Refused("a scheduler", "none", "start it")

    monkeypatch.setattr(gather, "open_workers", unreachable)
    options = Options([NET], identity_printer())
    with pytest.raises(Refused, match="a scheduler"):
        gather_evidence(few, make_manifest(promise()), options, journal=tmp_path / "out" / "photos.jsonl")
    assert not (tmp_path / "out").exists()


def test_a_camera_is_as_much_nearer_as_the_print_is_smaller():
    pose = CameraPose(azimuth_uncertainty_deg=2.0, distance_mm=600.0, distance_uncertainty_mm=20.0)
    entry = gather._of_print(PhotoEntry(file="a.jpg", status="measured", pose=pose), Scale(scale_x=0.96, scale_y=0.98))
    size = np.sqrt(0.96 * 0.98)
    assert (entry.pose.distance_mm, entry.pose.distance_uncertainty_mm) == pytest.approx((600 * size, 20 * size))
    assert gather._of_print(PhotoEntry(file="a.jpg", status="judged"), entry.scale).pose is None


@pytest.mark.parametrize(("mm", "scale"), [((100.5, 100), 1.005), ((97, 96.5), 0.97)])
def test_rulers_tell_the_size_and_only_a_possible_one(few, mm, scale):
    with pytest.warns(UserWarning, match=r"0\.970 × 0\.965 of its size") if scale < 0.98 else nullcontext():
        report = verified(few, ruler_mm=mm)
    assert all(photo.scale.scale_x == pytest.approx(scale) for photo in report.photos)
    with pytest.raises(Refused, match=r"lengths of about 100 and 100 mm, as printed, got 9\.7 and 9\.7 mm"):
        verified(few, ruler_mm=(9.7, 9.7))
    with pytest.raises(Refused, match="got 0 and 97 mm"):
        verified(few, ruler_mm=(0, 97))


def test_a_control_s_sheet_under_another_control_s_name_does_not_count(few, tmp_path):
    """In `mine`, a name of the user's own, it does."""
    manifest = make_manifest()
    piece_ids = sorted(surface_of(manifest).piece_ids)
    ids = dict(zip(piece_ids, marker_ids(manifest.sheet_id, "gray", len(piece_ids)), strict=True))
    markers = tuple(marker.changed(id=ids.get(marker.id, marker.id)) for marker in manifest.markers)
    page = page_raster(manifest.changed(markers=markers), True)
    for number, name in enumerate(("gray", "mean", "bare", "mine")):
        (tmp_path / name).mkdir()
        homography = view(10 + number, 5, 550, size_px=(800, 600))
        save(photograph(page, homography, (800, 600), blur_px=0.5), tmp_path / name / "a.jpg")
        save(half_lit(20 + number), tmp_path / name / "b.jpg")
    evidence = verified(few, controls=tmp_path)
    assert {control.name: control.n for control in evidence.controls} == {"gray": 2, "mean": 1, "bare": 1, "mine": 2}
    said = "\n".join(evidence.summary.left_out)
    assert all(f"it shows the control gray, not the control {name}" in said for name in ("mean", "bare"))


@pytest.mark.parametrize(("contrast", "nothing"), [(1, True), (3, False)])
def test_two_tones_show_something_from_a_code_or_two_on(contrast, nothing):
    picture = np.full((240, 320, 3), 90, np.uint8)
    picture[:, 160:] += contrast
    assert is_featureless(picture) is nothing


def test_only_scans_have_no_rate(tmp_path):
    homography = np.diag([3.0, 3.0, 1.0])
    scan = Image.fromarray(photograph(raster(False), homography, (640, 900), light=0.9))
    more = {"save_all": True, "append_images": [scan]}
    scan.save(tmp_path / "scan.tif", dpi=(300, 300), **more)
    report = verified(tmp_path, scan_dpi=76.2)
    summary, (entry,) = report.summary, report.photos
    for phrase, sentence in zip(entry.said, summary.left_out, strict=True):
        assert sentence == f"{phrase}: scan.tif" and sentence in "\n".join(verdict_lines(report))
    assert entry.said[0] == MORE_PAGES and "300 × 300 dpi, where --scan-dpi says 76.2" in entry.said[1]
    assert entry.model_dump()["said"] == entry.said and "said" not in entry.changed(said=()).model_dump()
    assert (summary.judged, summary.measured, summary.rate, summary.verdict) == (0, 1, None, "cannot_tell")


def test_folders_and_judges_that_will_not_do_are_refused_in_a_sentence(tmp_path):
    for path, words in ((tmp_path / "gone", "no folder at"), (tmp_path, "got none")):
        with pytest.raises(Refused, match=words):
            verified(path)
    save(np.zeros((50, 50, 3), np.uint8), tmp_path / "a.jpg")
    other = Classifier("other", None, 32, ("bright", "dark"), brightness)
    retrained = Classifier("net", "cd" * 32, 32, ("bright", "dark"), brightness)
    for model, words in ((other, "the promise's own network net"), (retrained, "got SHA-256 cdcdcdcdcdcd")):
        with pytest.raises(Refused, match=words):
            gather_evidence(tmp_path, make_manifest(promise()), Options([model], identity_printer()))


@pytest.mark.parametrize(
    ("label", "accept", "indices", "labels", "refused"),
    [
        ("Street_Sign", (), (1,), ("mug", "street sign, post", "cup"), None),
        ("mug", ("cup",), (0, 2), ("mug", "sign", "cup"), None),
        (1, ("cup",), (1, 2), ("mug", "sign", "cup"), None),
        ("mug", (), (0,), ("cup", "mug"), r'mug as label 0 of net, as promised, got "cup": give it back'),
        ("mug", ("cup",), (0, 1), ("mug", "sign"), r'mug or cup as label 0 or 1 of net, .* got "mug" or "sign"'),
        ("mug", ("cup",), (0, 2), ("mug", "sign", "rug"), r'got "mug" or "rug"'),
        ("mug", (), (5,), ("mug", "sign"), "mug as label 5 of net, as promised, got none"),
        (1, (), (0,), ("mug", "sign"), '1 as label 0 of net, as promised, got "mug"'),
    ],
)
def test_the_labels_of_the_promised_network_stay_at_their_indices(label, accept, indices, labels, refused):
    promised = promise()
    promised["target"] |= {"label": str(label), "indices": indices}
    settings = {"target": {"label": label, "accept": accept}}
    manifest = make_manifest(promised).changed(settings=settings)
    network = Classifier("net", "ab" * 32, 32, labels, brightness)
    other = Classifier("other", None, 32, ("cup", "sign", "street sign", "mug"), brightness)
    if refused is None:
        found = judges_of([network, other], manifest)
        assert found is not None and found.indices["net"] == indices
        return
    with pytest.raises(Refused, match=refused):
        judges_of([network], manifest)
