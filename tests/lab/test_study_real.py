"""The study of real photographs: on photographs made by other means its figures come back, and it refuses what is not
the board.

The photographs of the tests are OpenCV's: its own drawing of the board, warped at eight times the size, blurred there,
averaged down, lit, with noise, as sRGB. Nothing of our channel or of the study's own pattern is in them.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from patchlab.study.study import Result, load_study, run_study
from patchlab.validation import real_photos
from patchlab.validation.board_fit import BoardFit, edge_profile, fit_board, white_noise
from patchlab.validation.marker_boards import BoardPose, BoardSettings, find_board
from patchproof.base.errors import Refused
from patchproof.base.validation import validate_model
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.markers import marker_cells

FINER, SIZE = 8, (320, 240)
BLUR_PX, BLACK, NOISE = 0.9, (0.05, 0.04, 0.03), 0.008
CORNERS = np.array([[42, 20], [283, 33], [296, 214], [30, 205]], float)  # px, of the board without its rim


def grid(**values) -> BoardSettings:
    return validate_model(
        BoardSettings, {"photos": ["x"], "kind": "grid", "rows": 3, "columns": 4, "gap": 0.25} | values, "the test"
    )


def drawn_by_opencv(kind: str) -> np.ndarray:
    """The board as OpenCV draws it, 80 px a marker, 20 px between them: 0 ink, 1 paper."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_250)
    if kind == "grid":
        board = cv2.aruco.GridBoard((4, 3), 0.8, 0.2, dictionary)
        return board.generateImage((380, 280), marginSize=0).astype(np.float32) / 255
    board = cv2.aruco.CharucoBoard((5, 4), 1.0, 0.8, dictionary)
    return board.generateImage((500, 400), marginSize=0).astype(np.float32) / 255


@lru_cache(maxsize=4)
def photograph(kind: str = "grid", noise: float = NOISE, blur_px: float = BLUR_PX) -> tuple[np.ndarray, np.ndarray]:
    """(uint8 photograph, light of paper H×W) of a board in light that falls off to one side."""
    board = drawn_by_opencv(kind)
    height, width = board.shape
    outline = np.array([[0, 0], [width, 0], [width, height], [0, height]], float) - 0.5
    target = (CORNERS * FINER - 0.5).astype(np.float32)
    matrix = cv2.getPerspectiveTransform(outline.astype(np.float32), target)
    fine_size = SIZE[0] * FINER, SIZE[1] * FINER
    fine = cv2.warpPerspective(board, matrix, fine_size, flags=cv2.INTER_NEAREST, borderValue=1.0)
    fine = cv2.GaussianBlur(fine, (0, 0), blur_px * FINER)
    paper = cv2.resize(fine, SIZE, interpolation=cv2.INTER_AREA)
    u = np.linspace(-1, 1, SIZE[0])[None] * np.ones((SIZE[1], 1))
    light = 0.6 + 0.15 * u - 0.05 * u**2
    black = np.array(BLACK)
    linear = light[..., None] * (black + (1 - black) * paper[..., None])
    grain = np.random.default_rng(3).standard_normal(linear.shape) * np.sqrt(linear + 1 / 16)
    linear = (linear + noise * grain).clip(0, 1)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return (srgb * 255 + 0.5).astype(np.uint8), light


BOARDS = {"grid": grid(), "charuco": grid(kind="charuco", rows=4, columns=5)}


@lru_cache(maxsize=2)
def fitted(kind: str = "grid") -> tuple[BoardPose, BoardFit]:
    srgb = photograph(kind)[0]
    pose = find_board(srgb, BOARDS[kind])
    return pose, fit_board(srgb, pose)


@pytest.mark.parametrize("kind", BOARDS)
def test_known_figures_come_back(kind):
    (srgb, light), (pose, fit) = photograph(kind), fitted(kind)
    assert pose.found == pose.expected and pose.misfit_px < 0.15
    assert fit.blur_px == pytest.approx(BLUR_PX, abs=0.06)
    assert fit.black == pytest.approx(BLACK, abs=0.006)
    np.testing.assert_allclose(fit.light[fit.mask], np.repeat(light[fit.mask][:, None], 3, 1), rtol=0.015)
    noise, uneven = white_noise(fit, srgb)
    assert noise == pytest.approx(NOISE, rel=0.2) and uneven < 0.015
    left = (srgb.astype(float) - fit.rendered())[fit.mask]
    assert np.sqrt((left**2).mean()) < 4  # noise of 0.008 alone is 2 code values in the light and 3 in the dark


def test_an_edge_is_as_wide_as_its_blur_and_pixel_say():
    srgb, _ = photograph(noise=0.0)
    pose = find_board(srgb, grid())
    fit = fit_board(srgb, pose)
    wide = 2.563 * np.sqrt(
        BLUR_PX**2 + 1 / 12
    )  # 10 to 90 % of a Gaussian are 2.563 sigma; a pixel's own variance is 1/12
    for picture in (srgb, fit.rendered()):
        width, overshoot = edge_profile(fit.paper_seen(picture), fit.prints, pose.module_px)
        assert width == pytest.approx(wide, rel=0.08) and overshoot == pytest.approx(0, abs=0.02)


