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

from patchproof.base.goal import points_text
from patchproof.base.output import make_folder, write_atomically
from patchproof.base.text import csv_lines
from patchproof.report import words
from patchproof.report.page import DELTA_TOP, data_uri, render_page, saved_pictures
from patchproof.report.plots import ledger_plot, recognition_plot

_FIRST = ("file", "status", "code", "figure", "threshold", "advice")
_PLOTS = (("tilt_deg", "tilt in degrees"), ("px_per_mm", "pixels per millimeter"))


def write_report(report: Mapping, manifest: Mapping, out_dir: str | Path, ledger: Mapping | None = None) -> Path:
    """Write report.json, report.csv and report.html into `out_dir`; returns the page's path.

    `report` and `manifest` are `model_dump()`s. Pictures are those of `page.save_pictures` in `out_dir`/pictures:
    `photo`, `seen`, `fitted`, `promised` and `delta_e00`. `ledger` is that of `plots.ledger_plot`.
    """
    out = Path(out_dir)
    make_folder(out)
    pictures = {photo["file"]: saved_pictures(out / "pictures", photo["file"]) for photo in report["photos"]}
    write_atomically(out / "report.json", json.dumps(report, indent=1, allow_nan=False) + "\n")
    write_atomically(out / "report.csv", photos_csv(report["photos"]))
    write_atomically(out / "report.html", report_html(report, manifest, pictures, ledger))
    return out / "report.html"


def report_html(report: Mapping, manifest: Mapping, encoded: Mapping[str, Mapping], ledger: Mapping | None) -> str:
    """Render the page's HTML; `encoded` are JPEG or PNG bytes by photo and kind."""
    promise, summary, photos = manifest.get("promise"), report["summary"], report["photos"]
    judged = [photo for photo in photos if photo["status"] != "rejected"]
    plots, primary = [], None
    if promise:
        primary = promise["models"][0]["name"]
        plots = [
            (recognition_plot(judged, primary, name, label, promise["conditions"]), f"chart of recognition by {label}")
            for name, label in _PLOTS
        ]
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
        ledger=ledger,
        waterfall=ledger_plot(ledger) if ledger else "",
        plots=[(svg, about) for svg, about in plots if svg],
        sized=any(photo["scale_x"] is not None for photo in photos),
        cards=cards,
        remarks=words.remarks(photos),
        times=Counter(text for photo in photos for text in (photo["advice"], *photo.get("said", ()))),
        points=points_text,
        delta_top=DELTA_TOP,
        settings=json.dumps(manifest["settings"], indent=1, ensure_ascii=False),
        origin=report["origin"],
    )


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
