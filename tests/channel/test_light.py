"""Light: hand numbers, slow twins, energy, and terms that are off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from patchproof.base.settings import SceneSettings
from patchproof.base.strict import validated
from patchproof.channel.light import Gloss, Lamp, Lighting, highlight, irradiance, lighting_of
from patchproof.scene.conditions import draw


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


FORWARD, UP = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)


def drawn(n, stream="promise", **light):
    settings = {
        "object": {"mesh": "primitive:mug", "length_mm": 100},
        "patch": {"width_mm": 9, "height_mm": 9},
        "target": {"label": 0, "models": ["builtin"]},
        "light": light,
    }
    return draw(validated(SceneSettings, settings, "test"), stream, n, 0).light


def one(ambient=0.0, directional=0.0, toward=(0.0, 0.0, 1.0), **terms) -> Lighting:
    numbers = (torch.tensor([v], dtype=torch.float64) for v in (ambient, directional, toward))
    return Lighting(*numbers, **terms)


def directions(n) -> torch.Tensor:
    """n×3 points spread evenly over the sphere (Fibonacci), each standing for 4π/n."""
    i = torch.arange(n, dtype=torch.float64)
    z, turn = 1 - (2 * i + 1) / n, i * torch.pi * (3 - 5**0.5)
    flat = (1 - z * z).sqrt()
    return torch.stack([flat * turn.cos(), flat * turn.sin(), z], 1)


def zeros(n) -> torch.Tensor:
    return torch.zeros(n, dtype=torch.int64)


def row(*values) -> torch.Tensor:
    return torch.tensor([values], dtype=torch.float64)


def test_paper_facing_the_light_is_white_and_facing_away_gets_the_ambient_part():
    normal = torch.tensor([[0.0, 0, 1], [0, 0, -1], [1, 0, 0]])
    lamp = Lighting(torch.tensor([0.4]), torch.tensor([0.6]), torch.tensor([[0.0, 0, 1]]))
    light = irradiance(normal, torch.tensor([0, 0, 0]), lamp)
    torch.testing.assert_close(light, torch.tensor([1.0, 0.4, 0.4]))


def test_terms_that_are_off_do_not_exist_and_change_nothing():
    conditions = drawn(4)
    light = lighting_of(conditions, FORWARD, UP, (0, 0, 0))
    assert light.uneven is None and light.lamp is None and light.gloss is None
    assert highlight(row(0, 0, 1), row(0, 0, 0), row(0, 0, 9), zeros(1), light) is None
    off = lighting_of(drawn(4, point=[0, 1], sh2=[0, 0.3], gloss=[0, 0.04]), FORWARD, UP, (0, 0, 0))
    nothing = torch.zeros(4)
    dark = replace(
        light,
        uneven=nothing[:, None] * off.uneven,
        lamp=replace(off.lamp, irradiance=nothing),
        gloss=replace(off.gloss, share=nothing),
    )
    normal, view = directions(40).float(), torch.arange(40) % 4
    position = torch.rand(40, 3) * 100
    plain = irradiance(normal, view, light)
    assert torch.equal(irradiance(normal, view, dark, position), plain)
    assert not highlight(normal, position, torch.full((4, 3), 500.0), view, dark).any()


def test_a_lamp_gives_its_light_in_the_middle_and_a_quarter_at_twice_the_distance():
    conditions = drawn(3, ambient=[0, 0], directional=[0, 0], point=[0.8, 0.8], point_distance_mm=[500, 500])
    middle = np.array([10.0, 20, 30])
    light = lighting_of(conditions, FORWARD, UP, middle)
    away = light.lamp.position_mm - torch.tensor(middle, dtype=torch.float32)
    facing, view = away / 500, torch.arange(3)
    at_middle = torch.tensor(middle, dtype=torch.float32).expand(3, 3)
    full = torch.full((3,), 0.8)
    torch.testing.assert_close(away.norm(dim=1), torch.full((3,), 500.0))
    torch.testing.assert_close(irradiance(facing, view, light, at_middle), full)
    torch.testing.assert_close(irradiance(facing, view, light, at_middle - away), full / 4)
    assert not irradiance(-facing, view, light, at_middle).any()
    across = torch.linalg.cross(facing, torch.tensor([[0.0, 1, 0]]).expand(3, 3))
    tilted = torch.nn.functional.normalize(facing + 3**0.5 * torch.nn.functional.normalize(across, dim=1), dim=1)
    torch.testing.assert_close(irradiance(tilted, view, light, at_middle), full / 2)  # cos 60°


def test_a_lamp_far_away_is_a_directional_light_and_one_on_the_paper_stays_finite():
    toward, normal = row(0.6, 0, 0.8), directions(200)
    lamp = Lamp(row(0.7)[0], row(1e7)[0], toward * 1e7)
    position = torch.rand(200, 3, dtype=torch.float64) * 100
    near = irradiance(normal, zeros(200), one(0.3, lamp=lamp), position)
    torch.testing.assert_close(near, irradiance(normal, zeros(200), one(0.3, 0.7, (0.6, 0, 0.8))), atol=1e-4, rtol=0)
    on_it = irradiance(row(0, 0, 1), zeros(1), one(lamp=Lamp(row(1)[0], row(9)[0], row(0, 0, 0))), row(0, 0, 0))
    assert bool(torch.isfinite(on_it).all())


def test_uneven_light_has_the_stated_deviation_and_the_mean_of_even_light():
    """Over directions the mean is the ambient light; over draws the deviation is `sh2` of it at every normal."""
    conditions = drawn(4000, directional=[0, 0], ambient=[0.5, 0.5], sh2=[0.1, 0.1])
    light = lighting_of(conditions, FORWARD, UP, (0, 0, 0))
    normal = directions(400)
    for i in range(5):
        seen = irradiance(normal.float(), torch.full((400,), i), light)
        assert float(seen.mean()) == pytest.approx(0.5, rel=1e-3)
    for n in normal[::80]:
        seen = irradiance(n.float().expand(4000, 3), torch.arange(4000), light)
        assert float(seen.std()) == pytest.approx(0.05, rel=0.05)


def test_uneven_light_is_the_cosine_weighted_environment():
    """Eq. 13 against the integral of radiance over the hemisphere, for one environment of second order."""
    coefficients = torch.tensor([0.3, -0.2, 0.1, 0.25, -0.15, 0.2, 0.1, -0.3], dtype=torch.float64)
    w = directions(40000)
    x, y, z = w.unbind(1)
    # real spherical harmonics in the order of the coefficients (eq. 3 of the paper); a constant 1 has E = π
    harmonics = [0.488603 * y, 0.488603 * z, 0.488603 * x, 1.092548 * x * y, 1.092548 * y * z]
    harmonics += [0.315392 * (3 * z * z - 1), 1.092548 * x * z, 0.546274 * (x * x - y * y)]
    radiance = torch.stack(harmonics, 1) @ coefficients
    normal = directions(50)
    true = ((normal @ w.T).clamp_min(0) * radiance).sum(1) * (4 * torch.pi / len(w))
    spread = (torch.pi / 3 + 5 * torch.pi / 64) ** 0.5  # by which the module divides
    light = one(10.0, uneven=coefficients[None])
    ours = (irradiance(normal, zeros(50), light) - 10) * spread
    torch.testing.assert_close(ours, true, atol=2e-4, rtol=0)


def test_uneven_light_is_never_negative():
    light = lighting_of(drawn(50, directional=[0, 0], sh2=[1, 1]), FORWARD, UP, (0, 0, 0))
    seen = irradiance(directions(2000).float(), torch.arange(2000) % 50, light)
    assert float(seen.min()) == 0 and 0.05 < float((seen == 0).float().mean()) < 0.3


@pytest.mark.parametrize("shininess", [5.0, 20.0, 80.0])
def test_a_highlight_reflects_its_share_whatever_the_shininess(shininess):
    """All that paper lit along its normal sends out: radiance · cos θ over the hemisphere; white paper sends out 1."""
    eye = directions(200000)
    eye = eye[eye[:, 2] > 0]
    n, view = len(eye), torch.arange(len(eye))
    share = torch.full((n,), 0.04, dtype=torch.float64)
    light = Lighting(
        torch.zeros_like(share),
        torch.ones_like(share),
        row(0, 0, 1).expand(n, 3),
        gloss=Gloss(share, torch.full_like(share, shininess)),
    )
    seen = highlight(row(0, 0, 1).expand(n, 3), torch.zeros(n, 3, dtype=torch.float64), eye * 1000, view, light)
    energy = float((seen * eye[:, 2]).sum() * 4 * torch.pi / 200000 / torch.pi)
    assert energy == pytest.approx(0.04, rel=1e-3)


def test_a_highlight_lies_where_a_mirror_would_show_the_light():
    gloss = Gloss(row(0.04)[0], row(50.0)[0])
    light = one(0.0, 1.0, (0.6, 0, 0.8), gloss=gloss)
    eyes = torch.nn.functional.normalize(torch.tensor([[-0.6, 0, 0.8], [0.6, 0, 0.8], [-0.3, 0, 0.95]]), dim=1).double()
    seen = [float(highlight(row(0, 0, 1), row(0, 0, 0), eye[None] * 300, zeros(1), light)) for eye in eyes]
    # at the mirror's angle (n·h) is 1: 0.04 · 52 · 54 / (8 · 50) · 0.8
    assert seen[0] == pytest.approx(0.04 * 52 * 54 / 400 * 0.8, rel=1e-6)
    assert seen[0] > seen[2] > seen[1]


def test_a_lamp_has_a_highlight_too_and_even_light_is_a_veil():
    gloss = Gloss(row(0.1)[0], row(10.0)[0])
    far = Lamp(row(0.5)[0], row(1e7)[0], row(0.6e7, 0, 0.8e7))
    where = (row(0, 0, 1), row(5, 5, 0), row(-100, 20, 300), zeros(1))
    lamp, sun = (
        highlight(*where, one(lamp=far, gloss=gloss)),
        highlight(*where, one(0, 0.5, (0.6, 0, 0.8), gloss=gloss)),
    )
    torch.testing.assert_close(lamp, sun, rtol=1e-5, atol=0)
    assert float(highlight(*where, one(0.5, gloss=gloss))) == pytest.approx(0.05)


def test_batches_equal_single_views():
    conditions = drawn(6, point=[0, 1], sh2=[0, 0.5], gloss=[0, 0.1])
    light = lighting_of(conditions, FORWARD, UP, (1, 2, 3))
    normal, position, eye = directions(60).float(), torch.rand(60, 3) * 80, torch.rand(6, 3) * 100 + 400
    view = torch.arange(60) % 6
    together = irradiance(normal, view, light, position)
    shine = highlight(normal, position, eye, view, light)
    for i in range(6):
        alone, rows = lighting_of(conditions[i : i + 1], FORWARD, UP, (1, 2, 3)), view == i
        first = zeros(int(rows.sum()))
        torch.testing.assert_close(irradiance(normal[rows], first, alone, position[rows]), together[rows])
        seen = highlight(normal[rows], position[rows], eye[i : i + 1], first, alone)
        torch.testing.assert_close(seen, shine[rows])


def test_the_light_moves_with_the_patchs_side():
    conditions = drawn(5, point=[1, 1], gloss=[0.1, 0.1])
    front, right = lighting_of(conditions, FORWARD, UP, (0, 0, 0)), lighting_of(conditions, (1.0, 0, 0), UP, (0, 0, 0))
    turn = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # z to x about y
    torch.testing.assert_close(right.toward, front.toward @ turn.T)
    torch.testing.assert_close(right.lamp.position_mm, front.lamp.position_mm @ turn.T, atol=1e-3, rtol=0)


def test_light_matches_finite_differences():
    """Positions and normals of a bent piece may be optimized one day: the formulas are smooth where they are lit."""
    normal = torch.nn.functional.normalize(torch.rand(4, 3, dtype=torch.float64) + 0.5, dim=1).requires_grad_()
    position = (torch.rand(4, 3, dtype=torch.float64) * 10).requires_grad_()
    light = one(
        0.5,
        0.5,
        (0.6, 0, 0.8),
        uneven=torch.full((1, 8), 0.02, dtype=torch.float64),
        lamp=Lamp(row(0.5)[0], row(200.0)[0], row(120, 120, 100)),
        gloss=Gloss(row(0.2)[0], row(12.0)[0]),
    )

    def both(n, p):
        return irradiance(n, zeros(4), light, p) + highlight(n, p, row(150, 90, 200), zeros(4), light)

    assert torch.autograd.gradcheck(both, (normal, position))
