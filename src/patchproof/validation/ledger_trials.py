"""Whether the gap ledger names a known culprit in simulated photographs.

They have one known trouble each, and stand beside the same ones without it.
In: finished runs. Out: for each trial the culprit that was put in and the one that `verify` named; rates with Wilson
intervals and the table of confusions. A trial draws views of the reprint stream and one trouble: another printer, blur,
a color cast or dim light. Only troubles that cost at least 10 points of confidence, in the photographs that the ledger
can use, are a question; weaker ones are counted apart, and so are those that leave too few such photographs. Wrong
printers are inkjets from `inkjets`, the other ICC profile, and dyes that faded.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from patchproof.channel.printer import Printer, load_printer
from patchproof.claims import rate
from patchproof.classifier import center_square
from patchproof.classifier.load import load_classifier
from patchproof.classifier.network import Classifier
from patchproof.color import linear_from_srgb, srgb_from_linear
from patchproof.evidence.classify import target_indices
from patchproof.evidence.ledger import LEAST_PHOTOS, usable
from patchproof.evidence.run import gather_evidence
from patchproof.evidence.task import Options
from patchproof.optimizer.run import load_run
from patchproof.output import image_pixels
from patchproof.render.photograph import expose
from patchproof.render.views import Views, see
from patchproof.report.tables import Table
from patchproof.reprints.hung_sheet import HungSheet, hang_own, jpeg_of
from patchproof.reprints.inkjets import draw_inkjet
from patchproof.scene.conditions import Conditions, with_values
from patchproof.scene.scene import PieceScene
from patchproof.sheets.manifest import Manifest, Promise
from patchproof.strict import Strict
from patchproof.study.study import Cell, Result, Study

STEP = {"print": "print", "blur": "blur_and_noise", "cast": "light_and_camera", "dim": "light_and_camera"}
LEAST_COST = 0.10  # of confidence
_TRIES = 3  # troubles drawn for a trial until one costs enough
Printed = Callable[[Tensor], Tensor]  # sRGB as sent, 1×3×H×W, to what is seen
_FADED = 0.2  # of the density that dyes may keep


class LedgerSettings(Strict):
    """Whose designs are photographed, and how often."""

    runs: Annotated[tuple[str, ...], Field(min_length=1)]  # folders of finished runs
    trials: Annotated[int, Field(ge=1, le=10_000)] = 60  # over all runs
    photos: Annotated[int, Field(ge=5, le=100)] = 12  # in each trial
    photo_px: tuple[int, int] | None = None  # their width, height; by default the scene's own, smaller is quicker
    seed: int = 0  # of everything that is drawn


def cells(settings: LedgerSettings, base: Path) -> list[Cell]:
    """Trials in turn of culprits, and of runs."""
    kinds, runs = list(STEP), settings.runs
    turns = [(i, kinds[i % len(kinds)], runs[i // len(kinds) % len(runs)]) for i in range(settings.trials)]
    return [Cell(f"trial_{i:04d}", {"number": i, "culprit": kind, "run": run}) for i, kind, run in turns]


def run(settings: LedgerSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """What was put in, what it cost and what the ledger says; `outcome` is asked, weak or unreadable."""
    hall = _hall(str(base / cell.values["run"]), settings.photo_px)
    number, n = cell.values["number"], settings.photos
    conditions = hall.scene.draw("reprint", n, settings.seed, number * n)
    views = hall.views(conditions)
    plain = hall.confidence(hall.take(views, conditions))
    rng = np.random.default_rng([settings.seed, number])
    found: dict[str, Any] = {}
    for _ in range(_TRIES):
        trouble, printer, changed = _trouble(cell.values["culprit"], rng, conditions, hall)
        photos = hall.take(views, changed, printer)
        loss = hall.sign * (plain - hall.confidence(photos))
        found = {"trouble": trouble, "outcome": "weak", "cost": float(loss.mean()), "photos": 0}
        if loss.mean() >= LEAST_COST:
            found |= hall.judged(photos, loss)
        if found["outcome"] == "asked":
            return found
    return found


@dataclass(frozen=True)
class _Hall:
    """A run's sheet, ready to be photographed, and its manifest as of photographs of `photo_px`."""

    sheet: HungSheet
    manifest: Manifest
    model: Classifier
    indices: tuple[int, ...]
    sign: int  # of what the patch should add to confidence
    photo_px: tuple[int, int]

    @property
    def scene(self) -> PieceScene:
        return self.sheet.scene

    def module_px(self, conditions: Conditions) -> float:
        """A marker's module in the middle one of the views, in pixels of a photograph of the scene's own size."""
        scales = self.scene.piece_scales(conditions, self.scene.photo_px)
        return self.scene.piece.module_mm * float(np.median(scales))

    def views(self, conditions: Conditions) -> list[Views]:
        """What is rasterized once for all that is done to print, light and camera."""
        each = range(len(conditions))
        return [see(self.sheet.stage, self.sheet.piece, conditions[i : i + 1], self.photo_px) for i in each]

    def take(self, views: Sequence[Views], conditions: Conditions, printed: Printed | None = None) -> list[bytes]:
        """A JPEG file for each condition of the piece as `printed` shows it (by default as promised)."""
        piece, photos = self.sheet.piece if printed is None else self.sheet.printed(printed), []
        for i, view in enumerate(views):
            seen = replace(view, conditions=conditions[i : i + 1])
            with torch.no_grad():
                photos.append(jpeg_of(expose(seen, piece, jpeg=False), seen.conditions))
        return photos

    def confidence(self, photos: Sequence[bytes]) -> np.ndarray:
        """Target confidence of each photograph's centered square."""
        found = []
        for photo in photos:
            srgb = image_pixels(photo) / np.float32(255)
            square = center_square(torch.from_numpy(srgb.transpose(2, 0, 1))[None], self.model.input_px)
            with torch.inference_mode():
                found.append(float(self.model.confidence(self.model.logits(square), self.indices)[0]))
        return np.array(found)

    def judged(self, photos: Sequence[bytes], loss: np.ndarray) -> dict[str, Any]:
        """What `verify` makes of the photographs, each of which lost so much."""
        with TemporaryDirectory() as folder:
            for i, photo in enumerate(photos):
                (Path(folder) / f"{i:03d}.jpg").write_bytes(photo)
            report = gather_evidence(folder, self.manifest, Options([self.model], self.sheet.printer))
        ledger = report.ledger
        used = np.array([usable(entry.status, entry.code) for entry in report.photos])
        codes = [entry.code or "fine" for entry in report.photos]
        found = {"codes": {code: codes.count(code) for code in sorted(set(codes))}}
        if ledger is None or ledger.photos < LEAST_PHOTOS:
            return found | {"outcome": "unreadable", "photos": 0 if ledger is None else ledger.photos}
        shares = {step: share.share for step, share in ledger.shares.items()}
        whole = self.sign * (ledger.ideal - ledger.photo)
        cost = float(loss[used].mean())
        return found | {
            "outcome": "asked" if cost >= LEAST_COST else "weak",
            "cost": cost,
            "photos": ledger.photos,
            "named": ledger.culprit,
            "shares": shares,
            "intervals": {step: share.interval for step, share in ledger.shares.items()},
            "sum_error": abs(sum(shares.values()) - whole),
        }


