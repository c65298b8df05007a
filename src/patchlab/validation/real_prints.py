"""Hold default conditions and their promises against colors that real printers and cameras made.

In: cells of known color in photographs of prints (sRGB sent, light over white paper; an NPZ with `photographs.csv`
beside it, which names print and place), and scenes with networks. Out: for each photograph the distance to the default
printer in the best of its conditions, the share of cells within what the conditions can make, and how far cells lie off
a smooth map of colors (what `printer.mottle` is of); for each scene and network, promises beside sessions of twins: the
same design under the scene's views in the colors of one photograph; and verify's print fit beside those colors.

With `left_out` the default printer is made again without the photographs of a place, or of a print, that it is held
against: for photographs that it was made from. `former` are the conditions that promises are compared with. Left out on
purpose: blur and light that changes over a print, which lie within the default ranges.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field

from patchlab.study.estimates import mean, median
from patchlab.study.grid import GridSettings, PositiveInt, cell_key, grid_cells, network_names, scene_of
from patchlab.study.study import Cell, Result, Study
from patchlab.study.trained_designs import best_design
from patchlab.validation.known_colors import KnownColors, fit_photo, fit_printer
from patchlab.validation.twins import Cells, Twin, load_cells
from patchproof.base.color import ciede2000, lab_from_linear, lift_tone, linear_from_srgb, srgb_from_linear
from patchproof.base.intervals import Estimate
from patchproof.base.output import write_files_atomically
from patchproof.base.sessions import count_by_session, rate_posterior
from patchproof.base.settings import CameraSettings, PrinterSettings, SceneSettings
from patchproof.base.validation import expand_path
from patchproof.channel.effects import EFFECT_BY_NAME, Print
from patchproof.channel.print_colors import ShownColors, add_ink, added_terms, choose_cells, fit_ink_and_photos
from patchproof.channel.printer import (
    Printer,
    identity_printer,
    load_printer,
    print_change,
    printer_contents,
    printer_output,
    vary_print,
)
from patchproof.evidence.surface import cell_means
from patchproof.optimizer.patch import Patch
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.promise import VIEWS_PER_SESSION
from patchproof.optimizer.subject import from_pixels
from patchproof.render.photograph import expose
from patchproof.render.pixels import PiecePicture
from patchproof.report.tables import Table
from patchproof.scene.conditions import Conditions
from patchproof.scene.interface import Scene

Tables = Mapping[str, Mapping[str, Any]]
FORMER: Tables = {
    "printer": {"profile": "coated", "chroma": (0, 0), "veil": (0, 0.004), "mottle": (0, 0)},
    "camera": {"tone": (0, 0)},
}
"""Default conditions before real prints were measured; black that differed by ±0.004 is a veil of at most that."""
_STILL: Tables = {
    "printer": dict.fromkeys(("dot_gain", "density", "chroma", "veil", "mottle"), (0, 0)),
    "camera": {"tone": (0, 0)},
}
_CHUNK = 4  # views rendered at a time
_BASE = "coated"  # the printer that an ink is told apart from
_FIT_CELLS, _FIT_VIEWS = 48, 24  # of the design's sides for a print fit, which photographs resolve; that it is seen in
_FITS = ("print fit", "quadratic", "default printer")


class RealPrintsSettings(GridSettings):
    """Cells of known color, and scenes whose promises are held against twins of their photographs."""

    scenes: tuple[str, ...] = ()  # scene files; without them, colors only
    cells: str = "${PATCHPROOF_DATA}/real_prints/cells.npz"  # NPZ with photographs.csv beside it
    left_out: Literal["nothing", "place", "print"] = "nothing"  # of the default printer, for what it is held against
    draws: Annotated[int, Field(ge=20)] = 150  # of the conditions, for what they can make
    per_photo: Annotated[int, Field(ge=20)] = 350  # cells of each photograph that inks and conditions are held against
    views: Annotated[int, Field(ge=2 * VIEWS_PER_SESSION)] = 200  # of a promise
    sessions: PositiveInt = 2  # of each twin
    photos: PositiveInt = 10  # of each session


def cells(settings: RealPrintsSettings, base: Path) -> list[Cell]:
    """A cell for the colors, and one for each scene and network."""
    load_cells(Path(path := expand_path(settings.cells, base)))  # refused before any work
    return [Cell("colors", {"cells": path}), *(grid_cells(settings, base) if settings.scenes else [])]


def run(settings: RealPrintsSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Hold the default conditions against colors, or a scene's promises against twins."""
    every = load_cells(Path(expand_path(settings.cells, base)))
    if cell.name == "colors":
        return {"photographs": list(_colors(settings, every))}
    return _hold_promises(settings, base, cell, every)


