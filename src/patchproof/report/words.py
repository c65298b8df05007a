"""Sentences for terminal and page that sum up a promise, an evaluation or a verification.

In: a promise, an evaluation or a report, or a report's summary as plain data. Out: lines for the terminal; and a
headline that says whether the patch helps, a sentence with its figures, and the verdict on the promise. A summary's
`worth` is the one comparison behind them, its `next_step` what is still needed to tell.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from patchproof.base.goal import LEAST_GAIN, Goal, points_text
from patchproof.base.output import rate_text
from patchproof.base.settings import NO_PAGE, background_summary
from patchproof.base.text import command_text
from patchproof.base.validation import summarize_names

VERDICTS = {"kept": "Promise kept", "broken": "Promise broken", "cannot_tell": "Promise neither broken nor proved"}
_CONTROLS = {
    "bare": "the bare object",
    "mean": "a plain patch in the design's average color",
    "gray": "a plain gray patch",
    "noise": "a patch of noise",
}
_NO_GAIN = f"A gain of {100 * LEAST_GAIN:.0f} points or more is ruled out."


def headline_of(summary: Mapping[str, Any]) -> str:
    """Say whether the patch helps, as a headline, and by which evidence."""
    worth = summary["worth"]
    if worth is None:
        return "Cannot be told yet"
    words, where = Goal(worth["goal"]).words[worth["word"]], " into these photographs" * (worth["source"] == "rendered")
    return f"{words[0].upper()}{words[1:]} (controls {worth['source']}{where})"


def benefit_sentence(summary: Mapping[str, Any]) -> str:
    """Say the figures behind the headline."""
    worth = summary["worth"]
    if worth is None:
        return "There is nothing to compare the photographs with."
    ours = rate_text(worth["rate"], worth["interval"])
    theirs = rate_text(worth["control_rate"], worth["control_interval"])
    points = points_text(worth["rate"], worth["control_rate"], worth["difference_interval"])
    shown = "these" if worth["photos"] == summary["judged"] else f"{worth['photos']} of these"
    control = _CONTROLS.get(worth["control"], f"the control “{worth['control']}”")
    text = f"Recognized in {ours} of {shown} {summary['judged']} photographs, {control} in {theirs}: {points}."
    text += f" {_NO_GAIN}" if worth["word"] == "does_not_help" else ""
    return text + (f" This cannot tell: {worth['advice']}." if worth["advice"] else "")


def looks_sentence(summary: Mapping[str, Any]) -> str:
    """Say how often these photographs were looked at, as far as it is known."""
    number, planned = summary["looks"], summary["looks_planned"]
    if planned > 1:
        return f"looks: the verdict is computed after each session, {number} so far, {planned} planned"
    more = "; those in other folders are not known, and each further one needs stronger evidence"
    return f"looks: {number}, counted in the report's folder{more}"


def remarks(photos: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, int, str]]:
    """Group photographs: (code, advice, their number, first names), the most frequent first, then by code."""
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


def promise_lines(promise: Any, settings: Mapping[str, Any], run: str = "RUN") -> list[str]:
    """Sum up a promise: whether the design helps and what to do about it, the rate, the background of its views, the
    difference to each control. `settings` are the scene's as plain data, `run` is the run's folder.
    """
    (low, high), target, (first, *more_models) = promise.interval, promise.target, promise.models
    meaning, background = recognition_meaning(first.model_dump(), target.label), background_summary(settings)
    return [
        promise_summary(promise, settings, run),
        f'promise ({target.goal} "{target.label}"): recognized in {promise.rate:.1%} of {promise.n} unseen conditions '
        f"in {promise.sessions} sessions [{low:.1%}, {high:.1%}] by {first.name}"
        f"{background and f', simulated {background}'}",
        *(f"  also {model.name}: {rate_text(model.rate, model.interval)}" for model in more_models),
        *([meaning] if meaning else []),
        *control_lines({kind: claim.model_dump() for kind, claim in promise.controls.items()}),
    ]


def promise_summary(promise: Any, settings: Mapping[str, Any], run: str = "RUN") -> str:
    """Say whether the design helps, which command tells if a promise cannot, what to change if it does not help."""
    change = "place, size or seed" if (settings.get("object") or {}).get("mesh") else "size or seed"
    if (settings.get("patch") or {}).get("kind", "patch") != "patch":
        change = "seed, or let more of the surface change"
    elif settings.get("imported"):
        change = change.replace("seed", "picture")
    advice = {
        "helps": "",
        "does_not_help": f" {_NO_GAIN} Try another {change}.",
        "cannot_tell": f" What tells: {promise.command(run)}.",
    }
    return promise.headline + advice[promise.answer]


def run_lines(run: Any) -> list[str]:
    """Sum up a finished run, and say which command comes next if it helps; else the summary says what to do."""
    folder, settings = str(run.folder), run.scene.settings.model_dump()
    page = f"{run.folder.resolve().name}.json" if settings["sheet"]["template"] == NO_PAGE else "sheet.pdf"
    following = ("sheet", folder, "--out", page) if settings["patch"]["kind"] == "patch" else ("evaluate", folder)
    lines = promise_lines(run.promise, settings | {"imported": run.details.get("imported")}, folder)
    return [*lines, f"run: {folder}", *([f"next: {command_text(*following)}"] if run.promise.answer == "helps" else [])]


def verdict_lines(report: Any) -> list[str]:
    """Sum up a report: the patch's benefit, the verdict on the promise, and the counts behind them."""
    summary, data = report.summary, report.summary.model_dump()
    untested = "" if report.controls else " (no control photographs)"
    lines = [f"{headline_of(data)}. {benefit_sentence(data)}"]
    lines.append(f"verdict: {summary.verdict}{untested}. {summary.reason}".strip())
    lines += [summary.next_step] if summary.next_step else []
    if summary.background:
        hint = f"; a draft of {summary.draft_views} views, preliminary" if summary.draft_views else ""
        lines.append(f"promise simulated {summary.background}{hint}")
    lines.append(f"photographs: {summary.photos}, judged {summary.judged}, measured {summary.measured}")
    if summary.sessions:
        count = sum(session.same_as is None for session in summary.sessions)
        lines.append(f"{count} session{'s' * (count > 1)} ({summary.sessions_known_from})")
        lines += [f"  {summary.sessions_note}"] if summary.sessions_note else []
        lines.append(looks_sentence(data))
    if summary.rate is not None:
        lines.append(f"recognized: {rate_text(summary.rate, summary.interval)} of {summary.judged}")
    others = [item for item in list(summary.models.items())[1:] if item[1].rate is not None]
    lines += [f"  also {name}: {rate_text(model.rate, model.interval)}" for name, model in others]
    if summary.prediction_interval is not None:
        lines.append("expected: {} to {} of {}".format(*summary.prediction_interval, summary.judged))
    if summary.estimated is not None:
        lines += _estimated_lines(summary.estimated)
    if summary.ledger is not None and (culprit := summary.ledger.culprit) is not None:
        share = summary.ledger.shares[culprit].share
        lines.append(f"costs the most: {culprit.replace('_', ' ')} ({100 * share:.0f} points of confidence)")
    lines += [f"not measured: {figure} ({reason})" for figure, reason in summary.not_measured.items()]
    rows = remarks([photo.model_dump() for photo in report.photos])
    lines += [f"  {code}: {count} ({files}): {advice}" for code, advice, count, files in rows]
    return lines + [f"  left out: {sentence}" for sentence in summary.left_out]


