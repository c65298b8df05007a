"""Estimates of tables, by hand."""

import numpy as np
import pytest

from patchlab.study.estimates import mean, median


def test_intervals_of_medians_are_order_statistics():
    # of 100 values the binomial's 2.5 % point is 40: the 40th and 61st, as tables of the sign test have it
    middle = median(np.arange(1.0, 101))
    assert (middle.value, middle.low, middle.high, middle.n) == (50.5, 40, 61, 100)
    few = median([3.0, 1, 2])
    assert (few.value, few.low, few.high) == (2, 1, 3)


def test_means_have_student_s_interval_and_one_value_has_none():
    # by hand: deviation 1, /√3, t of 2 degrees 4.303
    assert mean([1.0, 2.0, 3.0]).high == pytest.approx(2 + 4.303 / 3**0.5, rel=1e-3)
    assert mean([1.0]) is None
