"""The rule from counts to a verdict, by hand numbers."""

from __future__ import annotations

import json

import numpy as np
import pytest
from synthetic_photos import make_manifest

from patchproof.app.verify import _look_at
from patchproof.base.sessions import TAIL
from patchproof.evidence.results import CameraPose, Geometry, PhotoEntry
from patchproof.evidence.task import promised_ranges
from patchproof.evidence.verdict import (
    Look,
    compare_with_control,
    judge,
    kept_chance,
    required_rate,
    sessions_needed,
    watched,
)
from patchproof.sheets.manifest import ConditionClaim, Promise


def promise_of(rate: float, control: float = 0.0, goal: str = "assist", correlation: float = 0.0) -> Promise:
    """A promise of 100 sessions of 6, whose rates are drawn from the beta distribution with that correlation."""
    hits = [i < 600 * rate for i in range(600)]
    if correlation:
        strength, rng = 1 / correlation - 1, np.random.default_rng(5)
        hits = (rng.random((100, 6)) < rng.beta(rate * strength, (1 - rate) * strength, (100, 1))).ravel().tolist()
        rate = float(np.mean(hits))
    claim = dict(interval=(0, 1), confidence=0.5)
    empty = dict(px_per_mm=None, tilt_deg=None, azimuth_deg=None, contrast=None, blur_px=None)
    return Promise(
        target=dict(label="jeep", indices=(1,), goal=goal),
        models=[dict(name="m", sha256=None, rate=rate, **claim)],
        rate=rate,
        interval=(0, 1),
        n=600,
        per_session=6 if correlation else 1,
        controls={"bare": dict(n=600, rate=control, difference=rate - control, difference_interval=(-1, 1), **claim)},
        conditions=[dict(recognized=hit, **empty) for hit in hits],
    )


def word(recognized: int, photos: tuple[int, ...], promise: Promise, without: int = 0) -> str:
    return judge(recognized, photos, promise, without).verdict


def test_the_rule_at_both_ends_of_the_interval():
    low, high = prediction = promise_of(0.9).posterior.count_interval((40,))
    assert prediction == judge(36, (40,), promise_of(0.9)).prediction_interval and low < 36 < high
    assert word(low - 1, (40,), promise_of(0.9)) == "broken"
    assert word(low, (40,), promise_of(0.9)) == "cannot_tell"  # allowed for, and no proof
    assert word(36, (40,), promise_of(0.9)) == word(40, (40,), promise_of(0.9)) == "kept"


@pytest.mark.parametrize(
    ("recognized", "photos", "rate", "control"), [(0, 40, 0.0875, 0.05), (1, 5, 0.2, 0.1), (40, 40, 0.9, 0.93)]
)
def test_what_proves_nothing_keeps_no_promise(recognized, photos, rate, control):
    """None of 40 at 8.75 % promised; one of five at 20 %; all of 40 where the bare object is as good."""
    assert word(recognized, (photos,), promise_of(rate, control)) == "cannot_tell"


def test_a_rate_too_low_is_rarely_called_kept_and_the_promised_one_mostly():
    """40 photographs in 4 sessions, 85 % promised; true rates of 85, 75, 70 and 65 %."""
    rng, promise, photos = np.random.default_rng(0), promise_of(0.85, 0.3, correlation=0.05), (10,) * 4
    words = [word(count, photos, promise) for count in range(41)]
    for rate, most in ((0.75, 0.30), (0.70, 0.11), (0.65, 0.04)):
        counts = rng.binomial(10, rng.beta(19 * rate, 19 * (1 - rate), (4000, 4))).sum(1)
        assert np.mean([words[count] == "kept" for count in counts]) <= most
    counts = rng.binomial(10, rng.beta(19 * 0.85, 19 * 0.15, (4000, 4))).sum(1)
    assert np.mean([words[count] == "kept" for count in counts]) >= 0.60
    assert kept_chance(promise, photos) == pytest.approx(
        np.mean([words[c] == "kept" for c in counts]), abs=0.12
    )  # which knows rate and spread


