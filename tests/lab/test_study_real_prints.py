"""The study of real prints on made cells: conditions hold what they make, a twin shows its photograph's colors."""

import csv
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from patchlab.study.estimates import mean
from patchlab.study.study import Cell, Result, run_study
from patchlab.validation import known_colors, real_prints, twins
from patchproof import load_scene
from patchproof.base.color import lift_tone, linear_from_srgb, srgb_from_linear
from patchproof.base.errors import Refused
from patchproof.channel.printer import load_printer, printer_output, vary_print

PLACES = ("A desk", "B door")
CODES = np.random.default_rng(0).integers(0, 256, (60, 3)).astype(np.uint8)


def seen(veil, chroma, tone):
    """Light of the cells in the default printer, in conditions."""
    light = torch.tensor(linear_from_srgb(printer_output(load_printer("office"), CODES / 255)))
    light = vary_print(light, torch.tensor([0.0, 0.0, chroma, *veil]))
    return linear_from_srgb(lift_tone(srgb_from_linear(light), torch.tensor(tone)).numpy())


@pytest.fixture
def folder(tmp_path):
    """Two photographs within the default conditions, and one in a veil that is far beyond them."""
    photos = [seen([0.02] * 3, -0.1, 0.03), seen([0.03, 0.03, 0.04], 0.1, -0.03), seen([0.3] * 3, 0.0, 0.0)]
    photo = np.repeat(np.arange(3), len(CODES)).astype(np.uint8)
    np.savez(tmp_path / "cells.npz", code=np.tile(CODES, (3, 1)), light=np.concatenate(photos), photo=photo)
    rows = "A-one,desk\nA-one,window\nB-two,door\n"
    (tmp_path / "photographs.csv").write_text("print,place\n" + rows, encoding="utf-8")
    (tmp_path / "s.toml").write_text('cells = "cells.npz"\nper_photo = 60\n', encoding="utf-8")
    return tmp_path


def test_conditions_hold_the_photographs_that_they_make_and_no_others(folder, monkeypatch):
    monkeypatch.setattr(known_colors, "minimize", partial(minimize, tol=0.01))  # of ΔE00: most of the time is the rest
    (colors,) = run_study("real-prints", folder / "s.toml", folder / "out").tables
    distance, within = ({row[0]: getattr(row[i], "value", row[i]) for row in colors.rows} for i in (1, 2))
    assert {row[0] for row in colors.rows if not hasattr(row[1], "low")} >= {"place A desk", "print B-two"}  # of one
    assert distance["place A desk"] < 0.5 and distance["place A window"] < 0.5 and distance["place B door"] > 5
    assert within["print A-one"] > 0.9 and within["print B-two"] < 0.3


def test_scatter_is_what_no_smooth_map_of_colors_explains(folder, monkeypatch):
    monkeypatch.setattr(real_prints, "fit_photo", lambda seen, _: seen.light)  # most of the time, and another column
    cells = dict(np.load(folder / "cells.npz"))
    shift = 0.03 * np.random.default_rng(1).standard_normal((len(CODES), 3))
    last = cells["photo"] == 2
    cells["light"][last] = linear_from_srgb(np.clip(srgb_from_linear(cells["light"][last]) + shift, 0, 1))
    np.savez(folder / "cells.npz", **cells)
    (colors,) = run_study("real-prints", folder / "s.toml", folder / "out").tables
    even, uneven = (next(row[3] for row in colors.rows if row[0] == f"place {place}") for place in PLACES)
    assert even < 0.015 and 0.018 < uneven < 0.035  # of 60 cells, 20 terms of a cubic take a part


def test_photographs_without_a_row_are_refused(folder):
    (folder / "photographs.csv").write_text("print,place\nA-one,desk\n", encoding="utf-8")
    with pytest.raises(Refused, match=r"a row for each photograph, got .* with other contents \(IndexError\)"):
        twins.load_cells(folder / "cells.npz")


@pytest.mark.parametrize(
    "broken",
    [
        {"code": np.tile(CODES, (3, 1)) / 255},  # codes as shares
        {"light": np.full((3 * len(CODES), 3), np.nan)},
        {"light": np.full((3 * len(CODES), 3), 255.0)},
        {"light": np.zeros((3 * len(CODES), 2))},
        {"photo": np.zeros(7, np.uint8)},
        {"photo": None},
    ],
)
def test_arrays_that_are_no_cells_are_refused_before_any_work(folder, broken):
    cells = dict(np.load(folder / "cells.npz")) | broken
    np.savez(folder / "cells.npz", **{name: array for name, array in cells.items() if array is not None})
    with pytest.raises(Refused, match=r"cells\.npz of photo .* with other contents"):
        run_study("real-prints", folder / "s.toml", folder / "out")
    assert not (folder / "out").exists()


def test_rows_of_photographs_without_cells_are_left_out(folder):
    cells = dict(np.load(folder / "cells.npz"))
    one = cells["photo"] == 1
    np.savez(folder / "cells.npz", **{name: array[one] for name, array in cells.items()})
    assert twins.load_cells(folder / "cells.npz").places == ("A window",)


