"""The gap ledger: Shapley's laws, a re-projection that is the photograph, and culprits that are known."""

from __future__ import annotations

import functools
from dataclasses import replace
from itertools import product

import cv2
import numpy as np
import pytest
import torch
from synthetic_photos import CONDITION, make_manifest, noisy_design, page_raster, photograph, save, view

from patchproof.base.color import ciede2000, lab_from_linear, linear_from_srgb
from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.base.progress import Compute
from patchproof.channel.print_colors import ShownColors, add_ink, fit_ink_and_photos
from patchproof.channel.printer import identity_printer, load_printer
from patchproof.classifier import Classifier
from patchproof.evidence.classify import square_of
from patchproof.evidence.gather import gather_evidence
from patchproof.evidence.ledger import _ledger, shapley
from patchproof.evidence.reproject import (
    PhotoSquare,
    Reference,
    change_blur,
    light_fit,
    photo_square,
    reprojected_square,
    reprojected_squares,
)
from patchproof.evidence.surface import (
    LEAST_CELLS,
    PhotographedDesign,
    PromisedColors,
    cell_means,
    choose_photo_cells,
    piece_picture,
    promised_of,
    surface_of,
)
from patchproof.evidence.task import Options
from patchproof.photo.quality import FrameLight, pattern_light
from patchproof.report.write import ledger_bars
from patchproof.sheets.manifest import Manifest
from test_verify_run import measured

SIZE, PHOTOS = (480, 360), 5


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


def shown_by(profile: str, srgb: np.ndarray) -> np.ndarray:
    """Linear light H×W×3 of what a shipped printer makes of sRGB."""
    seen = load_printer(profile).apply(torch.from_numpy(srgb).permute(2, 0, 1)[None].float())
    return linear_from_srgb(seen[0].permute(1, 2, 0).double().numpy())


def delta(a: np.ndarray, b: np.ndarray) -> float:
    return float(ciede2000(lab_from_linear(a), lab_from_linear(b)).mean())


INK = np.zeros((1, 1, 3))
LOOKS = ((0.0, 0.8, 0.0, 0.0), (0.04, 0.6, -0.08, -0.2), (0.02, 0.9, -0.04, 0.1))  # veil, paper, tone, chroma
PRINTS = {
    "same": lambda srgb: shown_by("coated", srgb),
    "uncoated": lambda srgb: shown_by("uncoated", srgb),
    "dot_gain": lambda srgb: shown_by("coated", srgb - srgb * (1 - srgb) / 4),  # midtones a fourth too dark
    "weak_ink": lambda srgb: shown_by("coated", srgb) ** [1, 0.8, 0.55],  # magenta and yellow lack density
}


def cells_of_print(light: np.ndarray, seed: int, noise: float = 0.004) -> np.ndarray:
    """16×16 cells of a photograph's design, with noise."""
    cells = cv2.resize(light, (16, 16), interpolation=cv2.INTER_AREA)
    return cells + np.random.default_rng(seed).normal(0, noise, cells.shape)


def fit_print(photos, promised: PromisedColors):
    read = choose_photo_cells(photos, promised)
    if read is None:
        return None
    ink, terms = fit_ink_and_photos(read, 3)
    return ink, [ShownColors.of_terms(t) for t in terms]


def fitted(cells, promised: np.ndarray, seen_ink, ink):
    """The print's map from photographs in light 1 without blur; None if there is none."""
    light = FrameLight(np.ones(3), np.asarray(seen_ink), 1.0, 0.0)
    fit = fit_print([PhotographedDesign(c, 0.0, light) for c in cells], PromisedColors(promised, ink))
    return fit and functools.partial(add_ink, ink=fit[0])


