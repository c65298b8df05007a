"""Photographs changed so that networks recognize them better, and what attacks leave of that.

In: images, a CSV of file names and labels, networks. Out: PNGs under the images' names at their own sizes, and tables:
accuracy clean and attacked, hardened beside original on the same photographs, per network, with 95 % intervals; how far
the images moved. What is judged are the 8-bit PNGs as a reader of the file gets them. A cell of the table where a
stronger attack leaves more than a weaker one is flagged: there the attack failed, not the network held.

`harden_images` is the command's one setting; the study `harden` varies networks, methods and ε, and then its PNGs lie
in `images/`. Originals are judged in cells of their own, once per network.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from PIL import Image
from pydantic import BeforeValidator, Field

from patchproof.claims import difference, rate
from patchproof.classifier.labels import find_labels
from patchproof.classifier.load import load_classifier
from patchproof.classifier.network import Classifier
from patchproof.harden.attacks import ATTACKS, right
from patchproof.harden.harden import Method, harden, moved, squares
from patchproof.harden.labeled import in_blocks, labeled_files, read_large_enough
from patchproof.output import write_whole
from patchproof.photo.cannot import CannotJudge
from patchproof.report.tables import Drawing, Table
from patchproof.strict import Positive, Refused, Share, Strict, expand
from patchproof.study.grid import short_name
from patchproof.study.study import Cell, Finished, Result, Study, carry_out

Attack = Literal["fgsm", "pgd"]
CLEAN = "clean"


def _epsilon(value: Any) -> float | None:
    """0.03, "0.03", "8/255" or "none"."""
    if value is None or value == "none":
        return None
    numerator, _, denominator = str(value).partition("/")
    try:
        epsilon = float(numerator) / float(denominator or 1)
    except (ValueError, ZeroDivisionError):
        raise ValueError('must be a number, such as 0.03 or "8/255", or "none"') from None
    if not 1 / 255 - 1e-9 <= epsilon <= 1:
        raise ValueError("must be from 1/255 to 1: 8-bit images cannot hold less")
    return epsilon


Epsilon = Annotated[float | None, BeforeValidator(_epsilon)]


class HardenSettings(Strict):
    """Every method with every ε, for each network alone or for all of them together."""

    images: str
    labels: str  # CSV: file name, label
    models: Annotated[tuple[str, ...], Field(min_length=1)]
    together: bool = False  # against the mean of the networks' losses
    judges: tuple[str, ...] = ()  # networks that only judge
    methods: Annotated[tuple[Method, ...], Field(min_length=1)] = ("pgd",)
    epsilons: Annotated[tuple[Epsilon, ...], Field(min_length=1)] = (8 / 255, 0.1, None)
    steps: Annotated[int, Field(ge=1)] = 100
    step_size: Positive | None = None
    attacks: tuple[Attack, ...] = ("fgsm", "pgd")
    attack_epsilons: tuple[Annotated[Share, Field(gt=0)], ...] = (0.01, 0.02, 0.04)


def harden_images(
    settings: HardenSettings,
    out: str | Path,
    *,
    resume: bool = False,
    overwrite: bool = False,
    jobs: int = 1,
    cluster: str | None = None,
    on_cell: Callable[[int, int], None] = lambda done, total: None,
) -> Finished:
    """Harden into the folder `out`: PNGs and labels.csv, which is again a labeled folder of images, and the tables."""
    out, base = Path(out), Path.cwd()
    if out.resolve() == Path(expand(settings.images, base)).resolve():
        raise Refused("another folder for hardened images than the originals'", str(out), "choose another --out")
    finished = carry_out(
        _study_in(out),
        settings,
        base,
        out,
        resume=resume,
        overwrite=overwrite,
        jobs=jobs,
        cluster=cluster,
        on_cell=on_cell,
    )
    lines = [f'{photo["png"]},"{photo["label"]}"\n' for photo in _photos(finished.results, _variants(settings)[0])]
    write_whole(out / "labels.csv", lambda path: path.write_text("file,label\n" + "".join(lines), "utf-8"))
    return finished


def cells(settings: HardenSettings, base: Path) -> list[Cell]:
    """Originals by network, and every variant, in blocks of photographs; networks and labels are checked here."""
    folder = Path(expand(settings.images, base))
    rows = labeled_files(folder, Path(expand(settings.labels, base)))
    indices = {}
    for name in dict.fromkeys((*settings.models, *settings.judges)):
        labels = _classifier(name, base).labels
        indices[name] = {label: find_labels(labels, _number(label))[0] for _, _, label in rows}
    variants, work = _variants(settings), []
    for number, block in enumerate(in_blocks(folder, rows)):
        photos = [{"file": file, "png": png, "label": label} for file, png, label in block]
        for at, name in enumerate(indices):
            values = {"photos": photos, "judges": [name], "indices": {name: _of(indices[name], photos)}}
            work.append(Cell(f"original{at + 1}_{number + 1:04d}", values))
        for at, variant in enumerate(variants):
            judges = list(dict.fromkeys((*variant["models"], *settings.judges)))
            values = {
                "photos": photos,
                "judges": judges,
                "indices": {name: _of(indices[name], photos) for name in judges},
                "variant": variant,
                "folder": "" if len(variants) == 1 else f"images/{_named(at, variant)}/",
            }
            work.append(Cell(f"hardened{at + 1}_{number + 1:04d}", values))
    return work


def run(settings: HardenSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """One block: hardened if it has a variant, then judged."""
    values, folder = cell.values, Path(expand(settings.images, base))
    said, originals, unread = [], [], []
    for at, photo in enumerate(values["photos"]):
        try:
            originals.append(read_large_enough(folder / photo["file"]))
            said.append(photo | {"at": at})
        except CannotJudge as cannot:
            unread.append({"file": photo["file"], "reason": cannot.advice})
    shown, files = originals, {}
    if said and "variant" in values:
        shown, files = _hardened(settings, base, values, said, originals)
        for photo, original, picture in zip(said, originals, shown, strict=True):
            photo["rms"], photo["ssim"] = moved(original, picture)
    for name in values["judges"] if said else ():
        truth = torch.tensor([values["indices"][name][photo["at"]] for photo in said])
        for photo, outcome in zip(said, _judged(settings, _classifier(name, base), shown, truth), strict=True):
            photo.setdefault("right", {})[name] = outcome
    return {"photos": said, "unread": unread} | files


def tables(settings: HardenSettings, results: Sequence[Result]) -> list[Table]:
    """Accuracy with intervals and flags, how far images moved, and what could not be read."""
    rows, distances = [], []
    for variant in _variants(settings):
        photos = list(_photos(results, variant))
        for name in dict.fromkeys((*variant["models"], *settings.judges)):
            rows += _accuracy_rows(settings, results, variant, photos, name)
        if photos:
            rms, ssim = ([photo[kind] for photo in photos] for kind in ("rms", "ssim"))
            row = (len(photos), float(np.mean(rms)), max(rms), float(np.mean(ssim)), min(ssim))
            distances.append((*_words(variant), *row))
    head = ("network", "hardened for", "method", "epsilon", "attack", "original", "hardened", "gain", "flag")
    about = (
        "Share of photographs recognized (top-1), on the same photographs; an attacked one counts where it withstands "
        "both a cross-entropy and a margin loss. Flagged: a stronger attack leaves more than a weaker one."
    )
    moved_head = ("hardened for", "method", "epsilon", "photographs", "RMS", "largest RMS", "SSIM", "least SSIM")
    found = [
        Table("accuracy", "Accuracy, hardened beside original", head, tuple(rows), about),
        Table("moved", "How far the images moved", moved_head, tuple(distances), "RMS of values in [0, 1]."),
    ]
    unread = {(one["file"], one["reason"]) for result in results for one in result.answers["unread"]}
    if unread:
        found.append(Table("unread", "What could not be read", ("file", "reason"), tuple(sorted(unread))))
    return found


def figures(settings: HardenSettings, results: Sequence[Result]) -> list[Drawing]:
    """Accuracy over the attack's ε, original and hardened, a panel per network and attack."""
    names = tuple(dict.fromkeys((*settings.models, *settings.judges)))

    def draw(figure) -> None:
        grid = figure.subplots(len(names), len(settings.attacks), squeeze=False, sharex=True, sharey=True)
        for panels, name in zip(grid, names, strict=True):
            for axes, attack in zip(panels, settings.attacks, strict=True):
                _draw_panel(axes, settings, results, name, attack)
        grid[0, 0].legend(frameon=False, fontsize=7)
        figure.supxlabel("ε of the attack", fontsize=9)
        figure.supylabel("share recognized", fontsize=9)

    if not settings.attacks or not settings.attack_epsilons:
        return []
    size = (4 * len(settings.attacks) + 0.5, 2.2 * len(names) + 0.6)
    return [Drawing("accuracy", "Accuracy under attack", draw, size, "ε = 0 is the clean photograph.")]


