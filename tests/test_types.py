"""Types are checked as they are written: no error in the package, and every mistake of a user is seen."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

RIGHT = """
import patchproof as pp

scene = pp.load_scene("scene.toml")
stage = pp.set_stage(scene)
pictures = pp.photograph(stage, None, scene.draw("evaluate", 4), (96, 96))
run: pp.Run = pp.optimize(scene, "run")
rate: float = run.promise.rate
report = pp.verify("photos", "sheet.json", "report")
verdict: str = report.summary.verdict
"""
WRONG = """
import patchproof as pp

scene = pp.load_scene(7)
pictures = pp.photograph(pp.set_stage(scene), None, scene.draw("evaluate", 4), 96)
rate: str = pp.optimize(scene, "run").promise.rate
"""


@pytest.fixture(scope="module")
def errors(tmp_path_factory) -> dict[str, list[str]]:
    """The checker's errors by file, of the package and of two users' scripts, in one run."""
    folder = tmp_path_factory.mktemp("types")
    for name, text in (("right.py", RIGHT), ("wrong.py", WRONG)):
        (folder / name).write_text(text)
    settings = {
        "include": [str(ROOT / "src"), str(folder)],
        "extraPaths": [str(ROOT / "src")],
        "typeCheckingMode": "standard",
    }
    (folder / "pyrightconfig.json").write_text(json.dumps(settings))
    command = ["basedpyright", "--outputjson", "-p", str(folder)]
    young = os.environ | {"NODE_OPTIONS": "--max-semi-space-size=64"}  # MB: a tenth less time in its garbage collector
    checked = json.loads(subprocess.run(command, capture_output=True, text=True, check=False, env=young).stdout)
    assert checked["summary"]["filesAnalyzed"] > 100
    found: dict[str, list[str]] = {"right.py": [], "wrong.py": [], "package": []}
    for error in checked["generalDiagnostics"]:
        if error["severity"] == "error":
            path = Path(error["file"])
            where = path.name if path.parent == folder else "package"
            found[where].append(f"{path.name}:{error['range']['start']['line'] + 1}: {error['message']}")
    return found


def test_the_package_has_no_type_error(errors):
    assert errors["package"] == []


def test_a_users_script_is_understood(errors):
    assert errors["right.py"] == []


def test_three_mistakes_are_three_errors(errors):
    assert [error.split(":")[1] for error in errors["wrong.py"]] == ["4", "5", "6"]
