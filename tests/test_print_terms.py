"""What a printer can do, and what prints do: designs kept in gamut, NPS, misregistration, paper, scale, the study."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from conftest import SCENE
from patchproof.channel.printer import (
    IN_GAMUT,
    Printer,
    identity_printer,
    load_printer,
    misregistered,
    node_colors,
    save_printer,
)
from patchproof.optimizer import loop
from patchproof.optimizer.loop import steps
from patchproof.optimizer.pixels import as_pixels, from_pixels
from patchproof.optimizer.problem import set_problem
from patchproof.plan.terms import Setup, scene_terms
from patchproof.render.photograph import expose, photograph, shade
from patchproof.render.stage import set_stage
from patchproof.render.views import see
from patchproof.scene.conditions import with_values
from patchproof.strict import Refused
from patchproof.study.study import Cell, Result, run_study
from patchproof.validation.gamut import UNPRINTED, WAYS, other_printers, reprinted, rows_of, way_problem
from test_plan import scene_with
from test_views import WHITE, area, box_scene, outline, piece_of, posed


@pytest.fixture(autouse=True)
def few_selection_views(monkeypatch):
    """What designs are selected by does not matter here."""
    monkeypatch.setattr(loop, "SELECT_VIEWS", 2)


def colors(n=4000) -> torch.Tensor:
    """Random colors and the corners of sRGB, as 1×3×N×1."""
    corners = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3)
    random = torch.tensor(np.random.default_rng(1).random((n, 3)), dtype=torch.float32)
    return torch.cat([random, corners]).T[None, :, :, None]


# ------------------------------------------------------------------------------------------------ in gamut


@pytest.mark.parametrize("name", ["coated", "uncoated"])
def test_colors_brought_into_gamut_are_shown_as_asked_and_others_are_left_alone(name):
    printer, sent = load_printer(name), colors()
    inside = printer.gamut_distance(sent) <= IN_GAMUT
    assert 0.2 < inside.float().mean() < 0.6
    moved = printer.into_gamut(sent)
    assert printer.gamut_distance(moved).max() <= IN_GAMUT + 1e-4
    torch.testing.assert_close(torch.where(inside, moved, sent), sent, rtol=0, atol=0)
    torch.testing.assert_close(printer.into_gamut(moved), moved, rtol=0, atol=2e-3)
    rounded = (moved * 255).round() / 255  # what is printed; measured: 3.2 and 3.3
    assert printer.gamut_distance(rounded).max() < IN_GAMUT + 0.5


def ball_printer(distance_at_gray=0.0, slope=20.0) -> Printer:
    """Shows every color's complement, and misses colors the more, the farther from middle gray they are."""
    nodes = torch.tensor(node_colors(), dtype=torch.float32)
    distance = distance_at_gray + slope * (nodes - 0.5).norm(dim=-1)
    return Printer("ball", "assumed", 1 - nodes, distance)


def test_where_what_is_shown_is_out_of_gamut_too_a_mix_with_gray_is_taken():
    printer, sent = ball_printer(), colors(500)
    moved = printer.into_gamut(sent)
    radius = (moved - 0.5).norm(dim=1)
    outside = (sent - 0.5).norm(dim=1) > 0.25
    assert outside.any() and radius.max() < 0.151
    assert radius[outside].min() > 0.13  # up to the edge: 3 / 20, but for the table's steps of 1/32
    torch.testing.assert_close(identity_printer().into_gamut(sent), sent, rtol=0, atol=0)


def test_every_step_of_an_optimization_in_gamut_is_in_gamut(tmp_path):
    worst = {}
    for in_gamut in (False, True):
        given = {"optimize__in_gamut": in_gamut, "optimize__gamut": 0.0}
        problem = set_problem(scene_with(tmp_path, optimize__steps=6, printer__profile="uncoated", **given))
        designs = torch.stack([step.state.design for step in steps(problem)])
        worst[in_gamut] = float(problem.printer.gamut_distance(designs).max())
    assert worst[True] <= IN_GAMUT + 1e-4 < 8 < worst[False]


