"""Measure time: calls in turn within one run.

In: calls. Out: milliseconds. Seconds of one machine mean little on another, so times are compared only within a run.
"""

import time
from collections.abc import Callable, Hashable, Mapping
from typing import TypeVar

Name = TypeVar("Name", bound=Hashable)
ReturnValue = TypeVar("ReturnValue")


def call_in_turn(calls: Mapping[Name, Callable[[], ReturnValue]], rounds: int) -> dict[Name, list[ReturnValue]]:
    """By name the results of each call in `rounds` rounds; every round makes all calls in turn; one before warms up."""
    answers: dict[Name, list[ReturnValue]] = {name: [] for name in calls}
    for _ in range(rounds + 1):
        for name, call in calls.items():
            answers[name].append(call())
    return {name: values[1:] for name, values in answers.items()}


def time_call(
    call: Callable[[], ReturnValue], clock: Callable[[], float] = time.process_time
) -> tuple[ReturnValue, float]:
    """(the call's result, milliseconds); by default processor time, which other work on the machine leaves alone."""
    begin = clock()
    return call(), 1000 * (clock() - begin)