@pytest.mark.parametrize(
    ("change", "before", "after"),
    [("same", 0.0, 0.3), ("uncoated", 5.0, 2.0), ("dot_gain", 3.1, 2.4), ("weak_ink", 9.5, 1.4)],
)
def test_a_known_print_is_read_from_a_noisy_design(change, before, after):
    """ΔE00 in the mean over the design's own pixels, finer than any cell; other designs of that print as well."""
    printed, (sent, other) = PRINTS[change], (noisy_design(seed) for seed in (0, 1))
    promised, ink = shown_by("coated", sent), shown_by("coated", INK)[0, 0]
    cells = [cells_of_print(printed(sent), i) for i in range(3)]
    as_printed = fitted(cells, promised.astype(np.float32), printed(INK)[0, 0], ink)
    assert delta(printed(sent), promised) == pytest.approx(before, abs=0.1)
    assert delta(printed(sent), as_printed(promised)) < after
    assert delta(printed(other), as_printed(shown_by("coated", other))) < after
    ends = as_printed(np.stack([np.ones(3), ink]))
    assert ends == pytest.approx(np.stack([np.ones(3), printed(INK)[0, 0]]), abs=0.015)


def test_noise_of_one_photograph_makes_no_other_print():
    """A prior of a tenth of the former weight, whatever the number of cells, read ΔE00 1.9 here."""
    sent, ink = noisy_design(0), shown_by("coated", INK)[0, 0]
    promised = shown_by("coated", sent)
    as_printed = fitted([cells_of_print(promised, 0, noise=0.03)], promised.astype(np.float32), ink, ink)
    assert delta(promised, as_printed(promised)) < 1.2


def test_a_print_of_small_blocks_is_read_through_each_photographs_own_veil_tone_and_chroma():
    """70 × 70 blocks, whose 16 × 16 means are alike. ΔE00 of cells as one photograph shows them, halved."""
    sent = np.random.default_rng(0).random((70, 70, 3)).repeat(2, 0).repeat(2, 1)
    promised, ink = shown_by("coated", sent).astype(np.float32), shown_by("coated", INK)[0, 0]
    terms = [np.array([v, v, v, *np.log(paper) * np.ones(3), t, t, t, c]) for v, paper, t, c in LOOKS]
    looks = [ShownColors.of_terms(t) for t in terms]
    light, end = (cell_means(np.moveaxis(x, -1, 0), (70, 70), 0.0) for x in (shown_by("uncoated", sent), promised))
    seen_ink = shown_by("uncoated", INK)[0, 0]
    photos = [
        PhotographedDesign(look.show(light), 0.0, FrameLight(look.show(np.ones(3)), look.show(seen_ink), 1.0, 0.0))
        for look in looks
    ]
    ink_map, fits = fit_print(photos, PromisedColors(promised, ink))
    for look, fit in zip(looks, fits, strict=True):
        truth = look.show(light)
        assert delta(fit.show(add_ink(end, ink_map)), truth) < 2.05 < 4.1 < delta(look.show(np.ones(3)) * end, truth)


def test_black_that_is_lighter_in_photographs_is_print():
    sent = noisy_design()
    ink = np.full(3, 0.02)
    as_printed = fitted([cells_of_print(sent, 0)], sent.astype(np.float32), np.full(3, 0.1), ink)
    assert as_printed(ink[None]) == pytest.approx(np.full((1, 3), 0.1), abs=0.03)


def test_cells_too_few_or_too_much_alike_do_not_say_what_the_print_is():
    ink, colorful, gray = np.full(3, 0.02), noisy_design(), noisy_design(colorful=False)
    few = cells_of_print(colorful, 0)
    for readable, told in ((LEAST_CELLS, True), (LEAST_CELLS - 1, False)):
        cells = np.full_like(few, np.nan)
        rows, columns = np.divmod(np.arange(readable), 14)
        cells[rows + 1, columns + 1] = few[rows + 1, columns + 1]
        assert (fitted([cells, cells], colorful.astype(np.float32), ink, ink) is not None) == told
    assert fitted([cells_of_print(gray, 0)], gray.astype(np.float32), ink, ink) is None
    assert fitted([], colorful.astype(np.float32), ink, ink) is None


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
    shot = PhotoSquare("a.jpg", square, np.eye(3), light, 0.3, 0.0, np.zeros((16, 16, 3)), 1.0)
    promised = PromisedColors(np.ones((1, 1, 3)), np.full(3, 0.02))
    fit = light_fit(shot, promised)
    assert fit.undo(light.paper) == pytest.approx(np.ones(3))
    assert fit.undo(light.ink) == pytest.approx(np.full(3, seen_ink), abs=1e-6)


