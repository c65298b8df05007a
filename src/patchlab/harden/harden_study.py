"""Change photographs so that networks recognize them better, and attack the results.

In: images, a CSV of file names and labels, networks. Out: PNGs under the images' names at their own sizes, and tables:
accuracy clean and attacked, hardened beside original on the same photographs, per network, with 95 % intervals; how far
the images moved. The 8-bit PNGs are judged as a reader of the file gets them. A cell of the table is flagged where
a stronger attack leaves more than a weaker one: there the attack failed. How many steps PGD takes to win stands in a
table of its own: an attack that is stopped early leaves what only an unfinished one leaves.

`harden_images` runs the command's single variant; the study `harden` varies networks, methods and ε, and writes its
PNGs to `images/`. Originals are judged in separate cells, once per network.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field

from patchlab.harden.attacks import PGD_STEP, PGD_STEPS, is_correct, pgd_outcomes, survives_fgsm
from patchlab.harden.hardening import Epsilon, HardenMethod, center_squares, epsilon_text, harden, image_change
from patchlab.harden.labeled_photos import list_labeled_files, read_large_enough, split_into_blocks
from patchlab.study.estimates import cluster_mean
from patchlab.study.grid import Names, PositiveInt, cached_network, short_name
from patchlab.study.study import DEFAULT_WORK, Cell, FinishedStudy, Result, Study, Work, run_cells
from patchproof.base.csv_file import csv_lines
from patchproof.base.folder_lock import lock_folder
from patchproof.base.intervals import estimate_difference, rate
from patchproof.base.output import image_bytes, refuse_inputs_in, write_atomically
from patchproof.base.validation import Positive, Share, StrictModel, expand_path
from patchproof.classifier.labels import find_labels
from patchproof.classifier.network import Classifier
from patchproof.photo.rejection import PhotoRejected
from patchproof.report.tables import Table

Attack = Literal["fgsm", "pgd"]
Condition = tuple[str, float]  # an attack and its ε
CLEAN: Condition = ("clean", 0.0)
_ATTACK_RANKS = {"clean": 0, "fgsm": 1, "pgd": 2}
EARLY_STOPS = (1, 2, 5, 10, 20, 40)  # steps after which the attack is looked at


class HardenSettings(StrictModel):
    """Settings: every method with every ε, for each network alone or for all networks together."""

    images: str  # a folder of images
    labels: str  # CSV: file name, label
    models: Names  # networks to harden for, each alone
    together: bool = False  # harden for all networks at once, by their mean loss
    judges: tuple[str, ...] = ()  # networks that only judge
    methods: Annotated[tuple[HardenMethod, ...], Field(min_length=1)] = ("pgd",)  # how to step
    # Largest change of a value in [0, 1]: 0.03, "8/255", or "none".
    epsilons: Annotated[tuple[Epsilon, ...], Field(min_length=1)] = (8 / 255, 0.1, None)
    steps: PositiveInt = 100  # steps of hardening
    step_size: Positive | None = None  # first step size; by default the method's own
    # ε of a PGD attack that each step is taken under, so that images withstand it; takes eight times the passes.
    through: Annotated[Share, Field(gt=0)] | None = None
    attacks: tuple[Attack, ...] = ("fgsm", "pgd")  # attacks to withstand
    attack_epsilons: tuple[Annotated[float, Field(gt=0, le=1)], ...] = (0.01, 0.02, 0.04)  # the attacks' largest change
    attack_steps: PositiveInt = PGD_STEPS  # steps of PGD
    attack_step_size: Positive = PGD_STEP  # of PGD, as a share of ε
    restarts: Annotated[int, Field(ge=0)] = 0  # random starts of PGD besides the photograph itself
    photos: PositiveInt | None = None  # so many at most, evenly spread over the lines of `labels`
    keep_images: bool = True  # store the hardened PNGs


def harden_images(settings: HardenSettings, out: str | Path, work: Work = DEFAULT_WORK) -> FinishedStudy:
    """Harden images into the folder `out`: PNGs and labels.csv (again a labeled folder of images), and tables."""
    out, base = Path(out), Path.cwd()
    refuse_inputs_in(out, (expand_path(settings.images, base), expand_path(settings.labels, base)))
    # PNGs have the names of the images, and lie beside the tables
    finished = run_cells(replace(STUDY, own_files=("*",)), settings, base, out, work)
    rows = [(photo["png"], photo["label"]) for photo in _photos_of(finished.results, _variants(settings)[0])]
    with lock_folder(out):
        write_atomically(out / "labels.csv", csv_lines([("file", "label"), *rows]))
    return finished


def cells(settings: HardenSettings, base: Path) -> list[Cell]:
    """Cells of originals by network and of every variant, in blocks of photographs; checks networks and labels."""
    folder = Path(expand_path(settings.images, base))
    rows = list_labeled_files(folder, Path(expand_path(settings.labels, base)))
    if (most := settings.photos or len(rows)) < len(rows):
        rows = [rows[i * len(rows) // most] for i in range(most)]
    names = tuple(dict.fromkeys((*settings.models, *settings.judges)))
    for name in names:
        _label_indices(name, base, [label for _, _, label in rows])
    variants, work = _variants(settings), []
    for number, block in enumerate(split_into_blocks(folder, rows), 1):
        photos = [{"file": file, "png": png, "label": label} for file, png, label in block]
        for index, name in enumerate(names, 1):
            work.append(Cell(f"original{index}_{number:04d}", {"photos": photos, "judges": [name]}))
        for index, variant in enumerate(variants, 1):
            words = f"{index:02d}_{variant['method']}_{epsilon_text(variant['epsilon']).replace('/', '-')}"
            judges = list(dict.fromkeys((*variant["models"], *settings.judges)))
            folder_out = "" if len(variants) == 1 else f"images/{words}/"
            values = {"photos": photos, "judges": judges, "variant": variant, "folder": folder_out}
            work.append(Cell(f"hardened{index}_{number:04d}", values))
    return work


def run(settings: HardenSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Harden one block if it has a variant, then judge it."""
    values, folder = cell.values, Path(expand_path(settings.images, base))
    photos, originals, unread = [], [], []
    for photo in values["photos"]:
        try:
            originals.append(read_large_enough(folder / photo["file"]))
            photos.append(photo | {"right": {}, "lost_at": {}})
        except PhotoRejected as error:
            unread.append({"file": photo["file"], "reason": error.advice})
    labels, pictures, files = [photo["label"] for photo in photos], originals, {}
    if photos and "variant" in values:
        names, how = values["variant"]["models"], (values["variant"]["method"], values["variant"]["epsilon"])
        networks = [cached_network(name, base) for name in names]
        truth = [_label_indices(name, base, labels) for name in names]
        steps = settings.steps, settings.step_size, settings.through
        pictures = harden(originals, truth, networks, *how, *steps)
        for photo, original, picture in zip(photos, originals, pictures, strict=True):
            if settings.keep_images:
                files[values["folder"] + photo["png"]] = image_bytes(picture, "PNG")
            photo["rms"], photo["ssim"] = image_change(original, picture)
    for name in values["judges"] if photos else ():
        truth = torch.tensor(_label_indices(name, base, labels))
        outcomes, lost = _judge(settings, cached_network(name, base), pictures, truth)
        for i, photo in enumerate(photos):
            photo["right"][name] = [bool(outcome[i]) for outcome in outcomes]
            photo["lost_at"][name] = [int(steps[i]) for steps in lost]
    return {"photos": photos, "unread": unread} | files


