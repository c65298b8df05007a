"""What prints do: their size, and how they differ from one another."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from patchproof.app.plan.errors import Setup, scene_terms
from patchproof.optimizer import loop
from patchproof.optimizer.problem import set_problem
from patchproof.render.photograph import expose
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
    scene = scene_with(tmp_path, printer__density=[0.1, 0.2], printer__scale=[0.9, 0.95])
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
    names = {"dot gain", "ink density", "veil", "chroma", "print scale"}
    for tables, off in (({"printer__scale": [0.95, 1]}, set()), ({}, {"print scale"})):
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