@functools.cache
def design() -> np.ndarray:
    """Stripes of 1.5 mm in strong colors, reddish and greenish, which change every 10 mm."""
    low, high = np.array([[140, 10, 20], [10, 140, 20]]), np.array([[250, 110, 200], [110, 250, 200]])
    colors = np.random.default_rng(0).integers(low[:, None, None], high[:, None, None], (2, 14, 14, 3))
    return striped(*colors.repeat(20, 1).repeat(20, 2))


def striped(first, second) -> np.ndarray:
    """uint8 280×280×3, three rows of the one color and three of the other in turn."""
    rows = np.arange(280) // 3 % 2 == 1
    return np.where(rows[:, None, None], first, second * np.ones((280, 280, 1))).astype(np.uint8)


@functools.cache
def sheet(two_colors: bool = False) -> Manifest:
    rng = np.random.default_rng(0)
    conditions = [CONDITION | dict(contrast=c, blur_px=0.3) for c in rng.uniform(0.6, 0.9, 50)]
    model = dict(name="net", sha256=None, rate=0.9, interval=[0.85, 0.93], confidence=0.8)
    target = dict(label="striped", indices=[0], goal="assist")
    promise = dict(target=target, models=[model], rate=0.9, interval=[0.85, 0.93], n=50)
    colors = striped([220, 40, 60], [30, 200, 90]) if two_colors else design()
    return make_manifest(promise | dict(controls={}, conditions=conditions), design=colors)


def stripes(pictures: torch.Tensor) -> torch.Tensor:
    """ "striped" grows with the red-green contrast from row to row in the middle, where the design is."""
    middle = pictures[..., 60:180, 60:180]
    step = (middle[:, 0] - middle[:, 1]).diff(dim=1).abs().mean((1, 2))
    return torch.stack([16 * step, torch.full_like(step, 4.0)], 1)


NET = Classifier("net", None, 240, ("striped", "plain"), stripes)


@functools.cache
def raster(faded: bool, two_colors: bool = False) -> np.ndarray:
    page = page_raster(sheet(two_colors), True)
    if faded:  # paper white and marker black stay as they are
        gray = page @ np.full(3, 0.55 / 3, np.float32)
        page *= np.float32(0.45)
        page += gray[..., None]
    return page


def take(folder, faded=False, light=0.75, **look):
    for i in range(PHOTOS):
        homography = view(8 * i - 16, 5, 280, size_px=SIZE)  # nearer to each other they are one
        taken = dict(blur_px=0.3, noise=0.002, jpeg=95, light=light, seed=i) | look
        save(photograph(raster(faded), homography, SIZE, **taken), folder / f"{i}.png")


@pytest.mark.parametrize(
    ("change", "culprit"),
    [
        ({"faded": True}, "print"),
        ({"blur_px": 1.6}, "blur_and_noise"),
        ({"light": np.array([0.05, 0.05, 0.35])}, "light_and_camera"),
    ],
)
def test_known_culprits_are_named(tmp_path, monkeypatch, change, culprit):
    monkeypatch.setattr("patchproof.evidence.gather.estimate_effect", lambda *_: None)  # not asked here
    take(tmp_path, **change)
    check_ledger(gather_evidence(tmp_path, sheet(), Options([NET], identity_printer())).summary.ledger, culprit)


