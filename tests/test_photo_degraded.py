"""What is called measured is right: photographs degraded in forty ways, against the truth they were made from.

Run as a program it takes as many photographs as wanted and prints a table by kind:
`python tests/test_photo_degraded.py --photos 1000 [--first 0] [--kinds fold_30 waves] [--rows FILE]`. `--all` takes 16
of each kind; where FILE holds some of them already, those are not taken again.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import numpy as np
import pytest
from bent_paper import SIDE_MM
from degraded_photos import KINDS, take

from patchproof.base.geometry import rect_corners
from patchproof.evidence import measure as measuring
from patchproof.evidence.locate import locate_sheet, pinhole_photo
from patchproof.evidence.results import PhotoEntry
from patchproof.evidence.task import promised_ranges
from patchproof.photo.read import read_photo
from patchproof.photo.unroll import LocatedSheet

FIGURES = ("corners", "azimuth", "distance", "tilt")
CORNERS = rect_corners((0.0, 0.0, SIDE_MM, SIDE_MM))
# One of a kind each: the other kinds, and more photographs of these, are the program's.
USUAL = ("plain", "plain_8_markers", "jpeg_60", "motion_2", "shadow", "lens_mild")
ROLLED = ("roll_60_100_bends", "roll_300_1000_bends", "roll_any_axis")
UNEXPLAINED = ("fold_30", "wobble_12", "two_prints")
RISKY = ("oblique", "lens", "motion_8", "fold_10", "waves", "cone", "glare", "covered")
CROPPED = ("crop_told", "crop_aside", "zoom_told")


@dataclass(frozen=True)
class Outcome:
    """An entry, and by figure how far it is off with the 95 % uncertainty that was stated of it."""

    entry: PhotoEntry
    off: dict[str, tuple[float, float]]

    @property
    def measured(self) -> bool:
        """Whether its status says so."""
        return self.entry.status == "measured"

    def wrong(self) -> dict[str, tuple[float, float]]:
        """Figures of a measured photograph beyond three times what was stated."""
        return {name: pair for name, pair in self.off.items() if self.measured and pair[0] > 3 * pair[1]}


def outcome(kind: str, seed: int, folder) -> Outcome:
    """One photograph, taken and measured as `verify` does."""
    truth, surface, promised = take(kind, seed)
    (folder / "a.jpg").write_bytes(truth.jpeg)
    with patch.object(measuring, "locate_sheet", wraps=locate_sheet) as placing:
        returned: list[LocatedSheet | None] = []
        placing.side_effect = lambda *args: returned.append(locate_sheet(*args)) or returned[-1]
        view = pinhole_photo(read_photo(folder / "a.jpg"), None)
        entry = measuring.measure(view, "a.jpg", surface, promised, promised_ranges(())).entry
    geometry, pose, off = entry.geometry, entry.pose, {}
    if geometry is not None and returned[-1] is not None:
        off["corners"] = _corner_error_mm(returned[-1], truth.px(CORNERS)), geometry.corner_uncertainty_mm
        if geometry.tilt_deg is not None:
            off["tilt"] = abs(geometry.tilt_deg - truth.tilt_deg), geometry.tilt_uncertainty_deg
    if pose is not None and pose.azimuth_deg is not None:
        off["azimuth"] = abs(pose.azimuth_deg - truth.azimuth_deg), pose.azimuth_uncertainty_deg
    if pose is not None and pose.distance_mm is not None:
        off["distance"] = abs(pose.distance_mm - truth.distance_mm), pose.distance_uncertainty_mm
    return Outcome(entry, off)


def _corner_error_mm(placed: LocatedSheet, true_px: np.ndarray) -> float:
    """The farthest that the model's page points at the true pixels lie from the design's corners."""
    mm, steps, px = CORNERS.copy(), 0.05 * np.eye(2), placed.shape.px
    for _ in range(10):
        by_mm = np.stack([(px(mm + step) - px(mm - step)) / 0.1 for step in steps], -1)
        mm = mm + np.clip(np.linalg.solve(by_mm, (true_px - px(mm))[..., None])[..., 0], -20, 20)
    return float(np.linalg.norm(mm - CORNERS, axis=1).max())


@pytest.mark.parametrize("kind", [*USUAL, *ROLLED, *UNEXPLAINED, *RISKY, *CROPPED])
def test_what_is_called_measured_is_right(kind, tmp_path):
    result = outcome(kind, 0, tmp_path)
    assert not result.wrong()
    if kind in USUAL + ROLLED:
        assert result.measured and result.entry.pose is not None and result.entry.pose.azimuth_deg is not None
    if kind in UNEXPLAINED:
        assert not result.measured and result.entry.code in {"curled", "too_few_markers", "several_sheets"}
    if kind in CROPPED:
        assert result.measured and result.entry.pose is None
        expected = "contradicted" if kind == "crop_aside" else "cropped"
        assert result.entry.geometry is not None and result.entry.geometry.focal == expected


@pytest.mark.parametrize(
    ("kind", "seed", "code"),
    [
        ("squeezed", 0, None),
        ("rolling_shutter", 0, None),
        ("keystone", 19, None),
        ("second_far", 2, "several_sheets"),
        ("flat_far", 22, None),
        ("flat_far", 52, None),
        ("design_scaled", 8, None),
        ("design_scaled", 1, "curled"),
        ("dog_ear_small", 0, "too_few_markers"),
        ("corner_cut", 10, None),
        ("corner_cut_ear", 10, "too_few_markers"),
        ("second_covered", 0, "several_sheets"),
        ("draft_gray", 0, "wrong_ink"),
    ],
)
def test_what_prints_and_pictures_do_to_a_sheet_is_in_the_uncertainty_or_refused(kind, seed, code, tmp_path):
    result = outcome(kind, seed, tmp_path)
    assert result.entry.code == code and not result.wrong()
    geometry = result.entry.geometry
    if geometry is not None and geometry.focal == "contradicted":
        assert result.entry.pose is None and geometry.tilt_deg is geometry.tilt_uncertainty_deg is None
    assert kind not in ("squeezed", "rolling_shutter") or (geometry and geometry.focal == "contradicted")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photos", type=int, default=len(KINDS))
    parser.add_argument("--all", action="store_const", const=16 * len(KINDS), dest="photos", help="16 of each kind")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--kinds", nargs="*", default=list(KINDS))
    parser.add_argument("--rows", type=Path, help="JSON lines, one a photograph; those in it are not taken again")
    asked = parser.parse_args()
    lines = asked.rows.read_text(encoding="utf-8").splitlines() if asked.rows and asked.rows.is_file() else []
    rows = {(row["kind"], row["seed"]): row for row in map(json.loads, lines)}
    with TemporaryDirectory() as folder:
        for number in range(asked.photos):
            seed, kind = asked.first + number // len(asked.kinds), asked.kinds[number % len(asked.kinds)]
            if (kind, seed) not in rows:
                rows[kind, seed] = row_of(kind, seed, outcome(kind, seed, Path(folder)))
                if asked.rows:
                    with asked.rows.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(rows[kind, seed]) + "\n")
    print(*table(list(rows.values())), sep="\n")


def row_of(kind: str, seed: int, result: Outcome) -> dict:
    """An outcome as it is stored: `off` has for each figure how far it is off and the stated 95 % uncertainty."""
    off = {name: [round(float(value), 5) for value in pair] for name, pair in result.off.items()}
    return {"kind": kind, "seed": seed, "measured": result.measured, "code": result.entry.code, "off": off}


def table(rows: list[dict]) -> list[str]:
    """A line for each kind and for all, then one for each figure beyond three times what was stated."""
    lines = [
        f"{'kind':20s}  n measured beyond 3x; median corner error in mm; within 1x, within 3x of: corners, azimuth, "
        "distance, tilt; codes of the others"
    ]
    for kind in [*KINDS, "all"]:
        own = [row for row in rows if kind in (row["kind"], "all")]
        taken, shares = [row["off"] for row in own if row["measured"]], []
        for name in FIGURES:
            pairs = [off[name] for off in taken if name in off]
            shares.append(f"{sum(a <= b for a, b in pairs)}, {sum(a <= 3 * b for a, b in pairs)} of {len(pairs)}")
        codes = Counter(row["code"] for row in own if not row["measured"])
        wrong = sum(any(a > 3 * b for a, b in off.values()) for off in taken)
        error = f"{np.median([off['corners'][0] for off in taken]):.3f}" if taken else "-"
        if own:
            lines.append(
                f"{kind:20s} {len(own):4d} {len(taken):4d} {wrong:4d}; {error}; {'; '.join(shares)}; {dict(codes)}"
            )
    beyond = (
        f"{row['kind']} {row['seed']}: {name} {a:.3g} off, stated {b:.3g}"
        for row in rows
        if row["measured"]
        for name, (a, b) in row["off"].items()
        if a > 3 * b
    )
    return [*lines, *beyond]


if __name__ == "__main__":
    main()
