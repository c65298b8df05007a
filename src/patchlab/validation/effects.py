"""Check effects estimated by rendering a control into photographs against those of photographed controls.

In: settings of `promises`, and a control. Out: for every session of photographs by another renderer, the effect
estimated from the photographs beside that with photographs of the control under the same conditions; by scene the bias
of the estimates and the coverage of their intervals.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from patchlab.study.estimates import mean
from patchlab.study.grid import by_scene
from patchlab.study.study import Cell, Result, Study
from patchlab.validation import photo_sessions
from patchproof.base.intervals import rate
from patchproof.report.tables import Table


class EffectsSettings(photo_sessions.SessionsSettings):
    """Settings of sessions, and the control that is photographed in place of each design."""

    control: Literal["mean", "gray", "noise"] = "gray"  # photographed under the same conditions


def run(settings: EffectsSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Record estimated effects and photographed effects by session."""
    with tempfile.TemporaryDirectory() as temporary:
        folder, sessions = Path(temporary), []
        patch_run = photo_sessions.make_run_and_sheet(base, cell, folder)
        photos, controls = (
            photo_sessions.take_photos(settings, cell, patch_run, folder, control)
            for control in (None, settings.control)
        )
        for name in sorted(path.name for path in photos.iterdir() if path.is_dir()) or [""]:  # one has no folder
            report = photo_sessions.verify_photos(photos / name, folder, base, cell, controls=controls / name)
            sessions.append(_record_session(report, settings.control))
    return photo_sessions.record_promise(patch_run) | {"sessions": sessions}


def _record_session(report: Any, control: str) -> dict[str, Any]:
    """A session's record from its report; effects are the patch's rate minus the control's."""
    summary = report.summary
    record: dict[str, Any] = {"photos": summary.judged, "agree": None, "estimated": None, "photographed": None}
    if summary.estimated is not None:
        record["agree"] = summary.estimated.agree
        of_control = [claim for claim in summary.estimated.controls if claim.name == control]
        record["estimated"] = [(claim.difference, *claim.difference_interval) for claim in of_control][0:1] or None
    if report.controls:
        record["photographed"] = report.controls[0].difference
    return record


def tables(settings: EffectsSettings, results: Sequence[Result]) -> tuple[Table, ...]:
    """Tables of effects, by scene and in all, and of every session."""
    about = f"{settings.sessions} sessions of {settings.photos} photographs of each run; the patch beside "
    about += settings.control
    head = ("scene", "sessions", "refused", "photographed effect", "estimated minus photographed", "interval held")
    effects = [(name, *_effect_row(group)) for name, group in (by_scene(results) | {"all": list(results)}).items()]
    return Table("effects", "Effects estimated and photographed", head, tuple(effects), about), _session_table(results)


def _effect_row(group: Sequence[Result]) -> tuple:
    sessions = [session for result in group for session in result.answers["sessions"]]
    refused = [session["estimated"] is None for session in sessions]
    both = [
        (*session["estimated"][0], session["photographed"])
        for session in sessions
        if session["estimated"] is not None and session["photographed"] is not None
    ]
    if not both:
        return len(sessions), rate(refused), None, None, None
    errors = [estimated - photographed for estimated, _, _, photographed in both]
    held = rate([low <= photographed <= high for _, low, high, photographed in both])
    return len(sessions), rate(refused), mean([photographed for *_, photographed in both]), mean(errors), held


def _session_table(results: Sequence[Result]) -> Table:
    rows, measured = [], ("session", "photographs", "agree", "estimated", "low", "high", "photographed")
    for result in results:
        start = tuple(result.cell.values[name] for name in ("name", "network", "seed"))
        for number, session in enumerate(result.answers["sessions"], 1):
            estimated = session["estimated"][0] if session["estimated"] else (None,) * 3
            rows.append((*start, number, session["photos"], session["agree"], *estimated, session["photographed"]))
    head = ("scene", "network", "seed", *measured)
    return Table("sessions", "Every session", head, tuple(rows), "effects are of the patch minus the control")


STUDY = Study("effects", EffectsSettings, photo_sessions.cells, run, tables)
