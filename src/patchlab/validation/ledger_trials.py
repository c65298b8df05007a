"""Check that the gap ledger names a known culprit in simulated photographs.

Each trial adds one trouble to photographs and compares them with the same photographs without it.
In: finished runs. Out: for each trial the added culprit and the one that `verify` names; rates with Wilson
intervals, and a confusion table. A trial draws views of the reprint stream and one trouble: another printer, blur,
a color cast or dim light. Only troubles that cost at least 10 points of confidence, in photographs that the ledger can
use, count for the rates; weaker ones, and those that leave too few usable photographs, are counted separately. Wrong
printers are inkjets from `inkjets`, the other ICC profile, and faded dyes.
"""

from collections import Counter
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

from patchlab.study.study import Cell, Result, Study
from patchlab.validation.inkjets import draw_inkjet
from patchlab.validation.mounted_sheets import mount_run_sheet
from patchproof.base.color import linear_from_srgb, srgb_from_linear
from patchproof.base.intervals import rate
from patchproof.base.output import image_pixels
from patchproof.base.validation import StrictModel
from patchproof.channel.printer import Printer, load_printer
from patchproof.classifier.load import load_classifier
from patchproof.classifier.network import Classifier
from patchproof.evidence.batch import MEASURABLE_CODES
from patchproof.evidence.classify import target_indices
from patchproof.evidence.gather import gather_evidence
from patchproof.evidence.ledger import LEAST_PHOTOS
from patchproof.evidence.task import Options
from patchproof.optimizer.pixels import from_pixels
from patchproof.optimizer.run import load_run
from patchproof.render.photograph import expose
from patchproof.render.views import Views, render_views
from patchproof.report.tables import Table
from patchproof.reprints.mounted_sheet import MountedSheet, jpeg_of
from patchproof.scene.conditions import Conditions, with_values
from patchproof.scene.interface import PieceScene

STEP_OF_CULPRIT = {"print": "print", "blur": "blur_and_noise", "cast": "light_and_camera", "dim": "light_and_camera"}
MIN_COST = 0.10  # least loss of confidence that counts
_MAX_TRIES = 3  # troubles drawn per trial until one costs enough
TensorPrinter = Callable[[Tensor], Tensor]  # from sRGB sent, 1×3×H×W, to sRGB printed
_MIN_DYE_SHARE = 0.2  # least share of their density that dyes keep


class LedgerSettings(StrictModel):
    """Runs, trials and photographs."""

    runs: Annotated[tuple[str, ...], Field(min_length=1)]  # folders of finished runs
    trials: Annotated[int, Field(ge=1, le=10_000)] = 60  # trials over all runs
    photos: Annotated[int, Field(ge=5, le=100)] = 12  # photographs in each trial
    seed: int = 0  # seed of all draws


