"""The commands as a user types them, in this process."""

from __future__ import annotations

import sys
from collections.abc import Callable

from patchlab import cli as lab
from patchproof.app import cli


def _exit_code(main: Callable[[], None], name: str, arguments: tuple[object, ...]) -> int:
    before, sys.argv = sys.argv, [name, *map(str, arguments)]
    try:
        main()
    except SystemExit as stop:
        return int(stop.code or 0)
    finally:
        sys.argv = before
    return 0


def command(*arguments: object) -> int:
    """The exit code of `patchproof ARGUMENTS`."""
    return _exit_code(cli.main, "patchproof", arguments)


def lab_command(*arguments: object) -> int:
    """The exit code of `patchlab ARGUMENTS`."""
    return _exit_code(lab.main, "patchlab", arguments)
