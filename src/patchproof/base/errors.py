"""The errors of patchproof: one tree, so that one `except PatchproofError` catches all that it raises on purpose.

    PatchproofError
    ├── Refused              a mistake in the input: what was expected, what was found, what to do (also a ValueError)
    │   ├── WorkerDied       the process that worked on one item died at each try; the other items' results stand
    │   └── UploadRefused    a photograph that `capture` does not accept, with its HTTP status
    ├── PhotoRejected        a photograph that cannot be measured or judged: a code, figure, threshold and advice
    ├── UnsupportedNetwork   an ONNX file that holds something not supported; callers turn it into Refused
    └── TimeLimitExceeded    a file that takes more processor time than it may; callers turn it into Refused

Public functions raise `Refused`; `load_manifest`, `load_run`, `load_scene` and all verbs do so for missing, damaged or
contradicting files. Rejected photographs never stop a batch: they are listed in the report with their code. The command
line prints the sentence of a `PatchproofError` and exits with 1. All survive pickling, to cross processes.
"""

from typing import Any

from patchproof.base.text import printable


class PatchproofError(Exception):
    """Base of all errors that patchproof raises on purpose."""


class Refused(PatchproofError, ValueError):
    """An input that is not accepted, in one sentence: "Expected EXPECTED, got GOT: DO."."""

    def __init__(self, expected: str, got: str, do: str):
        self._parts = expected, got, do
        expected, got, do = map(_shorten, self._parts)
        super().__init__(f"Expected {expected}, got {got}: {do.rstrip('.')}.")

    def with_advice(self, advice: str) -> "Refused":
        """A copy of this error with `advice` appended to the instruction."""
        expected, got, do = self._parts
        return Refused(expected, got, f"{do.rstrip('.')}{advice}")

    def __reduce__(self) -> Any:
        # exceptions are rebuilt from their message when they come back from another process; this one has three parts
        return type(self), self._parts


def _shorten(part: str) -> str:
    """Return printable text in one line; a hostile file may have put text of any kind and length there."""
    text = printable(" ".join(part[:10_000].split()))
    return text if len(text) < 2000 else f"{text[:1000]} ..."


class WorkerDied(Refused):
    """The process that worked on one item died at each try; the other items' results stand."""


class TimeLimitExceeded(PatchproofError):
    """The work has reached its limit of processor time, which the message states."""
