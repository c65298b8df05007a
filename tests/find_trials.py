"""How often a print without markers is found by its design, and how often where it is not: a command, no test.

`PATCHPROOF_DATA=DIR python tests/find_trials.py --prints 400 --without 500 --designs DIR --rows FILE` pastes prints of
block designs, photographs and the pictures in --designs (optimized designs), as the printer `office` shows them, into
photographs of DIR under other light, veil, tone, blur, noise and JPEG, 66 to 450 px wide; and looks for designs in
pictures without them, every other one of which shows another print. With `--photographs FOLDER` the pictures without
are its photographs instead, each once, as they are. FILE holds a JSON line for each; those that it has are not made
again.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import torch

from patchproof.base.color import linear_from_srgb, srgb_from_linear
from patchproof.base.geometry import rect_corners
from patchproof.base.intervals import wilson
from patchproof.channel.printer import load_printer
from patchproof.photo.find_design import find_design
from patchproof.photo.rejection import PhotoRejected

SIZE_PX = (1200, 900)
KINDS = ("blocks", "photo", "optimized")
FINE = 3


def photographs() -> list[Path]:
    data = Path(os.environ["PATCHPROOF_DATA"])
    return sorted(path for name in ("backgrounds", "photos") for path in (data / name).glob("*.[jp][pn]g"))


@cache
def picture(path: Path) -> np.ndarray:
    return cv2.imread(str(path))[:, :, ::-1]


def crop(rng: np.random.Generator, size: tuple[int, int], least: float) -> np.ndarray:
    """A part of a photograph: `least` or more of what fits into it."""
    srgb = picture(photographs()[rng.integers(len(photographs()))])
    scale = min(srgb.shape[1] / size[0], srgb.shape[0] / size[1]) * rng.uniform(least, 1)
    width, height = int(size[0] * scale), int(size[1] * scale)
    x, y = rng.integers(0, srgb.shape[1] - width + 1), rng.integers(0, srgb.shape[0] - height + 1)
    return cv2.resize(np.ascontiguousarray(srgb[y : y + height, x : x + width]), size, interpolation=cv2.INTER_AREA)


def draw_design(kind: str, designs: list[Path], rng: np.random.Generator) -> np.ndarray:
    if kind == "optimized":
        return picture(designs[rng.integers(len(designs))])
    if kind == "photo":
        return crop(rng, (192, 192), 0.4)
    side = int(rng.choice([8, 12, 16, 24, 32]))
    palette = rng.integers(0, 256, (int(rng.choice([4, 8, 64])), 3), np.uint8)
    return palette[rng.integers(0, len(palette), (side, side))]


def photograph(design: np.ndarray | None, width_px: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A picture with the print of a design (None: without one), and its corners 4×2 px."""
    light = linear_from_srgb(crop(rng, SIZE_PX, 0.6) / 255.0).astype(np.float32)
    matrix = np.array([[1.2 * SIZE_PX[0], 0, SIZE_PX[0] / 2], [0, 1.2 * SIZE_PX[0], SIZE_PX[1] / 2], [0, 0, 1]])
    tilt, around = np.radians(rng.uniform(0, 50)), rng.uniform(0, 2 * np.pi)
    turn = cv2.Rodrigues(tilt * np.array([np.cos(around), np.sin(around), 0]))[0]
    turn = turn @ cv2.Rodrigues(np.array([0, 0, np.radians(rng.uniform(-25, 25))]))[0]
    middle = np.array([rng.uniform(0.75 * width_px, side - 0.75 * width_px) for side in SIZE_PX])
    away = matrix[0, 0] / width_px * np.sqrt(np.cos(tilt))
    square = np.column_stack([rect_corners((-0.5, -0.5, 1, 1)), np.zeros(4)])
    seen = (square @ turn.T + away * np.linalg.solve(matrix, [*middle, 1])) @ matrix.T
    corners = seen[:, :2] / seen[:, 2:]
    if design is not None:
        zoom = max(1, round(2 * FINE * width_px / len(design)))
        sent = torch.tensor(design / 255.0, dtype=torch.float32).permute(2, 0, 1)[None]
        paper = linear_from_srgb(load_printer("office").apply(sent)[0].permute(1, 2, 0).numpy()).astype(np.float32)
        paper = paper.repeat(zoom, 0).repeat(zoom, 1)
        low = np.maximum(np.floor(corners.min(0)).astype(int) - 4, 0)
        size = np.minimum(np.ceil(corners.max(0)).astype(int) + 4, SIZE_PX) - low
        outline = rect_corners((0, 0, *paper.shape[1::-1])).astype(np.float32) - 0.5
        to_px = cv2.getPerspectiveTransform(outline, ((corners - low) * FINE - 0.5).astype(np.float32))
        covered, shown = (
            cv2.resize(
                cv2.warpPerspective(each, to_px, (size * FINE).tolist()), size.tolist(), interpolation=cv2.INTER_AREA
            )
            for each in (np.ones(paper.shape[:2], np.float32), paper)
        )
        shown = shown * rng.uniform(0.35, 1) * rng.uniform(0.85, 1, 3) + rng.uniform(0, 0.05) * covered[..., None]
        part = light[low[1] : low[1] + size[1], low[0] : low[0] + size[0]]
        part[:] = part * (1 - covered[..., None]) + shown
    light = cv2.GaussianBlur(light, (0, 0), rng.uniform(0.4, 1.0))
    light = np.clip(light + rng.normal(0, 0.006, light.shape) * np.sqrt(np.abs(light) + 0.02), 0, 1)
    codes = (255 * srgb_from_linear(light) ** rng.uniform(0.85, 1.15)).round().astype(np.uint8)
    _, file = cv2.imencode(".jpg", codes[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(70, 96))])
    return np.ascontiguousarray(cv2.imdecode(file, 1)[:, :, ::-1]), corners


