"""Light: hand numbers, batches beside single views, the side that a patch is on."""

from __future__ import annotations

import torch

from patchproof.base.settings import SceneSettings
from patchproof.base.validation import validate_model
from patchproof.channel.camera import irradiance, lighting_of
from patchproof.scene.conditions import draw

FORWARD, UP = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)


def drawn(n):
    settings = {
        "object": {"mesh": "primitive:mug", "length_mm": 100},
        "patch": {"width_mm": 9, "height_mm": 9},
        "target": {"label": 0, "models": ["builtin"]},
    }
    return draw(validate_model(SceneSettings, settings, "test"), "promise", n, 0).light


def test_paper_facing_the_light_is_white_and_facing_away_gets_the_ambient_part():
    normal = torch.tensor([[0.0, 0, 1], [0, 0, -1], [1, 0, 0], [0.6, 0, 0.8]])
    sun = torch.tensor([[0.4], [0.0], [0.0], [0.6]])
    light = irradiance(normal.T, sun)
    torch.testing.assert_close(light, torch.tensor([1.0, 0.4, 0.4, 0.88]))


def test_batches_equal_single_views():
    conditions = drawn(6)
    light = lighting_of(conditions, FORWARD, UP)
    normal = torch.nn.functional.normalize(torch.randn(60, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    view = torch.arange(60) % 6
    together = irradiance(normal.T, light[:, view])
    for i in range(6):
        alone, rows = lighting_of(conditions[i : i + 1], FORWARD, UP), view == i
        torch.testing.assert_close(irradiance(normal[rows].T, alone), together[rows])


def test_the_light_moves_with_the_patchs_side():
    conditions = drawn(5)
    front, right = lighting_of(conditions, FORWARD, UP), lighting_of(conditions, (1.0, 0, 0), UP)
    turn = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # z to x about y
    torch.testing.assert_close(right[1:], turn @ front[1:])
