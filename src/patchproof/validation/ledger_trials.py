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
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from patchproof.claims import rate
from patchproof.color import linear_from_srgb, srgb_from_linear
from patchproof.geometry import local_scale
from patchproof.report.tables import Table
from patchproof.scene.conditions import with_values
from patchproof.strict import Strict
from patchproof.study.study import Cell, Result, Study

STEP = {"print": "print", "blur": "blur_and_noise", "cast": "light_and_camera", "dim": "light_and_camera"}
LEAST_COST = 0.10  # of confidence
_TRIES = 3  # troubles drawn for a trial until one costs enough
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
    """A run's sheet, ready to be photographed: `pixels` of the PDF's piece, 1×3×H×W sRGB."""

    scene: Any
    stage: Any
    manifest: Any
    model: Any
    indices: tuple[int, ...]
    pixels: Any
    photo_px: tuple[int, int]
    printer: Any

    @property
    def sign(self) -> float:
        return self.manifest.promise.target.goal.sign

    def module_px(self, conditions) -> float:
        """A marker's module in the middle one of the views, in pixels of a photograph of the scene's own size."""
        scene, middle = self.scene, np.array(self.scene.piece.size_mm) / 2
        views = scene.piece_homographies(conditions, scene.settings.camera.photo_px)
        return scene.piece.module_mm * float(np.median([local_scale(view, middle)[0] for view in views]))

    def piece(self, printed: Callable[[Any], Any]):
        """The piece as it was printed, sRGB 1×3×H×W to the same."""
        from patchproof.render.pixels import PiecePicture

        srgb = printed(self.pixels)[0].permute(1, 2, 0)
        whole = (0, 0, srgb.shape[1], srgb.shape[0])
        return PiecePicture(srgb, whole, whole)

    def views(self, conditions) -> list[Any]:
        """What is rasterized once for all that is done to print, light and camera."""
        from patchproof.render.views import see

        piece, each = self.piece(self.printer.apply), range(len(conditions))
        return [see(self.stage, piece, conditions[i : i + 1], self.photo_px) for i in each]

    def take(self, views, conditions, printed: Callable[[Any], Any] | None = None) -> list[bytes]:
        """A JPEG file for each condition of the piece as `printed` shows it (by default as promised)."""
        import torch
        from PIL import Image

        from patchproof.render.photograph import expose

        piece, photos = self.piece(printed or self.printer.apply), []
        for i, view in enumerate(views):
            one = conditions[i : i + 1]
            with torch.no_grad():
                picture = expose(replace(view, conditions=one), piece, jpeg=False)
            codes = (picture[0].permute(1, 2, 0).numpy().clip(0, 1) * 255 + 0.5).astype(np.uint8)
            buffer = BytesIO()
            Image.fromarray(codes).save(buffer, "JPEG", quality=int(one.jpeg[0]))
            photos.append(buffer.getvalue())
        return photos

    def confidence(self, photos: Sequence[bytes]) -> np.ndarray:
        """Target confidence of each photograph's centered square."""
        import torch
        from PIL import Image

        from patchproof.classifier import center_square

        found = []
        for photo in photos:
            srgb = np.asarray(Image.open(BytesIO(photo)).convert("RGB")) / np.float32(255)
            square = center_square(torch.from_numpy(srgb.transpose(2, 0, 1))[None], self.model.input_px)
            with torch.inference_mode():
                found.append(float(self.model.confidence(self.model.logits(square), self.indices)[0]))
        return np.array(found)

    def judged(self, photos: Sequence[bytes], loss: np.ndarray) -> dict[str, Any]:
        """What `verify` makes of the photographs, each of which lost so much."""
        from patchproof.evidence.ledger import LEAST_PHOTOS, usable
        from patchproof.evidence.run import gather_evidence
        from patchproof.evidence.task import Options

        with TemporaryDirectory() as folder:
            for i, photo in enumerate(photos):
                (Path(folder) / f"{i:03d}.jpg").write_bytes(photo)
            evidence = gather_evidence(folder, self.manifest, Options([self.model], self.printer))
        report, ledger = evidence.report, evidence.ledger
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
    import torch

    from patchproof.channel.printer import load_printer
    from patchproof.classifier.load import load_classifier
    from patchproof.evidence.classify import target_indices
    from patchproof.optimizer.run import load_run
    from patchproof.printing.sheet import sheet_of
    from patchproof.render.stage import set_stage
    from patchproof.reprints.reprint import DPI_RANGE, OVERSAMPLING
    from patchproof.sheets.raster import piece_pixels

    made = load_run(folder)
    scene, own_px = made.scene, made.scene.settings.camera.photo_px
    size = photo_px or own_px
    with TemporaryDirectory() as temporary:
        pdf = Path(temporary) / "sheet.pdf"
        manifest = sheet_of(made, pdf)
        dpi = float(np.clip(OVERSAMPLING * scene.closest_px_per_mm(size) * 25.4, *DPI_RANGE))
        pixels = torch.tensor(piece_pixels(pdf, manifest, dpi)).permute(2, 0, 1)[None] / 255
    manifest = _at_size(manifest, size, own_px)
    model = load_classifier(manifest.promise.models[0].name, scene.base)
    return _Hall(
        scene,
        set_stage(scene),
        manifest,
        model,
        target_indices(model, manifest.promise, manifest.settings),
        pixels,
        size,
        load_printer(scene.settings.printer.profile, scene.base),
    )


def _at_size(manifest, photo_px: tuple[int, int], own_px: tuple[int, int]):
    """The manifest as of a camera whose photographs are of another size."""
    scale = min(photo_px) / min(own_px)
    conditions = tuple(
        one.model_copy(
            update={k: None if (v := getattr(one, k)) is None else v * scale for k in ("px_per_mm", "blur_px")}
        )
        for one in manifest.promise.conditions
    )
    camera = manifest.settings["camera"] | {"photo_px": photo_px}
    promise = manifest.promise.model_copy(update={"conditions": conditions})
    return manifest.model_copy(update={"promise": promise, "settings": manifest.settings | {"camera": camera}})


def _trouble(kind: str, rng: np.random.Generator, conditions, hall: _Hall):
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


def _wrong_printer(rng: np.random.Generator, hall: _Hall):
    """A name, and a function from sRGB tensors 1×3×H×W as sent to what is seen."""
    import torch

    from patchproof.channel.printer import load_printer
    from patchproof.reprints.inkjets import draw_inkjet

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
        name, light = f"faded {kept.round(2)}", lambda srgb: _faded(hall.printer, kept, srgb)

    def printed(pixels):
        seen = light(pixels[0].permute(1, 2, 0).double().numpy())
        return torch.from_numpy(srgb_from_linear(seen.clip(0, 1))).permute(2, 0, 1)[None].to(pixels)

    return name, printed


def _faded(printer, kept: np.ndarray, srgb: np.ndarray) -> np.ndarray:
    """Light of a print whose dyes keep these shares of their density; what is neutral is black ink and stays."""
    import torch

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


def figures(settings: LedgerSettings, results: Sequence[Result]) -> tuple[()]:
    """None: the tables say it."""
    return ()


STUDY = Study("ledger", LedgerSettings, cells, run, tables, figures)
