"""The piece: ids, layout, the markers' raster, and controls."""

import os
import subprocess
import sys

import cv2
import numpy as np
import pytest

from patchproof.base.color import linear_from_srgb, srgb_from_linear
from patchproof.base.errors import Refused
from patchproof.sheets.piece import (
    SHEET_KINDS,
    black_runs,
    control_design,
    hash_order,
    lay_out_piece,
    marker_ids,
    marker_image,
    marker_rects_mm,
    marker_size_mm,
    sheet_id,
    whiten_marker_pixels,
    with_ids,
)

ID = "A1B2C3D4E5"


def reserved_of(piece):
    """What belongs to each marker as x0, y0, x1, y1."""
    return [(x, y, x + w, y + h) for x, y, w, h in piece.reserved_mm]


def between(a, b):
    """The larger of the gaps along x and y: negative where two rectangles overlap."""
    return max(max(a[i] - b[i + 2], b[i] - a[i + 2]) for i in (0, 1))


def test_sheet_id_is_ten_characters_that_never_change():
    # written down once; another value would orphan every sheet ever printed
    assert sheet_id({"b": 1.0, "a": [1, "x"]}, 3) == sheet_id({"a": [1, "x"], "b": 1.0}, 3) == "QN1RBZLCDM"
    assert sheet_id({"a": 1}, 0) != sheet_id({"a": 1}, 1) != sheet_id({"a": 2}, 1)


def test_marker_ids_never_change_and_grow_by_appending():
    assert marker_ids(ID, "design", 4) == [295, 626, 539, 749]
    assert marker_ids(ID, "design", 12)[:4] == marker_ids(ID, "design", 4)


def test_kinds_of_one_sheet_share_no_id():
    ids = [i for kind in SHEET_KINDS for i in marker_ids(ID, kind, 166)]
    assert len(ids) == len(set(ids)) == 5 * 166
    assert 0 <= min(ids) and max(ids) < 1000


def test_marker_ids_refuse_too_many_and_unknown_kinds():
    with pytest.raises(Refused, match="at most 166 markers"):
        marker_ids(ID, "design", 167)
    with pytest.raises(Refused, match='did you mean "gray"'):
        marker_ids(ID, "grayy", 4)


def test_ids_do_not_depend_on_the_hash_seed():
    code = (
        "from patchproof.sheets.piece import marker_ids, sheet_id; "
        "print(sheet_id({'a': 1, 'b': 2}, 0), marker_ids('A1B2C3D4E5', 'noise', 5))"
    )
    seed = "2" if os.environ.get("PYTHONHASHSEED") == "1" else "1"  # another one than here
    environment = {"PYTHONHASHSEED": seed, "PYTHONPATH": ":".join(sys.path)}
    command = [sys.executable, "-c", code]
    there = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    assert there.split("\n")[0] == f"{sheet_id({'a': 1, 'b': 2}, 0)} {marker_ids('A1B2C3D4E5', 'noise', 5)}"


def test_hash_order_is_a_permutation():
    assert sorted(hash_order("x", 50)) == list(range(50)) != list(hash_order("x", 50))