@pytest.mark.parametrize(("goal", "rate", "control"), [("assist", 0.85, 0.3), ("deceive", 0.15, 0.7)])
def test_the_chance_of_kept_is_that_of_all_counts_which_are_called_so(goal, rate, control):
    for photos in ((40,), (10,) * 4, (5,)):
        promise = promise_of(rate, control, goal, correlation=0.1)
        words = [word(count, photos, promise) == "kept" for count in range(sum(photos) + 1)]
        assert kept_chance(promise, photos) == pytest.approx(promise.posterior.chances(photos) @ words, abs=1e-12)


def test_photographs_in_one_place_prove_less():
    promise = promise_of(0.85, 0.3, correlation=0.2)
    chances = [kept_chance(promise, photos) for photos in ((40,), (10,) * 4, (5,) * 8)]
    assert chances == sorted(chances) and chances[0] < 0.4 < chances[2]
    assert "(needed: " in judge(33, (40,), promise).reason


def test_deceive_is_the_mirror_image_of_assist():
    for k in range(41):
        mirrored = promise_of(0.1, 1.0, "deceive")
        assert word(k, (40,), promise_of(0.9)) == word(40 - k, (40,), mirrored)
    assert required_rate(promise_of(0.1, 0.2, "deceive")) == pytest.approx(0.2)


def test_fewer_than_five_or_too_many_without_markers_cannot_tell():
    assert word(0, (4,), promise_of(0.9)) == "cannot_tell"
    assert word(0, (5,), promise_of(0.9)) == "broken"
    assert judge(0, (), promise_of(0.9)).prediction_interval is None
    # 4 of 40 readable ones are 10 %, 5 of 41 are more
    assert word(36, (36,), promise_of(0.9), 4) == "kept"
    assert word(36, (36,), promise_of(0.9), 5) == "cannot_tell"


def answers(sessions: list[str], first: int = 0, prefix: str = "") -> dict[tuple[int, str], bool]:
    """Answers by session from a text of 0 and 1 each."""
    return {(first + i, f"{prefix}{j}"): x == "1" for i, text in enumerate(sessions) for j, x in enumerate(text)}


def test_photographs_of_equal_names_in_a_session_are_pairs():
    patch, control = answers(["1111111111"] * 4), answers(["1100000000", "0000000011"] * 2)
    compared = compare_with_control(patch, "bare", control, promise_of(0.9))
    assert (compared.pairs, compared.sessions, compared.shown, compared.advice) == (40, 4, True, "")
    assert compared.difference == pytest.approx(0.8) and compared.difference_interval[0] > 0.4
    assert not compare_with_control(patch, "bare", control, promise_of(0.1, 0.8, "deceive")).shown
    assert compare_with_control(control, "bare", patch, promise_of(0.1, 0.8, "deceive")).shown


def test_a_few_names_that_happen_to_be_equal_are_no_pairs():
    patch = answers(["1" * 10] * 4, prefix="a") | answers(["111111"])
    control = answers(["0" * 10] * 4, prefix="b") | answers(["111111"])
    compared = compare_with_control(patch, "bare", control, promise_of(0.9))
    assert compared.pairs == 0 and compared.shown


@pytest.mark.parametrize(("first", "prefix"), [(0, ""), (0, "b"), (9, "b")])
def test_one_session_cannot_tell_what_its_place_does_and_says_what_would(first, prefix):
    patch, control = answers(["1" * 20]), answers(["0" * 20], first, prefix)
    compared = compare_with_control(patch, "bare", control, promise_of(0.9))
    assert compared.shown is False and compared.difference_interval == (-1, 1) and "two places" in compared.advice


def test_sessions_that_disagree_prove_less_than_their_photographs():
    even = answers(["1111100000"] * 4, 9, "c")
    steady, uneven = (answers(each) for each in (["1111111100"] * 4, ["1111111111"] * 3 + ["1100000000"]))
    assert compare_with_control(steady, "bare", even, promise_of(0.9)).difference == pytest.approx(0.3)
    assert compare_with_control(uneven, "bare", even, promise_of(0.9)).difference == pytest.approx(0.3)
    assert compare_with_control(
        answers(["1111111110"] * 4), "bare", answers(["1000000000"] * 4, 9), promise_of(0.9)
    ).shown
    low = [compare_with_control(a, "bare", even, promise_of(0.9)).difference_interval[0] for a in (steady, uneven)]
    assert low[1] < low[0] - 0.1