def _some(settings: RealPrintsSettings, known: KnownColors) -> KnownColors:
    """As many cells of each photograph, at random."""
    rng = np.random.default_rng(0)
    rows = [np.flatnonzero(known.photo == photo) for photo in np.unique(known.photo)]
    keep = np.concatenate([rng.choice(each, min(settings.per_photo, len(each)), False) for each in rows])
    return KnownColors(known.code[keep], known.light[keep], known.photo[keep])


def _printers(settings: RealPrintsSettings, every: Cells) -> dict[str, tuple[Printer, list[int]]]:
    """By group of photographs, the default printer made without them, and the group's photographs."""
    groups, some = every.groups(settings.left_out), _some(settings, every.known)
    found = {}
    for group in dict.fromkeys(groups):
        held = [i for i, name in enumerate(groups) if name == group]
        if settings.left_out == "nothing":
            printer = load_printer(PrinterSettings().profile)
        else:
            printer = fit_printer(some.of(np.setdiff1d(np.unique(some.photo), held)), load_printer(_BASE))
        found[group] = printer, held
    return found


def _colors(settings: RealPrintsSettings, every: Cells) -> Iterator[dict[str, Any]]:
    """Of each photograph: ΔE00 of its median cell in the best conditions, share of cells within what they can make."""
    some, twins = _some(settings, every.known), every.twins
    for printer, held in _printers(settings, every).values():
        for photo in held:
            seen = some.of(np.array([photo]))
            best = fit_photo(seen, printer)
            distance = ciede2000(lab_from_linear(np.clip(best, 0, 1)), lab_from_linear(seen.light))
            light = linear_from_srgb(printer_output(printer, seen.code / 255))
            yield {
                "place": every.places[photo],
                "print": every.prints[photo],
                "distance": float(np.median(distance)),
                "within": _share_within(torch.as_tensor(light), seen.light, settings.draws),
                "scatter": float(np.sqrt((twins[photo].left ** 2).mean())),
            }


def _share_within(light: torch.Tensor, seen: np.ndarray, draws: int) -> float:
    """The share of cells whose three channels lie between the least and the most that default conditions make."""
    defaults = SceneSettings.model_construct(printer=PrinterSettings(), camera=CameraSettings())
    rng, drawn = np.random.default_rng(1), dict[str, np.ndarray]()
    for effect in map(EFFECT_BY_NAME.__getitem__, ("dot gain", "ink density", "chroma", "veil", "tone")):
        drawn |= effect.sample(defaults, rng.random((draws, len(effect.columns))), np.arange(draws))
    tone = torch.as_tensor(drawn.pop("tone"))
    made = vary_print(light, torch.as_tensor(print_change(Print(**drawn)))[:, None])
    shown = lift_tone(srgb_from_linear(made), tone[:, None]).numpy()
    codes = srgb_from_linear(seen)
    return float(((codes >= shown.min(0) - 1e-3) & (codes <= shown.max(0) + 1e-3)).all(1).mean())


