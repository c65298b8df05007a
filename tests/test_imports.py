"""Each package imports only from rows above it, and photographs need no torch."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import patchproof

ROOT = Path(patchproof.__file__).parent
GROUND = {
    "version",
    "strict",
    "settings",
    "goal",
    "claims",
    "sessions",
    "color",
    "geometry",
    "input",
    "output",
    "workers",
}
# From the ground up: a room may import from the rows above its own, as far as they are named here.
WORLD = GROUND | {"sheets", "photo", "channel", "mesh", "scene", "render", "classifier"}
EVIDENCE = GROUND | {"sheets", "photo", "channel", "classifier", "evidence", "report"}
COMMANDS = WORLD | EVIDENCE | {"optimizer", "calibrate", "printing", "reprints"}
STUDIES = COMMANDS | {"journey", "plan", "study"}
MAY_IMPORT = {
    **{module: set() for module in GROUND},
    "settings": {"strict", "goal"},
    "input": {"strict"},
    "output": {"strict"},
    "sessions": {"claims"},
    "workers": {"strict"},
    "sheets": GROUND,
    "photo": GROUND | {"sheets"},
    "channel": GROUND,
    "mesh": GROUND,
    "scene": GROUND | {"sheets", "photo", "channel", "mesh"},
    "render": GROUND | {"sheets", "photo", "channel", "mesh", "scene"},
    "classifier": GROUND,
    "optimizer": WORLD,
    "calibrate": GROUND | {"sheets", "photo", "channel"},
    "evidence": GROUND | {"sheets", "photo", "classifier", "channel"},
    "report": GROUND,
    "printing": WORLD | {"optimizer", "evidence"},
    "reprints": WORLD | {"optimizer", "evidence", "report", "printing"},
    "journey": COMMANDS,
    "begin": COMMANDS,
    "capture": GROUND | {"sheets", "photo", "evidence", "optimizer", "printing", "reprints", "report", "journey"},
    "plan": COMMANDS | {"journey"},
    "study": WORLD | {"optimizer", "report"},
    "harden": GROUND | {"photo", "scene", "classifier", "report", "study"},
    "experiments": WORLD | {"optimizer", "report", "study", "harden"},
    "validation": STUDIES,
    "training": WORLD,
    "bench": STUDIES | {"training", "harden", "experiments"},
    "cli": STUDIES | {"capture", "begin", "harden", "bench", "training", "experiments", "validation"},
    "__init__": COMMANDS | {"journey"},
    "__main__": {"cli"},
}


def imported(source: str) -> set[str]:
    """The packages of ours that a module names in its imports."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("patchproof"):
            parts = node.module.split(".")
            found |= {parts[1]} if len(parts) > 1 else {alias.name for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name.split(".")[1] for alias in node.names if alias.name.startswith("patchproof.")}
    return found


def test_the_reader_of_imports_sees_them():
    deep = "def f():\n    import patchproof.mesh.mesh"
    source = f"from patchproof.sheets.piece import Piece\n{deep}\nfrom patchproof import color"
    assert imported(source) == {"sheets", "mesh", "color"}


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.py")), ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_upwards(path):
    top = path.relative_to(ROOT).parts[0].removesuffix(".py")
    assert imported(path.read_text(encoding="utf-8")) <= MAY_IMPORT[top] | {top}


@pytest.mark.parametrize("package", ["sheets.write", "sheets.raster", "photo.read", "photo.detect", "photo.rectify"])
def test_paper_and_photographs_need_no_torch(package):
    code = f"import sys, patchproof.{package}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_public_names_exist_and_lead_somewhere():
    for name in patchproof.__all__:
        assert getattr(patchproof, name) is not None, name
    assert set(patchproof.__all__) <= set(dir(patchproof))
    with pytest.raises(AttributeError, match="no_such"):
        _ = patchproof.no_such


def test_type_checkers_see_the_public_names_that_are_imported_late():
    tree = ast.parse((ROOT / "__init__.py").read_text(encoding="utf-8"))
    seen = {
        alias.asname: f"{node.module}:{alias.name}".removeprefix("patchproof.")
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("patchproof.")
        if node.module != "patchproof.version"
        for alias in node.names
    }
    assert seen == patchproof._HOME and patchproof.__all__ == sorted(patchproof._HOME)