def test_a_lens_that_bends_a_little_is_followed():
    srgb, _ = photograph(noise=0.0)
    rows, columns = np.mgrid[0 : SIZE[1], 0 : SIZE[0]].astype(np.float32)
    bowed = columns + 0.8 * ((rows - SIZE[1] / 2) / SIZE[1] * 2) ** 2
    srgb = cv2.remap(srgb, bowed, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    fit = fit_board(srgb, find_board(srgb, grid()))
    assert fit.bend_px > 0.1 and residual(srgb, fit) < 4


def residual(srgb, fit) -> float:
    return float(np.sqrt(((srgb.astype(float) - fit.rendered())[fit.mask] ** 2).mean()))


def test_the_wrong_print_leaves_much():
    (srgb, _), (pose, fit) = photograph(), fitted()
    others = marker_cells("DICT_6X6_250", range(100, 100 + len(pose.prints)))
    wrong = [replace(printed, cells=cells) for printed, cells in zip(pose.prints, others, strict=True)]
    assert residual(srgb, fit) < 4
    assert residual(srgb, fit_board(srgb, replace(pose, prints=tuple(wrong)))) > 40


def test_boards_that_are_not_there_or_not_flat_are_told():
    srgb, _ = photograph()
    with pytest.raises(PhotoRejected, match="0 markers of DICT_4X4_50"):
        find_board(srgb, grid(dictionary="DICT_4X4_50"))
    with pytest.raises(PhotoRejected, match="no plane fits"):
        find_board(srgb, grid(gap=0.6))
    with pytest.raises(PhotoRejected, match="overexposed"):
        fit_board(np.full_like(srgb, 255), find_board(srgb, grid()))


def test_only_what_was_found_counts():
    srgb, (whole, _) = photograph("charuco")[0].copy(), fitted("charuco")
    srgb[:80, :90] = 128  # hides the first markers
    part = find_board(srgb, BOARDS["charuco"])
    assert part.found < whole.found
    assert not part.mask(srgb.shape)[:60, :70].any() and part.mask(srgb.shape).sum() < whole.mask(srgb.shape).sum()
    assert residual(srgb, fit_board(srgb, part)) < 4


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"kind": "loose"}, "loose markers take ids"),
        ({"ids": [1, 2]}, "takes one for each of the 12 markers"),
        ({"dictionary": "DICT_6X7"}, "a name that OpenCV knows"),
    ],
)
def test_settings_that_name_no_board_are_refused(values, message):
    with pytest.raises(Refused, match=message):
        grid(**values)


def test_the_study_end_to_end(tmp_path, monkeypatch):
    def fit_known(srgb, pose):
        assert np.array_equal(srgb, photograph()[0]) and pose.found == pose.expected
        return fitted()[1]

    monkeypatch.setattr(real_photos, "fit_board", fit_known)  # that of this photograph is made already
    folder = tmp_path / "photos"
    folder.mkdir()
    for name, picture in (("a", photograph()[0]), ("b", np.full((240, 320, 3), 200, np.uint8))):
        cv2.imwrite(str(folder / f"{name}.png"), picture[..., ::-1])
    config = tmp_path / "real_photos.toml"
    config.write_text('[boards.desk]\nphotos = ["photos"]\nkind = "grid"\nrows = 3\ncolumns = 4\ngap = 0.25\n')
    finished = run_study("real", config, tmp_path / "out")
    tables = {table.name: table for table in finished.tables}
    assert not finished.failed
    assert tables["left_out"].rows == (("desk", "b.png", "0 markers of DICT_6X6_250 with the board's ids were found"),)
    (row,) = tables["photographs"].rows
    assert row[:3] == ("desk", "a.png", "12 of 12")
    assert {(row[1], row[2], row[3]) for row in tables["networks"].rows} == {
        ("builtin", change, 1) for change in ("our rendering", "JPEG 90", "half a pixel")
    }
    assert (tmp_path / "out" / "real_ranges.png").is_file() and (tmp_path / "out" / "files" / "photo_000.png").is_file()


def test_medians_by_hand():
    settings = real_photos.RealSettings(boards={"desk": grid()})
    figures = dict.fromkeys((*real_photos._FIGURES, "clipped"), 1.0) | {"markers": "12 of 12", "left_out": None}
    change = {"label": "x", "changed": False, "confidence": -0.1, "log_rms": 0.5}
    moved = {"label": "x", "confidence": 0.5} | dict.fromkeys(real_photos._CHANGES, change)
    cell = real_photos.Cell("photo_000", {"board": "desk", "photo": "a.png"})
    results = [
        Result(cell, figures | {"noise": noise, "networks": {"builtin": moved}}, Path())
        for noise in (None, 0.1, 0.3, 0.2)
    ]
    boards, networks = real_photos.tables(settings, results)[:2]
    assert ("desk", "noise at white", 0.2, 0.1, 0.3, 3) in boards.rows
    assert networks.rows[0] == ("desk", "builtin", "our rendering", 4, 0, 0.1, 0.5)


def test_real_photographs(data):
    board = validate_model(
        BoardSettings, {"photos": ["x"], "kind": "grid", "rows": 5, "columns": 4, "gap": 0.13}, "the test"
    )
    srgb = real_photos.read_photo(data / "markers" / "grid_6x6" / "aruco_data_0.jpg").srgb
    pose = find_board(srgb, board)
    fit = fit_board(srgb, pose)
    assert pose.found == 20 and pose.misfit_px is not None and pose.misfit_px < 0.4
    assert residual(srgb, fit) < 14 and fit.blur_px < 0.8 and 0.03 < fit.black.mean() < 0.15
    assert load_study("real") is real_photos.STUDY
