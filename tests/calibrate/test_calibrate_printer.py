"""Printers from their charts: the ladder, the reading of a chart in a photograph, and what is refused."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import typer
from PIL import Image, ImageCms

from drawn_printers import (
    chart_manifest,
    draw_printer,
    printed_page,
)
from inkjets import DRIVERS, draw_inkjet
from patchproof.app import cli
from patchproof.base.color import linear_from_srgb, srgb_from_linear
from patchproof.base.errors import Refused
from patchproof.base.output import image_pixels
from patchproof.calibrate import chart as chart_module
from patchproof.calibrate import icc
from patchproof.calibrate.chart import (
    ChartPhoto,
    calibrate_chart,
    combine_light,
    printer_of,
    prints_of,
    read_chart,
    summary_lines,
)
from patchproof.calibrate.ladder import (
    MIN_WIDTH,
    average_repeats,
    choose_map,
    color_difference,
    color_width,
    fit_affine,
    fit_white_black,
    map_kinds,
)
from patchproof.channel.printer import load_printer, printer_output
from patchproof.photo.read import Photo, read_photo
from patchproof.photo.rejection import PhotoRejected
from patchproof.reprints.page_photos import photograph_page
from patchproof.sheets.manifest import dump_manifest, load_manifest
from patchproof.sheets.page import chart_colors

UNSEEN = np.random.default_rng(8).random((500, 3))
WHITE = np.ones((1, 3))


def shown(printer, colors) -> np.ndarray:
    """sRGB N×3 relative to paper."""
    return srgb_from_linear(printer(colors) / printer(WHITE))


def chart(count: int) -> np.ndarray:
    return np.array(chart_colors(count))


@pytest.fixture(scope="module")
def priors():
    return {name: partial(printer_output, load_printer(name)) for name in ("coated", "uncoated")}


# ------------------------------------------------------------------------------------------------ the ladder


def test_each_rung_finds_a_printer_of_its_own_kind_and_none_above_it_is_taken(priors):
    rng = np.random.default_rng(2)
    mix = np.column_stack([np.diag([0.75, 0.7, 0.65]) + 0.06, [0.07, 0.1, 0.15]])
    kinds = {
        "identity": lambda colors: colors,
        "white_black": lambda colors: srgb_from_linear(0.06 + 0.94 * linear_from_srgb(colors)),
        "affine": lambda colors: colors @ mix[:, :3].T + mix[:, 3],
        "prior": priors["uncoated"],
        "prior+affine": lambda colors: priors["coated"](colors) @ mix[:, :3].T + mix[:, 3],
        "spline": lambda colors: shown(draw_inkjet(0), colors),
    }
    sent = chart(72)
    for name, show in kinds.items():
        seen = np.clip(show(sent) + rng.normal(0, 0.003, sent.shape), 0, 1)
        choice = choose_map(map_kinds(priors), sent, seen)
        assert choice.chosen.name == name, choice.rungs
        assert color_difference(choice.predict(UNSEEN), show(UNSEEN)).mean() < (1.0 if name == "spline" else 0.5)


def test_affine_and_paper_with_black_by_hand():
    sent = chart(24)
    matrix = np.array([[0.8, 0.1, 0.0], [0.05, 0.7, 0.1], [0.0, 0.2, 0.6]])
    np.testing.assert_allclose(fit_affine(sent, sent @ matrix.T + 0.05)(UNSEEN), UNSEEN @ matrix.T + 0.05, atol=1e-12)
    seen = sent.copy()
    seen[(sent == 0).all(1)] = srgb_from_linear(np.array([0.02, 0.04, 0.06]))
    lifted = linear_from_srgb(fit_white_black(sent, seen)(np.array([[1.0, 1, 1], [0, 0, 0]])))
    np.testing.assert_allclose(lifted, [[1, 1, 1], [0.02, 0.04, 0.06]], atol=1e-12)


def test_a_color_sent_twice_counts_once_with_the_mean_of_its_light():
    sent, light = np.array([[0.5] * 3, [1.0] * 3, [0.5] * 3]), np.array([[0.2] * 3, [1.0] * 3, [0.4] * 3])
    colors, seen = average_repeats(sent, srgb_from_linear(light))
    np.testing.assert_allclose(colors[:, 0], [0.5, 1])
    np.testing.assert_allclose(linear_from_srgb(seen)[:, 0], [0.3, 1])


def test_corners_are_never_held_out_and_every_other_color_is_once(priors):
    seen_in_training = []

    def spy(sent, seen):
        seen_in_training.append(sent)
        return lambda colors: colors

    sent = chart(48)
    free = map_kinds({})
    choice = choose_map([replace(free[0], fit=spy)], sent, sent)
    corners = np.isin(average_repeats(sent, sent)[0], (0.0, 1.0)).all(1)
    assert choice.held_out == (~corners).sum() == 34
    for training in seen_in_training:
        assert np.isin(training, (0.0, 1.0)).all(1).sum() == 8
    assert sum(len(corners) - len(training) for training in seen_in_training[:-1]) == 34


@pytest.mark.parametrize("count", [6, 12])
def test_few_swatches_leave_rungs_with_nothing_to_fit(priors, count):
    sent = chart(count)
    choice = choose_map(map_kinds(priors), sent, shown(draw_inkjet(1), sent))
    assert choice.chosen.name in {"identity", "white_black", "prior"}
    assert "spline" in choice.left_out and "affine" in choice.left_out


def test_splines_start_at_24_colors(priors):
    sent = np.vstack([chart(14), np.random.default_rng(4).random((10, 3))])
    names = {rung.name for rung in choose_map(map_kinds(priors), sent, sent).rungs}
    assert "spline" in names
    names = {rung.name for rung in choose_map(map_kinds(priors), sent[:-1], sent[:-1]).rungs}
    assert "spline" not in names and "prior+affine" in names


def grayed(share: float) -> np.ndarray:
    """The chart of 48 with its colors drawn towards gray: `share` of their chroma is left."""
    colors = chart(48)
    return np.round((share * colors + (1 - share) * colors.mean(1, keepdims=True)) * 255) / 255


def test_colors_that_are_nearly_gray_hold_no_free_map(priors):
    """Last good and first bad width, 0.063 and 0.032: beyond, splines were 11 off where held-out grays said 1.4."""
    printer, noise = draw_inkjet(1), np.random.default_rng(1).normal(0, 0.004, (48, 3))
    assert color_width(np.repeat(np.linspace(0, 1, 30)[:, None], 3, 1)) == pytest.approx(0, abs=1e-12)
    off = {}
    for share in (1.0, 0.2, 0.1, 0.0):
        sent = grayed(share)
        choice = choose_map(map_kinds(priors), sent, np.clip(shown(printer, sent) + noise, 0, 1))
        free = {rung.name for rung in choice.rungs} & {"affine", "spline", "prior+affine+spline"}
        assert bool(free) == (choice.width >= MIN_WIDTH) == (share >= 0.2)
        off[share] = color_difference(choice.predict(UNSEEN), shown(printer, UNSEEN)).mean()
    assert off[1.0] < 1.5 < off[0.2] < 6 and max(off.values()) < 12


@pytest.mark.parametrize(
    ("share", "readable", "says"), [(0.6, 48, None), (0.4, 48, "hardly spread"), (1.0, 4, None), (1.0, 3, "refused")]
)
def test_a_chart_read_in_part_says_what_its_figure_is_worth(monkeypatch, tmp_path, share, readable, says):
    """Widths 0.19 and 0.13; 4 swatches and 3."""
    manifest = chart_manifest(48)
    swatches = tuple(
        swatch.model_copy(update={"srgb": tuple(color)})
        for swatch, color in zip(manifest.chart, grayed(share), strict=True)
    )
    manifest = manifest.model_copy(update={"chart": swatches})
    light = linear_from_srgb(shown(draw_inkjet(0), np.array([swatch.srgb for swatch in swatches])))
    by_light = light.sum(1).argsort()
    light[np.delete(by_light, np.linspace(0, 47, readable).round().astype(int))] = np.nan
    Image.new("RGB", (8, 8)).save(tmp_path / "a.png")
    read = ChartPhoto(light, (1.0, 1.0, 1.0))
    monkeypatch.setattr(chart_module, "read_chart", lambda *_: read)
    if says == "refused":
        with pytest.raises(Refused, match="at least 4 readable swatches, got 3"):
            calibrate_chart([[tmp_path / "a.png"]], manifest, "x")
        return
    gray = ChartPhoto(light.mean(1, keepdims=True) + np.array([0.0, 0.01, 0.02]), (1.0, 1.0, 1.0))
    monkeypatch.setattr(chart_module, "read_chart", lambda *_: gray)
    with pytest.raises(Refused, match="a chart in color, got gray ones: switch black and white off"):
        calibrate_chart([[tmp_path / "a.png"]], manifest, "x")
    monkeypatch.setattr(chart_module, "read_chart", lambda *_: read)
    found = calibrate_chart([[tmp_path / "a.png"]], manifest, "x")
    assert any("hardly spread" in warning for warning in found.warnings) == (says is not None or readable == 4)
    if readable == 4:
        assert found.choice.chosen.name in {"identity", "white_black", "prior"}


def test_the_simplest_within_one_standard_error_wins_by_hand():
    """Two rungs: the second is better by more than the error of the difference, or by less."""
    sent = chart(48)
    off = np.zeros_like(sent)
    off[:, 0] = 0.1 * sent[:, 0] * (1 - sent[:, 0])
    free = map_kinds({})
    near = replace(free[2], name="true", fit=lambda a, b: lambda c: c + np.array([0.1, 0, 0]) * (c * (1 - c)))
    assert choose_map([free[0], near], sent, sent + off).chosen.name == "true"
    noise = np.random.default_rng(0).normal(0, 0.05, sent.shape)
    faint = choose_map([free[0], near], sent, np.clip(sent + 0.5 * off + noise, 0, 1))
    assert faint.chosen.name == "identity" and faint.rungs[0].worse_by <= faint.rungs[0].standard_error


# ------------------------------------------------------------------------------------------------ photographs


@pytest.fixture(scope="module")
def shots():
    """A printer, and two photographs of its chart of 48 swatches."""
    printer, manifest = draw_inkjet(2), chart_manifest(48)
    page = printed_page(manifest, printer)
    taken = (photograph_page(page, seed) for seed in (1, 4))
    return printer, manifest, [(Photo(image_pixels(file), None), paper) for file, paper in taken]


@pytest.fixture(scope="module")
def readings(shots):
    """What is read in each of the photographs."""
    return [read_chart(photo, shots[1]) for photo, _ in shots[2]]


def test_swatches_are_read_relative_to_paper_under_uneven_light(shots, readings):
    printer, manifest, both = shots
    sent = np.array([swatch.srgb for swatch in manifest.chart])
    for (_, paper), read in zip(both, readings, strict=True):
        assert np.isfinite(read.light).all()
        error = color_difference(srgb_from_linear(read.light), shown(printer, sent))
        assert error.mean() < 1.2 and error.max() < 4
        np.testing.assert_allclose(read.paper, paper, rtol=0.06)


def test_a_chart_page_is_rehearsed_without_a_printer(tmp_path):
    cli.app(["sheet", "--template", "chart48_a4", "--out", str(tmp_path / "chart.pdf")], standalone_mode=False)
    rehearsed = ["reprint", str(tmp_path / "chart.pdf"), "--n", "1", "--printer", "uncoated"]
    cli.app([*rehearsed, "--print-scale", "0.97", "--out", str(tmp_path / "photos")], standalone_mode=False)
    manifest = load_manifest(tmp_path / "chart.json")
    read = read_chart(read_photo(tmp_path / "photos/photo_0001.jpg"), manifest)
    sent = torch.tensor(np.array([swatch.srgb for swatch in manifest.chart]).T[None, :, :, None], dtype=torch.float32)
    uncoated = load_printer("uncoated").apply(torch.cat([sent, torch.ones_like(sent[:, :, :1])], 2))[0, :, :, 0].T
    light = linear_from_srgb(uncoated.numpy())
    read_well = np.isfinite(read.light).all(1)
    error = color_difference(srgb_from_linear(read.light), srgb_from_linear(light[:-1] / light[-1]))[read_well]
    assert read_well.sum() >= 40 and error.mean() < 1.5
    with pytest.raises(typer.BadParameter, match="need --run RUN"):
        cli.app([*rehearsed, "--sessions", "2", "--out", str(tmp_path / "other")], standalone_mode=False)
    for scale in ("inf", "nan", "0"):
        with pytest.raises(typer.BadParameter, match="should be"):
            cli.app([*rehearsed, "--print-scale", scale, "--out", str(tmp_path / "other")], standalone_mode=False)


def test_without_the_flat_field_the_same_photograph_would_be_far_off(shots, readings):
    """The guard that the test above can fail: light that falls off by a third is read as ink where it is not taken
    out.
    """
    _, manifest, ((shot, _), _) = shots
    falling = np.linspace(1, 0.6, shot.srgb.shape[1])[:, None]
    darker = (srgb_from_linear(linear_from_srgb(shot.srgb / 255) * falling) * 255 + 0.5).astype(np.uint8)
    before, after = readings[0], read_chart(Photo(darker, None), manifest)
    error = color_difference(srgb_from_linear(after.light), srgb_from_linear(before.light))
    assert error.mean() < 0.5 and after.paper[1] < 0.9 * before.paper[1]


def test_photographs_that_show_no_chart(shots):
    _, manifest, ((shot, _), _) = shots
    small = cv2.resize(shot.srgb, (800, 600), interpolation=cv2.INTER_AREA)
    paper = read_chart(Photo(small, None), manifest).paper
    with pytest.raises(PhotoRejected, match="too_few_markers"):
        read_chart(Photo(np.full_like(small, 90), None), manifest)
    with pytest.raises(PhotoRejected, match="mirrored"):
        read_chart(Photo(np.ascontiguousarray(small[:, ::-1]), None), manifest)
    light = linear_from_srgb(small / 255) * 8
    white = Photo((srgb_from_linear(light.clip(0, 1)) * 255).astype(np.uint8), None)
    with pytest.raises(PhotoRejected, match=r"clipped|too_few"):
        read_chart(white, manifest)
    for share in (0.15, 0.1):
        light = linear_from_srgb(small / 255) * share / np.mean(paper)
        dark = Photo((srgb_from_linear(light) * 255 + 0.5).astype(np.uint8), None)
        with nullcontext() if share == 0.15 else pytest.raises(PhotoRejected, match="noisy: the paper is too dark"):
            read_chart(dark, manifest)


def test_a_printer_is_calibrated_stored_and_loaded(shots, readings, tmp_path, capsys, monkeypatch):
    printer, manifest, both = shots

    def read_before(photo, of_chart):
        assert of_chart == manifest
        return next(
            read for (shot, _), read in zip(both, readings, strict=True) if np.array_equal(photo.srgb, shot.srgb)
        )

    monkeypatch.setattr(chart_module, "read_chart", read_before)
    (tmp_path / "chart.json").write_text(dump_manifest(manifest), encoding="utf-8")
    for i, (shot, _) in enumerate(both):
        Image.fromarray(shot.srgb).save(tmp_path / f"{i}.png")
    (tmp_path / "bad.jpg").write_bytes(b"no picture")
    command = ["calibrate", "printer", "--sheet", str(tmp_path / "chart.json"), "--out", str(tmp_path / "mine.npz")]
    command += [*(str(tmp_path / name) for name in ("0.png", "1.png", "bad.jpg"))]
    with pytest.raises(SystemExit) as ended:
        cli.app(command)
    told = capsys.readouterr()
    assert ended.value.code == 0 and "chosen" in told.out and "appearance" in told.out and "bad.jpg" in told.err
    mine = load_printer(str(tmp_path / "mine.npz"))
    assert mine.method == "measured" and mine.provenance["chosen"] == "spline"
    assert [row["name"] for row in mine.provenance["ladder"]] == [rung.name for rung in map_kinds({"x": None})]
    assert len(mine.provenance["photographs"]) == 2 and "this camera" in mine.provenance["model_of"]
    assert mine.provenance["delta_e00_of_prints"] is None and "how prints differ is not measured" in told.out
    np.testing.assert_allclose(mine.lut[-1, -1, -1], 1, atol=1e-6)
    assert color_difference(printer_output(mine, UNSEEN), shown(printer, UNSEEN)).mean() < 2
    with pytest.raises(Refused, match="which exists"):
        cli.app(command, standalone_mode=False)


def test_what_cannot_be_calibrated_is_refused_in_one_sentence(shots, tmp_path):
    _, manifest, ((shot, _), _) = shots
    Image.fromarray(np.full_like(shot.srgb, 90)).save(tmp_path / "none.png")
    with pytest.raises(Refused, match=r"chart can be read, got none of 1"):
        calibrate_chart([[tmp_path / "none.png"]], manifest, "x")
    with pytest.raises(Refused, match="with a chart"):
        calibrate_chart([[tmp_path / "none.png"]], manifest.model_copy(update={"chart": ()}), "x")
    with pytest.raises(Refused, match="no file at"):
        prints_of([tmp_path / "missing.jpg"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(Refused, match="photographs of one print"):
        prints_of([tmp_path / "empty"])


def test_folders_are_prints_and_files_are_of_one(tmp_path):
    for name in ("a/1.jpg", "a/2.png", "a/notes.txt", "b/1.jpg", "c.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    found = prints_of([tmp_path / "a", tmp_path / "c.jpg", tmp_path / "b"])
    assert [[path.name for path in one] for one in found] == [["c.jpg"], ["1.jpg", "2.png"], ["1.jpg"]]


def test_readings_are_combined_without_the_one_that_is_off():
    good = np.full((4, 3), 0.4)
    glare, gap = good + np.array([[0.5], [0], [0], [0]]), good.copy()
    gap[3] = np.nan
    np.testing.assert_allclose(combine_light([good, glare, good, gap]), good)
    assert np.isnan(combine_light([gap, gap])[3]).all()


def test_how_prints_and_photographs_of_one_differ_is_said(shots, readings, monkeypatch, tmp_path):
    """Two prints, the second with all its ink a tenth lighter; the second photograph of the first has a glare."""
    light = readings[0].light
    glare = np.where(np.arange(len(light))[:, None] < 40, light + 0.5, light)
    paths = [tmp_path / name for name in "abc"]
    for path in paths:
        Image.new("RGB", (8, 8)).save(path, "PNG")
    charts = iter(ChartPhoto(each, (1.0, 1.0, 1.0)) for each in (light, glare, light + 0.1 * (1 - light)))
    monkeypatch.setattr(chart_module, "read_chart", lambda *_: next(charts))
    found = calibrate_chart([paths[:2], paths[2:]], shots[1], "x")
    assert [row["print"] for row in found.printer.provenance["photographs"]] == [1, 1, 2]
    assert found.printer.provenance["photographs"][2]["delta_e00_from_print"] is None
    assert all(1 < each < 9 for each in found.printer.provenance["delta_e00_of_prints"])
    assert sum("glare" in warning for warning in found.warnings) == 2
    assert any("prints differ from their mean" in line for line in summary_lines(found))


# ------------------------------------------------------------------------------------------ drawn printers


def test_a_printer_is_never_its_own_prior():
    for seed in (5, 11):
        driver, shows, priors = draw_printer(seed)
        assert driver == "the other profile" and len(priors) == 1
        prior = next(iter(priors.values()))
        assert color_difference(prior(UNSEEN), shown(shows, UNSEEN)).mean() > 3


# ------------------------------------------------------------------------------------------------ simulated printers


@pytest.mark.parametrize("seed", range(len(DRIVERS)))
def test_simulated_printers_are_printers(seed):
    printer = draw_inkjet(seed)
    light = shown(printer, np.vstack([WHITE, np.zeros((1, 3)), UNSEEN]))
    np.testing.assert_allclose(light[0], 1)
    assert light.min() > 0 and light.max() <= 1 + 1e-9 and light[1].max() < 0.6
    assert printer.driver == DRIVERS[seed]


def test_the_table_of_a_map_leaves_paper_white_and_clips():
    printer = printer_of("x", lambda colors: 0.9 * colors + 0.02, {})
    np.testing.assert_allclose(printer.lut[-1, -1, -1], 1)
    assert printer.lut.min() >= 0 and printer.gamut[-1, -1, -1] < 0.01 < printer.gamut[0, 0, 0]


# ------------------------------------------------------------------------------------------------ RGB profiles


def rgb_printer_profile(path: Path) -> Path:
    """LittleCMS's own sRGB profile, called a printer's: a profile of another color space than the shipped ones."""
    data = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    data[12:16] = b"prtr"
    path.write_bytes(bytes(data))
    return path


def test_an_rgb_profile_is_baked_with_both_intents(tmp_path):
    path = rgb_printer_profile(tmp_path / "rgb.icc")
    for perceptual, word in ((False, "relative"), (True, "perceptual")):
        printer = icc.bake(path, "rgb", perceptual)
        assert printer.provenance["profile_colors"] == "RGB" and printer.provenance["intents"].startswith(word)
        assert color_difference(printer_output(printer, UNSEEN), UNSEEN).mean() < 0.3  # sRGB, in 8 bits


def test_damaged_profiles_never_end_in_anything_but_a_sentence(tmp_path):
    whole = rgb_printer_profile(tmp_path / "rgb.icc").read_bytes()
    rng = np.random.default_rng(1)
    for _ in range(60):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), 12):
            data[at] = rng.integers(256)
        (tmp_path / "damaged.icc").write_bytes(bytes(data))
        try:
            icc.bake(tmp_path / "damaged.icc", "x")
        except Refused as error:
            assert "\n" not in str(error)