def _judge(
    settings: HardenSettings, classifier: Classifier, pictures: Sequence[np.ndarray], truth: torch.Tensor
) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """Per condition N bool: the network is correct about the photographs; per PGD attack N steps until it wins."""
    views, network, lost = center_squares(pictures, classifier), classifier.network, []
    with torch.no_grad():
        outcomes = [is_correct(network(views), truth)]
    _, *attacks = _attack_conditions(settings).values()
    for attack, epsilon in attacks:
        if attack == "fgsm":
            outcomes.append(survives_fgsm(network, views, truth, epsilon))
            continue
        how = settings.attack_steps, settings.attack_step_size, settings.restarts
        for record, found in zip((lost, outcomes), pgd_outcomes(network, views, truth, epsilon, *how), strict=True):
            record.append(found)
    return outcomes, lost


def tables(settings: HardenSettings, results: Sequence[Result]) -> list[Table]:
    """Tables of accuracy with intervals and flags, of changes to the images, and of unreadable files."""
    rows, early, distances = [], [], []
    for variant in _variants(settings):
        for name in dict.fromkeys((*variant["models"], *settings.judges)):
            rows += _accuracy_rows(settings, results, variant, name)
            early += _early_rows(settings, results, variant, name)
        if photos := list(_photos_of(results, variant)):
            rms, ssim = ([photo[kind] for photo in photos] for kind in ("rms", "ssim"))
            row = (len(photos), float(np.mean(rms)), max(rms), float(np.mean(ssim)), min(ssim))
            distances.append((*_variant_texts(variant), *row))
    head = ("network", "hardened for", "method", "epsilon", "attack")
    head = (*head, "original", "hardened", "gain", "gain by class", "flag")
    about = (
        "Share of photographs recognized (top-1), on the same photographs; an attacked one counts where it withstands "
        "both a cross-entropy and a margin loss. By class: the mean of the classes' gains, its interval over classes."
        " Flagged: a stronger attack leaves more than a weaker one."
    )
    moved_head = ("hardened for", "method", "epsilon", "photographs", "RMS", "largest RMS", "SSIM", "least SSIM")
    all_tables = [
        Table("accuracy", "Accuracy, hardened beside original", head, tuple(rows), about),
        Table("moved", "How far the images moved", moved_head, tuple(distances), "RMS of values in [0, 1]."),
    ]
    if early:
        early_head = (*head[:5], "pictures", *(f"after {steps}" for steps in EARLY_STOPS))
        about = "Share recognized after each of so many steps along the cross-entropy, from the picture itself."
        all_tables.append(Table("early", "PGD stopped early", early_head, tuple(early), about))
    if unread := {(photo["file"], photo["reason"]) for result in results for photo in result.answers["unread"]}:
        all_tables.append(Table("unread", "What could not be read", ("file", "reason"), tuple(sorted(unread))))
    return all_tables


