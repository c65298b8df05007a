"""One command at a time writes into an output folder, and a killed one keeps nobody out."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from patchproof.base.errors import Refused
from patchproof.base.folder_lock import lock_folder
from patchproof.base.output import new_folder

HOLDER = """
import sys
from patchproof.base.folder_lock import lock_folder
with lock_folder(sys.argv[1]):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_folder_is_written_by_one_command_at_a_time(tmp_path):
    """Also through a link to it, and while it does not exist yet; another folder is free."""
    out = tmp_path / "new" / "out"
    with lock_folder(out):
        with pytest.raises(Refused, match=f"no other command writes into, got {out}, into which process {os.getpid()}"):
            with lock_folder(out):
                pass
        out.mkdir()
        (tmp_path / "link").symlink_to(out)
        with pytest.raises(Refused, match="wait until it ends"), new_folder(tmp_path / "link", ("*",)):
            pass
        with lock_folder(out / "inner"):
            pass
    with lock_folder(out):  # and it is free again
        pass
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["link", "new", "out"]


def test_a_lock_dies_with_its_process(tmp_path):
    """Another process is kept out without a trace; after kill -9 its file is there and locks nothing."""
    out = tmp_path / "out"
    command = [sys.executable, "-c", HOLDER, str(out)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None and holder.stdout.readline() == "held\n"
        with pytest.raises(Refused, match=f"into which process {holder.pid} writes"), new_folder(out, ("*",)):
            pass
        holder.kill()
    assert [path.name for path in tmp_path.iterdir()] == [".out.lock.part"]
    with new_folder(out, ("*",)):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("name", ["x\0y", "x" * 300])
def test_a_path_that_no_system_accepts_is_refused(tmp_path, name):
    with pytest.raises(Refused, match="Expected a folder that can be"), lock_folder(tmp_path / name):
        pass