def test_a_twin_shows_the_colors_of_its_photograph():
    light = seen([0.02] * 3, -0.1, 0.03)
    twin = twins.Twin.of(CODES / 255, srgb_from_linear(light))
    shown = twin.show(CODES[:36].reshape(6, 6, 3) / 255, np.random.default_rng(0)).reshape(-1, 3)
    error = np.abs(shown - srgb_from_linear(light[:36]))
    assert np.median(error) < 0.03 and np.abs(twin.left).max() > 0


def test_figures_in_the_notebook_are_the_stored_ones():
    results = Path(real_prints.__file__).parents[1] / "results"
    stored = {
        name: (results / "real_prints" / f"real-prints_{name}.csv").read_text("utf-8")
        for name in ("colors", "places", "designs", "fits")
    }
    rows = {name: list(csv.DictReader(text.splitlines())) for name, text in stored.items()}
    page = (results / "measured.md").read_text("utf-8")
    every = rows["colors"][0]
    assert f"| {100 * float(every['cells within the conditions']):.1f} % [" in page
    distance = (float(every["ΔE00 in the best conditions" + end]) for end in ("", "_low", "_high"))
    assert "| {:.2f} [{:.2f}, {:.2f}] |".format(*distance) in page
    name = "rms about a cubic, in sRGB"
    assert "| {:.3f} [{:.3f}, {:.3f}] (".format(*(float(every[name + end]) for end in ("", "_low", "_high"))) in page

    def estimate(row: dict[str, str], name: str, form: str) -> str:
        return form.format(*(100 * float(row[name + end]) for end in ("", "_low", "_high")))

    for row in rows["places"]:
        effect = estimate(row, "bias of the effect", "{:.1f} % [{:.1f}, {:.1f}]")
        rate = estimate(row, "bias of the rate", "{:.1f} points [{:.1f}, {:.1f}]")
        cells = [row["conditions"], row["twins of"], effect, rate, f"{100 * float(row['sessions inside']):.0f} %"]
        if row["conditions"] != "without mottle" or row["twins of"] == "all":
            assert f"| {' | '.join(cells)} |" in page
    scenes = {"light": "traffic light", "pickup": "pickup", "postbox": "letter box", "suv": "SUV"}
    for row in rows["designs"]:
        before, now = (f"{100 * float(row[f'by {which} conditions']):.1f} %" for which in ("former", "default"))
        gain = estimate(row, "gain", "{:+.1f} [{:.1f}, {:.1f}]")
        assert f"| {scenes[row['scene']]} | {row['seed']} | {before} | {now} | {gain} |" in page
    gains = mean([float(row["gain"]) for row in rows["designs"]])
    assert f"{100 * gains.value:.1f} points in the mean [{100 * gains.low:.1f}, {100 * gains.high:.1f}]" in page
    fits = [row for row in rows["fits"] if row["twins of"] == "all"]
    for row in fits:
        fit, alone = (f"{float(row[name]):+.2f}" for name in ("print fit", "default printer"))
        rms, quadratic = (f"{float(row[name]):.2f}" for name in ("print fit, rms", "quadratic, rms"))
        assert f"| {scenes[row['scene']]} | {row['seed']} | {fit}, {rms} | {alone} | {quadratic} |" in page
    no_larger = sum(float(row["print fit, rms"]) <= float(row["quadratic, rms"]) for row in fits)
    assert f"no larger than the quadratic's in {no_larger} of {len(fits)}" in page


def test_a_print_fit_shows_colors_that_our_conditions_make_and_a_printer_alone_does_not(monkeypatch):
    monkeypatch.setattr(real_prints, "_FIT_VIEWS", 8)
    scene = Path(real_prints.__file__).parents[1] / "results/speed/truck.toml"
    problem = real_prints._problem(load_scene(scene), ("builtin",), real_prints._STILL)
    rng = np.random.default_rng(5)
    sent = np.kron(rng.integers(0, 256, (12, 12, 3)), np.ones((16, 16, 1))) / 255
    photos = [seen([0.02] * 3, -0.2, 0.05), seen([0.04, 0.04, 0.05], -0.3, 0.03)]
    made = [twins.Twin.of(CODES / 255, srgb_from_linear(photo)) for photo in photos]
    printers = [(load_printer("office"), [1, 0])]
    fits = dict(real_prints._print_fits(problem, sent, ("desk", "desk"), made, printers))
    fit, quadratic, alone = np.abs([fits[0], fits[1]]).max(0)
    assert fit < 0.2 * alone and quadratic < 0.2 * alone and alone > 0.1


def test_figures_of_one_run_by_place_stand_without_an_interval():
    promised = {"effect": 1.0, "sessions": [[3, 3, 3], [4, 4, 4]]}
    twin = {"effect": 0.5, "sessions": [[2], [4]]}
    answers = {"places": ["a", "a"], "former": {"promised": {"default": [([0, 1], promised)]}, "twins": [twin, twin]}}
    table = real_prints._place_table([Result(Cell("run", {}), answers, Path())])
    assert table.rows == (("default", "all", 1.0, 0.25, 1.0), ("default", "a", 1.0, 0.25, 1.0))