@pytest.mark.parametrize("piece_mm", [(110, 110), (39, 39), (60, 140), (900, 60), (1200, 1200)])
@pytest.mark.parametrize("needed_mm", [2.0, 13.7, 40.0])
@pytest.mark.parametrize("bends", [False, True])
def test_what_belongs_to_markers_is_a_module_of_white_and_lies_apart_within_the_cut(piece_mm, needed_mm, bends):
    marker_mm = marker_size_mm(needed_mm, piece_mm)
    piece = lay_out_piece(piece_mm, marker_mm, ID, "design", bends)
    assert piece.size_mm == piece_mm and piece.marker_mm == pytest.approx(marker_mm)
    assert len({m.id for m in piece.markers}) == len(piece.markers) >= 4
    reserved = reserved_of(piece)
    for i, (marker, (x0, y0, x1, y1)) in enumerate(zip(piece.markers, reserved, strict=True)):
        (left, top), _, (right, bottom), _ = marker.corners_mm
        # a millimeter and a module to the cut, a module to what is the design's
        assert min(left, top, piece_mm[0] - right, piece_mm[1] - bottom) >= 1 + marker_mm / 7 - 1e-9
        assert min(left - x0, top - y0, x1 - right, y1 - bottom) >= marker_mm / 7 - 1e-9
        assert min(x0, y0) >= 0 and x1 <= piece_mm[0] + 1e-9 and y1 <= piece_mm[1] + 1e-9
        # either the cut line is its border, or scissors leave more than a sliver of the design beside it
        assert all(side <= 1e-9 or side > 2 for side in (x0, y0, piece_mm[0] - x1, piece_mm[1] - y1))
        assert all(between(reserved[i], other) > 0 for other in reserved[:i])
    corners = sum((x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in reserved[:4])
    assert corners <= (4 * 0.29**2 + 1e-9) * min(piece_mm) ** 2  # the design keeps two thirds of a square


def test_hand_numbers_of_a_piece():
    # 19 mm markers: modules of 2.714286, so corners of 19 × 9/7 + 1 = 25.428571 mm
    piece = lay_out_piece((162, 110), 19, ID, "design")
    assert np.array(piece.markers[0].corners_mm) == pytest.approx(
        np.array([[0, 0], [19, 0], [19, 19], [0, 19]]) + 1 + 19 / 7
    )
    side = 25.428571
    assert np.array(piece.reserved_mm) == pytest.approx(
        np.array(
            [
                (0, 0, side, side),
                (162 - side, 0, side, side),
                (162 - side, 110 - side, side, side),
                (0, 110 - side, side, side),
            ]
        )
    )


@pytest.mark.parametrize(
    ("length_mm", "bends", "along"),
    [
        # 10 mm markers begin 1 + 10/7 mm from the cut: 12 of them fit between two on 120 + 20 + 34/7 = 144.857 mm
        (144.8, False, 0),
        (144.9, False, 1),
        (264.8, False, 1),  # twice 120 from corner marker to corner marker
        (264.9, False, 2),
        # three on bent paper: 30 + 20 + 34/7 = 54.857 mm
        (54.8, True, 0),
        (54.9, True, 1),
        (144.9, True, 1),
        (264.9, True, 2),
    ],
)
def test_markers_come_along_sides_that_are_long_or_bend(length_mm, bends, along):
    piece = lay_out_piece((length_mm, 45.0), 10.0, ID, "design", bends)
    assert len(piece.markers) == 4 + 2 * along
    starts = sorted({marker.corners_mm[0][0] for marker in piece.markers})
    assert len(starts) == 2 + along and np.diff(starts) == pytest.approx(np.diff(starts)[0])
    assert {m.corners_mm[0][1] for m in piece.markers} == {m.corners_mm[0][1] for m in piece.markers[:4]}
    upright = lay_out_piece((45.0, length_mm), 10.0, ID, "design", bends)
    assert sorted({marker.corners_mm[0][1] for marker in upright.markers}) == starts
    assert len(lay_out_piece((length_mm, length_mm), 10.0, ID, "design", bends).markers) == 4 + 4 * along


def test_marker_size_is_what_is_needed_else_what_leaves_the_design_its_share_else_refused():
    assert marker_size_mm(12.3, (110, 110)) == 12.3
    assert marker_size_mm(2, (110, 110)) == 8
    # 0.29 × 110 = 31.9 mm for a corner; (31.9 - 1) × 7/9 = 24.03
    assert marker_size_mm(40, (110, 200)) == marker_size_mm(40, (200, 110)) == 24.0
    assert marker_size_mm(24, (110, 110)) == 24 and marker_size_mm(24.02, (110, 110)) == 24.02
    # 8 × 9/7 + 1 = 11.2857 mm are 0.29 of 38.92
    assert marker_size_mm(19, (39, 50)) == marker_size_mm(19, (38.92, 38.92)) == 8
    for size in ((38.9, 50), (50, 38.9)):
        with pytest.raises(Refused) as refusal:
            marker_size_mm(8, size)
        got = f"{size[0]:g} × {size[1]:g} mm"
        told = f"Expected a piece of at least 39 mm, which has room for 8 mm markers, got {got}: make the patch larger."
        assert str(refusal.value) == told


def test_marker_rects_cover_opencv_s_own_picture():
    piece = lay_out_piece((50, 50), 14, ID, "design")
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_1000)
    for marker in piece.markers:
        drawn = np.full((70, 70), 255)
        for x, y, w, h in marker_rects_mm(marker):
            x, y = (x - marker.corners_mm[0][0]) * 5, (y - marker.corners_mm[0][1]) * 5
            drawn[round(y) : round(y + h * 5), round(x) : round(x + w * 5)] = 0
        assert np.array_equal(drawn, cv2.aruco.generateImageMarker(dictionary, marker.id, 70))