def _estimated_lines(estimated: Any) -> list[str]:
    """Sum up the effect as estimated by rendering controls into the photographs."""
    agree = f"re-rendering gave the original answer in {estimated.agree:.0%} of {estimated.photos} photographs"
    if not estimated.controls:
        return [f"controls not rendered into these photographs: {agree}"]
    rows = {control.name: vars(control) | {"rate": control.rates[1]} for control in estimated.controls}
    return [f"controls rendered into these photographs ({agree}):", *control_lines(rows)]


def control_lines(controls: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Write a line per control: its rate, the design's in as many of the same views or photographs, the difference."""
    rows = []
    for kind, claim in controls.items():
        rate, ours = claim["rate"], claim["rate"] + claim["difference"]
        points = points_text(ours, rate, claim["difference_interval"])
        rows.append(f"  {kind:>6}: {rate:6.1%}, design {ours:.1%} in the same {claim['n']}: {points}")
    return rows


def imported_lines(imported: Mapping[str, Any]) -> list[str]:
    """Sum up an imported picture: its size in print, and how far the printer misses its colors."""
    width, height = imported["picture_px"]
    return [
        f"{imported['file']}: {width} × {height} pixels, printed at {imported['dpi']:.0f} dpi; {imported['printer']} "
        f"misses its colors by {abs(imported['delta_e00']):.1f} ΔE00 in the mean, {imported['out_of_gamut']:.0%} of "
        "them visibly",
        *(f"  {note}" for note in imported["notes"]),
    ]


def evaluation_lines(result: Mapping[str, Any]) -> list[str]:
    """Sum up an evaluation: whether the design helps, by each network, its rate and controls."""
    lines, goal = [], Goal(result["goal"])
    for name, rates in result["models"].items():
        (low, high), controls = rates["interval"], rates["controls"]
        ends = {kind: claim["difference_interval"] for kind, claim in controls.items()}
        word = goal.answer(ends[goal.hardest(ends)])
        told = goal.words[word] + f" (what tells: --n {4 * result['n']})" * (word == "cannot_tell")
        share = f"{rates['rate']:.1%} of {result['n']} conditions [{low:.1%}, {high:.1%}]"
        lines.append(f"{name}: {told}; recognized in {share}")
        lines += control_lines(controls)
    return lines
