"""Known colors: the channel's own formulas, their inverse, and ink told apart from photographs."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from patchproof.base.color import lift_tone, linear_from_srgb, srgb_from_linear
from patchproof.channel.print_colors import CellColors, ShownColors, added_terms, fit_ink_and_photos
from patchproof.channel.printer import vary_print

TERMS = np.array([0.03, 0.02, 0.04, -0.2, -0.1, -0.3, -0.08, -0.05, -0.1, -0.2])  # veil, log gains, tone, chroma
LIGHT = np.random.default_rng(0).uniform(0.02, 0.9, (300, 3))


def test_a_photograph_shows_what_the_channel_makes_of_a_print():
    change = torch.tensor([0.0, 0.0, TERMS[9], *TERMS[:3]])
    lit = vary_print(torch.tensor(LIGHT), change) * torch.tensor(TERMS[3:6]).exp()
    expected = linear_from_srgb(lift_tone(srgb_from_linear(lit), torch.tensor(TERMS[6:9])).numpy())
    photo, plain = ShownColors.of_terms(TERMS), (LIGHT - 0.2).clip(0.02)  # chroma leaves [0, 1] beyond
    inside = (vary_print(torch.tensor(LIGHT), change) < 1).all(1).numpy()
    np.testing.assert_allclose(photo.show(LIGHT)[inside], expected[inside], atol=1e-6)
    np.testing.assert_allclose(photo.undo(photo.show(plain)), plain, atol=1e-9)


def test_ink_and_photographs_are_told_apart_as_far_as_they_differ():
    """Of four places with other veils; a veil in all of them is taken for light in black ink, which is said."""
    rng, ink = np.random.default_rng(1), np.random.default_rng(2).normal(0, 0.03, (9, 3))
    photos = []
    for veil, tone in ((0.0, 0.0), (0.05, -0.05), (0.02, 0.05), (0.03, 0.0)):
        promised = rng.uniform(0.02, 0.9, (200, 3))
        cells = CellColors(promised, added_terms(promised).T, promised, np.zeros(10))
        look = ShownColors.of_terms(np.array([veil] * 3 + [0] * 3 + [tone] * 3 + [0]))
        photos.append(CellColors(promised, cells.terms, look.show(cells.ink_light(ink)), np.zeros(10)))
    found, terms = fit_ink_and_photos(photos)
    for cells, term in zip(photos, terms, strict=True):
        assert np.abs(ShownColors.of_terms(term).show(cells.ink_light(found)) - cells.seen).mean() < 0.006
    veils = np.array(terms)[:, :3].mean(1)
    assert veils - veils[0] == pytest.approx([0, 0.05, 0.02, 0.03], abs=0.012)
