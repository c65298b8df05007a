"""The gap ledger: Shapley's laws, a re-projection that is the photograph, and culprits that are known."""

from __future__ import annotations

import functools
from itertools import product

import cv2
import numpy as np
import pytest
import torch

from patchproof.channel.printer import identity_printer
from patchproof.classifier import Classifier
from patchproof.color import linear_from_srgb
from patchproof.evidence.ledger import _ledger, shapley
from patchproof.evidence.print_fit import fit_print
from patchproof.evidence.reproject import Shot, deblurred, light_fit, shot_of
from patchproof.evidence.run import gather_evidence
from patchproof.evidence.surface import Promised, piece_picture, promised_of, surface_of
from patchproof.evidence.task import Options
from patchproof.photo.pattern_light import pattern_light
from patchproof.photo.quality import FrameLight
from patchproof.report.plots import ledger_plot
from patchproof.sheets.manifest import Manifest
from test_photo_synthetic import CONDITION, make_manifest, page_raster, photograph, save, view
from test_verify_run import measured

SIZE, PHOTOS = (640, 480), 5


def test_shapley_splits_what_players_do_together_evenly_and_sums_to_the_whole():
    # a costs 3 alone, b and c cost 2 only together: 3, 1, 1
    values = {on: 10.0 - 3 * on[0] - 2 * (on[1] and on[2]) for on in product((False, True), repeat=3)}
    assert shapley(values) == pytest.approx([3, 1, 1])
    noise = dict(zip(product((False, True), repeat=4), np.random.default_rng(0).random(16), strict=True))
    assert shapley(noise).sum() == pytest.approx(noise[(False,) * 4] - noise[(True,) * 4])


def ledger(costs, spread=0.02, photos=12, steps=("gamut", "print", "light_and_camera", "blur_and_noise")):
    rng = np.random.default_rng(0)
    values, seen = [], []
    for _ in range(photos):
        own = np.array(costs) + rng.normal(0, spread, len(costs))
        values.append({on: 0.9 - float(own[:-1] @ np.array(on)) for on in product((False, True), repeat=len(steps))})
        seen.append(0.9 - own.sum())
    return _ledger(steps, values, np.array(seen), 1.0)


@pytest.mark.parametrize(
    ("costs", "culprit"),
    [
        ((0, 0.15, 0.03, 0, 0), "print"),
        ((0.3, 0, 0.12, 0, 0.02), "light_and_camera"),  # the promise was made with the gamut
        ((0, 0.12, 0.12, 0, 0), None),  # two alike
        ((0, 0.03, 0, 0, 0), None),  # too little to matter
        ((0, 0.1, 0, 0, 0.3), None),  # most of it is not explained
    ],
)
def test_a_culprit_is_named_only_where_it_is_clear(costs, culprit):
    found = ledger(costs)
    assert found.culprit == culprit
    assert sum(s.share for s in found.shares.values()) == pytest.approx(found.ideal - found.photo)
    assert ledger(costs, photos=4).culprit is None and ledger(costs, photos=4).shares["print"].interval is None


def test_the_print_is_read_from_swatches_and_needs_eight_of_them():
    promised = linear_from_srgb(np.array(make_manifest().model_dump()["chart"][0]["srgb"]) * 0 + 0.5)
    corners = np.array(list(product((0.02, 1.0), repeat=3)) + [(g, g, g) for g in (0.1, 0.3, 0.6)])
    faded = 0.7 * corners + 0.3 * corners.mean(1, keepdims=True)
    seen = np.stack([faded, faded, np.full_like(faded, np.nan)])
    ink = np.full(3, 0.02)
    printed = fit_print(list(seen), corners, ink, ink)
    assert printed(np.stack([ink, np.ones(3)])) == pytest.approx(np.stack([ink, np.ones(3)]), abs=0.01)
    assert printed(corners) == pytest.approx(faded, abs=0.02)
    assert printed(promised[None]) == pytest.approx(promised[None], abs=0.03)
    few = faded.copy()
    few[7:] = np.nan
    assert fit_print([few], corners, ink, ink) is None
    gray = fit_print([np.maximum(faded, 0.1)], corners, np.full(3, 0.1), ink)  # black became lighter, too
    assert gray(ink[None]) == pytest.approx(np.full((1, 3), 0.1), abs=0.03)


