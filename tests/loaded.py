"""Commands in a process of their own, and the modules that it ends with."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

_PROGRAM = """
import importlib, json, os, sys
steps = json.loads(sys.argv.pop())

def typed(arguments):
    from patchproof.app import cli
    sys.argv = ["patchproof", *arguments]
    try:
        cli.main()
    except SystemExit as end:
        if end.code:
            raise

def done(commands, constants):
    for name, value in constants.items():
        module, _, constant = name.rpartition(".")
        setattr(importlib.import_module(module), constant, value)
    for arguments in commands:
        typed(arguments)
    print()
    print("modules:", json.dumps([*sys.modules]), flush=True)

for commands, constants, apart, before in steps:
    for name in before:
        importlib.import_module(name)
    child = os.fork() if apart else 0
    if child:
        if os.waitpid(child, 0)[1]:
            sys.exit(1)
        continue
    done(commands, constants)
    if apart:
        sys.stdout.flush()
        os._exit(0)
"""


@dataclass(frozen=True)
class Loaded:
    """Modules by name."""

    names: frozenset[str]

    @property
    def rooms(self) -> set[str]:
        """The rooms of the tool, some module of which is loaded."""
        return {name.split(".")[1] for name in self.names if name.startswith("patchproof.")}

    @property
    def lines(self) -> int:
        """The lines of the tool's and the laboratory's modules."""
        own = (name for name in self.names if name.partition(".")[0] in ("patchproof", "patchlab"))
        files = {spec.origin for name in own if (spec := find_spec(name)) is not None and spec.origin is not None}
        return sum(len(Path(file).read_text(encoding="utf-8").splitlines()) for file in files)


@dataclass(frozen=True)
class Step:
    """Commands of `patchproof`, each without the program's name, with `constants` (dotted names) set and libraries
    imported before; what one that is `apart` loads, in a fork, is not among what the next ones have loaded.
    """

    commands: tuple[tuple[object, ...], ...] = ()
    constants: dict[str, object] | None = None
    apart: bool = False
    libraries: tuple[str, ...] = ()


def loaded_by(*steps: Step) -> list[Loaded]:
    """What is loaded after each step, all of them in one new process."""
    given = [
        ([list(map(str, command)) for command in step.commands], step.constants or {}, step.apart, step.libraries)
        for step in steps
    ]
    command = [sys.executable, "-c", _PROGRAM, json.dumps(given)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    told = [line.partition(": ")[2] for line in done.stdout.splitlines() if line.startswith("modules: ")]
    assert len(told) == len(steps), done.stdout + done.stderr
    return [Loaded(frozenset(json.loads(names))) for names in told]
