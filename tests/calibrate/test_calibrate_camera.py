"""Cameras from boards: known lenses come back, the ladder stops where it should, and what cannot be told is refused.

Corners are projected by OpenCV or, once, found in rendered photographs; the lens module that reads the file is ours.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image

from patchproof.base.errors import Refused
from patchproof.calibrate.camera import (
    BoardView,
    calibrate_camera,
    calibration_lines,
    corner_positions_mm,
    find_boards,
    fit_camera,
)
from patchproof.calibrate.ladder import choose_rung
from patchproof.channel.lens import load_camera
from patchproof.sheets.blank import board_sheet, load_board
from patchproof.sheets.pdf_raster import rasterize_page

SIZE = (1600, 1200)
BOARD = load_board("charuco_a4")
PLACES = corner_positions_mm(BOARD)
NONE = np.zeros(5)


def matrix(focal=1300.0, middle=(790.0, 610.0)):
    return np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1.0]])


def pose(rng, focal, size, tilt):
    """Rotation and translation of a board that fills the picture, turned by `tilt` degrees about any axis."""
    angle, about, roll = np.radians(rng.uniform(*tilt)), rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi)
    turn = (
        cv2.Rodrigues(np.array([np.cos(about), np.sin(about), 0]) * angle)[0] @ cv2.Rodrigues(np.array([0, 0, roll]))[0]
    )
    away = focal * 270 / (min(size) * rng.uniform(0.7, 1.2))
    aside = rng.uniform(-0.25, 0.25, 2) * size / focal * away
    return turn, np.array([*aside, away]) - turn @ np.array([84, 120, 0])


def views(seed, count, bends=NONE, tilt=(10, 40), noise_px=0.04):
    """Views with exact corners plus noise, those outside of the picture left out."""
    rng, made = np.random.default_rng(seed), []
    flat = np.column_stack([PLACES, 0 * PLACES[:, 0]])
    while len(made) < count:
        turn, move = pose(rng, 1300, SIZE, tilt)
        px = cv2.projectPoints(flat, cv2.Rodrigues(turn)[0], move, matrix(), bends)[0].reshape(-1, 2)
        seen = ((px > 5) & (px < np.array(SIZE) - 5)).all(1)
        if seen.sum() >= 12:
            noisy = px + rng.normal(0, noise_px, px.shape)
            made.append(BoardView(f"{len(made):02d}.jpg", np.flatnonzero(seen), PLACES[seen], noisy[seen], SIZE))
    return made


def solved(shown, **more):
    return fit_camera(shown, {}, BOARD, "mine", **more)


@pytest.fixture(scope="module")
def pinholes():
    """Six calibrations of a camera that bends nothing, each by photographs of its own."""
    return [solved(views(seed, 8)).fit for seed in range(6)]


def test_without_distortion_the_ladder_stays_at_the_pinhole(pinholes):
    for fit in pinholes:
        assert fit.rung == "pinhole" and fit.numbers[:2] == pytest.approx(1300, rel=0.003)


@pytest.mark.parametrize(
    ("bends", "rung"),
    [((-0.015, 0, 0, 0, 0), "k1"), ((-0.25, 0.08, 0, 0, 0), "k1 k2"), ((-0.1, 0.02, 0.001, -0.0005, 0), "k1 k2 p1 p2")],
)
def test_a_known_lens_comes_back_with_its_rung(bends, rung):
    found = solved(views(1, 12, np.array(bends)))
    fit = found.fit
    assert fit.rung == rung
    true = np.array([1300, 1300, 790, 610, *bends])
    assert fit.numbers[:2] == pytest.approx(1300, rel=0.003) and fit.rms_px < 0.15
    free = fit.sd > 0
    assert (np.abs(fit.numbers - true)[free] < 4 * fit.sd[free]).all() and (fit.numbers[~free] == 0).all()
    # the project's own lens module, from the camera made here: where a pinhole's pixel goes
    pixel = np.array([[1400.0, 200.0]])
    flat = np.column_stack([(pixel - [790, 610]) / 1300, [1.0]])
    there = cv2.projectPoints(flat, np.zeros(3), np.zeros(3), matrix(), np.array(bends))[0].reshape(1, 2)
    assert found.camera.distort_points(pixel, SIZE) == pytest.approx(there, abs=0.5)


def test_the_lowest_rung_within_one_standard_error_of_the_paired_difference_is_chosen():
    """Hard items are hard for every rung: 0.4 of one of the photographs says nothing about which one is better."""
    best = np.array([0.4, 0.10, 0.09, 0.11])
    # worse by 0.01 on average, ± 0.0174 and ± 0.00174: the standard errors of four are 0.0174 / √3 = 0.01005 and 0.001
    near, far = best + 0.01 + np.array([1, -1, 1, -1]) * 0.0174, best + 0.01 + np.array([1, -1, 1, -1]) * 0.00174
    chosen, rungs = choose_rung(["pinhole", "k1", "k1 k2"], np.array([best + 0.1, near, best]))
    assert chosen == 1 and rungs[1].worse_by == pytest.approx(0.01)
    assert rungs[1].standard_error == pytest.approx(0.0174 / np.sqrt(3)) and rungs[2].worse_by == 0
    assert choose_rung(["pinhole", "k1", "k1 k2"], np.array([best + 0.1, far, best]))[0] == 2
    chosen, lost = choose_rung(["pinhole", "k1"], np.array([np.full(4, np.inf), best]))
    assert chosen == 1 and np.isinf(lost[0].error)


def test_stated_deviations_are_those_between_repeated_calibrations(pinholes):
    z = np.array([(fit.numbers[:4] - [1300, 1300, 790, 610]) / fit.sd[:4] for fit in pinholes])
    assert 0.5 < np.sqrt((z**2).mean()) < 1.6  # of 24; 40 calibrations of 8 photographs gave 0.9 to 1.0


@pytest.mark.parametrize("tilt", [(0, 0.01), (0, 3)])
def test_boards_that_all_face_the_camera_are_refused(tilt):
    with pytest.raises(Refused, match=r"turned against each other .* from 20 to 45° aside"):
        solved(views(0, 8, tilt=tilt))


def test_boards_that_are_turned_enough_are_not_refused():
    assert solved(views(1, 8, tilt=(0, 14))).fit.numbers[:2] == pytest.approx(1300, rel=0.003)


def test_five_photographs_are_too_few():
    with pytest.raises(Refused, match=r"Expected at least 6 photographs .* got 5 of 5"):
        solved(views(0, 5))
    assert len(solved(views(0, 6)).views) == 6


def test_a_moved_photograph_and_a_wrong_corner_are_left_out():
    shown = views(5, 10)
    rng = np.random.default_rng(0)
    shown[3] = BoardView(
        "moved.jpg", shown[3].ids, shown[3].board_mm, shown[3].px + rng.normal(0, 3, shown[3].px.shape), SIZE
    )
    shown[5].px[4] += 7
    found = solved(shown)
    assert list(found.left_out) == ["moved.jpg"] and "moved" in found.left_out["moved.jpg"]
    assert sum(len(v.ids) for v in found.views) == sum(len(v.ids) for v in shown) - len(shown[3].ids) - 1
    assert found.fit.numbers[:2] == pytest.approx(1300, rel=0.003)


def test_size_of_the_print_does_not_matter_but_its_proportions_do():
    def printed(scale):
        return [BoardView(v.file, v.ids, v.board_mm * scale, v.px, v.size_px) for v in views(2, 10)]

    assert solved(printed(0.5)).fit.numbers[:2] == pytest.approx(1300, rel=0.003)
    with pytest.raises(Refused, match=r"px rms: use one zoom and no crops, glue .*--ruler-mm"):
        solved(printed([0.98, 1.0]))
    found = solved(views(2, 10))
    for ratio, said in ((1.0, False), (1.004, False), (1.03, True)):
        stretched = replace(found, camera=found.camera.changed(fx=found.camera.fy * ratio))
        assert ("hardly this far from square" in " ".join(calibration_lines(stretched))) == said
    stretched = corner_positions_mm(BOARD, (97.0, 98.0))
    assert stretched == pytest.approx(PLACES * [0.97, 0.98])


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """Seven JPEGs of the printed page through a known lens, one without a board, one of another size."""
    folder = tmp_path_factory.mktemp("boards")
    board_sheet("charuco_a4", folder / "board.pdf")
    page = rasterize_page(folder / "board.pdf", 1, 127).astype(np.float32) / 255  # 5 px per mm
    size, fine, camera, bends = (640, 480), 2, matrix(560.0, (316.0, 244.0)), np.array([-0.12, 0, 0, 0, 0])
    x, y = np.meshgrid(*((np.arange(side * fine) + 0.5) / fine for side in size))
    straight = cv2.undistortPoints(np.stack([x.ravel(), y.ravel()], 1).reshape(-1, 1, 2), camera, bends).reshape(-1, 2)
    rng = np.random.default_rng(3)
    for i in range(7):
        turn, move = pose(rng, 560, size, (15, 40))
        homography = np.linalg.inv(np.column_stack([turn[:, 0], turn[:, 1], move]))
        mm = np.column_stack([straight, np.ones(len(straight))]) @ homography.T
        at = ((mm[:, :2] / mm[:, 2:] + [12, 20]) * 5 - 0.5).astype(np.float32).reshape(*x.shape, 2)
        light = cv2.remap(page[..., 0] ** 2.2, at, None, cv2.INTER_LINEAR, borderValue=0.25)
        light = cv2.GaussianBlur(cv2.resize(light, size, interpolation=cv2.INTER_AREA), (0, 0), 0.6) * 0.8
        light += rng.normal(0, 0.004, light.shape)
        gray = np.round(np.clip(light, 0, 1) ** (1 / 2.2) * 255).astype(np.uint8)
        Image.fromarray(np.dstack([gray] * 3)).save(folder / f"p{i}.jpg", quality=93)
    Image.fromarray(np.full((480, 640, 3), 90, np.uint8)).save(folder / "none.png")
    with Image.open(folder / "p0.jpg") as first:
        first.resize((400, 300)).save(folder / "small.png")
    (folder / "notes.txt").write_text("x")
    return folder


def test_photographs_give_a_camera_file_that_scenes_can_read(photos, tmp_path):
    out = tmp_path / "mine.json"
    found = calibrate_camera(photos, photos / "board.json", out)
    camera = load_camera(str(out), photo_px=(640, 480))
    assert camera == found.camera and camera.method == "measured" and camera.name == "mine"
    assert (camera.fx, camera.fy) == (pytest.approx(560, rel=0.003), pytest.approx(560, rel=0.003))
    assert (camera.cx, camera.cy) == (pytest.approx(316, abs=1), pytest.approx(244, abs=1))
    assert found.fit.rung == "k1" and camera.k1 == pytest.approx(-0.12, abs=0.01)
    assert found.fit.rms_px < 0.15 and "fx" in camera.uncertainty
    assert len(found.views) == 7 and set(found.left_out) == {"none.png", "small.png"}
    assert "0 markers" in found.left_out["none.png"]
    assert "a picture of 400 × 300 px where most have a picture of 640 × 480 px" in found.left_out["small.png"]
    first, *_ = lines = calibration_lines(found)
    assert "held-out error in px: pinhole 1." in first and first.count(",") == 4
    assert sum(line.startswith("left out: ") for line in lines) == 2
    with pytest.raises(Refused, match="Expected a new file"):
        calibrate_camera(photos, "charuco_a4", out)


def test_a_folder_without_boards_is_refused(tmp_path):
    Image.fromarray(np.full((480, 640, 3), 90, np.uint8)).save(tmp_path / "a.png")
    with pytest.raises(Refused, match="Expected photographs of the board"):
        find_boards(tmp_path, BOARD)
    none = tmp_path / "none"
    none.mkdir()
    Image.fromarray(np.full((480, 640, 3), 90, np.uint8)).save(none / "gray.png")
    with pytest.raises(
        Refused, match=r"got 1 that do not show it \(gray\.png: .+\): take them sharp and lit, not mirrored"
    ):
        calibrate_camera(none, "charuco_a4", tmp_path / "camera.json")
    with pytest.raises(Refused, match=r"ends in \.json"):
        calibrate_camera(tmp_path, "charuco_a4", tmp_path / "camera.txt")