def cells(settings: LedgerSettings, base: Path) -> list[Cell]:
    """A cell per trial; culprits take turns, then runs."""
    kinds, runs = list(STEP_OF_CULPRIT), settings.runs
    turns = [(i, kinds[i % len(kinds)], runs[i // len(kinds) % len(runs)]) for i in range(settings.trials)]
    return [Cell(f"trial_{i:04d}", {"number": i, "culprit": kind, "run": run}) for i, kind, run in turns]


def run(settings: LedgerSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Add a trouble, and record its cost and the ledger's culprit; `outcome` is asked, weak or unreadable."""
    setup = _open_setup(str(base / cell.values["run"]))
    number, n = cell.values["number"], settings.photos
    conditions = setup.scene.draw("reprint", n, settings.seed, number * n)
    views = setup.views(conditions)
    plain = setup.confidence(setup.take(views, conditions))
    rng = np.random.default_rng([settings.seed, number])
    answers: dict[str, Any] = {}
    for _ in range(_MAX_TRIES):
        trouble, printer, changed = _draw_trouble(cell.values["culprit"], rng, conditions, setup)
        photos = setup.take(views, changed, printer)
        loss = setup.sign * (plain - setup.confidence(photos))
        answers = {"trouble": trouble, "outcome": "weak", "cost": float(loss.mean()), "photos": 0}
        if loss.mean() >= MIN_COST:
            answers |= setup.judge(photos, loss)
        if answers["outcome"] == "asked":
            break
    return answers


@dataclass(frozen=True)
class _PhotoSetup:
    """A run's mounted sheet, and the network and target that judge its photographs."""

    sheet: MountedSheet
    model: Classifier
    indices: tuple[int, ...]
    sign: int  # +1 if the patch should raise confidence, else -1

    @property
    def scene(self) -> PieceScene:
        return self.sheet.scene

    def module_px(self, conditions: Conditions) -> float:
        """A marker's module in pixels of a full photograph, median over views."""
        scales = self.scene.piece_scales(conditions, self.scene.photo_px)
        return self.scene.piece.module_mm * float(np.median(scales))

    def views(self, conditions: Conditions) -> list[Views]:
        """Render the views of conditions once; print, light and camera are changed later."""
        stage, piece, each = self.sheet.stage, self.sheet.piece, range(len(conditions))
        return [render_views(stage, piece, conditions[i : i + 1], self.scene.photo_px) for i in each]

    def take(self, views: Sequence[Views], conditions: Conditions, printed: TensorPrinter | None = None) -> list[bytes]:
        """Photograph the piece, printed by `printed` or by default as promised: a JPEG file for each condition."""
        piece, photos = self.sheet.piece if printed is None else self.sheet.printed(printed), []
        for i, view in enumerate(views):
            drawn = conditions[i : i + 1]
            with torch.no_grad():
                photos.append(jpeg_of(expose(replace(view, conditions=drawn), piece, jpeg=False), drawn))
        return photos

    def confidence(self, photos: Sequence[bytes]) -> np.ndarray:
        """The target's confidence in each photograph."""
        with torch.inference_mode():
            logits = [self.model.logits(from_pixels(image_pixels(photo))[None]) for photo in photos]
            return self.model.confidence(torch.cat(logits), self.indices).numpy()

    def judge(self, photos: Sequence[bytes], loss: np.ndarray) -> dict[str, Any]:
        """Run `verify` on photographs with these losses of confidence, and record its ledger."""
        with TemporaryDirectory() as folder:
            for i, photo in enumerate(photos):
                (Path(folder) / f"{i:03d}.jpg").write_bytes(photo)
            report = gather_evidence(folder, self.sheet.manifest, Options([self.model], self.sheet.printer))
        ledger = report.ledger
        used = np.array([entry.status != "rejected" and entry.code in MEASURABLE_CODES for entry in report.photos])
        if ledger is None or ledger.photos < LEAST_PHOTOS:
            return {"outcome": "unreadable", "photos": 0 if ledger is None else ledger.photos}
        shares = {step: share.share for step, share in ledger.shares.items()}
        gap = self.sign * (ledger.ideal - ledger.photo)
        cost = float(loss[used].mean())
        return {
            "outcome": "asked" if cost >= MIN_COST else "weak",
            "cost": cost,
            "photos": ledger.photos,
            "named": ledger.culprit,
            "shares": shares,
            "sum_error": abs(sum(shares.values()) - gap),
        }


@lru_cache(maxsize=8)
def _open_setup(folder: str) -> _PhotoSetup:
    made = load_run(folder, trust=True)
    sheet, promise = mount_run_sheet(made), made.promise
    model = load_classifier(promise.models[0].name, made.scene.base)
    return _PhotoSetup(sheet, model, target_indices(model, promise, sheet.manifest.settings), promise.target.goal.sign)


def _draw_trouble(
    kind: str, rng: np.random.Generator, conditions: Conditions, setup: _PhotoSetup
) -> tuple[str, TensorPrinter | None, Conditions]:
    """Draw a trouble: (description, printer in place of the promised one or None, conditions)."""
    if kind == "print":
        name, printer = _draw_wrong_printer(rng, setup)
        return name, printer, conditions
    if kind == "blur":  # up to where the cells of markers can still be told apart
        modules = rng.uniform(0.35, 0.55)
        return f"{modules:.2f} modules", None, with_values(conditions, blur_px=modules * setup.module_px(conditions))
    if kind == "cast":
        gains = np.exp(rng.uniform(-1.8, 0.2, 3))
        cast = with_values(conditions, white_balance=conditions.sensor.white_balance * gains)
        return f"gains {gains.round(2)}", None, cast
    stops = rng.uniform(2.0, 5.5)
    return f"{stops:.1f} stops", None, with_values(conditions, exposure_ev=conditions.sensor.exposure_ev - stops)


def _draw_wrong_printer(rng: np.random.Generator, setup: _PhotoSetup) -> tuple[str, TensorPrinter]:
    """Draw a wrong printer: (name, function from sRGB sent, 1×3×H×W, to sRGB printed)."""
    which = rng.random()
    if which < 0.2:
        other = "uncoated" if setup.scene.settings.printer.profile != "uncoated" else "coated"
        return other, load_printer(other).apply
    if which < 0.6:
        seed = int(rng.integers(1 << 30))
        inkjet = draw_inkjet(seed)
        name, light = f"inkjet {seed}", lambda srgb: inkjet(srgb)
    else:
        least = _MIN_DYE_SHARE
        shares = rng.uniform(least, 1, 3) if rng.random() < 0.5 else np.full(3, rng.uniform(least, 0.5))
        name, light = f"faded {shares.round(2)}", lambda srgb: _faded_light(setup.sheet.printer, shares, srgb)

    def printed(pixels: Tensor) -> Tensor:
        reflected = light(pixels[0].permute(1, 2, 0).double().numpy())
        return torch.from_numpy(srgb_from_linear(reflected.clip(0, 1))).permute(2, 0, 1)[None].to(pixels)

    return name, printed


def _faded_light(printer: Printer, shares: np.ndarray, srgb: np.ndarray) -> np.ndarray:
    """Light of a print whose dyes keep these shares of their density; its neutral part is black ink and stays."""
    shown = printer.apply(torch.from_numpy(srgb).float().permute(2, 0, 1)[None])[0].permute(1, 2, 0).double().numpy()
    density = -np.log(np.clip(linear_from_srgb(shown), 1e-3, 1))
    black = density.min(-1, keepdims=True)
    return np.exp(-(black + (density - black) * shares))


def tables(settings: LedgerSettings, results: Sequence[Result]) -> Sequence[Table]:
    """Tables of rates by culprit, of confusions, and of every trial."""
    counted = [trial for trial in results if trial.answers["outcome"] == "asked"]
    return (_rates(results, counted), _confusions(counted), _trials(results))


def _culprit(trial: Result) -> str:
    return trial.cell.values["culprit"]


def _rates(results: Sequence[Result], counted: Sequence[Result]) -> Table:
    rows = []
    for kind in (*STEP_OF_CULPRIT, None):
        of_kind = [trial for trial in counted if kind in (None, _culprit(trial))]
        outcomes = [trial.answers["outcome"] for trial in results if kind in (None, _culprit(trial))]
        hits = [trial.answers["named"] == STEP_OF_CULPRIT[_culprit(trial)] for trial in of_kind]
        rows.append((kind or "all", rate(hits), outcomes.count("weak"), outcomes.count("unreadable")))
    about = f"of trials that cost at least {MIN_COST:.0%} of confidence; the shares' sum is the whole within "
    about += f"{max((trial.answers['sum_error'] for trial in counted), default=0):.0e}"
    return Table("rates", "Culprits named", ("culprit", "named", "cost less", "unreadable"), tuple(rows), about)


def _confusions(counted: Sequence[Result]) -> Table:
    names = ("print", "light_and_camera", "blur_and_noise", "print_light_and_camera", None)
    counts = Counter((_culprit(trial), trial.answers["named"]) for trial in counted)
    rows = tuple((kind, *(counts[kind, name] for name in names)) for kind in STEP_OF_CULPRIT)
    return Table("confusions", "Put in and named", ("put in", *(n or "none" for n in names)), rows, "trials")


def _trials(results: Sequence[Result]) -> Table:
    head = ("trial", "run", "culprit", "trouble", "outcome", "cost", "photographs", "named", "shares")
    rows = []
    for trial in results:
        values, answers = trial.cell.values, trial.answers
        shares = "  ".join(f"{step} {share:+.2f}" for step, share in answers.get("shares", {}).items())
        measured = (*(answers[key] for key in ("trouble", "outcome", "cost", "photos")), answers.get("named") or "–")
        rows.append((values["number"], Path(values["run"]).name, values["culprit"], *measured, shares))
    return Table("trials", "Every trial", head, tuple(rows), "cost and shares in confidence")


STUDY = Study("ledger", LedgerSettings, cells, run, tables)