def _accuracy_rows(
    settings: HardenSettings, results: Sequence[Result], variant: Mapping[str, Any], name: str
) -> list[tuple]:
    before, after = (_by_file(results, each, name, "right") for each in (None, variant))
    if not (files := [file for file in after if file in before]):
        return []
    conditions = _attack_conditions(settings)
    pairs = {
        condition: [[some[file][i] for file in files] for some in (before, after)]
        for i, condition in enumerate(conditions.values())
    }
    survivors = {
        word: {condition: sum(pair[side]) for condition, pair in pairs.items()}
        for side, word in enumerate(("original", "hardened"))
    }
    label = {photo["file"]: photo["label"] for photo in _photos_of(results, variant)}
    classes: dict[str, list[int]] = {}
    for i, file in enumerate(files):
        classes.setdefault(label[file], []).append(i)
    start = _row_start(variant, name)
    return [
        (
            *(*start, words, rate(old), rate(new), estimate_difference(new, old)),
            cluster_mean([float(np.mean([new[i] - old[i] for i in rows])) for rows in classes.values()]),
            ", ".join(word for word, counts in survivors.items() if attack_failed(condition, counts)),
        )
        for (words, condition), (old, new) in zip(conditions.items(), pairs.values(), strict=True)
    ]


def _row_start(variant: Mapping[str, Any], name: str) -> tuple[str, ...]:
    group, *how = _variant_texts(variant)
    return short_name(name), "itself" if variant["models"] == [name] else group, *how


def _early_rows(
    settings: HardenSettings, results: Sequence[Result], variant: Mapping[str, Any], name: str
) -> list[tuple]:
    rows, attacks = [], [words for words, (attack, _) in _attack_conditions(settings).items() if attack == "pgd"]
    for word, which in (("original", None), ("hardened", variant)):
        lost = _by_file(results, which, name, "lost_at").values()
        for words, steps in zip(attacks, zip(*lost, strict=True), strict=False):
            rates = (rate([one > min(stop, settings.attack_steps) for one in steps]) for stop in EARLY_STOPS)
            rows.append((*_row_start(variant, name), words, word, *rates))
    return rows


def attack_failed(condition: Condition, survivors: Mapping[Condition, int]) -> bool:
    """True if more pictures survive this attack than a weaker one: none, a smaller ε, or FGSM against PGD."""
    attack, epsilon = condition
    return any(
        survivors[condition] > count
        for (other, smaller), count in survivors.items()
        if _ATTACK_RANKS[other] <= _ATTACK_RANKS[attack] and smaller <= epsilon
    )


STUDY = Study("harden", HardenSettings, cells, run, tables, files=".", own_files=("images",))


def _variants(settings: HardenSettings) -> list[dict[str, Any]]:
    groups = [settings.models] if settings.together else [(name,) for name in settings.models]
    return [
        {"models": list(group), "method": method, "epsilon": epsilon}
        for group in groups
        for method in settings.methods
        for epsilon in settings.epsilons
    ]


def _attack_conditions(settings: HardenSettings) -> dict[str, Condition]:
    """Conditions by their names in tables: clean, then each attack with each ε."""
    attacks = [(attack, epsilon) for attack in settings.attacks for epsilon in settings.attack_epsilons]
    return {"clean": CLEAN, **{f"{attack} {epsilon:g}": (attack, epsilon) for attack, epsilon in attacks}}


def _variant_texts(variant: Mapping[str, Any]) -> tuple[str, str, str]:
    return ", ".join(map(short_name, variant["models"])), variant["method"], epsilon_text(variant["epsilon"])


def _label_indices(name: str, base: Path, labels: Sequence[str]) -> list[int]:
    """A network's indices of labels; refused if it lacks one."""
    known = cached_network(name, base).labels
    index = {label: find_labels(known, int(label) if label.isdigit() else label)[0] for label in dict.fromkeys(labels)}
    return [index[label] for label in labels]


def _photos_of(results: Sequence[Result], variant: Mapping[str, Any] | None) -> Iterator[Mapping[str, Any]]:
    for result in results:
        if result.cell.values.get("variant") == variant:
            yield from result.answers["photos"]


def _by_file(
    results: Sequence[Result], variant: Mapping[str, Any] | None, name: str, kind: str
) -> dict[str, Sequence[Any]]:
    """By file: what is recorded under "right" (a bool per condition) or "lost_at" (steps per PGD attack)."""
    return {photo["file"]: photo[kind][name] for photo in _photos_of(results, variant) if name in photo[kind]}
