"""Check what `patchproof demo` left behind: `python tests/check_demo.py FOLDER`."""

from __future__ import annotations

import json
import sys
from pathlib import Path


def check(folder: Path) -> list[str]:
    """What is wrong with a demo's folder; nothing when all is well."""
    wanted = ("run/design.png", "run/run.json", "sheet.pdf", "sheet.json", "photos/truth.json", "report/report.html")
    wrong = [f"{name} is missing" for name in wanted if not (folder / name).is_file()]
    if wrong:
        return wrong
    manifest = json.loads((folder / "sheet.json").read_text())
    summary = json.loads((folder / "report" / "report.json").read_text())["summary"]
    promise = manifest["promise"]
    best = max(claim["rate"] for claim in promise["controls"].values())
    photos = len(list((folder / "photos").rglob("*.jpg")))
    for ok, sentence in (
        (photos >= 40, f"{photos} photographs, expected 40 or more"),
        (summary["judged"] == photos, f"{summary['judged']} of {photos} photographs judged, expected all"),
        (summary["measured"] >= 0.9 * photos, f"{summary['measured']} of {photos} photographs measured, expected 90 %"),
        (summary["verdict"] == "kept", f"the verdict is {summary['verdict']}, expected kept"),
        (best <= 0.75, f"the best control reaches {best:.2f}, expected at most 0.75"),
        (promise["rate"] - best >= 0.15, f"promise {promise['rate']:.2f} against {best:.2f}, expected 15 points more"),
    ):
        if not ok:
            wrong.append(sentence)
    return wrong


if __name__ == "__main__":
    problems = check(Path(sys.argv[1]))
    print("\n".join(problems) or "the demo left what it should")
    sys.exit(bool(problems))
