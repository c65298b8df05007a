"""The rule from counts to a verdict, by hand numbers."""

from __future__ import annotations

import pytest

from patchproof.claims import prediction_interval
from patchproof.evidence.ranges import matched_rate, promised_ranges, promised_side_px
from patchproof.evidence.results import Geometry, PhotoEntry, Pose
from patchproof.evidence.verdict import compare, effect_of, judge
from patchproof.goal import Goal
from patchproof.sheets.manifest import ConditionClaim
from test_photo_synthetic import make_manifest


def test_the_rule_at_both_sides_of_the_interval():
    low, high = prediction_interval(360, 400, 40)
    assert (low, high) == (32, 39)  # mean 36, standard deviation √(40 · 0.9 · 0.1 · 441/402) = 1.99
    assert judge(32, 40, 0.9, 400, Goal.assist, 0).verdict == "kept"
    assert judge(31, 40, 0.9, 400, Goal.assist, 0).verdict == "broken"
    assert judge(40, 40, 0.9, 400, Goal.assist, 0).verdict == "kept"


def test_a_wide_interval_cannot_tell_but_can_still_break():
    # 6 photographs at 0.8: k_lo = 2, and 2/6 lies below 0.8 - 0.2
    low, _ = prediction_interval(320, 400, 6)
    assert low / 6 < 0.6
    assert judge(6, 6, 0.8, 400, Goal.assist, 0).verdict == "cannot_tell"
    assert judge(low - 1, 6, 0.8, 400, Goal.assist, 0).verdict == "broken"


def test_deceive_is_the_mirror_image_of_assist():
    for k in range(41):
        assert judge(k, 40, 0.9, 400, Goal.assist, 0).verdict == judge(40 - k, 40, 0.1, 400, Goal.deceive, 0).verdict


def test_fewer_than_five_or_too_many_without_markers_cannot_tell():
    assert judge(0, 4, 0.9, 400, Goal.assist, 0).verdict == "cannot_tell"
    assert judge(0, 5, 0.9, 400, Goal.assist, 0).verdict == "broken"
    assert judge(0, 0, 0.9, 400, Goal.assist, 0).prediction_interval is None
    # 4 of 40 readable ones are 10 %, 5 of 41 are more
    assert judge(36, 36, 0.9, 400, Goal.assist, 4).verdict == "kept"
    assert judge(36, 36, 0.9, 400, Goal.assist, 5).verdict == "cannot_tell"


def test_pairs_by_file_name_go_to_mcnemar():
    patch = {f"{i}.jpg": True for i in range(10)}
    control = {f"{i}.jpg": i < 4 for i in range(10)}
    compared = compare(patch, "bare", control, Goal.assist)
    # six discordant pairs, all one way: 2 · (1/2)⁶ = 0.03125
    assert (compared.pairs, compared.p_value, compared.shown) == (10, pytest.approx(0.03125), True)
    assert not compare(patch, "bare", control, Goal.deceive).shown
    assert compare(control, "bare", patch, Goal.deceive).shown
    control["4.jpg"] = True  # five pairs: 0.0625
    assert not compare(patch, "bare", control, Goal.assist).shown


def test_different_names_go_to_newcombe():
    patch, control = {f"a{i}": True for i in range(20)}, {f"b{i}": i < 5 for i in range(20)}
    compared = compare(patch, "bare", control, Goal.assist)
    assert compared.pairs == 0 and compared.p_value is None and compared.shown
    assert compared.difference == pytest.approx(0.75) and compared.difference_interval[0] > 0


def test_every_control_must_be_beaten_and_none_is_no_test():
    patch = {f"{i}": True for i in range(10)}
    good, bad = (
        compare(patch, "bare", {f"{i}": False for i in range(10)}, Goal.assist),
        compare(patch, "bare", patch, Goal.assist),
    )
    assert effect_of([good]) == "shown" and effect_of([good, bad]) == "not_shown"
    assert effect_of([]) == effect_of([compare(patch, "bare", {}, Goal.assist)]) == "not_tested"
    assert compare(patch, "bare", {}, Goal.assist).shown is None


def conditions(scales, recognized):
    rows = zip(scales, recognized, strict=True)
    empty = dict(tilt_deg=None, azimuth_deg=None, contrast=None, blur_px=None)
    return [ConditionClaim(px_per_mm=s, recognized=r, **empty) for s, r in rows]


def entry(photo_px=None, pose=None, **figures):
    rest = dict(residual_mm=0, px_per_mm=2, tilt_deg=0, contrast=1, blur_px=1, corner_uncertainty_mm=0)
    geometry = Geometry(**rest | figures) if figures else None
    return PhotoEntry(file="a.jpg", status="judged", photo_px=photo_px, geometry=geometry, pose=pose)


def test_ranges_have_a_tenth_of_margin_and_ignore_what_is_unknown():
    ranges = promised_ranges(conditions([1.0, 3.0], [True, True]))
    # px_per_mm: 10 % of the width is 0.2; 10 % of the value 3 is 0.3, which is more
    assert ranges.limits == {"px_per_mm": (pytest.approx(0.8), pytest.approx(3.3))}
    assert ranges.violated(entry(px_per_mm=0.85, tilt_deg=89.0), True) is None
    cannot = ranges.violated(entry(px_per_mm=0.7), True)
    assert (cannot.code, cannot.figure) == ("out_of_range", 0.7) and "come closer" in cannot.advice
    assert ranges.violated(entry(), True) is None


def test_a_photograph_with_more_pixels_is_compared_at_the_promised_size():
    ranges = promised_ranges(conditions([1.0, 3.0], [True, True]), side_px=1200)
    assert ranges.violated(entry(px_per_mm=7.5, photo_px=(4000, 3000)), True) is None  # 3.0 at 1200 px
    cannot = ranges.violated(entry(px_per_mm=9.0, photo_px=(3000, 4000)), True)
    assert cannot.figure == pytest.approx(3.6) and "1200 px" in cannot.advice
    assert promised_side_px(make_manifest()) is None


def test_an_azimuth_leaves_the_range_only_where_it_is_sure_to():
    """The promise covers up to 30 + 6°. At 40° by corners that know it to 3.9° it is outside, to 4.1° it may be in."""
    claims = [
        ConditionClaim(px_per_mm=1, tilt_deg=1, azimuth_deg=a, contrast=1, blur_px=1, recognized=True)
        for a in (-30, 30)
    ]
    ranges = promised_ranges(claims)
    at = [entry(px_per_mm=1, tilt_deg=1, pose=Pose(azimuth_deg=40, azimuth_uncertainty_deg=u)) for u in (3.9, 4.1)]
    assert ranges.violated(at[0], True).code == "out_of_range"
    assert ranges.violated(at[1], True) is None


def test_the_matched_rate_is_that_of_the_nearest_conditions():
    near, far = [1 + i / 1000 for i in range(20)], [5 + i / 1000 for i in range(20)]
    claims = conditions(near + far, [True] * 20 + [False] * 20)
    assert matched_rate([entry(px_per_mm=1.0)], claims) == 1.0
    assert matched_rate([entry(px_per_mm=1.0), entry(px_per_mm=5.0)], claims) == 0.5
    assert matched_rate([entry()], claims) is None and matched_rate([], claims) is None
    assert matched_rate([entry(px_per_mm=1.0)], conditions([None], [True])) is None