def test_rates_are_those_of_the_photographs_that_are_compared_and_none_is_no_test():
    patch, none = answers(["1111110"] * 3), answers(["0000000"] * 2)
    compared = compare_with_control(patch, "bare", none, promise_of(0.9))
    assert compared.pairs == 14 and compared.rates == (pytest.approx(6 / 7), 0.0)
    assert (
        compared.difference == pytest.approx(6 / 7) and compared.patch_interval[0] < 6 / 7 < compared.patch_interval[1]
    )
    unjudged = compare_with_control(patch, "gray", {}, promise_of(0.9))
    assert (unjudged.shown, unjudged.rates) == (None, None) and "no photograph of it" in unjudged.advice


def test_looks_that_were_not_planned_ask_for_more_and_together_spend_no_more_than_the_planned_one():
    for planned in (1, 4):
        tails = [Look(number, planned).tail for number in range(1, 2000)]
        assert tails[planned - 1] == TAIL and TAIL < sum(tails) <= 2 * TAIL
    promise = promise_of(0.9)
    words = [judge(34, (40,), promise, look=Look(number)) for number in range(1, 9)]
    assert words[0] == judge(34, (40,), promise) and words[0].verdict == "kept" and "look" not in words[0].reason
    assert words[-1].verdict == "cannot_tell" and "as for look 8" in words[-1].reason


def test_looking_until_it_fits_keeps_no_more_promises_falsely():
    """12 sessions of 10, the rate just asked for, a correlation of 0.1: 9 % are kept falsely if looks are free."""
    rng, promise, found = np.random.default_rng(0), promise_of(0.85, 0.3, correlation=0.1), np.zeros((2, 1000), bool)
    rate, sizes = required_rate(promise), [(10,) * n for n in range(1, 13)]
    hits = rng.binomial(10, rng.beta(9 * rate, 9 * (1 - rate), (1000, 12))).cumsum(1)
    for i, photos in enumerate(sizes):
        for row, look in enumerate((Look(i + 1), Look())):
            least = next((k for k in range(sum(photos) + 1) if is_kept(k, photos, promise, look)), 999)
            found[row] |= hits[:, i] >= least
    assert found[0].mean() <= 0.05 < 0.08 < found[1].mean()


def is_kept(recognized: int, photos: tuple[int, ...], promise: Promise, look: Look) -> bool:
    return judge(recognized, photos, promise, look=look).verdict == "kept"


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


def test_an_azimuth_leaves_the_range_only_where_it_is_sure_to():
    """The promise covers up to 30 + 6°. At 40° by corners that know it to 3.9° it is outside, to 4.1° it may be in."""
    claims = [
        ConditionClaim(px_per_mm=1, tilt_deg=1, azimuth_deg=a, contrast=1, blur_px=1, recognized=True)
        for a in (-30, 30)
    ]
    ranges = promised_ranges(claims)
    at = [
        entry(px_per_mm=1, tilt_deg=1, pose=CameraPose(azimuth_deg=40, azimuth_uncertainty_deg=u)) for u in (3.9, 4.1)
    ]
    assert ranges.violated(at[0], True).code == "out_of_range"
    assert ranges.violated(at[1], True) is None


@pytest.mark.parametrize(("earlier", "seen", "number"), [(None, "a", 1), (2, "a", 2), (2, "b", 3), ("x", "a", 1)])
def test_a_report_of_other_photographs_in_the_same_folder_is_a_look(tmp_path, earlier, seen, number):
    manifest, entry = make_manifest(), PhotoEntry(file="a.jpg", status="judged", sha256=seen)
    content = {"sheet_id": manifest.sheet_id, "summary": {"looks": earlier}, "photos": [{"sha256": "a"}]}
    if earlier is not None:
        (tmp_path / "report.json").write_text(json.dumps(content))
    assert _look_at(tmp_path, manifest, False)([entry]) == Look(number)
    (tmp_path / "report.json").write_text(json.dumps(content | {"sheet_id": "other"}))
    assert _look_at(tmp_path, manifest, False)([entry]) == Look(1)


def test_photographs_that_were_watched_have_a_look_for_each_session():
    promise = promise_of(0.85, 0.2, correlation=0.1)
    planned = sessions_needed(promise)
    assert watched((), promise) == Look(1, planned) and watched((10,) * planned, promise).tail == TAIL
    assert (
        watched((10,) * 3, promise).number == 3 and watched((10,), promise_of(0.3, 0.28, correlation=0.2)).planned == 15
    )
