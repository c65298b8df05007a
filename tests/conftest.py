"""What tests share: where outside data lies, and a small scene."""

from __future__ import annotations

import gc
import os
import sys
from pathlib import Path

import pytest

# the tests run side by side, a process per core, and so do the programs that they start
os.environ["OMP_NUM_THREADS"] = "1"

# tests of one room take helpers from those of another
sys.path += [str(folder) for folder in sorted(Path(__file__).parent.iterdir()) if folder.is_dir()]

LONG = (  # of the files' names
    *("readme", "journey", "optimize", "first_hour", "kill_anywhere", "find_design"),
    *("flat_journey", "ledger", "verify_run", "photo_degraded", "sheet_pages", "calibrate_printer", "begin", "workers"),
)


def pytest_configure(config):
    """Compute on one thread; a process that only hands tests to others loads no libraries."""
    if hasattr(config, "workerinput") or not config.getoption("numprocesses", 0):
        import cv2
        import torch

        from patchproof.base.workers import keep_freed_memory

        torch.set_num_threads(1)
        cv2.setNumThreads(1)
        keep_freed_memory()
        gc.disable()  # until all test files are imported: nothing of them is garbage


def pytest_collection_finish():
    """From here on garbage is looked for among what tests make: with torch's objects a look takes .4 s."""
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items):
    """The longest files first, so that no core waits for one of them at the end: xdist itself would begin with those
    of the most tests, and end with a single test of half a minute.
    """
    items.sort(key=lambda item: item.path.stem.removeprefix("test_") not in LONG)


@pytest.fixture(scope="session", autouse=True)
def one_core():
    """What takes all free cores where nothing is said takes one: the others have tests of their own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("patchproof.base.workers.available_cores", lambda: 1)
        yield


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real networks, meshes and photographs."""
    folder = os.environ.get("PATCHPROOF_DATA")
    if not folder:
        pytest.skip("needs real networks, meshes and photographs: set PATCHPROOF_DATA to their folder")
    return Path(folder)


@pytest.fixture
def a_small_search(monkeypatch):
    """For a place: few points, few places, short drafts. For tests of files, not of choices."""
    monkeypatch.setattr("patchproof.scene.candidate_places._POOL", 12)
    for name, count in (("SCREENED_PLACES", 3), ("MAX_PASSES", 0), ("HELD_OUT_VIEWS", 4)):
        monkeypatch.setattr(f"patchproof.optimizer.place_search.{name}", count)


@pytest.fixture(scope="session")
def torchvision():
    """torchvision; one that was built for CUDA lacks, beside a CPU torch, operators that no classifier needs."""
    import torch

    library = torch.library.Library("torchvision", "FRAGMENT")
    try:
        import torchvision
    except ImportError:
        pytest.skip('needs torchvision, of the extra "models"')
    except RuntimeError:
        for name in ("nms", "qnms"):
            library.define(f"{name}(Tensor boxes, Tensor scores, float least) -> Tensor")
        import torchvision
    yield torchvision


SCENE = """
[object]
mesh = "primitive:carton"
length_mm = 300
up = "y"
[patch]
side = "+z"
width_mm = 90
height_mm = 90
[target]
label = "carton"
models = ["builtin"]
[view]
azimuth_deg = [-40, 40]
elevation_deg = [0, 25]
distance_mm = [500, 900]
[background]
color = [0.5, 0.5, 0.5]
[camera]
photo_px = [800, 600]
[optimize]
steps = 3
views = 4
"""


@pytest.fixture
def scene_file(tmp_path) -> Path:
    """A scene file of a carton with a patch, small enough for tests."""
    path = tmp_path / "scene.toml"
    path.write_text(SCENE, encoding="utf-8")
    return path