def _piece(srgb: np.ndarray) -> PiecePicture:
    return PiecePicture.of(torch.tensor(np.clip(srgb, 0, 1), dtype=torch.float32))


def _hold_promises(settings: RealPrintsSettings, base: Path, cell: Cell, every: Cells) -> dict[str, Any]:
    """Promises by former and by default conditions beside twins, for a design by each: effects, hits by session."""
    scene, names = scene_of(base, cell.values), network_names(base, cell.values)
    answers: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as temporary:
        ways = {"default": {}, "without mottle": {"mottle": (0, 0)}}
        conditions = {"former": [(_problem(scene, names, FORMER), list(range(len(every.places))))]}
        printers = _printers(settings, every).values()
        for i, (printer, held) in enumerate(printers):
            file = Path(temporary, f"printer{i}.npz")
            write_files_atomically(printer_contents(replace(printer, name=file.stem), file))
            for way, changed in ways.items():
                problem = _problem(scene, names, {"printer": {"profile": str(file), **changed}})
                conditions.setdefault(way, []).append((problem, held))
        still, twins = _problem(scene, names, _STILL), every.twins
        plain = Patch(still.patch.scene, identity_printer(), still.patch.design_px, still.device)
        designs = {
            by: best_design(_problem(scene, names, tables)) for by, tables in (("former", FORMER), ("default", {}))
        }
        pieces = {
            by: [plain.appearance(from_pixels(each)).srgb.numpy() for each in (pixels, np.full_like(pixels, 128))]
            for by, pixels in designs.items()
        }
        for by, pixels in designs.items():
            promised = {
                way: [(held, _promise(settings, problem, pixels)) for problem, held in each]
                for way, each in conditions.items()
                if by == "former" or way == "default"
            }
            answers[by] = {"promised": promised, "twins": _twins(settings, still, pieces[by], twins)}
    fits = sorted(_print_fits(still, pieces["default"][0].astype(float), every.places, twins, printers))
    return answers | {"places": every.places, "print fits": [fit for _, fit in fits]}


def _problem(scene: Scene, names: Sequence[str], tables: Tables) -> Problem:
    return set_problem(replace(scene, settings=scene.settings.changed(**tables)), models=names)


def _promise(settings: RealPrintsSettings, problem: Problem, pixels: np.ndarray) -> dict[str, Any]:
    """The effect beside gray on the target's logit, and the numbers recognized in each session."""
    conditions = problem.scene.draw("promise", settings.views, per_session=VIEWS_PER_SESSION)
    shown = [problem.patch.appearance(from_pixels(each)) for each in (pixels, np.full_like(pixels, 128))]
    (own, gray), hits = _logits(problem, shown, conditions)
    return {"effect": own - gray, "sessions": count_by_session(hits, VIEWS_PER_SESSION)}


def _twins(
    settings: RealPrintsSettings, problem: Problem, sent: Sequence[np.ndarray], twins: Sequence[Twin]
) -> list[dict[str, Any]]:
    """The effect of the first of two pieces and the numbers recognized in sessions of each twin."""
    found = []
    for number, twin in enumerate(twins):
        n = settings.sessions * settings.photos
        views = problem.scene.draw("reprint", (number + 1) * n, per_session=settings.photos)[number * n :]
        shown = [_piece(twin.show(each, np.random.default_rng(number))) for each in sent]
        (own, gray), hits = _logits(problem, shown, views)
        found.append({"effect": own - gray, "sessions": count_by_session(hits, settings.photos)})
    return found


