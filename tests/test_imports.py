"""Each package imports only from rows above it, and photographs need no torch."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import patchproof

ROOT = Path(patchproof.__file__).parent
GROUND = {"claims", "color", "geometry", "output", "settings", "workers"}
MAY_IMPORT = {
    **{module: {"settings"} if module in {"output", "workers"} else set() for module in GROUND},
    "sheet": GROUND,
    "photo": GROUND | {"sheet"},
    "channel": GROUND,
    "scene": GROUND | {"sheet", "photo", "channel"},
    "render": GROUND | {"sheet", "photo", "channel", "scene"},
    "classifier": GROUND,
    "optimize": GROUND | {"sheet", "photo", "channel", "scene", "render", "classifier"},
    "calibrate": GROUND | {"sheet", "photo", "channel"},
    "verify": GROUND | {"sheet", "photo", "classifier", "channel"},
    "report": GROUND,
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
    deep = "def f():\n    import patchproof.scene.mesh"
    source = f"from patchproof.sheet.piece import Piece\n{deep}\nfrom patchproof import color"
    assert imported(source) == {"sheet", "scene", "color"}


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.py")), ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_upwards(path):
    top = path.relative_to(ROOT).parts[0].removesuffix(".py")
    if top in {"study", "bench", "cli", "__init__", "__main__"}:
        return
    assert imported(path.read_text(encoding="utf-8")) <= MAY_IMPORT[top] | {top}


@pytest.mark.parametrize("package", ["sheet.write", "sheet.raster", "photo.read", "photo.detect", "photo.rectify"])
def test_paper_and_photographs_need_no_torch(package):
    code = f"import sys, patchproof.{package}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_public_names_exist_and_lead_somewhere():
    for name in patchproof.__all__:
        assert callable(getattr(patchproof, name)), name
    assert set(patchproof.__all__) <= set(dir(patchproof))
    with pytest.raises(AttributeError, match="no_such"):
        _ = patchproof.no_such
