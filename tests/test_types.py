"""What a user's editor knows of the package: no error in a script that is right, and every mistake in a wrong one.

That the package has no type error itself is checked by `basedpyright`, as CONTRIBUTING and CI have it.
"""

from __future__ import annotations

import json
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
def errors(tmp_path_factory) -> dict[str, list[int]]:
    """The lines that the checker calls wrong in two users' scripts, in one run."""
    folder = tmp_path_factory.mktemp("types")
    for name, text in (("right.py", RIGHT), ("wrong.py", WRONG)):
        (folder / name).write_text(text)
    settings = {"include": [str(folder)], "extraPaths": [str(ROOT / "src")], "typeCheckingMode": "standard"}
    (folder / "pyrightconfig.json").write_text(json.dumps(settings))
    command = ["basedpyright", "--outputjson", "-p", str(folder)]
    checked = json.loads(subprocess.run(command, capture_output=True, text=True, check=False).stdout)
    assert checked["summary"]["filesAnalyzed"] == 2
    found: dict[str, list[int]] = {"right.py": [], "wrong.py": []}
    for error in checked["generalDiagnostics"]:
        if error["severity"] == "error":
            found[Path(error["file"]).name].append(error["range"]["start"]["line"] + 1)
    return found


def test_a_users_script_is_understood(errors):
    assert errors["right.py"] == []


def test_three_mistakes_are_three_errors(errors):
    assert errors["wrong.py"] == [4, 5, 6]
