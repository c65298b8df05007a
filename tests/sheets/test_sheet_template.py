"""Templates and the color chart."""

from itertools import product

import numpy as np
import pytest

from patchproof.base.errors import Refused
from patchproof.base.packaged import packaged_path
from patchproof.sheets.page import CORNERS, GRAYS, chart_colors, chart_swatches, sobol
from patchproof.sheets.template import load_template, template_names

A4 = packaged_path("print_templates", "a4.toml")


def changed(tmp_path, old, new):
    text = A4.read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "mine.toml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    return path


def test_shipped_template_by_name_and_by_file():
    assert "a4" in template_names()
    assert load_template("a4") == load_template(A4)
    assert load_template("a4").page_mm == (210, 297)


def test_unknown_name_is_refused_with_the_nearest():
    with pytest.raises(Refused, match='got "a44": did you mean "a4"'):
        load_template("a44")


def test_missing_file_is_refused(tmp_path):
    with pytest.raises(Refused, match="no file at"):
        load_template(tmp_path / "none.toml")


def test_unknown_key_and_wrong_values_are_refused(tmp_path):
    with pytest.raises(Refused, match='did you mean "margin_mm"'):
        load_template(changed(tmp_path, "margin_mm = 7.0", "margin_mm = 7.0\nmargins_mm = 7.0"))
    with pytest.raises(Refused, match="page_mm"):
        load_template(changed(tmp_path, "page_mm = [210.0, 297.0]", "page_mm = [nan, 297.0]"))
    with pytest.raises(Refused, match=r'only known keys in .*mine\.toml, got "card"'):
        load_template(changed(tmp_path, "[qr]", "[card]\ncorner_mm = [7.0, 218.0]\n\n[qr]"))
    with pytest.raises(Refused, match="at least 48 swatches"):
        load_template(changed(tmp_path, "rows = 6", "rows = 3"))


def test_chart_has_corners_gray_ramp_duplicates_and_filling():
    template = load_template("a4")
    colors = [srgb for _, srgb in chart_swatches(template.chart)]
    assert len(colors) == 72 >= 48
    assert set(product((0.0, 1.0), repeat=3)) <= set(colors)
    grays = sorted({r for r, g, b in colors if r == g == b})
    assert len(grays) >= 8 and max(np.diff(grays)) < 0.16
    assert len(colors) - len(set(colors)) >= 4
    steps = np.array(colors) * 255
    assert np.array_equal(steps, np.rint(steps))


def test_chart_filling_leaves_no_large_hole_in_the_cube():
    """The largest distance from any color to the nearest swatch: below that of a 4 × 4 × 4 lattice's cell, 0.577."""
    colors = np.array(chart_colors(72))
    everywhere = np.array(list(product(np.linspace(0, 1, 17), repeat=3)))
    nearest = np.linalg.norm(everywhere[:, None] - colors, axis=-1).min(1)
    assert nearest.max() < 0.45 and nearest.mean() < 0.2


def test_filling_is_the_sequence_that_others_know():
    from scipy.stats import qmc

    assert np.array_equal(sobol(1000), qmc.Sobol(3, scramble=False).random_base2(10)[:1000])


def test_chart_places_decouple_light_and_color():
    swatches = chart_swatches(load_template("a4").chart)
    places = np.array([rect[:2] for rect, _ in swatches])
    colors = np.array([srgb for _, srgb in swatches])
    channels = np.column_stack([colors, colors @ [0.2126, 0.7152, 0.0722]])
    correlation = np.corrcoef(places.T, channels.T)[:2, 2:]
    assert np.abs(correlation).max() < 0.1


def test_duplicates_lie_far_apart():
    swatches = chart_swatches(load_template("a4").chart)
    for color in {srgb for _, srgb in swatches}:
        places = np.array([rect[:2] for rect, srgb in swatches if srgb == color])
        assert len(places) == 1 or np.linalg.norm(places[0] - places[1]) > 60


def test_a_larger_chart_keeps_the_colors_of_a_smaller_one():
    assert chart_colors(96)[:72] == chart_colors(72)
    assert chart_colors(20)[:14] == [*CORNERS, *GRAYS]