def trial(number: int, shown: bool, designs: list[Path], real: list[Path]) -> dict:
    rng = np.random.default_rng([number, shown])
    kind, width_px = KINDS[number % len(KINDS)], float(np.exp(rng.uniform(np.log(66), np.log(450))))
    design, other = draw_design(kind, designs, rng), None
    if real and not shown:
        srgb, corners = np.ascontiguousarray(cv2.imread(str(real[number]))[:, :, ::-1]), np.zeros((4, 2))
    else:
        if not shown and number % 2:
            other = draw_design(kind, designs, rng)
            other = None if other is design else other
        srgb, corners = photograph(design if shown else other, width_px, rng)
    found, said, start = None, None, time.process_time()
    try:
        found = find_design(srgb, design, (100.0, 100.0))
    except PhotoRejected as rejection:
        said = rejection.code
    off = None if found is None else float(np.linalg.norm(found.px - corners, axis=1).max())
    row = {"number": number, "shown": shown, "kind": kind, "width_px": round(width_px, 1), "said": said}
    return row | {"off_px": off, "sigma_px": found and found.sigma_px, "seconds": round(time.process_time() - start, 2)}


def summary(rows: list[dict]) -> list[str]:
    lines = []
    for kind in (*KINDS, None):
        mine = [row for row in rows if row["shown"] and kind in (None, row["kind"])]
        found = [row["off_px"] for row in mine if row["said"] is None and row["off_px"] < 0.1 * row["width_px"]]
        if mine:
            low, high = wilson(len(found), len(mine))
            rate = f"{len(found)} of {len(mine)} [{low:.1%}, {high:.1%}]"
            corner = f"corner off by {np.percentile(found, 95):.2f} px at 95 %" if found else ""
            lines.append(f"{kind or 'all'}: found {rate}, {corner}")
    empty = [row for row in rows if not row["shown"]]
    false = sum(row["said"] in (None, "several_sheets") for row in empty)
    wrong = sum(r["shown"] and r["said"] is None and r["off_px"] >= 0.1 * r["width_px"] for r in rows)
    return [*lines, f"without the print: {false} of {len(empty)} found; with it: {wrong} found elsewhere"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--prints", type=int, default=400)
    parser.add_argument("--without", type=int, default=500)
    parser.add_argument("--designs", type=Path, required=True)
    parser.add_argument("--rows", type=Path, required=True)
    parser.add_argument("--photographs", type=Path)
    asked = parser.parse_args()
    rows = [json.loads(line) for line in asked.rows.read_text().splitlines()] if asked.rows.is_file() else []
    folder = sorted(asked.photographs.iterdir()) if asked.photographs else []
    real = [path for path in folder if cv2.haveImageReader(str(path))]
    without = min(asked.without, len(real)) if real else asked.without
    real = [real[i * len(real) // without] for i in range(without)] if real else []
    done, designs = {(row["number"], row["shown"]) for row in rows}, sorted(asked.designs.glob("*.png"))
    wanted = [(i, shown) for shown, n in ((True, asked.prints), (False, without)) for i in range(n)]
    for number, shown in (each for each in wanted if each not in done):
        rows.append(trial(number, shown, designs, real))
        with asked.rows.open("a", encoding="utf-8") as file:
            file.write(json.dumps(rows[-1]) + "\n")
    print(*summary(rows), sep="\n")


if __name__ == "__main__":
    main()