STUDY = Study("harden", HardenSettings, cells, run, tables, figures, files=".", own_files=("images",))


def _study_in(out: Path) -> Study:
    """The study with PNGs beside its tables; they are this command's own only where its JSON says so."""
    own = (*STUDY.own_files, "labels.csv", "*.png") if (out / "harden.json").is_file() else STUDY.own_files
    return replace(STUDY, own_files=own)


def _variants(settings: HardenSettings) -> list[dict[str, Any]]:
    groups = [settings.models] if settings.together else [(name,) for name in settings.models]
    return [
        {"models": list(group), "method": method, "epsilon": epsilon}
        for group in groups
        for method in settings.methods
        for epsilon in settings.epsilons
    ]


def _words(variant: Mapping[str, Any]) -> tuple[str, str, str]:
    return ", ".join(map(short_name, variant["models"])), variant["method"], _epsilon_words(variant["epsilon"])


def _named(at: int, variant: Mapping[str, Any]) -> str:
    """A folder's name, unique by its number."""
    return f"{at + 1:02d}_{variant['method']}_{_epsilon_words(variant['epsilon']).replace('/', '-')}"


def _epsilon_words(epsilon: float | None) -> str:
    if epsilon is None:
        return "none"
    codes = epsilon * 255
    return f"{codes:.0f}/255" if abs(codes - round(codes)) < 1e-6 else f"{epsilon:g}"


