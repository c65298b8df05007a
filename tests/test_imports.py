"""Rooms import only from the rows above them, and what is light stays light."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import patchlab
import patchproof

TOOL, LAB = Path(patchproof.__file__).parent, Path(patchlab.__file__).parent
# From the ground up: a room may import from the rows above its own, as far as they are named here.
MAY_IMPORT = {
    "base": set(),
    "sheets": {"base"},
    "photo": {"base", "sheets"},
    "channel": {"base"},
    "mesh": {"base"},
    "scene": {"base", "sheets", "photo", "channel", "mesh"},
    "render": {"base", "sheets", "channel", "mesh", "scene"},
    "networks": {"base"},
    "classifier": {"base", "networks"},
    "optimizer": {"base", "sheets", "photo", "channel", "mesh", "scene", "render", "networks", "classifier"},
    "evidence": {"base", "sheets", "photo", "channel", "classifier"},
    "calibrate": {"base", "sheets", "photo", "channel", "evidence"},
    "report": {"base"},
    "reprints": {
        *("base", "sheets", "channel", "scene", "render", "optimizer", "evidence", "report"),
    },
}
MAY_IMPORT |= {"app": set(MAY_IMPORT), "__init__": {*MAY_IMPORT, "app"}, "__main__": {"app"}}


def imports_in(source: str) -> list[ast.Import | ast.ImportFrom]:
    """A module's imports, those inside of functions too."""
    return [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Import | ast.ImportFrom)]


def named(nodes: list[ast.Import | ast.ImportFrom], package: str = "patchproof") -> set[str]:
    """The rooms of a package that imports name."""
    found = set()
    for node in nodes:
        if isinstance(node, ast.ImportFrom):
            if (node.module or "").split(".")[0] == package:
                parts = (node.module or "").split(".")
                found |= {parts[1]} if len(parts) > 1 else {alias.name for alias in node.names}
        else:
            names = [alias.name.split(".") for alias in node.names]
            found |= {(*name, "__init__")[1] for name in names if name[0] == package}
    return found


@pytest.fixture(scope="module")
def tool() -> dict[Path, tuple[set[str], set[str]]]:
    """By module of the tool, from its folder on: the tool's and the laboratory's rooms that it imports."""
    found = {}
    for path in {*TOOL.rglob("*.py")} - {*TOOL.glob("app/examples/*")}:  # users' programs
        nodes = imports_in(path.read_text(encoding="utf-8"))
        found[path.relative_to(TOOL)] = named(nodes), named(nodes, "patchlab")
    return found


def test_the_reader_of_imports_sees_them():
    deep = "def f():\n    import patchproof.mesh.mesh"
    source = f"from patchproof.sheets.piece import Piece\n{deep}\nfrom patchproof.base import color\nimport patchlab"
    nodes = imports_in(source)
    assert named(nodes) == {"sheets", "mesh", "base"} and named(nodes, "patchlab") == {"__init__"}


def test_imports_point_upwards(tool):
    """Also: the tool does not import the laboratory, and has at most fifteen rooms."""
    rooms = {path.name for path in TOOL.iterdir() if path.is_dir() and path.name != "__pycache__"}
    assert rooms <= set(MAY_IMPORT) and len(rooms) <= 15
    wrong = {}
    for path, (own, lab) in tool.items():
        room = path.parts[0].removesuffix(".py")
        if below := (own - MAY_IMPORT[room] - {room}) | lab:
            wrong[str(path)] = below
    assert not wrong and len(tool) > 100


def test_a_room_is_allowed_nothing_that_it_does_not_use(tool):
    """The table above is what a newcomer reads: arrows that are gone leave it, too."""
    for room, allowed in MAY_IMPORT.items():
        if room not in ("app", "__init__", "__main__"):
            assert allowed <= set().union(*(own for path, (own, _) in tool.items() if path.parts[0] == room)), room


def test_paper_and_photographs_need_no_torch():
    modules = ("sheets.write", "sheets.pdf_raster", "photo.read", "photo.detect", "photo.rectify")
    code = f"import sys; {'; '.join(f'import patchproof.{name}' for name in modules)}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_public_names_exist_and_lead_somewhere():
    for name in patchproof.__all__:
        assert getattr(patchproof, name) is not None, name
    assert set(patchproof.__all__) <= set(dir(patchproof))
    with pytest.raises(AttributeError, match="no_such"):
        _ = patchproof.no_such


def test_type_checkers_see_the_same_public_names():
    """They take a name of the stub as public where it is imported as itself."""
    stub = ast.parse((TOOL / "__init__.pyi").read_text(encoding="utf-8"))
    aliases = [alias for node in stub.body if isinstance(node, ast.ImportFrom) for alias in node.names]
    assert all(alias.name == alias.asname for alias in aliases)
    assert sorted(alias.name for alias in aliases) == patchproof.__all__
    assert all(hasattr(patchproof, name) for name in patchproof.__all__)
