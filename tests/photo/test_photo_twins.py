"""What is done a faster way to large photographs comes out as the slow way has it, and no sheet is lost to it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from synthetic_photos import PIECE_IDS, make_manifest, page_raster, photograph, view

from patchproof.channel import print_colors
from patchproof.channel.printer import identity_printer
from patchproof.classifier import center_square
from patchproof.evidence import appearance
from patchproof.evidence.classify import squares_of
from patchproof.evidence.locate import pinhole_photo
from patchproof.evidence.measure import identify_sheet, measure
from patchproof.evidence.surface import promised_of, surface_of
from patchproof.evidence.task import promised_ranges
from patchproof.photo import detect, edges, known_page, limits
from patchproof.photo.detect import LINEAR_FLOAT32_FROM_CODE, find_markers, fit_marker_borders, luminance
from patchproof.photo.edges import fit_borders
from patchproof.photo.known_page import find_sheet
from patchproof.photo.limits import count_edges, find_squares
from patchproof.photo.quality import CLIPPED_CODE
from patchproof.photo.read import Photo
from patchproof.photo.registration import _shift_per_error
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.markers import aruco_dictionary, marker_cells

IDS = frozenset(PIECE_IDS)


@pytest.fixture(scope="module")
def piece():
    return page_raster(make_manifest(), only_piece=True) * np.float32(0.97) + np.float32(0.02)


@pytest.fixture(scope="module")
def surface():
    return surface_of(make_manifest())


@pytest.mark.parametrize(("shape", "sizes"), [((200, 300), (96, 32)), ((301, 199), (96,)), ((33, 40), (33, 96))])
def test_squares_are_those_that_networks_were_trained_with(shape, sizes):
    srgb = np.random.default_rng(0).integers(0, 256, (*shape, 3), np.uint8)
    slow = torch.from_numpy(srgb.astype(np.float32)).permute(2, 0, 1)[None] / 255
    for size, fast in squares_of(srgb, sizes).items():
        assert fast.flags.c_contiguous, "what is summed in another order has other last bits"
        # 1e-5 is a four-hundredth of a code value; of 12 megapixels it is 8e-6, and no confidence moves by 2e-6
        torch.testing.assert_close(torch.from_numpy(fast), center_square(slow, size)[0], atol=1e-5, rtol=0)


def test_borders_do_not_depend_on_the_light_far_from_them_nor_on_other_markers(piece):
    photo = photograph(piece, view(25, 10, 400, 8), blur_px=0.7, noise=0.01)
    rough = find_markers(photo, IDS).corners_px
    ids = sorted(rough)
    quads, cells = np.array([rough[i] for i in ids]) + 0.8, marker_cells(detect.DICTIONARY, ids)
    together, whole = fit_marker_borders(photo, quads, cells), fit_borders(luminance(photo), quads, cells)
    alone = [fit_marker_borders(photo, quads[[i]], cells[[i]])[0] for i in range(len(ids))]
    assert len(ids) == 8 and all(b.fitted for b in whole)
    for borders in (whole, alone):
        for one, other in zip(together, borders, strict=True):
            np.testing.assert_allclose(one.corners_px, other.corners_px, atol=1e-6, rtol=0)


def test_a_sheet_too_small_for_the_first_levels_is_found_and_one_too_small_for_all_is_not(piece, surface, monkeypatch):
    levels = []
    inner = detect._detect
    monkeypatch.setattr(detect, "_detect", lambda level, *rest: levels.append(level.shape) or inner(level, *rest))
    near = photograph(piece, view(0, 0, 800, 10, (800, 600)), (800, 600), blur_px=0.4)
    far = np.full((1800, 2400, 3), 128, np.uint8)
    far[900:1500, 1300:2100] = near
    expected = find_sheet(near, IDS, surface.corners_mm).corners_px
    levels.clear()
    shown, _ = identify_sheet(far, surface)
    assert shown.corners_px.keys() == expected.keys() == IDS and levels[0] == (450, 600) and len(levels) > 1
    for marker_id, corners in shown.corners_px.items():
        np.testing.assert_allclose(corners - [1300, 900], expected[marker_id], atol=0.01, rtol=0)
    far[900:1500, 1300:2100] = 128
    far[900:975, 1300:1400] = cv2.resize(near, (100, 75), interpolation=cv2.INTER_AREA)
    with pytest.raises(PhotoRejected, match="no marker is readable"):
        identify_sheet(far, surface)


@pytest.mark.parametrize("moved_px", [0, 2])
def test_markers_that_are_predicted_are_completed_as_without_the_first_look(piece, surface, monkeypatch, moved_px):
    """Blurred and far away, where the detector misses some; with predictions that are up to half a module off."""
    photo = photograph(piece, view(30, 0, 560, 10), blur_px=1.5, noise=0.004)
    predicted = known_page._predict_corners

    def off(*given):
        quads = predicted(*given)
        return quads and {i: quad + np.array([moved_px, -moved_px]) for i, quad in quads.items()}

    monkeypatch.setattr(known_page, "_predict_corners", off)
    looked = find_sheet(photo, IDS, surface.corners_mm).corners_px
    monkeypatch.setattr(known_page, "_MIN_TRIAL_CORRELATION", -2)
    fitted = find_sheet(photo, IDS, surface.corners_mm).corners_px
    assert looked.keys() == fitted.keys() and len(looked) >= 6


def test_outlines_have_no_more_points_than_pixels_have_edges():
    rng = np.random.default_rng(0)
    for share in np.linspace(0, 1, 40):
        mask = (rng.random((23, 31)) < share).astype(np.uint8)
        outlines, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        assert sum(map(len, outlines)) <= count_edges(mask)
    assert count_edges(np.ones((3, 4), np.uint8)) == 14


def test_squares_among_noise_are_found_as_without_taking_its_specks_off(monkeypatch):
    y, x = np.mgrid[:400, :400] % 40
    picture = np.where((abs(y - 20) < 10) & (abs(x - 20) < 10), 40, 200) + np.random.default_rng(1).normal(
        0, 6, y.shape
    )
    picture = np.clip(picture, 0, 255).astype(np.uint8)
    count = len(find_squares(picture))
    monkeypatch.setattr(limits, "_NOISE_EDGES", 0)
    assert count > 60 and len(find_squares(picture)) == count


@pytest.mark.parametrize("step", [1, 3])
def test_light_is_averaged_and_clipped_pixels_are_counted(step):
    srgb = np.random.default_rng(0).integers(0, 256, (61, 40, 3), np.uint8)
    srgb[:20, :20] = np.minimum(srgb[:20, :20], CLIPPED_CODE - 1)
    height, width = 61 // step, 40 // step
    blocks = srgb[: height * step, : width * step].reshape(height, step, width, step, 3)
    clipped = (blocks.max(-1) >= CLIPPED_CODE).mean((1, 3))
    means = appearance._reduced_light(srgb, step)
    np.testing.assert_allclose(means[..., :3], LINEAR_FLOAT32_FROM_CODE[blocks].mean((1, 3)), atol=1e-5)
    np.testing.assert_allclose(means[..., 3], clipped, atol=1e-6)


def test_colors_are_those_of_all_pixels(piece, surface, monkeypatch):
    manifest = make_manifest()
    photo = photograph(piece, view(20, 5, 300, size_px=(1600, 1200)), (1600, 1200), blur_px=0.6, noise=0.005)
    photo = pinhole_photo(Photo(photo, None), None)

    def color():
        promised = promised_of(manifest, surface, identity_printer())
        return measure(photo, "a", surface, promised, promised_ranges(()), with_pictures=False).entry.color

    reduced = color()
    monkeypatch.setattr(appearance, "_SAMPLES_PER_CELL", 1e6)
    whole = color()
    # the 12-megapixel photographs that were compared differ by 0.0125 at most
    assert reduced.delta_e00_mean == pytest.approx(whole.delta_e00_mean, abs=0.03)
    assert reduced.clipped_share == whole.clipped_share and reduced.glossy_share == whole.glossy_share


@pytest.mark.parametrize(("azimuth_deg", "distance_mm", "blur_px"), [(0, 350, 0.6), (35, 500, 0.6), (20, 700, 1.2)])
def test_a_reduced_picture_seen_through_one_window_gives_the_markers_of_three(
    piece, surface, monkeypatch, azimuth_deg, distance_mm, blur_px
):
    sensor = {"fine": 2, "blur_px": blur_px, "noise": 0.01}
    photo = photograph(piece, view(azimuth_deg, 5, distance_mm, size_px=(1600, 1200)), (1600, 1200), **sensor)
    one = find_sheet(photo, IDS, surface.corners_mm).corners_px
    inner = detect._detect
    monkeypatch.setattr(detect, "_detect", lambda picture, aruco, full_px, _: inner(picture, aruco, full_px))
    three = find_sheet(photo, IDS, surface.corners_mm).corners_px
    assert one.keys() == three.keys() == IDS
    for marker_id, corners in one.items():
        np.testing.assert_allclose(corners, three[marker_id], atol=0.02, rtol=0)


def test_a_first_round_that_only_nears_the_borders_leaves_them_where_they_were(piece, surface, monkeypatch):
    photo = photograph(piece, view(25, 10, 400, 8), blur_px=0.7, noise=0.01)
    nearing = find_sheet(photo, IDS, surface.corners_mm).corners_px
    monkeypatch.setattr(edges, "_CONVERGED_PX", (1e-3, 1e-3))
    settled = find_sheet(photo, IDS, surface.corners_mm).corners_px
    assert nearing.keys() == settled.keys() == IDS
    assert max(np.abs(nearing[i] - settled[i]).max() for i in IDS) < 2e-3


def test_a_color_map_that_stops_where_it_settles_is_that_of_all_turns(monkeypatch):
    rng = np.random.default_rng(0)
    promised = rng.random((2000, 3))
    seen = promised @ np.array([[0.6, 0.1, 0.02], [0.05, 0.7, 0.03], [0.01, 0.08, 0.5]]) + 0.03
    seen += rng.standard_t(2, seen.shape) * 0.01
    seen[:300] += 0.3  # gloss
    stopped = print_colors.affine12(seen, promised)
    monkeypatch.setattr(print_colors, "_CONVERGED", 0)
    turned = print_colors.affine12(seen, promised)
    assert stopped is not None and turned is not None
    np.testing.assert_allclose(stopped.undo(seen), turned.undo(seen), atol=5e-4)


def test_how_vague_cells_are_and_how_well_codes_agree_are_numpy_s_own(piece):
    rng = np.random.default_rng(0)
    cells = rng.random((5, 30, 30), np.float32)
    cells[0] = 0.5
    cells[1] = np.linspace(0, 1, 30)  # texture along one side alone
    vague = _shift_per_error(cells)
    assert np.isinf(vague[:2]).all()
    for cell, figure in zip(cells[2:], vague[2:], strict=True):
        slopes = np.stack([slope.ravel() for slope in np.gradient(cell[5:-5, 5:-5])])
        least = np.linalg.eigvalsh(np.cov(slopes, bias=True))[0]
        assert figure == pytest.approx(cell.std() / np.sqrt(16 * least), rel=1e-4)
    code = (rng.random((7, 7)) < 0.5).astype(float)
    srgb = rng.integers(0, 256, (70, 70, 3), np.uint8)
    quad = np.array([[0, 0], [70, 0], [70, 70], [0, 70]], float)
    centers = np.mgrid[1:6, 1:6].reshape(2, -1) * 10 + 5
    light = edges.sample(luminance(srgb), centers.T[:, ::-1].astype(float))
    expected = np.corrcoef(light, code[1:-1, 1:-1].ravel())[0, 1]
    assert known_page._likeness(srgb, quad, code)[0] == pytest.approx(expected, abs=1e-5)
    assert known_page._likeness(np.full_like(srgb, 9), quad, code)[0] == 0


@pytest.mark.parametrize(("marker_px", "seen"), [(10, True), (9, True), (6, False)])
def test_a_print_is_seen_whose_markers_are_too_small_to_be_read(piece, surface, monkeypatch, marker_px, seen):
    near = photograph(piece, view(0, 0, 500, 0, (600, 450)), (600, 450), blur_px=0.4)
    first = find_sheet(near, IDS, surface.corners_mm)
    assert first.markers.keys() == IDS and not first.doubled
    side = np.mean([np.linalg.norm(np.diff(quad[:2], axis=0)) for quad in first.corners_px.values()])
    second = cv2.resize(near, None, fx=marker_px / side, fy=marker_px / side, interpolation=cv2.INTER_AREA)
    photo = np.full((450, 1000, 3), 128, np.uint8)
    photo[:, :600], photo[20 : 20 + len(second), 640 : 640 + second.shape[1]] = near, cv2.blur(second, (2, 2))
    assert bool(find_sheet(photo, IDS, surface.corners_mm).doubled) == seen
    alone = np.ascontiguousarray(photo[:, 600:])
    assert (len(find_sheet(alone, IDS, surface.corners_mm).markers) > 6) == seen
    others = {i + 50: corners for i, corners in surface.corners_mm.items()}
    assert not find_sheet(alone, {i + 50 for i in IDS}, others).markers
    monkeypatch.setattr(known_page, "find_second_print", lambda *given: ((), ()))
    assert not find_sheet(photo, IDS, surface.corners_mm).doubled


def test_a_code_in_any_turn_has_the_id_that_opencv_finds():
    rng, dictionary = np.random.default_rng(0), "DICT_4X4_50"
    aruco, square = aruco_dictionary(dictionary), np.array([[2, 2], [50, 2], [50, 50], [2, 50]], float)
    codes = [np.rot90(cells, k)[1:-1, 1:-1] for k, cells in enumerate(marker_cells(dictionary, range(0, 50, 7)))]
    for cells in (np.ascontiguousarray(code, np.uint8) for code in (*codes, *rng.integers(0, 2, (40, 4, 4)))):
        is_read, marker_id, _ = aruco.identify(cells, 0.0)
        light = np.kron(np.pad(40 + 200 * cells, 1, constant_values=40), np.ones((8, 8))).astype(np.uint8)
        seen = known_page._read_codes(np.pad(light, 2, constant_values=240), [square], dictionary)
        assert seen == ({marker_id} if is_read else set())
    assert detect.marker_codes(aruco_dictionary("DICT_5X5_1000").bytesList.tobytes(), 5).shape == (25, 4000)