def _print_fits(
    problem: Problem,
    sent: np.ndarray,
    places: Sequence[str],
    twins: Sequence[Twin],
    printers: Iterable[tuple[Printer, Sequence[int]]],
) -> Iterator[tuple[int, list[float]]]:
    """Each twin's number, and how far the logit of the piece H×W×3 lies above that in the twin's colors: in verify's
    print fit to all photographs of a place, in a quadratic of the photograph's own, as the printer makes it.
    """
    views = problem.scene.draw("reprint", _FIT_VIEWS)
    means = lambda maps: cell_means(np.moveaxis(maps, -1, 0), (_FIT_CELLS, _FIT_CELLS), 0.0)  # noqa: E731
    sent_cells = means(sent).reshape(-1, 3)
    for printer, held in printers:
        light = linear_from_srgb(printer_output(printer, sent.reshape(-1, 3))).reshape(sent.shape)
        promised = means(np.dstack([light, np.moveaxis(added_terms(light), 0, -1)]))
        for place in {places[i] for i in held}:
            photos = [i for i in held if places[i] == place]
            seen = [means(linear_from_srgb(twins[i].show(sent, np.random.default_rng(i)))) for i in photos]
            chosen = [choose_cells(each, promised, np.ones(3), np.zeros(3), None) for each in seen]
            ink, terms = fit_ink_and_photos(chosen)
            printed = add_ink(light, ink)
            for i, cells, of_photo in zip(photos, seen, terms, strict=True):
                fitted = srgb_from_linear(np.clip(ShownColors.of_terms(of_photo).show(printed), 0, 1))
                quadratic = Twin.of(sent_cells, srgb_from_linear(cells).reshape(-1, 3), 2).colors(sent)
                shown = twins[i].colors(sent), fitted, quadratic, srgb_from_linear(light)
                (true, *made), _ = _logits(problem, [_piece(each) for each in shown], views)
                yield i, [each - true for each in made]


@torch.no_grad()
def _logits(problem: Problem, shown: Sequence[PiecePicture], conditions: Conditions) -> tuple[list[float], list[bool]]:
    """Each picture's mean logit of the target, and where the first is recognized."""
    classifier, indices, logits, hits = problem.classifiers[0], list(problem.indices[0]), [[] for _ in shown], []
    for first in range(0, len(conditions), _CHUNK):
        views = problem.see(shown[0], conditions[first : first + _CHUNK], problem.figure_px)
        for i, picture in enumerate(shown):
            answer = classifier.logits(expose(views, picture), None)
            logits[i] += answer[:, indices].max(1).values.tolist()
            if i == 0:
                hits += classifier.recognized(answer, indices).tolist()
    return [float(np.mean(each)) for each in logits], hits


def tables(settings: RealPrintsSettings, results: Sequence[Result]) -> tuple[Table, ...]:
    """Colors by photograph; promises beside twins, by scene and network; designs on twins."""
    colors = [each for result in results for each in result.answers.get("photographs", ())]
    pairs = [result for result in results if "photographs" not in result.answers]
    return (
        *_color_tables(settings, colors),
        *((_promise_table(pairs), _place_table(pairs), _design_table(pairs), _fit_table(pairs)) if pairs else ()),
    )


def _color_tables(settings: RealPrintsSettings, photos: Sequence[Mapping[str, Any]]) -> Iterator[Table]:
    about = f"{len(photos)} photographs; left out of the default printer: {settings.left_out}"
    head = ("photographs", "ΔE00 in the best conditions", "cells within the conditions", "rms about a cubic, in sRGB")
    groups = {"all": list(photos)}
    for key in ("place", "print"):
        for photo in photos:
            groups.setdefault(f"{key} {photo[key]}", []).append(photo)
    rows = [
        (name, *((median if len(some) > 1 else min)([p[k] for p in some]) for k in ("distance", "within", "scatter")))
        for name, some in groups.items()
    ]
    yield Table("colors", "Colors of the median photograph", head, tuple(rows), about)


def _mean(values: Sequence[float]) -> Estimate | float:
    """The mean; a single value has no interval."""
    return mean(values) or values[0]


def _rate(answer: Mapping[str, Any]) -> float:
    hits, photos = map(sum, answer["sessions"])
    return hits / photos


