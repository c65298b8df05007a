"""Make a printer from its tables, and write its two files, which `channel.printer` reads."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from patchproof.base.color import lab_from_srgb
from patchproof.channel.printer import GAMUT_STEPS, Method, Paper, Printer, PrinterHead


def printer_from_table(
    name: str, method: Method, lut: np.ndarray, gamut: np.ndarray, white_lab, provenance: dict[str, Any]
) -> Printer:
    """A printer from arrays 33×33×33×3 (clipped to [0, 1], see `channel.printer`) and 33×33×33, with its own black."""
    lut = np.clip(np.asarray(lut, np.float64), 0, 1)
    paper = Paper(white_lab=white_lab, black_L=round(float(lab_from_srgb(lut[0, 0, 0])[0]), 2))
    distances = torch.tensor(np.asarray(gamut, np.float64), dtype=torch.float32)
    return Printer(name, method, torch.tensor(lut, dtype=torch.float32), distances, paper, provenance)


def printer_output(printer: Printer, colors: np.ndarray) -> np.ndarray:
    """The sRGB colors N×3 of a print of N×3 sRGB sent."""
    return printer.apply(torch.tensor(np.asarray(colors, float).T[None, :, :, None]))[0, :, :, 0].T.numpy()


def save_printer(printer: Printer, folder: Path) -> Path:
    """Write NAME.npz and NAME.json into `folder`; a printer always gives the same bytes. Returns the .npz path."""
    lut = printer.lut.double().numpy()
    in_8_bits = np.abs(lut * 255 - np.round(lut * 255)).max() < 1e-4  # tables from an 8-bit engine lose nothing
    levels, dtype = (255, np.uint8) if in_8_bits else (65535, np.uint16)
    gamut = np.round(printer.gamut.double().numpy() * GAMUT_STEPS).clip(0, 255).astype(np.uint8)
    path = folder / f"{printer.name}.npz"
    np.savez_compressed(path, lut=np.round(lut * levels).astype(dtype), gamut=gamut)
    head = PrinterHead(name=printer.name, method=printer.method, paper=printer.paper, provenance=printer.provenance)
    path.with_suffix(".json").write_text(json.dumps(head.model_dump(), indent=1, ensure_ascii=False) + "\n", "utf-8")
    return path
