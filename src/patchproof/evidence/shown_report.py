"""A report as a notebook shows it: verdict, rates as bars with intervals, and a photograph."""

from typing import TYPE_CHECKING

import numpy as np

from patchproof.base.notebook import Rates, notebook_html, rates_figure
from patchproof.base.output import image_pixels
from patchproof.evidence.results import Report

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def report_figure(report: Report) -> "Figure":
    """Draw the report's rates beside a photograph."""
    return rates_figure(f"verdict: {report.summary.verdict}", _rates(report), _photo(report))


def report_in_notebook(report: Report) -> str:
    """Return the report's verdict, rates and a photograph as HTML."""
    summary = report.summary
    rows = {"photographs": f"{summary.photos}, judged {summary.judged}, measured {summary.measured}"}
    if summary.prediction_interval is not None:
        rows["expected"] = "{} to {} of {}".format(*summary.prediction_interval, summary.judged)
    rows |= {"reason": summary.reason, "next": summary.next_step}
    rows = {key: text for key, text in rows.items() if text}
    return notebook_html(f"verdict: {summary.verdict}", rows, _rates(report), _photo(report))


def _rates(report: Report) -> Rates:
    """The photographs' rates with their intervals by name, the patch's first; {} if nothing was judged."""
    summary, worth, rates = report.summary, report.summary.worth, {}
    if summary.rate is None or summary.interval is None:
        return rates
    rates[f"patch, {summary.judged} photographs"] = summary.rate, summary.interval
    for each in report.controls:
        if each.n:
            rates[f"{each.name}, {each.n} photographs"] = each.recognized / each.n, each.interval
    if worth is not None and worth.source != "photographed":
        rates[f"{worth.control}, {worth.source}"] = worth.control_rate, worth.control_interval
    return rates


def _photo(report: Report) -> np.ndarray | None:
    """The first photograph that the report's folder has a picture of."""
    paths = [] if report.folder is None else sorted((report.folder / "pictures").glob("*.photo.jpg"))
    return image_pixels(paths[0].read_bytes()) if paths else None