@pytest.mark.parametrize(("miss", "refused"), [(2.9, False), (3.2, True)])
def test_a_printer_that_misses_even_gray_is_refused(tmp_path, miss, refused):
    save_printer(ball_printer(miss, slope=0), tmp_path)
    scene = scene_with(tmp_path, optimize__steps=6, optimize__in_gamut=True, printer__profile="ball.npz")
    if not refused:
        set_problem(scene)
        return
    with pytest.raises(Refused, match="even show middle gray"):
        set_problem(scene)


# ------------------------------------------------------------------------------------------------ what prints do


def test_planes_move_by_whole_pixels_and_parts_of_them():
    picture = torch.tensor(np.random.default_rng(3).random((12, 16, 3)))
    moved = misregistered(picture, torch.tensor([[2.0, 0.0], [0.0, -1.0]]))
    torch.testing.assert_close(moved[:, 2:, 0], picture[:, :-2, 0])  # red to the right
    torch.testing.assert_close(moved[:-1, :, 2], picture[1:, :, 2])  # blue up
    torch.testing.assert_close(moved[..., 1], picture[..., 1], rtol=0, atol=0)
    torch.testing.assert_close(moved[:, :2, 0], picture[:, :1, 0].expand(-1, 2))  # the border goes on
    half = misregistered(picture, torch.tensor([[0.5, 0.0], [0.0, 0.0]]))
    torch.testing.assert_close(half[:, 1:, 0], (picture[:, 1:, 0] + picture[:, :-1, 0]) / 2)
    torch.testing.assert_close(misregistered(picture, torch.zeros(2, 2)), picture)
    assert torch.autograd.gradcheck(
        lambda x: misregistered(x, torch.tensor([[0.3, 0.1], [-0.2, 0.4]])), (picture[:4, :4].requires_grad_(),)
    )


def test_each_view_shows_its_own_misregistration(tmp_path):
    """Two views with different shifts are the pictures of pieces shifted before (the slow twin)."""
    scene = box_scene(tmp_path)
    piece = piece_of(scene)
    shifts_mm = np.array([[[0.6, -0.2], [0.1, 0.5]], [[-0.4, 0.3], [0.0, 0.0]]])
    conditions = posed(scene, 2, azimuth_deg=[0, 30])
    stage, size = set_stage(scene), (160, 160)
    both = photograph(stage, piece, with_values(conditions, misregistration_mm=shifts_mm), size, jpeg=False)
    px_per_mm = piece.srgb.shape[1] / scene.piece.size_mm[0]
    for i, shift in enumerate(shifts_mm):
        alone = replace(piece, srgb=misregistered(piece.srgb, torch.tensor(shift * px_per_mm)))
        twin = photograph(stage, alone, conditions[i : i + 1], size, jpeg=False)
        torch.testing.assert_close(both[i : i + 1], twin, rtol=0, atol=2e-5)
    plain = photograph(stage, piece, conditions, size, jpeg=False)
    assert (plain - both).abs().max() > 0.05


def test_white_paper_reflects_what_its_lightness_and_tint_say(tmp_path):
    scene = box_scene(tmp_path)
    paper = np.array([[0.9, 0.95, 1.02]])
    stage, conditions = set_stage(scene), posed(scene, dot_gain=0, density=0, black=0)
    seen = [
        shade(see(stage, WHITE, one, (120, 120)), WHITE) for one in (conditions, with_values(conditions, paper=paper))
    ]
    middle = (seen[1] / seen[0])[0, :, 55:65, 55:65].mean((1, 2))
    np.testing.assert_allclose(middle, paper[0], rtol=1e-4)


