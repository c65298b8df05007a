"""What the studies of trained designs share: train a scene on some networks, then measure it on all of them.

In: a study's settings (scene files, ways to vary them, networks, seeds) and a cell's plain values. Out: cells with the
whole scene in them, so that a changed scene file is done again; a problem before all networks; a design trained on some
of them; and what every network said of every condition, as JSON values that pair up across cells: all cells of one
scene and seed are measured on the same draws of the evaluate stream, which training and selection never see.

A way overrides tables of the scene file (`patch`, `optimize`, ...), so that one scene serves for full and masked
textures, bounded or free, with Adam or the paper's signed steps: there ε is the step, here `optimize.step_size`; a ball
round the start is `patch.epsilon`. Left out on purpose: promises, which belong to runs that get printed.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from patchproof.claims import Estimate, difference, mean, rate
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.promise import Outcomes
from patchproof.optimizer.texture import Texture
from patchproof.scene.export import write_glb
from patchproof.scene.scene import Scene, build_scene
from patchproof.settings import SceneSettings
from patchproof.strict import Refused, Strict, expand, read_toml, validated
from patchproof.study.study import Cell, Result, short_name

Way = dict[str, dict[str, Any]]  # tables of a scene file with the keys that change
Word = Annotated[str, Field(pattern=r"^[\w=+,-]{1,24}$")]  # part of a file's name
ORIGINAL = "original"  # the row of the object as it came


class TrainedSettings(Strict):
    """What varies; paths are relative to the config's folder."""

    scenes: Annotated[tuple[str, ...], Field(min_length=1)]  # scene files
    networks: Annotated[tuple[str, ...], Field(min_length=1)]  # to train on and to test
    if_installed: tuple[str, ...] = ()  # networks that are left out where they cannot be loaded, such as `timm:` ones
    # By name: tables of the scene file with the keys that change.
    ways: dict[Word, Way] = Field({"as_is": {}}, min_length=1)
    seeds: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)] = (0,)  # of the optimizer
    n: Annotated[int, Field(ge=2)] = 400  # unseen conditions that measure


def networks_of(settings: TrainedSettings, base: Path) -> tuple[str, ...]:
    """The networks to train and test on: those named, and the optional ones that can be loaded here."""
    from patchproof.classifier.load import load_classifier

    found = list(settings.networks)
    for name in settings.if_installed:
        try:
            load_classifier(expand(name, base), base)
        except Exception:  # not installed, no weights: whatever the library raises
            continue
        found.append(name)
    if len({short_name(name) for name in found}) < len(found):
        raise Refused("networks whose files have different names", ", ".join(found), "rename one")
    return tuple(found)


def scenes_of(settings: TrainedSettings, base: Path) -> list[tuple[str, str, dict[str, Any]]]:
    """(scene's name, way's name, values of a cell that say them) for each scene file in each way."""
    names = [Path(scene).stem for scene in settings.scenes]
    if len(set(names)) < len(names):
        raise Refused("scene files with different names", ", ".join(settings.scenes), "rename one")
    found = []
    for name, file in zip(names, settings.scenes, strict=True):
        path = Path(expand(file, base))
        for way, tables in settings.ways.items():
            scene = validated(SceneSettings, _overridden(read_toml(path), tables), f"{path.name}, way {way}")
            values = {"name": name, "way": way, "file": file, "scene": scene.model_dump(mode="json")}
            found.append((name, way, values))
    return found


def _overridden(data: dict[str, Any], tables: Way) -> dict[str, Any]:
    return data | {name: {**data.get(name, {}), **keys} for name, keys in tables.items()}


def cell_of(values: Mapping[str, Any], row: str, trained: Sequence[str], tested: Sequence[str], seed: int) -> Cell:
    """The cell that trains on some networks (none: the original) and tests on others; `row` is its name in tables."""
    name = re.sub(r"[^\w=+.,-]", "-", f"{values['name'][:30]}.{values['way']}.{row}.{seed}")
    return Cell(name, {**values, "row": row, "trained": list(trained), "tested": list(tested), "seed": seed})


def problem_of(base: Path, cell: Cell) -> Problem:
    """The cell's scene before all the networks that test it."""
    return set_problem(scene_of(base, cell), models=tuple(expand(name, base) for name in cell.values["tested"]))