@lru_cache(maxsize=8)
def _hall(folder: str, photo_px: tuple[int, int] | None) -> _Hall:
    made = load_run(folder)
    sheet, own_px = hang_own(made, photo_px), made.scene.settings.camera.photo_px
    manifest = _at_size(sheet.manifest, made.promise, photo_px or own_px, own_px)
    model = load_classifier(made.promise.models[0].name, made.scene.base)
    return _Hall(
        sheet,
        manifest,
        model,
        target_indices(model, made.promise, manifest.settings),
        made.promise.target.goal.sign,
        photo_px or own_px,
    )


def _at_size(manifest: Manifest, promise: Promise, photo_px: tuple[int, int], own_px: tuple[int, int]) -> Manifest:
    """The manifest as of a camera whose photographs are of another size."""
    scale = min(photo_px) / min(own_px)
    conditions = tuple(
        one.changed(**{k: v * scale for k in ("px_per_mm", "blur_px") if (v := getattr(one, k)) is not None})
        for one in promise.conditions
    )
    settings = manifest.settings | {"camera": manifest.settings["camera"] | {"photo_px": photo_px}}
    return manifest.changed(promise={"conditions": conditions}, settings=settings)


def _trouble(
    kind: str, rng: np.random.Generator, conditions: Conditions, hall: _Hall
) -> tuple[str, Printed | None, Conditions]:
    """(what it is in words, the printer in place of the promise's or None, the conditions)."""
    if kind == "print":
        name, printer = _wrong_printer(rng, hall)
        return name, printer, conditions
    if kind == "blur":  # up to what still shows the cells of markers apart
        modules = rng.uniform(0.35, 0.55)
        return f"{modules:.2f} modules", None, with_values(conditions, blur_px=modules * hall.module_px(conditions))
    if kind == "cast":
        gains = np.exp(rng.uniform(-1.8, 0.2, 3))
        cast = with_values(conditions, white_balance=conditions.sensor.white_balance * gains)
        return f"gains {gains.round(2)}", None, cast
    stops = rng.uniform(2.0, 5.5)
    return f"{stops:.1f} stops", None, with_values(conditions, exposure_ev=conditions.sensor.exposure_ev - stops)


