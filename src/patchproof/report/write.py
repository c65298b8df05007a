"""Write a report: report.json as it is, report.csv for spreadsheets, report.html for people.

In: the report and its manifest as plain data, and the pictures that lie in the report's folder. Out: files there. The
page needs nothing from outside of itself: styles are inline, pictures are data URIs, there is no script. The same
input gives the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from patchproof.goal import Goal
from patchproof.output import make_folder, write_whole
from patchproof.report.images import DELTA_TOP, data_uri, saved_pictures
from patchproof.report.photo_table import photos_csv
from patchproof.report.plots import ledger_plot, recognition_plot, scale_plot

_WORDS = {
    "kept": ("Promise kept", "The photographs show what was promised before printing."),
    "broken": ("Promise broken", "The photographs show less than was promised before printing."),
    "cannot_tell": ("Cannot tell", "The photographs are too weak as evidence, one way or the other."),
}
_BROKEN_DECEIVE = "The photographs show more recognition than was promised before printing."
_EFFECTS = {
    "shown": "The patch itself makes the difference: it did better than every control.",
    "not_shown": "That the patch itself makes a difference was not shown: it did not clearly beat every control.",
    "not_tested": "Whether the patch itself makes a difference was not tested: there were no control photographs.",
}
_PLOTS = (("tilt_deg", "tilt in degrees"), ("px_per_mm", "pixels per millimetre"))


def write_report(
    report: Mapping[str, Any], manifest: Mapping[str, Any], out_dir: str | Path, ledger: Mapping[str, Any] | None = None
) -> Path:
    """Write report.json, report.csv and report.html into `out_dir`; returns the page's path.

    `report` and `manifest` are `model_dump()`s. Pictures are those of `images.save_pictures` in `out_dir`/pictures:
    `photo`, `seen`, `fitted`, `promised` and `delta_e00`. `ledger` is that of `plots.ledger_plot`.
    """
    out = Path(out_dir)
    make_folder(out)
    pictures = {photo["file"]: saved_pictures(out / "pictures", photo["file"]) for photo in report["photos"]}
    page = render(report, manifest, pictures, ledger)
    texts = {
        "report.json": json.dumps(report, indent=1, allow_nan=False) + "\n",
        "report.csv": photos_csv(report["photos"]),
        "report.html": page,
    }
    for name, text in texts.items():
        write_whole(out / name, lambda path, text=text: path.write_text(text, encoding="utf-8"))
    return out / "report.html"


def render(
    report: Mapping, manifest: Mapping, encoded: Mapping[str, Mapping[str, bytes]], ledger: Mapping | None
) -> str:
    """The page's HTML; `encoded` are JPEG or PNG bytes by photo and kind."""
    import jinja2

    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(
        loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.filters |= {"percent": _percent, "figure": _figure}
    promise = manifest.get("promise")
    primary = promise["models"][0]["name"] if promise else None
    headline, plain = _words(report["summary"]["verdict"], promise)
    return environment.get_template("page.html.j2").render(
        report=report,
        summary=report["summary"],
        manifest=manifest,
        promise=promise,
        primary=primary,
        headline=headline,
        plain=plain,
        effect=_EFFECTS[report["summary"]["effect"]],
        bars=_bars(report["summary"], promise, report["controls"]),
        controls=report["controls"],
        ledger=ledger,
        waterfall=ledger_plot(ledger) if ledger else "",
        plots=_plots(report, promise, primary),
        sized=any(photo["scale_x"] is not None for photo in report["photos"]),
        cards=[_card(photo, encoded.get(photo["file"], {})) for photo in report["photos"]],
        codes=_codes(report["photos"]),
        delta_top=DELTA_TOP,
        settings=json.dumps(manifest["settings"], indent=1, ensure_ascii=False),
        origin=report["origin"],
    )


def _words(verdict: str, promise: Mapping | None) -> tuple[str, str]:
    headline, plain = _WORDS[verdict]
    if verdict == "broken" and Goal(promise["target"]["goal"]).sign < 0:
        plain = _BROKEN_DECEIVE
    return headline, plain


def _bars(summary: Mapping, promise: Mapping | None, controls) -> list[dict]:
    """Rows of the chart of rates: name, rate, interval, and which side of the evidence they belong to."""
    rows = []
    if summary["rate"] is not None:
        rows.append(_bar("These photographs", summary["rate"], summary["interval"], "seen"))
    if promise:
        rows.append(_bar("Promised", promise["rate"], promise["interval"], "promised"))
    if summary["matched_rate"] is not None:
        rows.append(_bar("Promised at these views", summary["matched_rate"], None, "promised"))
    if summary["prediction_interval"] and summary["judged"]:
        allowed = [count / summary["judged"] for count in summary["prediction_interval"]]
        rows.append(_bar(f"Allowed for {summary['judged']} photographs", None, allowed, "allowed"))
    for control in controls:
        if control["n"]:
            rows.append(
                _bar(
                    f"Control: {control['name']}", control["recognized"] / control["n"], control["interval"], "control"
                )
            )
    for name, claim in (promise["controls"] if promise else {}).items():
        rows.append(_bar(f"Promised control: {name}", claim["rate"], claim["interval"], "control"))
    return rows


def _bar(name: str, rate: float | None, interval, kind: str) -> dict:
    return {"name": name, "rate": rate, "interval": interval, "kind": kind}


def _plots(report: Mapping, promise: Mapping | None, primary: str | None) -> list[str]:
    judged = [photo for photo in report["photos"] if photo["status"] != "rejected"]
    drawn = [scale_plot(judged)]
    if promise:
        drawn[:0] = [recognition_plot(judged, primary, name, label, promise["conditions"]) for name, label in _PLOTS]
    return [svg for svg in drawn if svg]


def _card(photo: Mapping, kinds: Mapping[str, bytes]) -> dict:
    return {"photo": photo, "pictures": {kind: data_uri(content) for kind, content in kinds.items()}}


def _codes(photos) -> list[tuple[str, int]]:
    counts: dict[str, int] = {}
    for photo in photos:
        if photo["code"]:
            counts[photo["code"]] = counts.get(photo["code"], 0) + 1
    return sorted(counts.items(), key=lambda item: (-item[1], item[0]))


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.0f} %"


def _figure(value: float | None, digits: int = 2) -> str:
    return "not measured" if value is None else f"{value:.{digits}f}"
