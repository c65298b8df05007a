"""The printer: a table from the sRGB colors that are sent to the colors seen on paper, differentiable.

In: sRGB as sent, N×3×H×W in [0, 1]. Out: sRGB as seen by an eye adapted to the paper (media-relative: bare paper is 1),
since light and camera are applied elsewhere. A second table holds how far each color is out of gamut (ΔE00 of the round
trip). A printer is a name, two tables and their provenance; on disk NAME.npz and NAME.json. Inks outside of sRGB
(offset cyan and green) are clipped to [0, 1] in the table, as in cameras that deliver sRGB. `vary_print` models how
prints vary, `mottled` how one is uneven. Left out on purpose: halftone dots (below what a camera resolves beyond 0.2 mm
per pixel) and ink spread.
"""

import base64
import hashlib
import io
import json
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from patchproof.base.color import LUMINANCE, clamp_to_unit, lab_from_srgb
from patchproof.base.errors import Refused
from patchproof.base.input import read_file, read_json
from patchproof.base.packaged import named_path, packaged_path
from patchproof.base.text import short_repr
from patchproof.base.validation import Finite, StrictModel, validate_model
from patchproof.channel.effects import Print

# 8-bit values that exist, so that a table baked by an 8-bit engine is exact at its nodes: 0, 8, ..., 248, 255
NODES_8BIT = (*range(0, 249, 8), 255)
SIZE = len(NODES_8BIT)
MOTTLE_CELLS = 50  # along the longer side: those of the stickers on which it was measured
# The upper Cholesky factor of the correlations of red, green, blue (0.73, 0.45, 0.66; 25 photographs, 3 places)
_MOTTLE_MIXING = np.linalg.cholesky(np.array([[1, 0.73, 0.45], [0.73, 1, 0.66], [0.45, 0.66, 1]])).T
_MOTTLE_FADES = 0.1  # below white, in sRGB: there it was half as strong
Method = Literal["measured", "icc", "assumed"]
GAMUT_STEPS = 8  # the gamut table is stored in eighths of a ΔE00, up to 31.9


class Paper(StrictModel):
    """The paper under the media-relative table; None for unknown values."""

    white_lab: tuple[Finite, Finite, Finite] | None = None  # D50, absolute
    black_L: Finite | None = None  # L* of printed sRGB black, with paper white at 100