def _wrong_printer(rng: np.random.Generator, hall: _Hall) -> tuple[str, Printed]:
    """A name, and a function from sRGB tensors 1×3×H×W as sent to what is seen."""
    which = rng.random()
    if which < 0.2:
        other = "uncoated" if hall.scene.settings.printer.profile != "uncoated" else "coated"
        return other, load_printer(other).apply
    if which < 0.6:
        seed = int(rng.integers(1 << 30))
        inkjet = draw_inkjet(seed)
        name, light = f"inkjet {seed}", lambda srgb: inkjet(srgb)
    else:
        kept = rng.uniform(_FADED, 1, 3) if rng.random() < 0.5 else np.full(3, rng.uniform(_FADED, 0.5))
        name, light = f"faded {kept.round(2)}", lambda srgb: _faded(hall.sheet.printer, kept, srgb)

    def printed(pixels: Tensor) -> Tensor:
        seen = light(pixels[0].permute(1, 2, 0).double().numpy())
        return torch.from_numpy(srgb_from_linear(seen.clip(0, 1))).permute(2, 0, 1)[None].to(pixels)

    return name, printed


def _faded(printer: Printer, kept: np.ndarray, srgb: np.ndarray) -> np.ndarray:
    """Light of a print whose dyes keep these shares of their density; what is neutral is black ink and stays."""
    seen = printer.apply(torch.from_numpy(srgb).float().permute(2, 0, 1)[None])[0].permute(1, 2, 0).double().numpy()
    density = -np.log(np.clip(linear_from_srgb(seen), 1e-3, 1))
    black = density.min(-1, keepdims=True)
    return np.exp(-(black + (density - black) * kept))


def tables(settings: LedgerSettings, results: Sequence[Result]) -> Sequence[Table]:
    """Rates by culprit, confusions, and every trial."""
    asked = [one for one in results if one.answers["outcome"] == "asked"]
    return (_rates(results, asked), _confusions(asked), _trials(results))


def _rates(results: Sequence[Result], asked: Sequence[Result]) -> Table:
    rows = []
    for kind in (*STEP, None):
        mine = [one for one in asked if kind in (None, one.cell.values["culprit"])]
        outcomes = [one.answers["outcome"] for one in results if kind in (None, one.cell.values["culprit"])]
        hits = [one.answers["named"] == STEP[one.cell.values["culprit"]] for one in mine]
        rows.append((kind or "all", rate(hits), outcomes.count("weak"), outcomes.count("unreadable")))
    about = f"of trials that cost at least {LEAST_COST:.0%} of confidence; the shares' sum is the whole within "
    about += f"{max((one.answers['sum_error'] for one in asked), default=0):.0e}"
    return Table("rates", "Culprits named", ("culprit", "named", "cost less", "unreadable"), tuple(rows), about)


def _confusions(asked: Sequence[Result]) -> Table:
    names = ("print", "light_and_camera", "blur_and_noise", "print_light_and_camera", None)
    rows = tuple(
        (kind, *(sum(o.cell.values["culprit"] == kind and o.answers["named"] == n for o in asked) for n in names))
        for kind in STEP
    )
    return Table("confusions", "Put in and named", ("put in", *(n or "none" for n in names)), rows, "trials")


def _trials(results: Sequence[Result]) -> Table:
    head = ("trial", "run", "culprit", "trouble", "outcome", "cost", "photographs", "named", "shares")
    rows = []
    for one in results:
        values, found = one.cell.values, one.answers
        shares = "  ".join(f"{step} {share:+.2f}" for step, share in found.get("shares", {}).items())
        said = (found["trouble"], found["outcome"], found["cost"], found["photos"], found.get("named") or "–", shares)
        rows.append((values["number"], Path(values["run"]).name, values["culprit"], *said))
    return Table("trials", "Every trial", head, tuple(rows), "cost and shares in confidence")


STUDY = Study("ledger", LedgerSettings, cells, run, tables)