def _of(indices: Mapping[str, int], photos) -> list[int]:
    return [indices[photo["label"]] for photo in photos]


def _number(label: str) -> str | int:
    return int(label) if label.isdigit() else label


@lru_cache(maxsize=4)  # a process works through one study: its networks stay loaded
def _classifier(name: str, base: Path) -> Classifier:
    return load_classifier(name, base)


def _hardened(settings, base: Path, values, said, originals) -> tuple[list[np.ndarray], dict[str, bytes]]:
    """The photographs as their PNGs hold them, and the PNGs."""
    variant = values["variant"]
    networks = [_classifier(name, base) for name in variant["models"]]
    truth = [[values["indices"][name][photo["at"]] for photo in said] for name in variant["models"]]
    method, epsilon = variant["method"], variant["epsilon"]
    pictures = harden(originals, truth, networks, method, epsilon, settings.steps, settings.step_size)
    files = {}
    for photo, picture in zip(said, pictures, strict=True):
        buffer = io.BytesIO()
        Image.fromarray(picture).save(buffer, "PNG")
        files[values["folder"] + photo["png"]] = buffer.getvalue()
    return [np.asarray(Image.open(io.BytesIO(content)).convert("RGB")) for content in files.values()], files


def _judged(settings, classifier: Classifier, pictures, truth: torch.Tensor) -> list[dict[str, bool]]:
    """Per photograph, whether the network is right about it clean and under each attack."""
    seen = squares(pictures, classifier)
    with torch.no_grad():
        outcomes = {CLEAN: right(classifier.network(seen), truth)}
    for attack in settings.attacks:
        for epsilon in settings.attack_epsilons:
            outcomes[_condition(attack, epsilon)] = ATTACKS[attack](classifier.network, seen, truth, epsilon)
    return [{key: bool(outcome[i]) for key, outcome in outcomes.items()} for i in range(len(pictures))]


def _condition(attack: str, epsilon: float) -> str:
    return f"{attack} {epsilon:g}"


def _photos(results: Sequence[Result], variant: Mapping | None) -> Iterator[Mapping[str, Any]]:
    """The photographs of a variant, or the originals."""
    for result in results:
        if result.cell.values.get("variant") == variant:
            yield from result.answers["photos"]


def _outcomes(results, variant, name: str) -> dict[str, Mapping[str, bool]]:
    return {
        photo["file"]: photo["right"][name] for photo in _photos(results, variant) if name in photo.get("right", {})
    }


def _accuracy_rows(settings, results, variant, photos, name: str) -> list[tuple]:
    before, after = _outcomes(results, None, name), _outcomes(results, variant, name)
    files = [photo["file"] for photo in photos if photo["file"] in before]
    conditions = [(CLEAN, 0.0)] + [(a, e) for a in settings.attacks for e in settings.attack_epsilons]
    pairs = {}
    for attack, epsilon in conditions:
        key = CLEAN if attack == CLEAN else _condition(attack, epsilon)
        pairs[attack, epsilon] = [before[file][key] for file in files], [after[file][key] for file in files]
    rows = []
    for condition, (old, new) in pairs.items():
        flagged = [
            word
            for word, side in (("original", 0), ("hardened", 1))
            if too_strong(condition, {one: sum(pair[side]) for one, pair in pairs.items()})
        ]
        words = CLEAN if condition[0] == CLEAN else _condition(*condition)
        row = (words, rate(old), rate(new), difference(new, old), ", ".join(flagged))
        group, *how = _words(variant)
        rows.append((short_name(name), "itself" if variant["models"] == [name] else group, *how, *row))
    return rows if files else []


def too_strong(condition: tuple[str, float], survivors: Mapping[tuple[str, float], int]) -> bool:
    """Whether more survive this attack than some weaker one: nothing, a smaller ε, or FGSM against PGD."""
    ranks = {CLEAN: 0, "fgsm": 1, "pgd": 2}
    attack, epsilon = condition
    return any(
        survivors[condition] > count
        for (other, smaller), count in survivors.items()
        if ranks[other] <= ranks[attack] and smaller <= epsilon
    )


def _draw_panel(axes, settings, results, name: str, attack: str) -> None:
    x = [0.0, *settings.attack_epsilons]
    keys = [CLEAN, *(_condition(attack, epsilon) for epsilon in settings.attack_epsilons)]
    lines = [("original", None)] + [
        (" ".join(_words(variant)[1:]), variant) for variant in _variants(settings) if name in variant["models"]
    ]
    for label, variant in lines:
        outcomes = list(_outcomes(results, variant, name).values())
        if outcomes:
            y = [float(np.mean([one[key] for one in outcomes])) for key in keys]
            axes.plot(x, y, "--o" if variant is None else "-o", color="0.4" if variant is None else None, label=label)
    axes.set_ylim(-0.05, 1.05)
    axes.set_title(f"{short_name(name)}, {attack}", fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