class PrinterHead(StrictModel):
    """The contents of a printer's NAME.json: everything but its tables."""

    name: str
    method: Method
    paper: Paper = Paper()
    provenance: dict[str, Any] = Field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Printer:
    """Tables at the nodes `NODES_8BIT` of red, green, blue (in this order); `provenance` says where they come from."""

    name: str
    method: Method
    lut: Tensor  # float32 33×33×33×3, seen sRGB in [0, 1]
    gamut: Tensor  # float32 33×33×33, ΔE00 between sent and seen
    paper: Paper = field(default_factory=Paper)
    provenance: dict[str, Any] = field(default_factory=dict)
    __repr__ = short_repr

    def apply(self, srgb: Tensor) -> Tensor:
        """Return the sRGB N×3×H×W that is seen when this sRGB is sent; values outside [0, 1] are clamped. Trilinear."""
        return _look_up(self._colors, srgb)

    def gamut_distance(self, srgb: Tensor) -> Tensor:
        """Return N×1×H×W: the ΔE00 by which the printer misses each color; differentiable, for use as a penalty."""
        return _look_up(self._distances, srgb)

    @cached_property
    def sha256(self) -> str:
        """Return the SHA-256 of everything that the printer's appearance depends on."""
        digest = hashlib.sha256(f"Paper({self.paper.__repr_str__(', ')})".encode())
        for table in (self.lut, self.gamut):
            digest.update(table.detach().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()

    @cached_property
    def _colors(self) -> Tensor:
        return _bordered(self.lut)

    @cached_property
    def _distances(self) -> Tensor:
        return _bordered(self.gamut[..., None])


def node_colors() -> np.ndarray:
    """Return float64 33×33×33×3: the sRGB colors at which the tables are known, red slowest."""
    nodes = np.array(NODES_8BIT) / 255
    return np.stack(np.meshgrid(nodes, nodes, nodes, indexing="ij"), -1)


def identity_printer() -> Printer:
    """Return an ideal printer, which shows the colors that it is sent."""
    lut = torch.tensor(node_colors(), dtype=torch.float32)
    note = {"source": "none: an ideal printer, for comparison"}
    return Printer("identity", "assumed", lut, torch.zeros(lut.shape[:3]), Paper(black_L=0.0), note)


def printer_from_table(name: str, method: Method, lut: np.ndarray, gamut: np.ndarray, provenance: dict) -> Printer:
    """Return a printer of tables 33×33×33×3 (clipped to [0, 1]) and 33×33×33, with its own black."""
    lut = np.clip(np.asarray(lut, np.float64), 0, 1)
    paper = Paper(black_L=round(float(lab_from_srgb(lut[0, 0, 0])[0]), 2))
    distances = torch.tensor(np.asarray(gamut, np.float64), dtype=torch.float32)
    return Printer(name, method, torch.tensor(lut, dtype=torch.float32), distances, paper, provenance)


def printer_output(printer: Printer, colors: np.ndarray) -> np.ndarray:
    """Return the sRGB colors N×3 of a print of N×3 sRGB sent."""
    return printer.apply(torch.tensor(np.asarray(colors, float).T[None, :, :, None]))[0, :, :, 0].T.numpy()


def vary_print(seen_linear: Tensor, change: Tensor) -> Tensor:
    """Return the light `... × 3` of another print in another photograph, given that of this one; channels last.

    `change` `... × 6` broadcasts against it: dot gain g, ink density d, chroma c, and a veil of light v in red, green
    and blue; 0 changes nothing. Bare paper stays 1. With reflectance R: coverage 1 - R (Murray-Davies) grows by
    4·g·R·(1 - R); density makes R^(1+d); chroma makes Y + (1+c)·(R - Y) about the luminance Y; light that the surface
    itself sends to the camera makes v + (1 - v)·R.
    """
    gain, density, chroma, veil = change.to(seen_linear).split((1, 1, 1, 3), -1)
    light = seen_linear * (1 - 4 * gain * (1 - seen_linear))
    # light^density, whose slope is computed in a quarter of the time of a power's; the floor keeps it finite at black
    light = light * (density * light.clamp_min(1e-3).log()).exp()
    luminance = light @ light.new_tensor(LUMINANCE)[:, None]
    return clamp_to_unit(luminance.lerp(light, 1 + chroma).lerp(torch.ones_like(light), veil))


def mottle_cells(seed: int) -> np.ndarray:
    """Return K×3 of rms 1: a value for each channel of a square print's cells, row by row."""
    return np.random.default_rng(seed).standard_normal((MOTTLE_CELLS**2, 3)) @ _MOTTLE_MIXING


def mottled(seen_srgb: Tensor, shift: Tensor) -> Tensor:
    """Return the sRGB colors `... × 3` with their mottle; bare paper stays 1, since only ink is uneven."""
    return clamp_to_unit(seen_srgb + shift * ((1 - seen_srgb) / _MOTTLE_FADES).clamp_max(1))


def print_change(variation: Print) -> np.ndarray:
    """Return N×6: the numbers of N prints as `vary_print` takes them."""
    return np.column_stack([variation.dot_gain, variation.density, variation.chroma, variation.veil])


def load_printer(name_or_file: str, base: Path | None = None) -> Printer:
    """Load a shipped printer by name, `identity`, or NAME.npz or NAME.json relative to `base`; else it is refused."""
    if name_or_file == "identity":
        return identity_printer()
    if Path(name_or_file).suffix.lower() in {".icc", ".icm"}:
        remedy = "bake the profile into one with patchproof calibrate printer"
        raise Refused("a printer model (.npz)", f"the ICC profile {name_or_file}", remedy)
    folder = packaged_path("calibration", "printers")
    path = named_path(name_or_file, base, "a printer", folder, (".npz", ".json"), ("identity",))
    return printer_of_files(*printer_files(path), path)


def printer_files(path: Path) -> tuple[bytes, Any]:
    """Return what a printer's NAME.npz and NAME.json hold."""
    expected, text = "a printer as NAME.npz with NAME.json beside it", path.with_suffix(".json")
    return read_file(path.with_suffix(".npz"), expected), read_json(text, expected, "calibrate again")


def printer_contents(printer: Printer, path: Path) -> dict[Path, bytes]:
    """Return the contents of NAME.npz, which is `path`, and of NAME.json; a printer always gives the same bytes."""
    lut = printer.lut.double().numpy()
    in_8_bits = np.abs(lut * 255 - np.round(lut * 255)).max() < 1e-4  # tables from an 8-bit engine lose nothing
    levels, dtype = (255, np.uint8) if in_8_bits else (65535, np.uint16)
    gamut = np.round(printer.gamut.double().numpy() * GAMUT_STEPS).clip(0, 255).astype(np.uint8)
    np.savez_compressed(tables := io.BytesIO(), lut=np.round(lut * levels).astype(dtype), gamut=gamut)
    head = PrinterHead(name=printer.name, method=printer.method, paper=printer.paper, provenance=printer.provenance)
    text = json.dumps(head.model_dump(), indent=1, ensure_ascii=False) + "\n"
    return {path: tables.getvalue(), path.with_suffix(".json"): text.encode()}


def printer_of_files(stored: bytes, description: Any, path: str | Path) -> Printer:
    """Make a printer of what its two files hold; `path` names them in a refusal."""
    head = validate_model(PrinterHead, description, str(path))
    try:
        with zipfile.ZipFile(io.BytesIO(stored)) as archive:
            lut = _array(archive, "lut", (SIZE, SIZE, SIZE, 3), (np.uint8, np.uint16))
            gamut = _array(archive, "gamut", (SIZE, SIZE, SIZE), (np.uint8,))
    except Exception as error:  # zip, deflate, LZMA and NumPy's header: each fails in its own way
        reason = " ".join(str(error).split()).rstrip(".")[:100]
        raise Refused("a printer's tables", f"{path} that cannot be read ({reason})", "calibrate again") from error
    lut_srgb = torch.tensor(lut / np.iinfo(lut.dtype).max, dtype=torch.float32)
    distances = torch.tensor(gamut / GAMUT_STEPS, dtype=torch.float32)
    return Printer(head.name, head.method, lut_srgb, distances, head.paper, head.provenance)


def carried_printer(path: Path) -> dict[str, Any]:
    """Return both files of a printer as JSON values: a sheet carries one without a name, since it may lie anywhere."""
    tables, head = printer_files(path)
    return {"npz": base64.b64encode(tables).decode(), "head": head}


def printer_of_sheet(carried: Mapping[str, Any], source: str | Path) -> Printer:
    """Return a printer from what `carried_printer` made of it; `source` names the sheet in a refusal."""
    try:
        tables = base64.b64decode(carried["npz"], validate=True)
    except ValueError as error:
        raise Refused("a printer's tables in base64", f"{source} with other text", "make the sheet again") from error
    return printer_of_files(tables, carried["head"], source)


def _array(archive: zipfile.ZipFile, name: str, shape: tuple[int, ...], kinds: tuple[type, ...]) -> np.ndarray:
    """Read an array of an .npz, which must have one shape and type: no more bytes than these are unpacked."""
    with archive.open(f"{name}.npy") as member:
        if np.lib.format.read_magic(member) != (1, 0):
            raise ValueError(f"{name} in an unknown .npy format")
        stored, by_columns, kind = np.lib.format.read_array_header_1_0(member)
        if stored != shape or by_columns or kind not in kinds:
            raise ValueError(f"the table {name} is {stored} {kind}")
        content = member.read(math.prod(shape) * kind.itemsize + 1)
    return np.frombuffer(content, kind).reshape(shape)  # raises for any other length


def _bordered(table: Tensor) -> Tensor:
    """Return 1×C×35×35×35: the table with one layer of linear continuation on all sides, because grid_sample's gradient
    is zero on the outermost nodes: pure black or white pixels would never move again.
    """
    bordered = np.pad(table.numpy(), [(1, 1)] * 3 + [(0, 0)], mode="reflect", reflect_type="odd")
    return torch.from_numpy(bordered).permute(3, 0, 1, 2)[None].contiguous()


@lru_cache(maxsize=8)
def _moved(table: Tensor, device: torch.device, dtype: torch.dtype) -> Tensor:
    return table.to(device, dtype)  # half a megabyte, not sent with every step


def _look_up(table: Tensor, srgb: Tensor) -> Tensor:
    colors = srgb if srgb.dtype == torch.float64 else srgb.float()  # half precision cannot address 33 nodes finely
    unit = clamp_to_unit(colors)
    # nodes are 8 levels apart, the last two 7; the table and its border reach from -1 to 1, white lies at `end`
    (slope, last), end = (2 * 255 / (step * (SIZE + 1)) for step in (8, 7)), (SIZE - 1) / (SIZE + 1)
    place = torch.where(unit <= 248 / 255, unit * slope - end, unit * last + (end - last))
    grid = place.movedim(1, -1).flip(-1)  # grid_sample wants (x, y, z) = (b, g, r)
    sample, table = torch.nn.functional.grid_sample, _moved(table, colors.device, colors.dtype)
    values = sample(table, grid[None], mode="bilinear", padding_mode="border", align_corners=True)
    return values.squeeze(0).movedim(0, 1).to(srgb.dtype)
