"""What a verification comes to, in words, for terminal and page alike.

In: a report's summary as plain data. Out: a headline that says whether the patch helps, which is what somebody
came for, a sentence with the figures behind it, and whether the promise held.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from patchproof.base.strict import listed

VERDICTS = {"kept": "Promise kept", "broken": "Promise broken", "cannot_tell": "Promise neither broken nor proved"}
_CONTROLS = {
    "bare": "the bare object",
    "mean": "a piece in its mean color",
    "gray": "a plain gray piece",
    "noise": "a piece of noise",
}
_HELPS = {"assist": "help", "deceive": "deceive"}


def headline_of(summary: Mapping[str, Any]) -> str:
    """Whether the patch helps."""
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


def worth_sentence(summary: Mapping[str, Any]) -> str:
    """The figures behind the headline."""
    worth = summary["worth"]
    if worth is None:
        return "There is nothing to compare the photographs with."
    low, high = (100 * end for end in worth["difference_interval"])
    how = "as photographed" if worth["photographed"] else "as simulated for the promise, not photographed"
    return (
        f"Recognized in {summary['rate']:.1%} of {summary['judged']} photographs, {control_words(worth['control'])} in "
        f"{worth['control_rate']:.1%} ({how}): {100 * worth['difference']:+.1f} points [{low:+.1f}, {high:+.1f}]."
    )


def control_words(name: str) -> str:
    """A control as people call it."""
    return _CONTROLS.get(name, f"the control “{name}”")


def remarks(photos: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, int, str]]:
    """Codes of photographs with advice, their number and the first names: the most frequent first, then by name. Advice
    that says figures of its own photograph is that of the first.
    """
    alike: dict[tuple[str, str], list[str]] = {}
    for photo in photos:
        if photo["code"]:
            alike.setdefault((photo["code"], photo["advice"]), []).append(photo["file"])
    rows = ((code, advice, len(files), listed(files)) for (code, advice), files in alike.items())
    return sorted(rows, key=lambda row: (-row[2], row[:2]))


def meaning_of(model: Mapping[str, Any]) -> str:
    """What it means that this network of a promise recognizes the object; of a classifier that is plain."""
    if model["least_score"] is None:
        return ""
    return (
        f"{model['name']} is a detector: recognized is what it finds in a box of score {model['least_score']:g} or "
        "more that overlaps the object's own by half."
    )
