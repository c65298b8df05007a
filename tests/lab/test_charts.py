"""The README's charts: fronts, gains and breaking points by hand, detectors on known paper, and resuming."""

from __future__ import annotations

import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from console import lab_command

from patchlab.charts import breaks, detect, make, speed, terms
from patchlab.charts.bars import Bar, BarPoint
from patchlab.charts.drawing import pareto_mask
from patchlab.charts.paper_photos import PIECE_MM, corners_mm, draw_sheet
from patchlab.study import measure
from patchlab.study.study import Cell, Result, Work
from patchproof.base.errors import Refused
from patchproof.report.page import draw_figure
from undrawn import draw_once

OUT = Path()


def test_a_point_that_another_beats_is_not_on_the_front():
    #                 cheap  exact  beaten  as exact but dearer  the same as another
    cost, error = [1, 3, 4, 4, 1], [5, 1, 2, 1, 5]
    assert pareto_mask(cost, error).tolist() == [True, True, False, False, True]


def test_calls_are_timed_in_turn_after_a_warm_up():
    order = []
    answers = measure.call_in_turn({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, 2)
    assert order == ["a", "b"] * 3 and [len(values) for values in answers.values()] == [2, 2]


def test_waiting_is_not_counted_as_work():
    answer, milliseconds = measure.time_call(lambda: time.sleep(0.05) or 7)
    assert answer == 7 and 0 <= milliseconds < 25


# Photographs of paper, and detectors


def test_pixels_and_paper_are_each_other_s_inverse():
    sheet, rng = draw_sheet(1, (1200, 900))
    mm = rng.uniform(0, PIECE_MM, (50, 2))
    assert sheet.mm(sheet.px(mm)) == pytest.approx(mm, abs=1e-6)


def test_fitted_borders_beat_plain_corners_on_known_photographs():
    ours, plain = (detect.try_finder(name, 2, (1200, 900)) for name in ("ours", "ArUco"))
    assert len(ours.milliseconds) == 2 and len(ours.errors_px) == 8
    assert np.median(ours.errors_px) < 0.1 and np.median(ours.errors_px) < 0.7 * np.median(plain.errors_px)


def test_a_detector_that_finds_nothing_is_infinitely_wrong(monkeypatch):
    monkeypatch.setitem(detect.FINDERS, "blind", (lambda srgb: {}, detect.DICTIONARY))
    assert np.isinf(detect.try_finder("blind", 1, (320, 240)).errors_px).all()


@pytest.mark.parametrize("turn", range(4))
def test_corners_of_a_library_that_counts_them_otherwise_are_put_in_order(monkeypatch, turn):
    """Its tags begin at any corner and run the other way round."""
    sheet, _ = draw_sheet(3, (1600, 1200))
    tags = [SimpleNamespace(tag_id=i, corners=np.roll(sheet.px(mm), turn, 0)[::-1]) for i, mm in corners_mm().items()]
    tags.append(SimpleNamespace(tag_id=3, corners=np.zeros((4, 2))))
    monkeypatch.setattr(detect, "_tag_detector", lambda: SimpleNamespace(detect=lambda gray: tags))
    found = detect.find_tag_corners(np.zeros((8, 8, 3), np.uint8))
    assert found.keys() == corners_mm().keys()
    assert max(np.abs(found[i] - sheet.px(mm)).max() for i, mm in corners_mm().items()) < 1e-9


# Speed


def hits(count: int) -> str:
    return "1" * count + "0" * (10 - count)


def pair_results(number: int, goal: str = "assist", **more) -> list[Result]:
    """A pair's designs: bare 2, gray 3 of ten, the default 6, a draft 5, pasted 4; both ceilings 9 and 7."""
    values = {"name": f"s{number}", "network": "n", "scene": {"target": {"goal": goal}}}
    given = {"draft": (5, 2.0), "default": (6, 8.0), "flat": (4, 8.0)} | more
    results = []
    for method, (count, seconds) in given.items():
        shown = {"design": hits(count)} | ({"bare": hits(2), "gray": hits(3)} if method == "default" else {})
        answers = {"seconds": seconds, "hits": shown}
        results.append(Result(Cell(f"{number}{method}", values | {"method": method}), answers, OUT))
    for chosen_by, count in ((8, 7), (6, 9)):
        answers = {"chosen_by": hits(chosen_by), "hits": {"design": hits(count)}}
        results.append(Result(Cell(f"{number}-{count}", values | {"method": "ceiling"}), answers, OUT))
    return results


def test_gains_are_over_the_better_control_and_the_ceiling_is_chosen_in_other_views():
    results = [result for number in range(6) for result in pair_results(number)]
    settings = make.chart_settings("speed", True)
    methods, ceiling, _, pairs = speed.tables(settings, results)
    rows = {row[0]: row for row in methods.rows}
    assert list(rows) == ["--draft", "default", "2D patch"] and rows["default"][1].value == pytest.approx(8)
    assert [round(row[2].value, 6) for row in rows.values()] == [0.2, 0.3, 0.1]
    assert [row[3] for row in rows.values()] == [True, True, False]
    assert [tuple(np.round(row[1:], 6)) for row in ceiling.rows] == [(0.3, 0.4, 0.1)] * 6  # 7 of 10: not the luckier 9
    assert "beyond the default +10.0 points [10.0, 10.0]" in ceiling.about and len(pairs.rows) == 6 * 4


def test_what_deceives_gains_by_what_is_lost():
    (found,) = speed._gains(pair_results(0, "deceive", default=(0, 8.0))).values()
    assert found["default"][0] == pytest.approx(0.2)  # the bare object is recognized in two of ten


def test_pairs_of_missing_data_art_and_apriltag_are_left_out(monkeypatch):
    with_data, without = (make.chart_settings("speed", False, env) for env in ({"PATCHPROOF_DATA": "d"}, {}))
    assert len(with_data.scenes) == 6 and without.scenes == make.OWN_PAIRS
    monkeypatch.setattr(speed, "find_spec", lambda name: None)
    assert not any(cell.values.get("method") == "ceiling" for cell in speed.cells(without, make._RESULTS))
    cells = speed.cells(without.model_copy(update={"ceiling": speed.Ceiling(pairs=4)}), make._RESULTS)
    methods = [cell.values.get("method") for cell in cells]
    assert "art" not in methods and methods.count("default") == 2 and methods.count("ceiling") == 2 * 3 * 3
    assert {cell.values.get("finder") for cell in cells} == {None, "ours", "ArUco", "ArUco subpixel"}
    steps = {cell.values["scene"]["optimize"]["steps"] for cell in cells if cell.values.get("method") == "ceiling"}
    assert steps == {10 * 240}


# Breaking points


def bar(*good: int, silent: int = 0) -> Bar:
    points = [BarPoint(n >= 8, [("blurred", 10 - n - silent)], silent) for n in good]
    return Bar("markers", "blur", range(len(good)), points, 10)


def test_the_last_good_point_stands_before_the_first_bad_one():
    worn = bar(10, 8, 7, 9, 0)  # what works again beyond it is luck
    assert (worn.last_good, worn.first_bad, worn.said) == (1, 2, "blurred")
    assert (bar(9, 9).last_good, bar(9, 9).first_bad) == (1, None)
    assert (bar(3, 9).last_good, bar(3, 9).first_bad) == (None, 0)
    assert bar(10, 2, 0, silent=2).silent == 4


@pytest.fixture(scope="module")
def sharp() -> breaks.MeasuredShot:
    return breaks._shoot("blur", {"blur": 0.1}, 0)


def test_a_blurred_photograph_breaks_all_that_is_read_from_it_and_says_so(sharp):
    blurred = breaks._shoot("blur", {"blur": 1.0}, 0)
    assert sharp.error_mm < 0.2 and abs(sharp.entry.geometry.tilt_deg - sharp.tilt_deg) < 2
    for method in ("markers", "rectification", "color"):
        assert breaks._CHECKS[method](sharp) == (True, None)
        good, said = breaks._CHECKS[method](blurred)
        assert not good and said in ("blurred", "too_few_markers")


def test_a_wrong_corner_that_is_called_measured_is_a_silent_one(sharp):
    assert breaks._rectified(sharp._replace(error_mm=9.0)) == (False, None)


def test_promises_of_copies_miss_and_others_hold():
    shares = [np.mean([breaks._covers(i, copies=copies).good for i in range(20)]) for copies in (1, 16)]
    assert shares[0] > 0.9 > shares[1]
    assert breaks._kept(0, sessions=1).said == "cannot_tell" and breaks._kept(0, below=0.4).said == "broken"


def test_a_killed_chart_is_resumed_to_the_same_bytes(tmp_path, monkeypatch):
    draw_once(monkeypatch)
    monkeypatch.setattr(breaks, "PROBES", breaks.PROBES[-2:])
    monkeypatch.setitem(make._QUICK, "breaks", {"draws": 2})
    finished = make.make_charts("breaks", tmp_path, True)["breaks"]
    files = {path: path.read_bytes() for path in (tmp_path / "breaks").glob("breaks*")}
    assert not finished.failed and tmp_path / "breaks/breaks_chart.png" in files
    (tmp_path / "breaks/cells/01.json").unlink()
    make.make_charts("breaks", tmp_path, True, Work(resume=True))
    assert files == {path: path.read_bytes() for path in (tmp_path / "breaks").glob("breaks*")}


def test_an_unknown_chart_is_refused_with_the_nearest(tmp_path):
    with pytest.raises(Refused, match='did you mean "speed"'):
        make.make_charts("sped", tmp_path / "out")


# Terms


def term_result(number: int, whole: int, **without: int) -> Result:
    told = {"": hits(whole)} | {name: hits(count) for name, count in without.items()}
    answers = {"hits": told, "ratios": {name: [0.9, 0.8, 0.9] for name in without}}
    return Result(Cell(f"{number}", {"name": f"s{number}", "network": "n"}), answers, OUT)


def test_what_a_term_is_worth_by_hand():
    results = [term_result(i, 8, light=6 if i % 2 else 9, noise=8) for i in range(6)]
    worth, gone, pairs = terms.tables(make.chart_settings("terms", True), results)
    light, noise = worth.rows  # the largest first
    assert light[0] == "light" and light[2].value == pytest.approx(0.15) and light[3].value == pytest.approx(0.05)
    assert light[4] == pytest.approx(0.2) and light[5].value == pytest.approx(0.1) and noise[2].value == 0
    names = [row[0] for row in gone.rows]
    assert "gloss" in names and "motion blur" not in names and len(pairs.rows) == 12


@pytest.mark.parametrize(
    ("study", "results"),
    [
        (speed, [r for i in range(6) for r in pair_results(i)]
         + [Result(Cell(f"{n}{s}", {"finder": n, "size_px": [s, 480]}),
                   {"milliseconds": [30.0, 40.0], "errors_px": [0.1] * 8 if n == "ours" else [None] * 8}, OUT)
            for n in ("ours", "ArUco") for s in (640, 1600)]),
        (terms, [term_result(i, 8, light=6, noise=8) for i in range(6)]),
    ],
)  # fmt: skip
def test_charts_are_drawn_even_where_a_detector_found_nothing(study, results):
    settings = make.chart_settings(study.STUDY.name, True)
    (drawing,) = study.figures(settings, results)
    svg = draw_figure(drawing.draw, drawing.size_in, "svg").decode()
    assert ("ceiling" in svg) == (study is speed) and len(svg) > 5000


def test_a_gallery_shows_design_page_and_photographs_of_each_object(tmp_path, monkeypatch):
    monkeypatch.setattr("patchlab.charts.gallery.OBJECTS", ["carton"])
    for constant, value in {"run.DRAFT_EFFORT": (1, 8), "loop.SELECT_VIEWS": 2}.items():
        monkeypatch.setattr(f"patchproof.optimizer.{constant}", value)
    assert lab_command("gallery", "--out", tmp_path / "all") == 0
    text = (tmp_path / "all" / "gallery.html").read_text("utf-8")
    assert text.count("<img") == 1 and "<h2>carton</h2>" in text and "beside its best control" in text
    assert (tmp_path / "all" / "carton" / "sheet.pdf").is_file()
