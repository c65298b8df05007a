"""The grid of most studies: every scene file with every network and seed, and what else a study varies.

In: a study's settings, with paths relative to the config's folder. Out: cells whose values hold the whole scene, so
that a cell is run again when its scene file changes; a cell's scene and problem; results in groups.

A study may change keys of the scene file's tables (`patch`, `optimize`, ...), so that one file serves for patches, full
and masked textures, bounded or free. Changes are checked like the file.
"""

import re
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import Field, model_validator

from patchlab.study.study import Cell, Result
from patchproof.base.settings import OptimizeSettings, SceneSettings
from patchproof.base.validation import StrictModel, expand_path, read_toml, validate_model
from patchproof.classifier.load import load_classifier
from patchproof.classifier.network import Classifier
from patchproof.optimizer import loop
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.scene.interface import Scene
from patchproof.scene.scene import build_scene

CellValues = dict[str, Any]  # a cell's JSON values
SceneChanges = Mapping[str, Mapping[str, Any]]  # tables of a scene file with the keys that change
PositiveInt = Annotated[int, Field(ge=1)]
Names = Annotated[tuple[str, ...], Field(min_length=1)]
Seeds = Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]
Key = TypeVar("Key", bound=Hashable)


class GridSettings(StrictModel):
    """Every scene file with every network and seed; paths are relative to the config's folder."""

    scenes: Names  # scene files
    networks: tuple[str, ...] = ()  # in place of each scene's networks
    seeds: Seeds = (0,)  # seeds of the optimizer and the draws

    @model_validator(mode="after")
    def _have_different_names(self):
        for key in ("scenes", "networks", "seeds"):
            names = [short_name(str(name)) for name in getattr(self, key)]
            if len(set(names)) < len(names):
                raise ValueError(f"takes {key} with different names")
        return self


def short_name(name: str) -> str:
    """A scene's or network's name for tables and file names: a file's stem, a registry's entry."""
    word = name.rpartition(":")[2]
    return re.sub(r"[^\w.+-]", "-", Path(word).stem if "/" in word or word.endswith((".toml", ".onnx")) else word)[-40:]


def scene_values(file: str, base: Path, tables: SceneChanges | None = None, where: str = "") -> CellValues:
    """A cell's values for a scene: name, file, and all settings with some tables' keys changed."""
    path = Path(expand_path(file, base))
    scene = _changed_settings(read_toml(path), tables or {}, path.name + where)
    return {"name": short_name(file), "file": file, "scene": scene}


def with_changes(values: CellValues, tables: SceneChanges) -> CellValues:
    """Cell values with keys of some of the scene's tables changed."""
    return values | {"scene": _changed_settings(values["scene"], tables, values["file"])}


def scene_network_pairs(settings: GridSettings, base: Path) -> Iterator[CellValues]:
    """Cell values without seed of every scene with every single network, under the network's short name."""
    for file in settings.scenes:
        values: CellValues = scene_values(file, base) | {"of_scene": not settings.networks}
        for network in settings.networks or values["scene"]["target"]["models"]:
            yield values | {"networks": [network], "network": short_name(network)}


def make_cell(values: CellValues, seed: int, *words: str) -> Cell:
    """A cell named after its scene, the words, and the seed."""
    name = ".".join((values["name"][:30], *words, str(seed)))
    return Cell(re.sub(r"[^\w=+.,-]+", "-", name), {**values, "seed": seed})


def grid_cells(
    settings: GridSettings,
    base: Path,
    vary: Callable[[CellValues], Iterable[tuple[CellValues, tuple[str, ...]]]] = lambda values: ((values, ()),),
) -> list[Cell]:
    """A cell for every scene, single network, variant (values, and words for the name) and seed."""
    return [
        make_cell(varied, seed, values["network"], *words)
        for values in scene_network_pairs(settings, base)
        for varied, words in vary(values)
        for seed in settings.seeds
    ]


def scene_of(base: Path, values: Mapping[str, Any]) -> Scene:
    """Build the scene in a cell's values; its paths are relative to the scene file's folder."""
    settings = validate_model(SceneSettings, values["scene"], values["file"])
    return build_scene(settings, _scene_folder(base, values), values["seed"])


def network_names(base: Path, values: Mapping[str, Any]) -> tuple[str, ...]:
    """Networks in a cell's values, with paths relative to the config's folder, or to the scene's if it names them."""
    folder = _scene_folder(base, values) if values["of_scene"] else base
    return tuple(expand_path(name, folder) for name in values["networks"])


def problem_of(base: Path, values: Mapping[str, Any]) -> Problem:
    """The problem of the scene and networks in a cell's values."""
    scene = scene_of(base, values)
    return set_problem(scene, models=[cached_network(name, scene.base) for name in network_names(base, values)])


def views_per_network(settings: OptimizeSettings) -> int:
    """The number of views that each network sees in training and selection."""
    steps = range(1, settings.steps + 1)
    selections = sum(loop.ends_interval(settings, number, loop.SELECT_AFTER) for number in steps)
    return settings.steps * settings.views + selections * loop.SELECT_VIEWS


@lru_cache(maxsize=8)
def cached_network(name: str, base: Path) -> Classifier:
    """Load a network once in a process, since to check it takes as long as many a cell."""
    return load_classifier(name, base)


def group_by(results: Iterable[Result], key: Callable[[Result], Key]) -> dict[Key, list[Result]]:
    """Results by key, keys in order of appearance."""
    groups: dict[Key, list[Result]] = {}
    for result in results:
        groups.setdefault(key(result), []).append(result)
    return groups


def by_values(*names: str) -> Callable[[Result], tuple]:
    """A function that returns these values of a result's cell, to group by."""
    return lambda result: tuple(result.cell.values[name] for name in names)


def by_scene(results: Sequence[Result]) -> dict[str, list[Result]]:
    """Results by their scene's name."""
    return group_by(results, lambda result: result.cell.values["name"])


cell_key = by_values("name", "network", "seed")  # (scene, network, seed), the first columns of many tables


def _changed_settings(data: Mapping[str, Any], tables: SceneChanges, where: str) -> dict[str, Any]:
    tables = {**data, **{name: {**data.get(name, {}), **keys} for name, keys in tables.items()}}
    return validate_model(SceneSettings, tables, where).model_dump(mode="json")


def _scene_folder(base: Path, values: Mapping[str, Any]) -> Path:
    return Path(expand_path(values["file"], base)).resolve().parent
