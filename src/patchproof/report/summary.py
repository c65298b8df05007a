"""Short summaries for the terminal: what a person wants to know before opening any file.

In: a promise, an evaluation or a report. Out: lines of text.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from patchproof.report.words import headline_of, meaning_of, remarks, worth_sentence


def promise_lines(promise: Any, background: str = "") -> list[str]:
    """The promised rate, what stood behind the object, and how it compares with each control."""
    low, high = promise.interval
    target = promise.target
    lines = [
        promise.headline,
        f'promise ({target.goal} "{target.label}"): recognized in {promise.rate:.1%} of {promise.n} unseen conditions '
        f"in {promise.sessions} sessions "
        f"[{low:.1%}, {high:.1%}] by {promise.models[0].name}{background and f', before {background}'}",
    ]
    lines += [
        f"  also {model.name}: {model.rate:.1%} [{model.interval[0]:.1%}, {model.interval[1]:.1%}]"
        for model in promise.models[1:]
    ]
    lines += [meaning] if (meaning := meaning_of(promise.models[0].model_dump())) else []
    return lines + _control_lines({kind: claim.model_dump() for kind, claim in promise.controls.items()})


def imported_lines(imported: Mapping[str, Any]) -> list[str]:
    """What became of a picture that was made elsewhere."""
    width, height = imported["picture_px"]
    return [
        f"{imported['file']}: {width} × {height} pixels, printed at {imported['dpi']:.0f} dpi; {imported['printer']} "
        f"misses its colors by {imported['delta_e00']:.1f} ΔE00 in the mean, {imported['out_of_gamut']:.0%} of them "
        "visibly",
        *(f"  {note}" for note in imported["notes"]),
    ]


def evaluation_lines(result: Mapping[str, Any]) -> list[str]:
    """Each network's rate and controls."""
    lines = []
    for name, rates in result["models"].items():
        low, high = rates["interval"]
        lines.append(f"{name}: recognized in {rates['rate']:.1%} of {result['n']} conditions [{low:.1%}, {high:.1%}]")
        lines += _control_lines(rates["controls"])
        if "ap50" in rates:
            lines.append("  AP50 " + ", ".join(f"{kind} {share:.3f}" for kind, share in rates["ap50"].items()))
    return lines


def verdict_lines(report: Any) -> list[str]:
    """What the patch is worth, the verdict, and the counts behind them."""
    summary = report.summary
    plain = summary.model_dump()
    lines = [f"{headline_of(plain)}. {worth_sentence(plain)}"]
    lines.append(f"verdict: {summary.verdict} (effect: {summary.effect}). {summary.reason}".strip())
    lines += [summary.next_step] if summary.next_step else []
    if summary.background:
        hint = f", a draft of {summary.draft_views} views and no more than a hint" if summary.draft_views else ""
        lines.append(f"promised before {summary.background}{hint}")
    lines.append(f"photographs: {summary.photos}, judged {summary.judged}, measured {summary.measured}")
    if summary.sessions:
        lines.append(f"sessions: {len(summary.sessions)} ({summary.sessions_known_from})")
    if summary.rate is not None:
        low, high = summary.interval
        lines.append(f"recognized: {summary.rate:.1%} [{low:.1%}, {high:.1%}]")
    if summary.prediction_interval is not None:
        k_low, k_high = summary.prediction_interval
        lines.append(f"promised: {k_low} to {k_high} of {summary.judged}")
    if summary.forecast is not None:
        forecast = summary.forecast
        low, high = forecast.interval
        lines.append(
            f"expected at the measured views: {forecast.expected:.1f} of {forecast.photos} [{low}, {high}], "
            f"recognized {forecast.recognized}"
        )
    if summary.estimated is not None:
        lines += estimated_lines(summary.estimated)
    if summary.culprit is not None:
        share = summary.ledger[summary.culprit].share
        lines.append(f"costs the most: {summary.culprit.replace('_', ' ')} ({100 * share:.0f} points of confidence)")
    rows = remarks([{"file": photo.file, **_remark(photo)} for photo in report.photos])
    lines += [f"  {code}: {count} ({files}): {advice}" for code, advice, count, files in rows]
    return lines + [f"  left out: {sentence}" for sentence in summary.left_out]


def _remark(photo: Any) -> dict[str, Any]:
    return {"code": photo.code, "advice": photo.remark and photo.remark.advice}


def estimated_lines(estimated: Any) -> list[str]:
    """The effect as estimated from the photographs themselves, by control."""
    if not estimated.controls:
        return [
            f"effect not estimated: {estimated.agree:.0%} of {estimated.photos} photographs say of the design put "
            "back into them what they say themselves"
        ]
    head = f"estimated by putting controls into {estimated.photos} photographs ({estimated.agree:.0%} agree):"
    return [head, *_control_lines({control.name: control.model_dump() for control in estimated.controls})]


def _control_lines(controls: Mapping[str, Mapping[str, Any]]) -> list[str]:
    rows = []
    for kind, claim in controls.items():
        low, high = (100 * bound for bound in claim["difference_interval"])
        seen = f" of {claim['n']}" if claim.get("n") else ""
        rows.append(
            f"  {kind:>6}: {claim['rate']:6.1%}{seen}   "
            f"difference {100 * claim['difference']:+.1f} points [{low:+.1f}, {high:+.1f}]"
        )
    return rows
