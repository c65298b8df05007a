from patchproof.app.compare import compare_runs as compare
from patchproof.app.verify import verify_photos as verify
from patchproof.base.errors import Refused as Refused
from patchproof.base.goal import Goal as Goal
from patchproof.base.settings import SceneSettings as SceneSettings
from patchproof.base.version import __version__ as __version__
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