def check_ledger(found, culprit):
    assert found.culprit == culprit, found
    whole = found.ideal - found.photo
    assert sum(share.share for share in found.shares.values()) == pytest.approx(whole, abs=1e-9)
    assert list(found.shares) == ["gamut", "print", "light_and_camera", "blur_and_noise", "photo"]
    if culprit:
        assert whole > 0.1
        assert abs(found.shares["photo"].share) < 0.5 * found.shares[culprit].share


def test_photographs_as_promised_have_no_culprit_and_processes_change_no_byte(tmp_path):
    take(tmp_path)
    options = Options([NET], identity_printer())
    one, two = (gather_evidence(tmp_path, sheet(), options, compute=Compute(jobs=jobs)) for jobs in (1, 2))
    check_ledger(one.summary.ledger, None)
    assert one.summary.estimated is not None
    assert one.model_dump_json() == two.model_dump_json()


def test_of_two_colors_print_and_light_are_one_step(tmp_path):
    homography = view(5, 5, 280, size_px=SIZE)
    save(photograph(raster(True, True), homography, SIZE, blur_px=0.3, light=0.75), tmp_path / "a.png")
    found = gather_evidence(tmp_path, sheet(two_colors=True), Options([NET], identity_printer())).summary.ledger
    assert list(found.shares) == ["gamut", "print_light_and_camera", "blur_and_noise", "photo"]
    assert found.shares["print_light_and_camera"].share > 0.1
    bars = ledger_bars(found.model_dump())
    assert [bar[0] for bar in bars[:3]] == ["ideal", "gamut", "print, light, camera"] and bars[-2][0] == "not explained"
    share = found.shares["print_light_and_camera"].share
    _, left, right, kind, text = bars[2]
    assert right - left == pytest.approx(share) and kind == "miss" and text.startswith(f"{-100 * share:+.1f}")
    last = bars[-2][1 if bars[-2][3] == "miss" else 2]  # where the last step ends
    assert last == pytest.approx(found.photo) and bars[-1][2] == found.photo


def test_no_ledger_where_none_was_asked_for(tmp_path):
    save(photograph(raster(False), view(size_px=SIZE, distance_mm=280), SIZE), tmp_path / "a.png")
    found = gather_evidence(tmp_path, sheet(), Options([NET], identity_printer(), ledger_photos=0))
    assert found.summary.ledger is None


@pytest.mark.parametrize(("sigma", "tolerance"), [(0.5, 0.01), (3.0, 0.03)])
def test_paper_and_ink_are_found_through_blur(sigma, tolerance):
    surface, homography = surface_of(sheet()), view(5, 5, 400, size_px=(640, 480))
    srgb = photograph(raster(False), homography, (640, 480), blur_px=sigma, light=0.75, fine=2)
    on_piece = {i: surface.corners_mm[i] for i in surface.piece_ids}
    paper, ink, blur, agreement = pattern_light(srgb, homography, on_piece, surface.dictionary, 0.9 * sigma)
    assert paper == pytest.approx(0.75, abs=tolerance + 0.02) and ink == pytest.approx(0, abs=tolerance)
    assert blur == pytest.approx(sigma, abs=0.2)
    assert agreement > 0.9
    turned = homography @ np.array([[1, 0.2, 0], [0, 1.3, -20], [0, 0, 1.0]])
    lost = pattern_light(srgb, turned, on_piece, surface.dictionary, 0.9 * sigma)
    assert lost is None or lost[-1] < 0.6


def test_a_photograph_whose_markers_lie_elsewhere_than_its_homography_says_is_left_out():
    surface, homography = surface_of(sheet()), view(5, 5, 400, size_px=SIZE)
    srgb = photograph(raster(False), homography, SIZE, blur_px=0.5, light=0.75)
    photo = measured(srgb, manifest=sheet())
    geometry = photo.entry.geometry
    rest = geometry.blur_px, photo.light, surface, 96
    homography = np.array(geometry.homography_px_from_mm)
    assert photo_square("a", srgb, homography, *rest) is not None
    turned = homography @ np.array([[1, 0.2, 0], [0, 1.3, -20], [0, 0, 1.0]])
    assert photo_square("a", srgb, turned, *rest) is None


