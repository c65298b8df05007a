"""Sentences for terminal and page that sum up a promise, an evaluation or a verification.

In: a promise, an evaluation or a report, or a report's summary as plain data. Out: lines for the terminal; and a
headline that says whether the patch helps, a sentence with its figures, and the verdict on the promise.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from patchproof.base.validation import not_measured_lines, summarize_names

VERDICTS = {"kept": "Promise kept", "broken": "Promise broken", "cannot_tell": "Promise neither broken nor proved"}
_CONTROLS = {
    "bare": "the bare object",
    "mean": "a piece in its mean color",
    "gray": "a plain gray piece",
    "noise": "a piece of noise",
}
_HELPS = {"assist": "help", "deceive": "deceive"}


def headline_of(summary: Mapping[str, Any]) -> str:
    """Say whether the patch helps, as a headline."""
    worth = summary["worth"]
    if worth is None:
        return "Cannot tell whether it helps"
    does, against = _HELPS[worth["goal"]], control_words(worth["control"])
    return {
        "helps": f"{does.capitalize()}s" + ("" if worth["photographed"] else " beside simulated controls"),
        "no_better": f"No better than {against}",
        "worse": f"Worse than {against}",
        "not_shown": f"Not shown to {does}",
    }[worth["word"]]


def benefit_sentence(summary: Mapping[str, Any]) -> str:
    """Say the figures behind the headline."""
    worth = summary["worth"]
    if worth is None:
        return "There is nothing to compare the photographs with."
    low, high = (100 * end for end in worth["difference_interval"])
    source = "as photographed" if worth["photographed"] else "as simulated for the promise, not photographed"
    return (
        f"Recognized in {summary['rate']:.1%} of {summary['judged']} photographs, {control_words(worth['control'])} in "
        f"{worth['control_rate']:.1%} ({source}): {100 * worth['difference']:+.1f} points [{low:+.1f}, {high:+.1f}]."
        + (f" This cannot tell: {worth['advice']}." if worth["advice"] else "")
    )


def looks_sentence(summary: Mapping[str, Any]) -> str:
    """Say how often these photographs were looked at, as far as it is known."""
    number, planned = summary["looks"], summary["looks_planned"]
    if planned > 1:
        return f"looks: watched while taken, so one for each session: {number}, {planned} planned"
    more = "; those in other folders are not known, and each one more asks for more proof"
    return f"looks: {number}, counted in the report's folder{more}"


def control_words(name: str) -> str:
    """Describe a control in plain words."""
    return _CONTROLS.get(name, f"the control “{name}”")


def remarks(photos: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, int, str]]:
    """Group photographs by code and advice: (code, advice, their number, the first names), the most frequent first,
    then by code.
    """
    groups: dict[tuple[str, str], list[str]] = {}
    for photo in photos:
        if photo["code"]:
            groups.setdefault((photo["code"], photo["advice"]), []).append(photo["file"])
    rows = ((code, advice, len(files), summarize_names(files)) for (code, advice), files in groups.items())
    return sorted(rows, key=lambda row: (-row[2], row[:2]))


def recognition_meaning(model: Mapping[str, Any], label: str) -> str:
    """Explain when a detector of a promise recognizes the object; empty for a classifier."""
    if model["least_score"] is None:
        return ""
    return (
        f"{model['name']} is a detector: recognized is a photograph with a box of “{label}”, of score "
        f"{model['least_score']:g} or more, over the piece's object: the box and the object's own share half or more."
    )


def promise_lines(promise: Any, background: str = "") -> list[str]:
    """Sum up a promise: the rate, the background of its views, and the difference to each control."""
    (low, high), target, (first, *more_models) = promise.interval, promise.target, promise.models
    meaning = recognition_meaning(first.model_dump(), target.label)
    return [
        promise.headline,
        f'promise ({target.goal} "{target.label}"): recognized in {promise.rate:.1%} of {promise.n} unseen conditions '
        f"in {promise.sessions} sessions "
        f"[{low:.1%}, {high:.1%}] by {first.name}{background and f', before {background}'}",
        *(f"  also {m.name}: {m.rate:.1%} [{m.interval[0]:.1%}, {m.interval[1]:.1%}]" for m in more_models),
        *([meaning] if meaning else []),
        *_control_lines({kind: claim.model_dump() for kind, claim in promise.controls.items()}),
    ]


def imported_lines(imported: Mapping[str, Any]) -> list[str]:
    """Sum up an imported picture: its size in print, and how far the printer misses its colors."""
    width, height = imported["picture_px"]
    return [
        f"{imported['file']}: {width} × {height} pixels, printed at {imported['dpi']:.0f} dpi; {imported['printer']} "
        f"misses its colors by {imported['delta_e00']:.1f} ΔE00 in the mean, {imported['out_of_gamut']:.0%} of them "
        "visibly",
        *(f"  {note}" for note in imported["notes"]),
    ]


def evaluation_lines(result: Mapping[str, Any]) -> list[str]:
    """Sum up an evaluation: each network's rate and controls."""
    lines = []
    for name, rates in result["models"].items():
        low, high = rates["interval"]
        lines.append(f"{name}: recognized in {rates['rate']:.1%} of {result['n']} conditions [{low:.1%}, {high:.1%}]")
        lines += _control_lines(rates["controls"])
        if rates["ap50"] is not None:
            lines.append("  AP50 " + ", ".join(f"{kind} {share:.3f}" for kind, share in rates["ap50"].items()))
    return lines + not_measured_lines(result["not_measured"])