@pytest.mark.parametrize("scale", [0.94, 1.03])
def test_a_print_of_another_size_covers_as_much_as_one_of_a_scene_made_for_it(tmp_path, scale):
    scene = box_scene(tmp_path)
    conditions = posed(scene, 2, azimuth_deg=[0, 35])
    drawn = with_values(conditions, printed_scale=np.full(2, scale))
    plain, scaled = (area(outline(scene, one, (200, 200))) for one in (conditions, drawn))
    assert scaled[0] / plain[0] == pytest.approx(scale**2, rel=1e-6)
    piece, twin = piece_of(scene), scene.printed_at((scale, scale))
    np.testing.assert_allclose(outline(scene, drawn, (200, 200)), outline(twin, conditions, (200, 200)), atol=1e-6)
    pictures = [photograph(set_stage(s), piece, c, (200, 200)) for s, c in ((scene, drawn), (twin, conditions))]
    assert (pictures[0] - pictures[1]).abs().max() < 2e-3


def test_print_terms_reach_the_gradient_through_each_views_own_copy(tmp_path):
    scene = scene_with(tmp_path, printer__misregistration_mm=[0.2, 0.5], printer__paper_b=[-8, 7])
    problem = set_problem(scene)
    design = torch.tensor(np.random.default_rng(4).random(tuple(problem.subject.start().shape)), dtype=torch.float32)
    design.requires_grad_()
    shown = problem.subject.shown(design)
    pictures = expose(problem.see(shown, scene.draw("train", 2), 192), shown, jpeg=False)
    (gradient,) = torch.autograd.grad(pictures.mean(), design)
    assert torch.isfinite(gradient).all() and float((gradient > 0).float().mean()) > 0.9


def test_the_plan_names_each_print_term_and_takes_it_out(tmp_path):
    names = {"dot gain", "ink density", "printed black", "paper white", "misregistration", "print scale"}
    on = {"paper_white": [0.9, 1], "misregistration_mm": [0, 0.3], "scale": [0.95, 1]}
    for tables, off in (({f"printer__{key}": value for key, value in on.items()}, set()), ({}, names - {"dot gain"})):
        problem = set_problem(scene_with(tmp_path, **tables))
        shown = problem.subject.shown(problem.subject.start())
        setup = Setup(problem.stage, shown, problem.scene.draw("select", 4))
        terms = {t.name: t for t in scene_terms(problem, problem.subject.start(), None) if t.name in names}
        assert set(terms) == names
        gone = {name for name, term in terms.items() if term.change(setup) is None}
        assert gone == (off - {"ink density", "printed black"})
        for term in terms.values():
            table, key = term.key.split(".")
            assert hasattr(getattr(problem.scene.settings, table), key)


def test_a_print_scale_range_reaches_the_promise_and_the_truth(tmp_path):
    """Homographies are those of the print as large as it is, so px_per_mm of the sheet's own millimeters shrink."""
    scene = scene_with(tmp_path, printer__scale=[0.5, 0.5])
    usual = scene_with(tmp_path)
    half, full = (area(outline(s, s.draw("promise", 3), (300, 300))) for s in (scene, usual))
    np.testing.assert_allclose(half / full, 0.25, rtol=0.05)


# ------------------------------------------------------------------------------------------------ the study


def test_the_study_reprints_by_printers_that_were_not_known():
    known, other, made = other_printers(load_printer("coated"))
    assert (known.name, other.name) == ("coated", "uncoated")
    light, black = torch.full((1, 3, 1, 1), 0.75), torch.zeros(1, 3, 1, 1)
    assert (made.apply(light) < other.apply(light) - 0.03).all()  # more dot gain
    assert (made.apply(black) > other.apply(black) + 0.03).all()  # a paler black
    torch.testing.assert_close(made.apply(torch.ones(1, 3, 1, 1)), torch.ones(1, 3, 1, 1))