@pytest.mark.parametrize(
    ("darkest", "ink", "seen_ink"),
    [
        (0, 0.16, 0.2),  # nothing veils black things beside it: the ink itself is lighter
        (120, 0.16, 0.02),  # it may be a veil, and is taken for one
        (0, 0.0, 0.0),  # no veil takes light away
    ],
)
def test_a_veil_is_no_lighter_than_the_darkest_place(darkest, ink, seen_ink):
    square = np.full((40, 40, 3), 150, np.uint8)
    square[:20] = darkest
    light = FrameLight(np.full(3, 0.8), np.full(3, ink), 0.8 - ink, 0.0)
    shot = Shot("a.jpg", square, np.eye(3), light, 0.3, 0.0, np.zeros((0, 3)), 1.0)
    promised = Promised(np.ones((1, 1, 3)), np.zeros((0, 3)), np.full(3, 0.02))
    fit = light_fit(shot, promised)
    assert fit.apply(light.paper) == pytest.approx(np.ones(3))
    assert fit.apply(light.ink) == pytest.approx(np.full(3, seen_ink), abs=1e-6)


@functools.cache
def design() -> np.ndarray:
    """Fine stripes of strong colors."""
    rows = np.arange(128) // 2 % 2
    return np.repeat(np.where(rows[:, None, None], [220, 40, 60], [30, 200, 90]), 128, axis=1).astype(np.uint8)


@functools.cache
def sheet() -> Manifest:
    rng = np.random.default_rng(0)
    conditions = [CONDITION | dict(contrast=c, blur_px=0.3) for c in rng.uniform(0.6, 0.9, 50)]
    model = dict(name="net", sha256=None, rate=0.9, interval=[0.85, 0.93], confidence=0.8)
    target = dict(label="striped", indices=[0], goal="assist")
    promise = dict(target=target, models=[model], rate=0.9, interval=[0.85, 0.93], n=400)
    return make_manifest(promise | dict(controls={}, conditions=conditions), design=design())


def stripes(pictures: torch.Tensor) -> torch.Tensor:
    """ "striped" grows with the red-green contrast from row to row in the middle, where the design is."""
    middle = pictures[..., 60:180, 60:180]
    step = (middle[:, 0] - middle[:, 1]).diff(dim=1).abs().mean((1, 2))
    return torch.stack([16 * step, torch.full_like(step, 4.0)], 1)


NET = Classifier("net", None, 240, ("striped", "plain"), stripes)


@functools.cache
def raster(faded: bool) -> np.ndarray:
    page = page_raster(sheet(), True)
    if faded:  # paper white and marker black stay as they are
        page = 0.45 * page + 0.55 * page.mean(-1, keepdims=True)
    return page.astype(np.float32)


def evidence(folder, faded=False, light=0.75, **look):
    for i in range(PHOTOS):
        homography = view(4 * i - 10, 5, 280, size_px=SIZE)
        taken = dict(blur_px=0.3, noise=0.002, jpeg=95, fine=2, light=light, seed=i) | look
        save(photograph(raster(faded), homography, SIZE, **taken), folder / f"{i}.png")
    return gather_evidence(folder, sheet(), Options([NET], identity_printer()))


@pytest.mark.parametrize(
    ("change", "culprit"),
    [
        ({}, None),
        ({"faded": True}, "print"),
        ({"blur_px": 1.6}, "blur_and_noise"),
        ({"light": 0.06}, "light_and_camera"),
        ({"light": np.array([0.1, 0.1, 0.7])}, "light_and_camera"),
    ],
)
def test_known_culprits_are_named(tmp_path, change, culprit):
    found = evidence(tmp_path, **change)
    summary = found.summary
    assert summary.culprit == culprit, summary.ledger
    whole = found.ledger.ideal - found.ledger.photo
    assert sum(share.share for share in summary.ledger.values()) == pytest.approx(whole, abs=1e-9)
    assert list(summary.ledger) == ["gamut", "print", "light_and_camera", "blur_and_noise", "photo"]
    if culprit:
        assert whole > 0.1
        assert abs(summary.ledger["photo"].share) < 0.5 * summary.ledger[culprit].share
    assert "not explained" in ledger_plot(found.ledger.model_dump())


