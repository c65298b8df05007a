"""Each name means one thing: classes, type aliases and public functions are defined once over both packages."""

from __future__ import annotations

import ast
from collections import defaultdict
from functools import cache
from pathlib import Path

import patchlab
import patchproof

SOURCES = [path for package in (patchproof, patchlab) for path in sorted(Path(package.__file__).parent.rglob("*.py"))]
RESULTS = Path(patchlab.__file__).parent / "results"  # programs that each made one stored figure
TWICE: dict[str, str] = {}  # a class or alias that may be defined twice, with the reason; five at most
# Functions by which several modules answer one question; their callers take the module as a parameter.
INTERFACES = {
    "build",  # kinds of scenes
    *("cells", "run", "tables", "figures"),  # studies
    *("main", "train", "write"),  # programs
}
COMMANDS = {"cli"}  # verbs of a command line are called as the public functions behind them
FORBIDDEN = ("got others", "got none of that", "got one of", "anew", " lest ", "gone on with")
ELLIPTICAL = ("What ", "The same", "Whether ", "Of ", "As in ")


def definitions(tree: ast.Module) -> dict[str, str]:
    """The classes and aliases ("type") and the public functions ("function") that a module defines."""
    found = {}
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            found[node.name] = "type"
        elif isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            found[node.name] = "function"
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            name = node.targets[0].id
            if name.lstrip("_")[:1].isupper() and any(letter.islower() for letter in name):
                found[name] = "type"
    return found


@cache
def module(path: Path) -> tuple[dict[str, str], list[str]]:
    """A file's definitions and docstrings. Its tree is let go: with all of them kept the parser takes four times as
    long, for the garbage collector looks through them again and again.
    """
    tree = ast.parse(path.read_text(encoding="utf-8"))
    documented = (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Module))
    return definitions(tree), [ast.get_docstring(node) or "" for node in documented]


def homes(kind: str) -> dict[str, list[Path]]:
    """The modules that define each name of a kind."""
    by_name = defaultdict(list)
    for path in SOURCES:
        if RESULTS not in path.parents and not (kind == "function" and COMMANDS & {path.stem, path.parent.name}):
            for name, found in module(path)[0].items():
                if found == kind:
                    by_name[name].append(path)
    return by_name


def test_the_reader_of_definitions_sees_them():
    source = "class A: ...\nBounds = dict[str, int]\nMAX_C = 3\ndef d(): ...\ndef _e(): ..."
    assert definitions(ast.parse(source)) == {"A": "type", "Bounds": "type", "d": "function"}
    assert len(homes("type")) > 300 and len(homes("function")) > 800


def test_each_class_and_alias_is_defined_once():
    twice = {name: paths for name, paths in homes("type").items() if len(paths) > 1}
    assert len(TWICE) <= 5 and twice.keys() == TWICE.keys(), twice


def test_each_public_function_is_defined_once():
    twice = {name: paths for name, paths in homes("function").items() if len(paths) > 1}
    assert twice.keys() <= INTERFACES, {name: paths for name, paths in twice.items() if name not in INTERFACES}


def test_sentences_say_what_they_are_about():
    """One-line docstrings with a subject or a verb; messages with the value that was found."""
    elliptical = []
    for path in SOURCES:
        text = path.read_text(encoding="utf-8")
        assert not [word for word in FORBIDDEN if word in text], path
        for said in module(path)[1]:
            elliptical += [f"{path}: {said}"] if said.startswith(ELLIPTICAL) and "\n" not in said else []
    assert len(elliptical) <= 40, elliptical