def _of_twins(
    promised: Sequence[tuple[list[int], Mapping[str, Any]]], twins: Sequence[Mapping[str, Any]]
) -> list[tuple[float, float, float]]:
    """Of each twin: bias of the effect as a share of the twins' mean, bias of the rate, share of sessions inside."""
    rows, size = [], abs(np.mean([twin["effect"] for twin in twins]))
    for held, promise in promised:
        posterior = rate_posterior(*promise["sessions"])
        for twin in (twins[i] for i in held):
            seen = list(zip(*twin["sessions"], strict=True))
            inside = [low <= k <= high for k, n in seen for low, high in [posterior.count_interval((n,))]]
            effect_bias = (promise["effect"] - twin["effect"]) / float(size)
            rows.append((effect_bias, _rate(promise) - _rate(twin), float(np.mean(inside))))
    return rows


def _promise_table(pairs: Sequence[Result]) -> Table:
    head = ("scene", "network", "seed", "conditions", "promised", "on twins", "bias of the effect", "bias of the rate")
    rows = []
    for result in pairs:
        answers = result.answers["former"]
        on_twins = [_rate(twin) for twin in answers["twins"]]
        for way, promised in answers["promised"].items():
            effect, bias, inside = zip(*_of_twins(promised, answers["twins"]), strict=True)
            promised_rate = float(np.mean([_rate(each) for _, each in promised]))
            figures = promised_rate, *map(_mean, (on_twins, effect, bias, inside))
            rows.append((*cell_key(result), way, *figures))
    about = "the design by former conditions; shares of the twins' mean effect; twins of one print and place are alike"
    return Table("promises", "Promises beside twins", (*head, "sessions inside"), tuple(rows), about)


def _place_table(pairs: Sequence[Result]) -> Table:
    by_group: dict[tuple[str, str], list[np.ndarray]] = {}
    for result in pairs:
        for way, promised in result.answers["former"]["promised"].items():
            biases = np.array(_of_twins(promised, result.answers["former"]["twins"]))
            places = np.array([result.answers["places"][i] for held, _ in promised for i in held])
            for place in ("all", *sorted(set(places))):
                of_place = biases[(places == place) | (place == "all")].mean(0)
                by_group.setdefault((way, place), []).append(of_place)
    rows = [(*group, *map(_mean, zip(*each, strict=True))) for group, each in by_group.items()]
    head = ("conditions", "twins of", "bias of the effect", "bias of the rate", "sessions inside")
    return Table("places", "Promises beside twins by place", head, tuple(rows), "means over scenes and seeds")


def _design_table(pairs: Sequence[Result]) -> Table:
    rows = []
    for result in pairs:
        former, default = ([_rate(twin) for twin in result.answers[by]["twins"]] for by in ("former", "default"))
        gains = [new - old for new, old in zip(default, former, strict=True)]
        rows.append((*cell_key(result), *map(_mean, (former, default, gains))))
    head = ("scene", "network", "seed", "by former conditions", "by default conditions", "gain")
    return Table("designs", "Designs on twins", head, tuple(rows), "each twin counts as one; rates")


def _fit_table(pairs: Sequence[Result]) -> Table:
    rows = []
    for result in pairs:
        off, places = np.array(result.answers["print fits"]), np.array(result.answers["places"])
        for place in ("all", *sorted(set(places))):
            some = off[(places == place) | (place == "all")]
            rows.append((*cell_key(result), place, *map(_mean, some.T.tolist()), *np.sqrt((some**2).mean(0)).tolist()))
    head = ("scene", "network", "seed", "twins of", *_FITS, *(f"{name}, rms" for name in _FITS))
    about = (
        f"the default design's logit over that in a twin's colors; {_FIT_CELLS} × {_FIT_CELLS} cells of each photograph"
    )
    return Table("fits", "Print fits beside twins", head, tuple(rows), about)


STUDY = Study("real-prints", RealPrintsSettings, cells, run, tables)
