"""Commands in a process of their own, and the modules that it ends with."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

_PROGRAM = """
import importlib, json, sys
commands, constants = json.loads(sys.argv.pop())
for name, value in constants.items():
    module, _, constant = name.rpartition(".")
    setattr(importlib.import_module(module), constant, value)
from patchproof.app import cli
for arguments in commands:
    sys.argv = ["patchproof", *arguments]
    try:
        cli.main()
    except SystemExit as end:
        if end.code:
            raise
print()
print(json.dumps([*sys.modules]))
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


def loaded_by(*commands: tuple[object, ...], constants: dict[str, object] | None = None) -> Loaded:
    """What is loaded after commands of `patchproof`, each without the program's name, with these `constants` (dotted
    names) set before.
    """
    given = json.dumps([[[str(word) for word in command] for command in commands], constants or {}])
    done = subprocess.run([sys.executable, "-c", _PROGRAM, given], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return Loaded(frozenset(json.loads(done.stdout.splitlines()[-1])))