def verdict_lines(report: Any) -> list[str]:
    """Sum up a report: the patch's benefit, the verdict on the promise, and the counts behind them."""
    summary = report.summary
    data = summary.model_dump()
    lines = [f"{headline_of(data)}. {benefit_sentence(data)}"]
    lines.append(f"verdict: {summary.verdict} (effect: {summary.effect}). {summary.reason}".strip())
    lines += [summary.next_step] if summary.next_step else []
    if summary.background:
        hint = f", a draft of {summary.draft_views} views and no more than a hint" if summary.draft_views else ""
        lines.append(f"promised before {summary.background}{hint}")
    lines.append(f"photographs: {summary.photos}, judged {summary.judged}, measured {summary.measured}")
    if summary.sessions:
        count = sum(session.same_as is None for session in summary.sessions)
        lines.append(f"sessions: {count} ({summary.sessions_known_from})")
        lines += [f"  {summary.sessions_note}"] if summary.sessions_note else []
        lines.append(looks_sentence(data))
    if summary.rate is not None:
        lines.append("recognized: {:.1%} [{:.1%}, {:.1%}]".format(summary.rate, *summary.interval))
    others = [item for item in list(summary.models.items())[1:] if item[1].rate is not None]
    lines += ["  also {}: {:.1%} [{:.1%}, {:.1%}]".format(name, rate.rate, *rate.interval) for name, rate in others]
    if summary.prediction_interval is not None:
        lines.append("promised: {} to {} of {}".format(*summary.prediction_interval, summary.judged))
    if (forecast := summary.forecast) is not None:
        head = f"expected at the measured views: {forecast.expected:.1f} of {forecast.photos}"
        lines.append(f"{head} [{forecast.interval[0]}, {forecast.interval[1]}], recognized {forecast.recognized}")
    if summary.estimated is not None:
        lines += _estimated_lines(summary.estimated)
    if summary.culprit is not None:
        share = summary.ledger[summary.culprit].share
        lines.append(f"costs the most: {summary.culprit.replace('_', ' ')} ({100 * share:.0f} points of confidence)")
    lines += not_measured_lines(summary.not_measured)
    rows = remarks([photo.model_dump() for photo in report.photos])
    lines += [f"  {code}: {count} ({files}): {advice}" for code, advice, count, files in rows]
    return lines + [f"  left out: {sentence}" for sentence in summary.left_out]


def _estimated_lines(estimated: Any) -> list[str]:
    """Sum up the effect as estimated by rendering controls into the photographs."""
    if not estimated.controls:
        return [
            f"effect not estimated: the network gives the original answer in {estimated.agree:.0%} of "
            f"{estimated.photos} photographs when the design is rendered back into them"
        ]
    head = f"estimated by rendering controls into {estimated.photos} photographs ({estimated.agree:.0%} agree):"
    return [head, *_control_lines({control.name: control.model_dump() for control in estimated.controls})]


def _control_lines(controls: Mapping[str, Mapping[str, Any]]) -> list[str]:
    rows = []
    for kind, claim in controls.items():
        low, high = (100 * bound for bound in claim["difference_interval"])
        of_count = f" of {claim['n']}" if claim.get("n") else ""
        difference = f"difference {100 * claim['difference']:+.1f} points [{low:+.1f}, {high:+.1f}]"
        rows.append(f"  {kind:>6}: {claim['rate']:6.1%}{of_count}   {difference}")
    return rows