def test_ways_differ_in_what_they_say(tmp_path):
    problem = set_problem(scene_with(tmp_path))
    posed_by = {way.name: way_problem(problem, way) for way in WAYS}
    assert posed_by[UNPRINTED.name].subject.printer.name == "identity"
    design = from_pixels(np.full((8, 8, 3), [255, 0, 255], np.uint8))
    kept = posed_by["in gamut by construction"].subject.clipped(design)
    assert as_pixels(kept).tolist() != as_pixels(design).tolist()
    assert as_pixels(posed_by["printer's table"].subject.clipped(design)).tolist() == as_pixels(design).tolist()


def test_a_cell_of_the_study_shows_every_design_in_the_same_views(tmp_path):
    problem = set_problem(scene_with(tmp_path, optimize__steps=2))
    ways = (WAYS[0], replace(WAYS[0], name="again"), WAYS[-1])
    answers = reprinted(problem, [load_printer("coated"), load_printer("uncoated")], ways, 6)
    assert len(answers["hits"]) == 3 * 2 and list(answers["missed"]) == [way.name for way in ways]
    first, again = (answers["confidence"][f"{way.name}, printed by uncoated"] for way in ways[:2])
    assert first == again and len(first[0]) == 6
    assert answers["missed"][ways[2].name] < 0.01
    cell = Cell("c", {"name": "scene", "networks": ["net"], "seed": 0})
    rows = rows_of([Result(cell, answers, tmp_path)])
    assert [row.difference.value for row in rows[:2]] == [0, 0] and rows[0].rate.n == 6


def test_rows_pool_seeds_by_hand():
    """Two seeds of two views: the other way gains one recognition and 0.1 of confidence in every view."""
    hits = ("10", "00"), ("11", "00")  # seeds × ways
    sure = ([0.5, 0.3], [0.6, 0.4]), ([0.4, 0.2], [0.5, 0.3])
    things = (f"{UNPRINTED.name}, printed by p", "other, printed by p")
    results = []
    for seed in (0, 1):
        answers = {
            "hits": {thing: [text] for thing, text in zip(things, hits[seed], strict=True)},
            "confidence": {thing: [row] for thing, row in zip(things, sure[seed], strict=True)},
            "missed": {UNPRINTED.name: 0.5, "other": 0.0},
            "printers": ["p"],
        }
        results.append(Result(Cell(f"c{seed}", {"name": "s", "networks": ["n"], "seed": seed}), answers, Path()))
    base, other = rows_of(results)
    assert (base.rate.n, base.rate.value, other.rate.value, other.difference.value) == (4, 0.75, 0.0, -0.75)
    assert other.gain.value == pytest.approx(0.1) and other.gain_by_seed == "+0.100 +0.100"
    assert (other.gain.low, other.gain.high) == pytest.approx((0.1, 0.1)) and base.missed == 0.5
    mean = base.confidence
    # Student's t of three degrees of freedom, 3.1824, times the deviation over the root of four
    assert mean.value == pytest.approx(0.35) and mean.high - mean.low == pytest.approx(3.1824 * 0.1290994, rel=1e-4)


def test_the_study_runs_cell_by_cell_and_says_what_is_missing(tmp_path):
    (tmp_path / "a.toml").write_text(SCENE.replace("steps = 3", "steps = 1").replace("views = 4", "views = 1"), "utf-8")
    (tmp_path / "study.toml").write_text('scenes = ["a.toml"]\nseeds = [0]\nn = 2\n', "utf-8")
    finished = run_study("gamut", tmp_path / "study.toml", tmp_path / "out")
    (table,) = finished.tables
    assert len(table.rows) == len(WAYS) * 3 and table.rows[0][:2] == ("coated", UNPRINTED.name)
    assert (tmp_path / "out/gamut_a.csv").is_file() and (tmp_path / "out/gamut_a.png").is_file()
    for other, says in (("none.toml", "no file at"), ("b/a.toml", "different names")):
        (tmp_path / "study.toml").write_text(f'scenes = ["a.toml", "{other}"]\n', "utf-8")
        with pytest.raises(Refused, match=says):
            run_study("gamut", tmp_path / "study.toml", tmp_path / "other")
