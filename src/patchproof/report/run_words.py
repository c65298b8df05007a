"""Sentences for the terminal that sum up imported pictures and evaluations."""

from collections.abc import Mapping
from typing import Any

from patchproof.base.goal import Goal
from patchproof.base.validation import not_measured_lines
from patchproof.report.words import control_lines


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
    """Sum up an evaluation: whether the design helps, by each network, its rate and controls."""
    lines, goal = [], Goal(result["goal"])
    for name, rates in result["models"].items():
        low, high = rates["interval"]
        ends = {kind: claim["difference_interval"] for kind, claim in rates["controls"].items()}
        word = goal.answer(ends[goal.hardest(ends)])
        told = goal.words[word] + f" (what tells: --n {4 * result['n']})" * (word == "cannot_tell")
        share = f"{rates['rate']:.1%} of {result['n']} conditions [{low:.1%}, {high:.1%}]"
        lines.append(f"{name}: {told}; recognized in {share}")
        lines += control_lines(rates["controls"])
        if rates["ap50"] is not None:
            lines.append("  AP50 " + ", ".join(f"{kind} {share:.3f}" for kind, share in rates["ap50"].items()))
    return lines + not_measured_lines(result["not_measured"])
