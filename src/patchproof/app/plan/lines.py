"""Format a plan as lines for the terminal."""

from collections.abc import Mapping
from typing import Any

from patchproof.base.validation import not_measured_lines
from patchproof.optimizer.place_search import place_lines
from patchproof.scene.interface import PX_PER_MODULE, READABLE_SHARE, measurable_text

Data = Mapping[str, Any]


def geometry_lines(plan: Data) -> list[str]:
    """Format the part of a plan that is known before anything is measured."""
    lines = [f"{plan['scene']}: {plan['target']}, {plan['kind']}, seen by {', '.join(plan['models'])}"]
    if plan["place"] is not None:
        lines += ["place", *(f"  {line}" for line in place_lines(plan["place"]))]
    lines += ["surface", *_surface_lines(plan["surface"])]
    lines += ["resolution", *_resolution_lines(plan["resolution"])]
    if plan["markers"] is not None:
        lines += ["markers", _marker_line(plan["markers"], plan["surface"]["family"])]
    return lines


def measured_lines(plan: Data) -> list[str]:
    """Format the part of a plan that was measured."""
    lines, cost = _term_lines(plan["terms"], plan["draft"]), plan["cost"]
    lines += ["photographs", f"  {plan['photographs']}"] if plan["photographs"] else []
    lines += ["not modeled", *(f"  {text}" for text in plan["omitted"])]
    views = f"{cost['views']} views of {cost['side_px']} px, {cost['threads']} threads"
    lines += [f"cost of a step ({views}): {cost['ms']:.0f} ms"]
    lines += [f"  {name:38} {ms:7.0f} ms {ms / cost['ms']:6.1%}" for name, ms in cost["parts"].items()]
    return lines + not_measured_lines(plan["not_measured"])


def _surface_lines(surface: Data) -> list[str]:
    width, height = surface["size_mm"]
    lines = [f"  {surface['family']}, {width:.0f} × {height:.0f} mm: {surface['reason']}"]
    if surface.get("gap_mm") is not None:
        gap, overhang, stretch = surface["gap_mm"], surface["overhang_share"], surface["stretch"]
        lines.append(
            f"  gap {gap:.2f} mm ({gap / min(width, height):.1%} of the shorter edge), mean "
            f"{surface['gap_mean_mm']:.2f} mm; overhang {overhang * width * height:.0f} mm² ({overhang:.1%}); stretch "
            f"{stretch * max(width, height):.2f} mm ({stretch:.2%})"
        )
    return lines + ([f"  {surface['other']}"] if surface["other"] else [])


def _resolution_lines(views: Data) -> list[str]:
    (far, near), (far_photo, near_photo) = views["px_per_mm_network"], views["px_per_mm_photo"]
    width, height = views["photo_px"]
    line = (
        f"  {far:.2f} to {near:.2f} px/mm at the network's {views['network_px']} px, {far_photo:.2f} to "
        f"{near_photo:.2f} in photographs of {width} × {height} px (5 % and 95 % of the views)"
    )
    density = f"{views['texels_per_px']:.1f} per pixel along a side in the closest"
    if views["design_px"] is None:
        return [line, f"  {views['texels']} texels may change, {density} view"]
    return [
        line,
        "  design {} × {} texels, ".format(*views["design_px"])
        + f"{density} possible view ({views['closest_px_per_mm']:.2f} px/mm)",
        "  printed as {} × {} px, ".format(*views["printed_px"]) + f"{views['printed_px_per_mm']:.1f} per mm",
    ]


def _marker_line(markers: Data, family: str) -> str:
    needed, printed = markers["needed_mm"], markers["printed_mm"]
    if not printed:
        return "  none: photographs are located by the design's corners"
    note = "" if printed > 0.95 * needed else " (all that page, object or blank allows)"
    return (
        f"  needed {needed:.1f} mm ({PX_PER_MODULE:g} px per module at the {READABLE_SHARE:.0%} point of the views), "
        f"printed {printed:.1f} mm{note}; {measurable_text(markers['unreadable_share'], family)}"
    )


def _term_lines(terms: Data, draft: Data) -> list[str]:
    lines = [
        f"error that leaving a term out leaves ({terms['views']} views of a draft of {draft['steps']} steps, rate "
        f"{draft['rate']:.0%}, before the first classifier)",
        f"  {'':23} {'codes: mean':>11} {'95 %':>6}   {'confidence':<15}  (what adds up to less than "
        f"{terms['threshold']:.3f} can go: selection cannot tell)",
    ]
    on = {name: error for name, error in terms["errors"].items() if error["verdict"] != "off"}
    off = [f"{name} ({error['key'] or 'no setting'})" for name, error in terms["errors"].items() if name not in on]
    lines += [_term_line(name, error) for name, error in on.items()]
    return [*lines, *([f"  off: {', '.join(off)}"] if off else [])]


def _term_line(name: str, error: Data) -> str:
    words = {"missing": "missing in training", "left out": "rightly left out"}
    verdict, key = words.get(error["verdict"], error["verdict"]), f" ({error['key']})" if error["key"] else ""
    verdict = "matters little" if verdict == "can go" and not key else verdict
    unseen = "; training's views do not show it" if error.get("in_training") is False else ""
    codes = f"{error['codes_mean']:11.2f} {error['codes_p95']:6.1f}"
    return f"  {name:23} {codes}   {error['confidence']:.3f} ({error['bias']:+.3f})   {verdict}{key}{unseen}"
