"""Networks whose answers are known in advance."""

from __future__ import annotations

import torch


class RedAgainstBlue(torch.nn.Module):
    """Two classes, "red" and "blue": the mean of red less that of blue over the middle of the picture, steep."""

    input_px = 32
    labels = ("red", "blue")

    def forward(self, photos):
        middle = photos[:, :, 8:24, 8:24].mean((2, 3))
        score = 20 * (middle[:, 0] - middle[:, 2])
        return torch.stack([score, -score], 1)


def red_against_blue():
    return RedAgainstBlue()


class BlueAgainstRed(RedAgainstBlue):
    """The same picture read the other way round: what one calls red, this one calls blue."""

    labels = ("blue", "red")


def blue_against_red():
    return BlueAgainstRed()


class Bright(torch.nn.Module):
    """Two classes, "bright" and "dark": the picture's upper left quarter against a half, green counting most."""

    input_px = 32
    labels = ("bright", "dark")

    def forward(self, photos):
        red, green, blue = photos[:, :, :16, :16].mean((2, 3)).T
        score = 20 * (0.3 * red + 0.6 * green + 0.1 * blue - 0.5)
        return torch.stack([score, -score], 1)


def bright():
    return Bright()


class Corner(RedAgainstBlue):
    """Looks at the picture's upper left corner alone, where no patch is."""

    def forward(self, photos):
        return super().forward(photos[:, :, :4, :4].repeat(1, 1, 8, 8))


def corner():
    return Corner()


class MeanColor(torch.nn.Module):
    """A line of the picture's mean color, before anything is learned."""

    def __init__(self, num_classes, steep):
        super().__init__()
        self.steep, self.line = steep, torch.nn.Linear(3, num_classes)

    def forward(self, photos):
        return self.line(self.steep * photos.mean((2, 3)))