def test_black_runs():
    dark = np.array([[0, 1, 1, 0, 1], [0, 0, 0, 0, 0], [1, 1, 1, 1, 1]], bool)
    assert black_runs(dark, (10, 20), 2) == [(12, 20, 4, 2), (18, 20, 2, 2), (10, 24, 10, 2)]


@pytest.mark.parametrize("design_px", [(64, 64), (113, 71), (300, 300)])
def test_marker_image_is_the_mean_light_of_supersampled_markers(design_px):
    """Slow twin: point samples, 24 × 24 in each pixel."""
    piece = lay_out_piece((120, 61), 11, ID, "design", bends=True)
    assert len(piece.markers) == 8
    srgb, reserved = marker_image(piece, design_px)
    assert srgb.dtype == np.float32 and srgb.shape == (design_px[1], design_px[0], 3)
    n = 24 if max(design_px) < 200 else 8
    x, y = ((np.arange(px * n) + 0.5) / n * mm / px for px, mm in zip(design_px, piece.size_mm, strict=True))
    linear, touched = np.ones((len(y), len(x)), np.float32), np.zeros((len(y), len(x)), bool)
    for rects, image, value in (
        ([rect for marker in piece.markers for rect in marker_rects_mm(marker)], linear, 0),
        (piece.reserved_mm, touched, True),
    ):
        for rx, ry, rw, rh in rects:
            image[np.ix_((y >= ry) & (y < ry + rh), (x >= rx) & (x < rx + rw))] = value
    mean = linear.reshape(design_px[1], n, design_px[0], n).mean((1, 3))
    # a straight edge through n × n samples is off by at most half a sample in each direction
    assert np.abs(linear_from_srgb(srgb.astype(float)) - mean[..., None]).max() < 1.01 / n
    assert np.abs(linear_from_srgb(srgb.astype(float)).mean() - mean.mean()) < 1e-3
    share = touched.reshape(design_px[1], n, design_px[0], n).mean((1, 3))
    assert reserved[share > 0].all()
    thin = reserved & (share == 0)  # touched by less than half a sample
    assert thin.mean() < 0.02 and (srgb[thin] == 1).all()


@pytest.mark.parametrize("design_px", [(97, 53), (512, 261), (32, 32)])
def test_marker_image_conserves_ink(design_px):
    """Sum of darkness in px² = black area in mm² × px²/mm², whatever the grid."""
    piece = lay_out_piece((120, 61), 11, ID, "design")
    srgb, _ = marker_image(piece, design_px)
    area = sum(w * h for m in piece.markers for _, _, w, h in marker_rects_mm(m))
    # 2e-5: the image is float32 sRGB
    dark = (1 - linear_from_srgb(srgb.astype(float))).sum((0, 1))
    assert dark == pytest.approx(np.full(3, area * design_px[0] / 120 * design_px[1] / 61), rel=2e-5)


@pytest.mark.parametrize("design_px", [(32, 32), (97, 53), (163, 88), (512, 261), (40, 600)])
def test_reserved_pixels_are_a_module_round_each_marker_and_no_more_than_that_needs(design_px):
    piece = lay_out_piece((120, 61), 11, ID, "design", bends=True)
    srgb, reserved = marker_image(piece, design_px)
    assert (srgb[~reserved] == 1).all()
    left, top = (np.arange(n) * mm / n for n, mm in zip(design_px, piece.size_mm, strict=True))
    right, bottom = (v + mm / n for v, n, mm in zip((left, top), design_px, piece.size_mm, strict=True))
    free = np.ones_like(reserved)
    for marker, (rx, ry, rw, rh) in zip(piece.markers, piece.reserved_mm, strict=True):
        (x0, y0), _, (x1, y1), _ = marker.corners_mm
        module = 11 / 7 - 1e-6
        near = np.ix_((bottom > y0 - module) & (top < y1 + module), (right > x0 - module) & (left < x1 + module))
        assert reserved[near].all()
        touches = (bottom > ry + 1e-5) & (top < ry + rh - 1e-5), (right > rx + 1e-5) & (left < rx + rw - 1e-5)
        free[np.ix_(*touches)] = False
    assert not reserved[free].any()


