"""Hostile and broken files: each is read or refused in a sentence, within limits, and nothing else happens.

`python tests/test_fuzz.py --fuzz N [--reader NAME] [--seed S]` tries N inputs and says how each kind of file fared.
"""

from __future__ import annotations

import argparse
import collections
import re
import subprocess
import sys

import numpy as np
import pytest
from fuzz.readers import READERS, Outcome, attempt
from fuzz.watch import MOST_BYTES, SECONDS, Watch

IN_THE_SUITE = {"photo": 12, "photos.jsonl": 4, "run.json": 6}  # else:
OF_OTHERS = 10


@pytest.fixture(scope="module")
def watch() -> Watch:
    return Watch()


@pytest.mark.parametrize("reader", [name for name in READERS if name != "largest photo"])  # test_photo_limits has some
def test_hostile_files_are_read_or_refused(reader, watch):
    outcomes = [attempt(reader, seed, watch) for seed in range(IN_THE_SUITE.get(reader, OF_OTHERS))]
    failed = [f"seed {o.seed}: {o.how}" for o in outcomes if o.how not in ("read", "refused")]
    assert not failed, "\n".join(failed[:3])
    # a journal's broken lines are done again
    assert reader == "photos.jsonl" or any(o.how == "refused" for o in outcomes)


def test_the_watch_sees_what_it_is_for(watch, tmp_path):
    outside = tmp_path / "outside"
    deeds = [
        lambda: (outside / "f").write_text("x"),
        lambda: (outside / "d").mkdir(),
        lambda: subprocess.run(["true"], check=True),
        lambda: __import__("socket").socket().close(),
    ]
    outside.mkdir()
    (tmp_path / "own").mkdir()
    for deed in deeds:
        with watch.on(tmp_path / "own"):
            deed()
        assert watch.events, deed
    with watch.on(tmp_path / "own"):
        (tmp_path / "own" / "f").write_text("x")
    assert not watch.events


def table(outcomes: list[Outcome]) -> list[str]:
    """A line for each kind of file."""
    lines = [f"{'reader':18}{'inputs':>8}{'read':>8}{'refused':>9}{'failed':>8}{'slowest s':>11}{'most MB':>9}"]
    for reader in READERS:
        own = [o for o in outcomes if o.reader == reader]
        if own:
            read, refused = (sum(o.how == how for o in own) for how in ("read", "refused"))
            slowest, most = max(o.seconds for o in own), max(o.bytes for o in own) / 1e6
            counts = f"{len(own):8}{read:8}{refused:9}{len(own) - read - refused:8}"
            lines.append(f"{reader:18}{counts}{slowest:11.2f}{most:9.0f}")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fuzz", type=int, default=200, help="inputs")
    parser.add_argument("--reader", choices=READERS, help="of one kind alone")
    parser.add_argument("--seed", type=int, default=1_000_000, help="of the first input")
    chosen = parser.parse_args()
    names = [chosen.reader] if chosen.reader else list(READERS)
    shares = np.array([READERS[name][1] for name in names], float)
    rng, watch, outcomes, failed = np.random.default_rng(chosen.seed), Watch(), [], collections.Counter()
    for number in range(chosen.fuzz):
        reader = names[rng.choice(len(names), p=shares / shares.sum())]
        outcome = attempt(reader, chosen.seed + number, watch)
        outcomes.append(outcome)
        if outcome.how not in ("read", "refused"):
            kind = re.sub(r"\d+|tmp\w+", "#", outcome.how.strip().splitlines()[-1][:160])
            failed[kind] += 1
            print(f"{reader} seed {outcome.seed}: {outcome.how if failed[kind] == 1 else kind}", flush=True)
    print(*table(outcomes), *(f"{count} times: {line}" for line, count in failed.items()), sep="\n")
    took = f"{sum(o.seconds for o in outcomes):.0f} s of processor time in readers"
    print(f"limits {SECONDS:g} s and {MOST_BYTES / 1e6:.0f} MB; {took}")
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