def scene_of(base: Path, cell: Cell) -> Scene:
    """The scene that a cell's values hold, its paths relative to the scene file's folder."""
    values = cell.values
    folder = Path(expand(values["file"], base)).resolve().parent
    return build_scene(validated(SceneSettings, values["scene"], values["file"]), folder, values["seed"])


def trained_on(problem: Problem, cell: Cell) -> Problem:
    """The same problem before the networks that train."""
    chosen = [cell.values["tested"].index(name) for name in cell.values["trained"]]
    return replace(
        problem,
        classifiers=tuple(problem.classifiers[i] for i in chosen),
        indices=tuple(problem.indices[i] for i in chosen),
    )


def said(outcomes: Outcomes) -> dict[str, Any]:
    """Outcomes as JSON values: per shown thing and network a text of 0 and 1, and confidences to five digits."""
    return {
        "hits": {kind: ["".join("01"[int(hit)] for hit in row) for row in rows] for kind, rows in _of(outcomes, 0)},
        "confidence": {kind: np.round(rows, 5).tolist() for kind, rows in _of(outcomes, 1)},
    }


def _of(outcomes: Outcomes, which: int) -> Iterable[tuple[str, np.ndarray]]:
    return (outcomes.recognized, outcomes.confidence)[which].items()


def object_file(problem: Problem, design: np.ndarray) -> bytes:
    """The object with its new textures as GLB, or the patch as PNG."""
    if isinstance(problem.subject, Texture):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "object.glb"
            write_glb(problem.scene.canvas.mesh, problem.subject.textures(design), path)
            return path.read_bytes()
    from patchproof.report.images import png

    return png(design)


class Told:
    """What results say of one shown thing, seeds one after the other: hits and confidences by network."""

    def __init__(self, results: Iterable[Result], kind: str):
        self._by_seed = {one.cell.values["seed"]: (one.cell.values["tested"], one.found) for one in results}
        self._kind = kind

    def hits(self, network: str, seeds: Iterable[int] | None = None) -> list[bool]:
        """Recognized or not, per condition."""
        return [hit == "1" for text in self._rows("hits", network, seeds) for hit in text]

    def confidences(self, network: str, seeds: Iterable[int] | None = None) -> list[float]:
        """The target's confidence, per condition."""
        return [value for row in self._rows("confidence", network, seeds) for value in row]

    def gain(self, other: Told, network: str) -> tuple[Estimate | None, Estimate | None]:
        """(rate, mean confidence) over those of `other`, paired by condition on the seeds that both have."""
        seeds = [seed for seed in self._by_seed if seed in other._by_seed]
        mine, theirs = self.confidences(network, seeds), other.confidences(network, seeds)
        return (
            difference(self.hits(network, seeds), other.hits(network, seeds)),
            mean([a - b for a, b in zip(mine, theirs, strict=True)]),
        )

    def level(self, network: str) -> tuple[Estimate | None, Estimate | None]:
        """(rate, mean confidence)."""
        return rate(self.hits(network)), mean(self.confidences(network))

    def _rows(self, key: str, network: str, seeds: Iterable[int] | None) -> list:
        chosen = self._by_seed if seeds is None else seeds
        return [
            found[key][self._kind][tested.index(network)]
            for tested, found in (self._by_seed[seed] for seed in chosen)
            if network in tested
        ]


def grouped(results: Sequence[Result]) -> dict[tuple[str, str], dict[str, list[Result]]]:
    """Results by (scene, way) and row, in the order of cells."""
    found: dict[tuple[str, str], dict[str, list[Result]]] = {}
    for one in results:
        values = one.cell.values
        found.setdefault((values["name"], values["way"]), {}).setdefault(values["row"], []).append(one)
    return found


def tested_in(results: Sequence[Result]) -> list[str]:
    """All networks that some cell was tested on."""
    return list(dict.fromkeys(name for one in results for name in one.cell.values["tested"]))


def left_out_note(settings: TrainedSettings, results: Sequence[Result]) -> str:
    """Which optional networks could not be loaded, as a sentence; empty where all could."""
    missing = [name for name in settings.if_installed if name not in tested_in(results)]
    return f" Not loaded here and left out: {', '.join(missing)}." if missing else ""


def verdict(gain: Estimate | None) -> str:
    """What an interval of a difference allows one to say."""
    if gain is None:
        return "not measured"
    return "gain" if gain.low > 0 else "loss" if gain.high < 0 else "none shown"
