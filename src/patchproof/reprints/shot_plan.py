"""The shot plan: how many photographs to take, in how many places, from where and of which controls, so that the
answers will not be `cannot_tell`.

In: a promise and the scene's ranges. Out: counts, and sentences for the sheet's last page. Photographs of one session
are alike, so that a few in each of several places prove more than many in one: for some numbers of photographs and
sessions, the counts that the promise allows for, the chance that they prove it, and the least gain that they show
beside as many photographs of a control in the same places.
"""

from patchproof.base.sessions import split_evenly
from patchproof.base.settings import SceneSettings, background_summary
from patchproof.evidence import verdict
from patchproof.optimizer.promise import PROMISE_VIEWS
from patchproof.report.words import promise_summary
from patchproof.sheets.manifest import Promise

SHOT_COUNTS = ((40, 1), (40, 2), (40, 4), (40, 8), (80, 8))  # photographs, sessions


def shot_sections(promise: Promise, settings: SceneSettings) -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Say how many photographs to take, and from where, as (heading, lines)."""
    data = settings.model_dump()
    summary = f"{promise_summary(promise, data)} Promise simulated {background_summary(data)}."
    counts = (summary, *_count_lines(promise))
    return (("How many photographs", counts), ("From where", _view_lines(settings)))


def _count_lines(promise: Promise) -> tuple[str, ...]:
    needed = verdict.photos_line(promise, (), promise.best_control)
    promised = (
        f"Promised: {promise.rate:.1%} recognized as {promise.target.label}, of {promise.n} views in "
        f"{promise.sessions} sessions, each with a place, light, camera and print of its own."
    )
    if promise.answer == "does_not_help":
        return promised, needed
    proofs = (
        f"A verdict asks the photographs to prove a rate of {verdict.required_rate(promise):.0%}. What they will show "
        "if the promise holds (the chance that it is enough; the least gain that they show beside as many photographs "
        f"of a control in the same places): {'; '.join(_proof(promise, *counts) for counts in SHOT_COUNTS)}."
        f"{verdict.useless_note(promise)}"
    )
    short = promise.n < PROMISE_VIEWS and not promise.draft
    more = (
        f"A promise of {PROMISE_VIEWS} views (patchproof promise RUN --n {PROMISE_VIEWS}, then this page again) "
        "knows better how much places differ, and often asks for fewer of them."
    )
    pairs = (
        "Take each view twice, with the patch and with the control, under equal file names, each control in a folder "
        "of its own: pairs tell more. A patch helps only if it beats every control that you photograph."
    )
    return promised, proofs, needed, *([more] if short else []), pairs


def _proof(promise: Promise, photos: int, sessions: int) -> str:
    """What so many photographs prove: the counts allowed for, the chance of `kept`, and the least gain they show."""
    split, gain = split_evenly(photos, sessions), verdict.provable_gain(promise, sessions, photos // sessions)
    low, high = promise.posterior.count_interval(split)
    chance, shown = verdict.kept_chance(promise, split), "no gain" if gain is None else f"{gain:.0%}"
    return f"{photos} in {verdict.places_text(sessions)}: {low} to {high} ({chance:.0%}; {shown})"


def _view_lines(settings: SceneSettings) -> tuple[str, ...]:
    if settings.object.mesh is None:
        return ("As the scene's own photographs were taken: the same places, distances and light.",)
    view, patch = settings.view, settings.patch
    target = "object" if view.look_at == "object" else "piece"
    light = "Light as it comes" if settings.light.ambient[0] < 1 else "Bright light"
    front = "the place of the piece" if patch.at_mm is not None else f"the piece's side ({patch.side})"
    if view.front != "patch":
        front = f"the object's {view.front} side"
    return (
        f"Spread over all of these, not the best ones: {_degrees(view.azimuth_deg)} to the left (-) and right (+) of "
        f"facing {front}, {_degrees(view.elevation_deg)} above it, "
        f"{view.distance_mm[0] / 10:.0f} to {view.distance_mm[1] / 10:.0f} cm from the middle of the {target}, the "
        f"camera turned by {_degrees(view.roll_deg)}.",
        f"The {target} belongs in the middle of the picture, the whole piece in view; classifiers see the picture's "
        "centered square.",
        f"{light}, without flash, shine or filters; views outside of these ranges are not counted.",
    )


def _degrees(bounds: tuple[float, float]) -> str:
    return f"{bounds[0]:g}° to {bounds[1]:g}°"