def test_hand_numbers_of_reserved_pixels():
    # 2 px/mm: corners of 25.428571 mm touch 50.86, so 51 pixels; 19 mm markers begin at 7.43 px and end at 45.43
    srgb, reserved = marker_image(lay_out_piece((110, 80), 19, ID, "design"), (220, 160))
    assert reserved[:51, :51].all() and reserved.sum() == 4 * 51 * 51
    assert (srgb[:7] == 1).all() and (srgb[:, :7] == 1).all() and (srgb[46:51, :51] == 1).all()
    assert srgb[7, 20] == pytest.approx(np.full(3, srgb_from_linear(np.array(3 / 7))), abs=1e-3)  # 4/7 of it is ink
    assert (srgb[8:12, 8:45] == 0).all()  # the black border


def test_on_paper_whitens_what_is_reserved_alone_and_once():
    piece, design = lay_out_piece((70, 100), 9, ID, "design"), photo_like_design()
    before = design.copy()
    printed = whiten_marker_pixels(design, piece)
    _, reserved = marker_image(piece, (70, 100))
    assert printed.dtype == np.uint8 and (printed[reserved] == 255).all()
    assert np.array_equal(printed[~reserved], design[~reserved]) and np.array_equal(design, before)
    assert np.array_equal(whiten_marker_pixels(printed, piece), printed)
    assert np.array_equal(
        whiten_marker_pixels(design, with_ids(piece, ID, "mean")), printed
    )  # whatever the markers' ids


def photo_like_design():
    y, x = np.mgrid[:100, :70]
    return np.stack([x * 3, y * 2, (x * y) % 256], -1).astype(np.uint8)


def test_mean_control_is_averaged_in_light():
    design = np.zeros((10, 10, 3), np.uint8)
    design[:5] = 255
    # half the light is sRGB 0.7354, code 188, not 128
    assert (control_design("mean", design, ID) == 188).all()
    assert srgb_from_linear(np.array(0.5)) * 255 == pytest.approx(187.5, abs=0.1)


def test_noise_control_is_uniform_and_follows_the_sheet_id():
    design = np.zeros((256, 512, 3), np.uint8)
    noise = control_design("noise", design, ID)
    cells = noise[8::16, 8::16]
    assert cells.shape == (16, 32, 3)
    assert np.array_equal(np.kron(cells, np.ones((16, 16, 1), np.uint8)), noise)
    # 1536 uniform bytes: mean 127.5 ± 4 × 73.9 / √1536
    assert abs(cells.mean() - 127.5) < 7.6
    assert np.array_equal(noise, control_design("noise", design, ID))
    assert not np.array_equal(noise, control_design("noise", design, "A1B2C3D4E6"))


@pytest.mark.parametrize("size", [(1, 1), (5, 3), (17, 100)])
@pytest.mark.parametrize("kind", SHEET_KINDS)
def test_controls_have_the_design_s_size_however_small(size, kind):
    design = np.arange(size[0] * size[1] * 3, dtype=np.uint8).reshape(*size, 3)
    control = control_design(kind, design, ID)
    assert control.shape == design.shape and control.dtype == np.uint8


@pytest.mark.parametrize("kind", SHEET_KINDS)
def test_controls_of_a_piece_are_white_where_its_markers_lie(kind):
    piece, design = lay_out_piece((70, 100), 9, ID, "design"), photo_like_design()
    _, reserved = marker_image(piece, (70, 100))
    control = control_design(kind, design, ID, piece)
    assert control.dtype == np.uint8 and (control[reserved] == 255).all()
    assert np.array_equal(whiten_marker_pixels(control, piece), control)
    if kind != "mean":  # elsewhere it is what it is without a piece
        assert np.array_equal(control[~reserved], control_design(kind, design, ID)[~reserved])
    # what the design has under the markers shows in no control
    design[reserved] = 7
    assert np.array_equal(control_design(kind, design, ID, piece), control)


def test_plain_controls():
    design = photo_like_design()
    assert (control_design("gray", design, ID) == 128).all()
    assert (control_design("blank", design, ID) == 255).all()
    assert np.array_equal(control_design("design", design, ID), design)
    with pytest.raises(Refused, match='did you mean "noise"'):
        control_design("noisy", design, ID)
