"""What prints do: their size, and how they differ from one another."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tolerances import FLOAT32

from patchproof.app.plan.errors import Setup, scene_terms
from patchproof.base.color import srgb_from_linear
from patchproof.optimizer import loop
from patchproof.optimizer.problem import set_problem
from patchproof.render.photograph import expose, shade
from patchproof.render.pixels import PiecePicture
from patchproof.render.stage import set_stage
from patchproof.render.views import render_views
from patchproof.scene.conditions import with_values
from patchproof.sheets.piece import marker_image
from test_plan import scene_with
from test_views import area, box_scene, outline, posed


@pytest.fixture(autouse=True)
def few_selection_views(monkeypatch):
    """What designs are selected by does not matter here."""
    monkeypatch.setattr(loop, "SELECT_VIEWS", 2)


@pytest.mark.parametrize("scale", [0.94, 1.03])
def test_a_print_of_another_size_covers_as_much_as_one_of_a_scene_made_for_it(tmp_path, scale):
    scene = box_scene(tmp_path)
    conditions = posed(scene, 2, azimuth_deg=[0, 35])
    drawn = with_values(conditions, printed_scale=np.full(2, scale))
    plain, scaled = (area(outline(scene, one, (200, 200))) for one in (conditions, drawn))
    assert scaled[0] / plain[0] == pytest.approx(scale**2, rel=1e-6)


def test_print_terms_let_gradients_pass(tmp_path):
    prints = {"printer__density": [0.1, 0.2], "printer__scale": [0.9, 0.95], "printer__mottle": [0.02, 0.04]}
    scene = scene_with(tmp_path, **prints)
    problem = set_problem(scene)
    design = torch.tensor(np.random.default_rng(4).random(tuple(problem.subject.start().shape)), dtype=torch.float32)
    design.requires_grad_()
    shown = problem.subject.appearance(design)
    pictures = expose(problem.see(shown, scene.draw("train", 2), 192), shown, jpeg=False)
    (gradient,) = torch.autograd.grad(pictures.mean(), design)
    free = ~torch.tensor(marker_image(problem.patch.scene.piece, problem.patch.design_px)[1])
    assert torch.isfinite(gradient).all() and float((gradient[:, free] > 0).float().mean()) > 0.9
    assert not gradient[:, ~free].any() and not free.all()


def test_the_plan_names_each_print_term_and_takes_it_out(tmp_path):
    names = {"dot gain", "ink density", "veil", "chroma", "mottle", "print scale"}
    every = {"printer__scale": [0.95, 1], "printer__mottle": [0, 0.03]}
    for tables, off in ((every, set()), ({"printer__mottle": [0, 0]}, {"mottle", "print scale"})):
        problem = set_problem(scene_with(tmp_path, **tables))
        shown = problem.subject.appearance(problem.subject.start())
        setup = Setup(problem.stage, shown, problem.scene.draw("select", 4))
        terms = {t.name: t for t in scene_terms(problem, problem.subject.start(), None) if t.name in names}
        assert set(terms) == names
        gone = {name for name, term in terms.items() if term.change(setup) is None}
        assert gone == off
        for term in terms.values():
            table, key = term.key.split(".")
            assert hasattr(getattr(problem.scene.settings, table), key)


def test_a_print_scale_range_reaches_the_promise_and_the_truth(tmp_path):
    """Homographies are those of the print as large as it is, so px_per_mm of the sheet's own millimeters shrink."""
    scene = scene_with(tmp_path, printer__scale=[0.5, 0.5])
    usual = scene_with(tmp_path)
    half, full = (area(outline(s, s.draw("evaluate", 3), (300, 300))) for s in (scene, usual))
    np.testing.assert_allclose(half / full, 0.25, rtol=0.05)


def test_mottle_is_as_strong_as_it_says_on_ink_and_is_not_on_paper(tmp_path):
    scene = box_scene(tmp_path)
    gray, white = (PiecePicture.of(torch.full((200, 200, 3), level)) for level in (0.5, 1.0))
    plain = posed(scene, 3, ambient=1, directional=0, noise=0, blur_px=0, exposure_ev=0, jpeg=0, mottle=0)
    uneven = with_values(plain, mottle=np.array([0.02, 0.02, 0.06]), mottle_seed=np.array([7, 7, 8]))
    stage = set_stage(scene)

    def shown(picture, conditions, side_px=1000):
        views = render_views(stage, picture, conditions, (side_px, side_px))
        seen, whole = shade(views, picture), views.on_piece.share[:, 0] > 0.99
        rows = seen.permute(0, 2, 3, 1).reshape(-1, 3)[views.on_piece.pixel[whole]]
        return [srgb_from_linear(rows[views.on_piece.view[whole] == view]) for view in range(len(conditions))]

    (off,) = shown(gray, plain[:1])  # as the others
    shifts = [on - off for on in shown(gray, uneven)]
    rms = [float(shift.square().mean().sqrt()) for shift in shifts]
    assert rms == pytest.approx([0.02, 0.02, 0.06], rel=0.08)  # cells are several pixels wide
    assert torch.equal(shifts[0], shifts[1])  # one print of a session, twice
    assert abs(np.corrcoef(shifts[0].ravel(), shifts[2].ravel())[0, 1]) < 0.05
    pairs = zip(shown(white, uneven, 300), shown(white, plain, 300), strict=True)
    assert max(float((on - off).abs().max()) for on, off in pairs) < FLOAT32
