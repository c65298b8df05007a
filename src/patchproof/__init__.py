"""patchproof: optimize a patch on a 3D object, print it at true size, photograph it, judge the photographs.

The public names tell the story in order: scene → optimize → sheet → photographs → verify. They are imported when first
used, so that `import patchproof` and `patchproof --help` stay quick; type checkers see them all.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from patchproof.base.version import __version__ as __version__

if TYPE_CHECKING:
    from patchproof.app.compare import compare_runs as compare
    from patchproof.app.verify import verify_photos as verify
    from patchproof.base.goal import Goal as Goal
    from patchproof.base.settings import SceneSettings as SceneSettings
    from patchproof.base.strict import Refused as Refused
    from patchproof.channel.printer import Printer as Printer
    from patchproof.channel.printer import load_printer as load_printer
    from patchproof.classifier.custom import classifier_of as classifier_of
    from patchproof.classifier.custom import detector_of as detector_of
    from patchproof.classifier.detector import Detector as Detector
    from patchproof.classifier.load import load_classifier as load_classifier
    from patchproof.classifier.network import Classifier as Classifier
    from patchproof.evidence.results import Report as Report
    from patchproof.optimizer.evaluate import evaluate_run as evaluate
    from patchproof.optimizer.given import import_patch as import_patch
    from patchproof.optimizer.places import Place as Place
    from patchproof.optimizer.places import choose_place as choose_place
    from patchproof.optimizer.run import Run as Run
    from patchproof.optimizer.run import load_run as load_run
    from patchproof.optimizer.run import optimize_scene as optimize
    from patchproof.render.photograph import photograph as photograph
    from patchproof.render.stage import Stage as Stage
    from patchproof.render.stage import set_stage as set_stage
    from patchproof.reprints.reprint import reprint as reprint
    from patchproof.reprints.run_sheet import sheet_of as sheet
    from patchproof.scene.conditions import Conditions as Conditions
    from patchproof.scene.interface import Scene as Scene
    from patchproof.scene.scene import load_scene as load_scene
    from patchproof.scene.scene import make_scene as make_scene
    from patchproof.sheets.manifest import Manifest as Manifest
    from patchproof.sheets.manifest import Promise as Promise
    from patchproof.sheets.manifest import load_manifest as load_manifest

# where each public name comes from, and what it is called there
_HOME = {
    "Classifier": "classifier.network:Classifier",
    "Conditions": "scene.conditions:Conditions",
    "Detector": "classifier.detector:Detector",
    "Goal": "base.goal:Goal",
    "Manifest": "sheets.manifest:Manifest",
    "Place": "optimizer.places:Place",
    "Printer": "channel.printer:Printer",
    "Promise": "sheets.manifest:Promise",
    "Refused": "base.strict:Refused",
    "Report": "evidence.results:Report",
    "Run": "optimizer.run:Run",
    "Scene": "scene.interface:Scene",
    "SceneSettings": "base.settings:SceneSettings",
    "Stage": "render.stage:Stage",
    "choose_place": "optimizer.places:choose_place",
    "classifier_of": "classifier.custom:classifier_of",
    "compare": "app.compare:compare_runs",
    "detector_of": "classifier.custom:detector_of",
    "evaluate": "optimizer.evaluate:evaluate_run",
    "import_patch": "optimizer.given:import_patch",
    "load_classifier": "classifier.load:load_classifier",
    "load_manifest": "sheets.manifest:load_manifest",
    "load_printer": "channel.printer:load_printer",
    "load_run": "optimizer.run:load_run",
    "load_scene": "scene.scene:load_scene",
    "make_scene": "scene.scene:make_scene",
    "optimize": "optimizer.run:optimize_scene",
    "photograph": "render.photograph:photograph",
    "reprint": "reprints.reprint:reprint",
    "set_stage": "render.stage:set_stage",
    "sheet": "reprints.run_sheet:sheet_of",
    "verify": "app.verify:verify_photos",
}

__all__ = [
    "Classifier",
    "Conditions",
    "Detector",
    "Goal",
    "Manifest",
    "Place",
    "Printer",
    "Promise",
    "Refused",
    "Report",
    "Run",
    "Scene",
    "SceneSettings",
    "Stage",
    "choose_place",
    "classifier_of",
    "compare",
    "detector_of",
    "evaluate",
    "import_patch",
    "load_classifier",
    "load_manifest",
    "load_printer",
    "load_run",
    "load_scene",
    "make_scene",
    "optimize",
    "photograph",
    "reprint",
    "set_stage",
    "sheet",
    "verify",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'patchproof' has no attribute {name!r}")
    module, _, attribute = _HOME[name].partition(":")
    return getattr(import_module(f"patchproof.{module}"), attribute)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
