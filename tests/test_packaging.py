"""What a wheel carries; that an installed one finds it is tried by `.ci/distributions`."""

from __future__ import annotations

from pathlib import Path

from hatchling.builders.wheel import WheelBuilder

ROOT = Path(__file__).resolve().parents[1]


def test_a_wheel_carries_all_code_and_data():
    carried = {file.distribution_path for file in WheelBuilder(str(ROOT)).recurse_included_files()}
    wanted = {
        place + path.relative_to(ROOT / folder).as_posix()
        for folder, place in (
            ("src", ""),
            ("calibration", "patchproof/calibration/"),
            ("print_templates", "patchproof/print_templates/"),
        )
        for path in (ROOT / folder).rglob("*")
        if path.is_file()
        and not any(part == "__pycache__" or part.startswith(".") for part in path.relative_to(ROOT).parts)
    }
    assert wanted <= carried
    for name in (
        "calibration/printers/coated.npz",
        "print_templates/a4.toml",
        "classifier/builtin.safetensors",
        "report/page.html.j2",
        "py.typed",
    ):
        assert f"patchproof/{name}" in wanted