def test_without_swatches_print_and_light_are_one_step(tmp_path):
    homography = view(5, 5, 280, size_px=SIZE)
    save(photograph(raster(True), homography, SIZE, blur_px=0.3, fine=2, light=0.75), tmp_path / "a.png")
    manifest = sheet().model_copy(update={"chart": ()})
    found = gather_evidence(tmp_path, manifest, Options([NET], identity_printer()))
    assert list(found.summary.ledger) == ["gamut", "print_light_and_camera", "blur_and_noise", "photo"]
    assert found.summary.ledger["print_light_and_camera"].share > 0.1


def test_no_ledger_where_none_was_asked_for(tmp_path):
    save(photograph(raster(False), view(size_px=SIZE, distance_mm=280), SIZE, fine=2), tmp_path / "a.png")
    found = gather_evidence(tmp_path, sheet(), Options([NET], identity_printer(), ledger_photos=0))
    assert found.summary.ledger is None and found.ledger is None


@pytest.mark.parametrize(("sigma", "tolerance"), [(0.5, 0.01), (3.0, 0.03)])
def test_paper_and_ink_are_found_through_blur(sigma, tolerance):
    surface, homography = surface_of(sheet()), view(5, 5, 400, size_px=SIZE)
    srgb = photograph(raster(False), homography, SIZE, blur_px=sigma, light=0.75, fine=2)
    on_piece = {i: surface.corners_mm[i] for i in surface.piece_ids}
    found = pattern_light(srgb, homography, on_piece, surface.dictionary, 0.9 * sigma)
    assert found.paper == pytest.approx(0.75, abs=tolerance + 0.02) and found.ink == pytest.approx(0, abs=tolerance)
    assert found.blur_px == pytest.approx(sigma, abs=0.2)
    assert found.agreement > 0.9
    turned = homography @ np.array([[1, 0.2, 0], [0, 1.3, -20], [0, 0, 1.0]])
    lost = pattern_light(srgb, turned, on_piece, surface.dictionary, 0.9 * sigma)
    assert lost is None or lost.agreement < 0.6


def test_a_photograph_whose_markers_lie_elsewhere_than_its_homography_says_is_left_out():
    surface, homography = surface_of(sheet()), view(5, 5, 400, size_px=SIZE)
    srgb = photograph(raster(False), homography, SIZE, blur_px=0.5, light=0.75, fine=2)
    photo = measured(srgb, manifest=sheet())
    geometry = photo.entry.geometry
    rest = geometry.blur_px, photo.light, surface, 96
    homography = np.array(geometry.homography_px_from_mm)
    assert shot_of("a", srgb, homography, *rest) is not None
    turned = homography @ np.array([[1, 0.2, 0], [0, 1.3, -20], [0, 0, 1.0]])
    assert shot_of("a", srgb, turned, *rest) is None


def test_the_piece_is_drawn_as_the_page_shows_it():
    surface = surface_of(sheet())
    promised = promised_of(sheet(), surface, identity_printer())
    drawn = piece_picture(surface, promised.design, promised.swatches, promised.ink)
    x, y, w, h = (round(v * 10) for v in surface.piece_mm)
    page = cv2.resize(
        page_raster(sheet(), True)[y : y + h, x : x + w], drawn.shape[1::-1], interpolation=cv2.INTER_AREA
    )
    assert np.abs(drawn - page).mean() < 0.02


def test_blur_is_taken_back_as_far_as_noise_allows():
    rng = np.random.default_rng(0)
    sharp = cv2.resize(rng.uniform(0.2, 0.8, (24, 24, 3)).astype(np.float32), (144, 144), interpolation=cv2.INTER_CUBIC)
    soft = cv2.GaussianBlur(sharp, (0, 0), 2.5)
    noisy = soft + rng.normal(0, 0.005, soft.shape).astype(np.float32)
    inner = np.s_[12:-12, 12:-12]
    left = np.abs(deblurred(noisy, 2.5, 0.3, 0.005) - sharp)[inner].mean()
    assert left < 0.4 * np.abs(soft - sharp)[inner].mean()
    # the other way it is a blur, and nothing changes where nothing should
    assert deblurred(sharp, 0.0, 2.5, 0.0)[inner] == pytest.approx(soft[inner], abs=1e-5)
    assert np.abs(deblurred(sharp, 1.0, 1.0, 0.0) - sharp).max() < 1e-6
