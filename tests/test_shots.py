"""The shot plan against simulation by the judge's own comparison, and where no number of photographs is enough."""

from __future__ import annotations

import numpy as np
import pytest

from patchproof.claims import prediction_interval
from patchproof.evidence.verdict import compare
from patchproof.goal import Goal
from patchproof.printing.shots import fewest, paired_power, plan_shots, unpaired_power
from patchproof.sheets.manifest import Promise


def promise_of(rate: float, control: float, n: int = 400, goal: str = "assist") -> Promise:
    claim = dict(interval=(0, 1), confidence=0.5)
    beside = claim | dict(difference=rate - control, difference_interval=(-1, 1))
    return Promise(
        target=dict(label="jeep", indices=(1,), goal=goal),
        models=[dict(name="m", sha256=None, rate=rate, **claim)],
        rate=rate,
        interval=(0, 1),
        n=n,
        controls={"bare": dict(rate=control, **beside), "gray": dict(rate=control / 2, **beside)},
        conditions=(),
    )


@pytest.mark.parametrize(("rates", "n"), [((0.9, 0.4), 20), ((0.7, 0.5), 60)])
def test_power_is_what_the_judge_finds_in_simulation(rates, n):
    rng, paired, unpaired, trials = np.random.default_rng(0), 0, 0, 1500
    for _ in range(trials):
        a, b = (rng.random(n) < rate for rate in rates)
        left = {str(i): bool(x) for i, x in enumerate(a)}
        paired += compare(left, "bare", {str(i): bool(x) for i, x in enumerate(b)}, Goal.assist).shown
        unpaired += compare(left, "bare", {f"c{i}": bool(x) for i, x in enumerate(b)}, Goal.assist).shown
    # three standard errors of 1500 trials
    assert paired_power(*rates, n) == pytest.approx(paired / trials, abs=0.04)
    assert unpaired_power(*rates, n) == pytest.approx(unpaired / trials, abs=0.04)


def test_the_verdict_s_count_keeps_the_rule_and_one_photograph_less_does_not():
    n = plan_shots(promise_of(0.8, 0.2)).verdict
    floors = [prediction_interval(320, 400, k)[0] / k - 0.6 for k in range(n - 1, n + 12)]
    assert min(floors[1:]) >= -1e-9 and floors[0] < -1e-9


def test_the_hardest_control_decides_and_small_differences_cannot_be_shown():
    plan = plan_shots(promise_of(0.9, 0.3))
    assert plan.control == "bare" and 5 <= plan.unpaired <= plan.paired < 40
    assert plan_shots(promise_of(0.5, 0.5)).paired is None
    assert plan_shots(promise_of(0.1, 0.8, goal="deceive")).control == "gray"
    assert fewest(lambda n: n >= 9) == 9 and fewest(lambda n: False) is None