def test_the_piece_is_drawn_as_the_page_shows_it():
    surface = surface_of(sheet())
    promised = promised_of(sheet(), surface, identity_printer())
    drawn = piece_picture(surface, promised.design)
    x, y, w, h = (round(v * 10) for v in surface.rect_mm)
    page = cv2.resize(
        page_raster(sheet(), True)[y : y + h, x : x + w], drawn.shape[1::-1], interpolation=cv2.INTER_AREA
    )
    assert np.abs(drawn - page).mean() < 0.02


def test_a_piece_put_into_a_photograph_is_what_a_photograph_of_it_shows():
    """Of another print on the same sheet, in the photograph's own light and blur and in a promised condition's."""
    surface, homography = surface_of(sheet()), view(15, 5, 300, size_px=SIZE)
    taken, other, promised_one = (
        photograph(raster(False, two), homography, SIZE, blur_px=blur_px, light=light, fine=4)
        for two, light, blur_px in ((False, 0.75, 0.8), (True, 0.75, 0.8), (True, 0.5, 0.3))
    )
    photo = measured(taken, manifest=sheet())
    geometry, promised = photo.entry.geometry, promised_of(sheet(True), surface, identity_printer())
    shot = photo_square(
        "a", taken, np.array(geometry.homography_px_from_mm), geometry.blur_px, photo.light, surface, 240
    )
    drawn, shown = piece_picture(surface, promised.design), light_fit(shot, promised)
    put = reprojected_squares(shot, {(): [drawn]}, surface.rect_mm, shown, shown, Reference(0.5, 0.3, 0.0))
    as_taken = reprojected_square(shot, [drawn], surface.rect_mm, shown)
    np.testing.assert_allclose(put[True, True], as_taken, rtol=0, atol=1e-6)
    toned = reprojected_square(shot, [drawn], surface.rect_mm, replace(shown, tone=np.array([0.08, -0.05, 0.02])))
    outline = apply_homography(shot.px_from_mm, rect_corners(surface.rect_mm)).round().astype(np.int32)
    printed = cv2.dilate(cv2.fillConvexPoly(np.zeros(shot.square.shape[:2], np.uint8), outline, 1), None, iterations=8)
    off = np.abs(toned - shot.square / 255)[printed == 0]  # tones of the channels leave alone what surrounds the print
    assert off.max() < 0.02 < np.abs(toned - as_taken).max()
    for on, expected in ((True, other), (False, promised_one)):
        off = np.abs(put[on, on] - square_of(expected)[0] / 255).mean()
        assert off < 0.009  # the print that was taken is 0.036 off and more


def test_blur_is_taken_back_as_far_as_noise_allows():
    rng = np.random.default_rng(0)
    sharp = cv2.resize(rng.uniform(0.2, 0.8, (24, 24, 3)).astype(np.float32), (144, 144), interpolation=cv2.INTER_CUBIC)
    soft = cv2.GaussianBlur(sharp, (0, 0), 2.5)
    noisy = soft + rng.normal(0, 0.005, soft.shape).astype(np.float32)
    inner = np.s_[12:-12, 12:-12]
    left = np.abs(change_blur(noisy, 2.5, 0.3, 0.005) - sharp)[inner].mean()
    assert left < 0.4 * np.abs(soft - sharp)[inner].mean()
    # the other way it is a blur, and nothing changes where nothing should
    assert change_blur(sharp, 0.0, 2.5, 0.0)[inner] == pytest.approx(soft[inner], abs=1e-5)
    assert np.abs(change_blur(sharp, 1.0, 1.0, 0.0) - sharp).max() < 1e-6
