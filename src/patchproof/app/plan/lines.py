"""Format a plan as lines for the terminal."""

from patchproof.app.plan.errors import TermError
from patchproof.app.plan.plan import GeometryPlan, Markers, Plan, Resolution, SurfacePlan
from patchproof.base.validation import not_measured_lines
from patchproof.optimizer.place_search import place_lines
from patchproof.scene.interface import PX_PER_MODULE, READABLE_SHARE, measurable_text


def geometry_lines(plan: GeometryPlan) -> list[str]:
    """Format the part of a plan that is known before anything is measured."""
    lines = [f"{plan.scene}: {plan.target}, {plan.kind}, seen by {', '.join(plan.models)}"]
    if plan.place is not None:
        lines += ["place", *(f"  {line}" for line in place_lines(plan.place))]
    lines += ["surface", *_surface_lines(plan.surface)]
    lines += ["resolution", *_resolution_lines(plan.resolution)]
    if plan.markers is not None:
        lines += ["markers", *_marker_lines(plan.markers, plan.surface.family)]
    return lines


def measured_lines(plan: Plan) -> list[str]:
    """Format the part of a plan that was measured."""
    lines = _term_lines(plan)
    lines += [f"chance, at the draft's rate of {plan.draft.rate:.0%} (95 %)"]
    lines += [
        f"  {s.name:27} {s.n:4d} samples leave ±{s.half_width:.3f}, {s.next_n} would ±{s.next_half_width:.3f}"
        for s in plan.samples
    ]
    lines += ["photographs", f"  {plan.photographs}"] if plan.photographs else []
    lines += ["not modeled", *(f"  {text}" for text in plan.omitted)]
    if (cost := plan.cost) is not None:
        views = f"{cost.views} views of {cost.side_px} px, {cost.threads} threads"
        lines += [f"cost of a step ({views}): {cost.ms:.0f} ms"]
        lines += [f"  {part.name:32} {part.ms:7.0f} ms {part.share:6.1%}" for part in cost.parts]
    return lines + not_measured_lines(plan.not_measured)


def _surface_lines(surface: SurfacePlan) -> list[str]:
    width, height = surface.size_mm
    lines = [f"  {surface.family}, {width:.0f} × {height:.0f} mm: {surface.reason}"]
    if surface.gap_mm is not None and surface.overhang_share is not None:
        edge, area = min(width, height), width * height
        lines.append(
            f"  gap {surface.gap_mm:.2f} mm ({surface.gap_mm / edge:.1%} of the shorter edge), mean "
            f"{surface.gap_mean_mm:.2f} mm; overhang {surface.overhang_share * area:.0f} mm² "
            f"({surface.overhang_share:.1%})"
        )
    return lines + ([f"  {surface.other}"] if surface.other else [])


def _resolution_lines(views: Resolution) -> list[str]:
    (far, near), (far_photo, near_photo) = views.px_per_mm_network, views.px_per_mm_photo
    lines = [
        f"  {far:.2f} to {near:.2f} px/mm at the network's {views.network_px} px, {far_photo:.2f} to {near_photo:.2f} "
        f"in photographs of {views.photo_px[0]} × {views.photo_px[1]} px (5 % and 95 % of the views)"
    ]
    density = f"{views.texels_per_px:.1f} per pixel along a side in the closest"
    if views.design_px is None or views.printed_px is None:
        return [*lines, f"  {views.texels} texels may change, {density} view"]
    return [
        *lines,
        "  design {} × {} texels, ".format(*views.design_px)
        + f"{density} possible view ({views.closest_px_per_mm:.2f} px/mm)",
        "  printed as {} × {} px, ".format(*views.printed_px) + f"{views.printed_px_per_mm:.1f} per mm",
    ]


def _marker_lines(markers: Markers, family: str) -> list[str]:
    if not markers.printed_mm:
        return ["  none: photographs are located by the design's corners"]
    note = "" if markers.printed_mm > 0.95 * markers.needed_mm else " (all that page, object or blank allows)"
    return [
        f"  needed {markers.needed_mm:.1f} mm ({PX_PER_MODULE:g} px per module at the {READABLE_SHARE:.0%} point of "
        f"the views), printed {markers.printed_mm:.1f} mm{note}; {measurable_text(markers.unreadable_share, family)}"
    ]


def _term_lines(plan: Plan) -> list[str]:
    terms = plan.terms
    lines = [
        f"error that leaving a term out leaves ({terms.views} views of a draft of {plan.draft.steps} steps, rate "
        f"{plan.draft.rate:.0%}, before the first classifier)",
        f"  {'':23} {'codes: mean':>11} {'95 %':>6}   {'confidence':<15}  (what adds up to less than "
        f"{terms.threshold:.3f} can go: selection cannot tell)",
    ]
    lines += [_term_line(term) for term in terms.errors if term.verdict != "off"]
    if terms.together is not None:
        note = "" if terms.together < terms.threshold else ": too much, keep some"
        lines.append(f"  {'all that can go, at once':42}   {terms.together:.3f}{note}")
    off = [f"{term.name} ({term.key or 'no setting'})" for term in terms.errors if term.verdict == "off"]
    return [*lines, *([f"  off: {', '.join(off)}"] if off else [])]


def _term_line(term: TermError) -> str:
    words = {"missing": "missing in training", "left out": "rightly left out"}
    verdict = words.get(term.verdict, term.verdict) if term.key or term.verdict != "can go" else "matters little"
    key = f" ({term.key})" if term.key else ""
    unseen = "; training's views do not show it" if term.in_training is False else ""
    return (
        f"  {term.name:23} {term.codes_mean:11.2f} {term.codes_p95:6.1f}   {term.confidence:.3f} ({term.bias:+.3f})"
        f"   {verdict}{key}{unseen}"
    )
