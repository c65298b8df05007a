"""Write a report: report.json with all data, report.csv for spreadsheets and statistics, report.html for people.

In: the report and its manifest as plain data, and the pictures in the report's folder. Out: files in that folder. The
page is self-contained: styles are inline, pictures are data URIs, there is no script. In the CSV each of the nine
entries of a homography and each network's predictions have their own columns; a figure that was not measured is an
empty cell. The same input gives the same bytes.
"""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from patchproof.base.csv_file import csv_lines
from patchproof.base.goal import points_text
from patchproof.base.intervals import Estimate, rate
from patchproof.base.output import data_uri, make_folder, write_atomically, write_json
from patchproof.report import words
from patchproof.report.page import DELTA_TOP, render_page, saved_pictures

_FIRST = ("file", "status", "code", "figure", "threshold", "advice")
# figures of a photograph by which recognition is split, in a band's words
_BANDS = {"tilt_deg": "tilted {:.0f} to {:.0f}°", "px_per_mm": "{:.3g} to {:.3g} pixels per mm"}
_LEAST_BANDED = 12  # photographs, of which each band has a third
_STEPS = {  # of the gap ledger
    "light_and_camera": "light, camera color",
    "print_light_and_camera": "print, light, camera",
    "blur_and_noise": "blur, noise",
    "photo": "not explained",
}


def write_report(report: Mapping, manifest: Mapping, out_dir: str | Path) -> Path:
    """Write report.json, report.csv and report.html into `out_dir`; returns the page's path. `report` and `manifest`
    are `model_dump()`s; pictures are those of `page.save_pictures` in `out_dir`/pictures.
    """
    out = Path(out_dir)
    make_folder(out)
    pictures = {photo["file"]: saved_pictures(out / "pictures", photo["file"]) for photo in report["photos"]}
    write_json(out / "report.json", report)
    write_atomically(out / "report.csv", photos_csv(report["photos"]))
    write_atomically(out / "report.html", report_html(report, manifest, pictures))
    return out / "report.html"


def report_html(report: Mapping, manifest: Mapping, encoded: Mapping[str, Mapping]) -> str:
    """Render the page's HTML; `encoded` are JPEG or PNG bytes by photo and kind."""
    promise, summary, photos = manifest.get("promise"), report["summary"], report["photos"]
    judged = [photo for photo in photos if photo["status"] != "rejected"]
    primary = promise["models"][0]["name"] if promise else None
    pictures = {file: {kind: data_uri(data) for kind, data in kinds.items()} for file, kinds in encoded.items()}
    cards = [{"photo": photo, "pictures": pictures.get(photo["file"], {})} for photo in photos]
    return render_page(
        "page.html.j2",
        report=report,
        summary=summary,
        manifest=manifest,
        promise=promise,
        primary=primary,
        headline=words.headline_of(summary),
        worth=words.benefit_sentence(summary),
        example=_median_card([card for card in cards if card["photo"] in judged], primary),
        looks=words.looks_sentence(summary),
        meaning=words.recognition_meaning(promise["models"][0], promise["target"]["label"]) if promise else "",
        verdict=words.VERDICTS[summary["verdict"]],
        steps=ledger_bars(summary["ledger"]) if summary["ledger"] else (),
        bands=rates_by_band(judged, primary, promise["conditions"]) if promise else (),
        scale=next(((p["scale_x"], p["scale_y"]) for p in photos if p["scale_x"] is not None), None),
        cards=cards,
        remarks=words.remarks(photos),
        times=Counter(text for photo in photos for text in (photo["advice"], *photo.get("said", ()))),
        points=points_text,
        delta_top=DELTA_TOP,
        settings=json.dumps(manifest["settings"], indent=1, ensure_ascii=False),
        origin=report["origin"],
    )


def ledger_bars(ledger: Mapping[str, Any]) -> list[tuple[str, float, float, str, str]]:
    """The gap ledger as bars from the ideal picture's confidence to the photographs': (step, left and right end within
    0 to 1, kind, change in points with its 95 % interval). A positive share is a loss for the goal.
    """
    level, rows = ledger["ideal"], [("ideal", 0.0, ledger["ideal"], "promised", f"{100 * ledger['ideal']:.0f} %")]
    rises = (ledger["photo"] > level) != (sum(each["share"] for each in ledger["shares"].values()) < 0)
    for step, each in ledger["shares"].items():
        sign, kind = 100 if rises else -100, "miss" if each["share"] > 0 else "hit"
        points = [round(sign * value, 1) + 0 for value in (each["share"], *(each["interval"] or ()))]  # + 0: no -0.0
        text = f"{points[0]:+.1f}" + (" [{:+.1f}, {:+.1f}]".format(*sorted(points[1:])) if points[1:] else "")
        left, right = sorted((level, after := level + sign * each["share"] / 100))
        rows.append((_STEPS.get(step) or step, left, right, kind, text))
        level = after
    return [*rows, ("photographs", 0.0, ledger["photo"], "seen", f"{100 * ledger['photo']:.0f} %")]


def rates_by_band(
    photos: Sequence[Mapping], model: str | None, conditions: Sequence[Mapping]
) -> list[tuple[str, Estimate, Estimate | None]]:
    """Return (band, rate, rate promised within it or None) for thirds of photographs by tilt and by size."""
    rows = []
    for figure, text in _BANDS.items():
        seen = sorted(
            (photo[figure], photo["predictions"][model]["recognized"])
            for photo in photos
            if photo[figure] is not None and model in photo["predictions"]
        )
        for third in range(3) if len(seen) >= _LEAST_BANDED else ():
            some = seen[len(seen) * third // 3 : len(seen) * (third + 1) // 3]
            (low, _), (high, _) = some[0], some[-1]
            there = [
                each["recognized"] for each in conditions if each[figure] is not None and low <= each[figure] <= high
            ]
            rows.append((text.format(low, high), rate([hit for _, hit in some]), rate(there)))
    return rows


def _median_card(cards: Sequence[Mapping], model: str | None) -> Mapping | None:
    """The counted photograph of median confidence in the target, of those with a picture; None without any."""
    seen = [c for c in cards if "photo" in c["pictures"] and model in c["photo"]["predictions"]]
    seen.sort(key=lambda card: card["photo"]["predictions"][model]["target_confidence"])
    return seen[len(seen) // 2] if seen else None


def photos_csv(photos: Sequence[Mapping[str, Any]]) -> str:
    """Convert photographs to CSV; without any, only the head's first columns."""
    rows = [_csv_row(photo) for photo in photos]
    head = list(dict.fromkeys((*_FIRST, *(name for row in rows for name in row))))
    return csv_lines([head, *([row.get(name, "") for name in head] for row in rows)])


def _csv_row(photo: Mapping[str, Any]) -> dict[str, Any]:
    row = {}
    for name, value in photo.items():
        if name == "homography_px_from_mm":
            numbers = [None] * 9 if value is None else [number for line in value for number in line]
            row |= {f"{name}_{i // 3}{i % 3}": number for i, number in enumerate(numbers)}
        elif name == "predictions":
            keys = ("label", "confidence", "target_confidence", "recognized")
            row |= {f"{model} {key}": answer[key] for model, answer in value.items() for key in keys}
        else:
            row[name] = value
    return row
