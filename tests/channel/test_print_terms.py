"""What prints do: misregistration, paper, scale."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from patchproof.app.plan.terms import Setup, scene_terms
from patchproof.channel.printer import misregistered
from patchproof.optimizer import loop
from patchproof.optimizer.problem import set_problem
from patchproof.render.photograph import expose, photograph, shade
from patchproof.render.pixels import PiecePicture
from patchproof.render.stage import set_stage
from patchproof.render.views import see
from patchproof.scene.conditions import with_values
from patchproof.sheets.piece import marker_image
from test_plan import scene_with
from test_views import WHITE, area, box_scene, outline, piece_of, posed


@pytest.fixture(autouse=True)
def few_selection_views(monkeypatch):
    """What designs are selected by does not matter here."""
    monkeypatch.setattr(loop, "SELECT_VIEWS", 2)


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
        alone = PiecePicture.of(misregistered(piece.srgb, torch.tensor(shift * px_per_mm)))
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
    free = ~torch.tensor(marker_image(problem.patch.scene.piece, problem.patch.design_px)[1])
    assert torch.isfinite(gradient).all() and float((gradient[:, free] > 0).float().mean()) > 0.9
    assert not gradient[:, ~free].any() and not free.all()


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
    half, full = (area(outline(s, s.draw("evaluate", 3), (300, 300))) for s in (scene, usual))
    np.testing.assert_allclose(half / full, 0.25, rtol=0.05)
