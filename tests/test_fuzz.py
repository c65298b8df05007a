"""Hostile and broken files: each is read or refused in a sentence, within limits, and nothing else happens.

`python tests/test_fuzz.py --fuzz N [--reader NAME] [--seed S]` tries N inputs and says how each kind of file fared;
`python tests/test_fuzz.py --hostile [--kind KIND]` uses all that are made to do harm, each in a process under guard.
"""

from __future__ import annotations

import argparse
import collections
import importlib
import re
import runpy
import socket
import subprocess
import sys

import numpy as np
import pytest
from fuzz import guard, readers
from fuzz.hostile import KINDS, prepared
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


# numbers that are quick; the rest runs by `--hostile`
OF_KINDS = {"sheet: names": 1, "sheet: no file": 1, "pdf: bombs": 12, "run: names": 3, "run: pictures": 3, "printer": 1}
OF_KINDS |= {"checkpoint": 7, "import": 3, "photographs: links": 1, "backgrounds": 3, "scene": 4, "camera": 1, "icc": 0}
OF_KINDS |= {
    "mask, faces": 1,
    "labels": 7,
    "boxes": 2,
    "corners": 0,
    "mesh": 12,
    "network: files": 2,
    "weights": 1,
    "album": 4,
}
needs_linux = pytest.mark.skipif(sys.platform != "linux", reason="processes that are forked and limited")


@pytest.fixture(scope="module")
def made_once():
    """What the forked processes find made, as do the readers above."""
    return readers.manifests(), readers.honest_photo(), readers.small_problem()


@needs_linux
@pytest.mark.parametrize("kind", OF_KINDS)
def test_files_that_are_made_to_do_harm_do_none(kind, made_once):
    ended = guard.attempt(kind, OF_KINDS[kind], KINDS[kind][0])
    assert ended.how in ("result", "refused"), ended.how
    assert ended.seconds < guard.SECONDS and ended.bytes < guard.BYTES


DEEDS = {
    "read": lambda place: lambda: (place.outside / "secret.txt").read_text(),
    "wrote": lambda place: lambda: (place.given / "new").write_text("x"),
    "os.remove": lambda place: lambda: (place.outside / "holiday.jpg").unlink(),
    "socket.getaddrinfo": lambda place: lambda: socket.getaddrinfo("localhost", 9),
    "subprocess.Popen": lambda place: lambda: subprocess.run(["true"], check=True),
    "executed": lambda place: lambda: runpy.run_path(str(place.given / "evil.py")),
    "Traceback": lambda place: lambda: 1 / 0,
}


@needs_linux
@pytest.mark.parametrize("deed", DEEDS)
def test_the_guard_sees_what_it_is_for(deed):
    assert deed in guard.attempt(deed, 0, lambda place, number: DEEDS[deed](place)).how


def hostile(kind: str | None) -> int:
    """Use every input that is made to do harm; prints each that does, and counts. Returns how many did."""
    prepared()
    outcomes = []
    for name, (make, count) in KINDS.items():
        own = [guard.attempt(name, number, make) for number in range(count if kind in (None, name) else 0)]
        outcomes += own
        for each in own:
            if each.how not in ("result", "refused"):
                print(f"{name} {each.number}: {each.how}", flush=True)
        if own:
            worst = f"{max(o.seconds for o in own):6.1f} s {max(o.bytes for o in own) / 1e6:6.0f} MB"
            counts = (sum(o.how == how for o in own) for how in ("result", "refused"))
            print(
                f"{name:22}{len(own):4} inputs, {'{} results, {} refused'.format(*counts)}, worst {worst}", flush=True
            )
    harmful = [o for o in outcomes if o.how not in ("result", "refused")]
    tracebacks = sum("Traceback" in o.how for o in harmful)
    results = sum(o.how == "result" for o in outcomes)
    print(
        f"{len(outcomes)} inputs: {results} results, {len(outcomes) - results - len(harmful)} refusals, {len(harmful)}"
    )
    print(f"that did harm ({tracebacks} tracebacks); worst {max(o.seconds for o in outcomes):.1f} s of processor time,")
    print(f"{max(o.bytes for o in outcomes) / 1e6:.0f} MB; limits {guard.SECONDS:g} s and {guard.BYTES / 1e6:.0f} MB")
    return len(harmful)


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
    parser.add_argument("--hostile", action="store_true", help="all inputs that are made to do harm")
    parser.add_argument("--kind", choices=KINDS, help="of one kind alone, with --hostile")
    chosen = parser.parse_args()
    if chosen.hostile:
        sys.exit(bool(hostile(chosen.kind)))
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
    importlib.import_module("conftest")  # which puts the folders of tests on the path
    main()
