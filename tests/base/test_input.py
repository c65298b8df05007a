"""Files that do not end, files that are too large, and work that has to be done within limits."""

from __future__ import annotations

import hashlib
import os
import signal
import sys
import time

import numpy as np
import pytest

from patchproof.base import input as bounds
from patchproof.base.errors import Refused, TimeLimitExceeded
from patchproof.base.input import file_size, hash_file, open_image, read_file, read_json, run_in_child
from patchproof.base.validation import read_toml
from test_workers import alive

needs_linux = pytest.mark.skipif(sys.platform != "linux", reason="processes that are forked and limited")


@needs_linux
def test_pipes_devices_and_files_that_never_end_are_not_read(tmp_path):
    """Each would wait, or be read forever; the system's files say that they have no bytes."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zeros").symlink_to("/dev/zero")
    (tmp_path / "pages").symlink_to("/proc/self/pagemap")
    for name in ("pipe", "zeros"):
        with pytest.raises(Refused, match=f"Expected some text, got no file at .*{name}: check the path"):
            read_file(tmp_path / name, "some text")
        with pytest.raises(Refused, match="no file"):
            hash_file(tmp_path / name)
    assert read_file(tmp_path / "pages", "some text") == b""
    assert hash_file(tmp_path / "pages").startswith("e3b0c442")  # of no bytes
    for name in ("pipe", "zeros", "pages"):
        with pytest.raises(Refused, match="a picture"), open_image(tmp_path / name, "a picture", "leave it out"):
            pass


def test_files_are_no_larger_than_what_they_are_read_as(tmp_path):
    with (tmp_path / "large").open("wb") as file:
        file.truncate(1 << 40)
    assert file_size(tmp_path / "large", 1 << 40) == 1 << 40
    for read in (read_toml, lambda path: read_json(path, "JSON", "mend it"), lambda path: read_file(path, "text")):
        with pytest.raises(Refused, match="1073741824 KiB, more than"):
            read(tmp_path / "large")
    with pytest.raises(Refused, match="more than"):
        hash_file(tmp_path / "large")
    (tmp_path / "text").write_bytes(b"abc" * 1_000_000)
    assert hash_file(tmp_path / "text") == hashlib.sha256(b"abc" * 1_000_000).hexdigest()


def test_settings_with_a_key_of_many_parts_are_refused_for_their_size(tmp_path):
    """The time that Python's reader takes grows with the square of their number: a minute for 100,000."""
    (tmp_path / "dots.toml").write_text(".".join(["a"] * 100_000) + " = 1")
    with pytest.raises(Refused, match="195 KiB, more than 64 KiB"):
        read_toml(tmp_path / "dots.toml")


def spin() -> None:
    while True:
        pass


@needs_linux
def test_work_in_a_child_ends_in_time_in_memory_and_with_its_own_result_or_error(monkeypatch):
    monkeypatch.setattr(bounds, "TIME_LIMIT_S", 0.1)
    monkeypatch.setattr(bounds, "MAX_CHILD_BYTES", 10_000_000)
    here = os.getpid()
    assert run_in_child(lambda: (here, os.getpid() != here)) == (here, True)
    np.testing.assert_array_equal(run_in_child(lambda: np.arange(3)), np.arange(3))
    with pytest.raises(Refused, match="Expected a, got b: c"):
        run_in_child(lambda: (_ for _ in ()).throw(Refused("a", "b", "c")))
    before = time.monotonic()
    with pytest.raises(TimeLimitExceeded, match=r"0\.1 s"):
        run_in_child(spin)
    assert time.monotonic() - before < 20
    with pytest.raises(MemoryError):
        run_in_child(lambda: bytes(2_000_000_000))
    with pytest.raises(MemoryError, match="than it may take"):
        run_in_child(lambda: os._exit(3))
    assert len(run_in_child(lambda: bytes(5_000_000))) == 5_000_000


@needs_linux
def test_a_child_with_much_to_say_ends_when_its_parent_is_killed(tmp_path):
    """Its answer is more than a pipe holds, and nobody reads it."""

    def work() -> bytes:
        (tmp_path / f"{os.getpid()}").touch()
        parent = os.getppid()
        while os.getppid() == parent:
            time.sleep(0.01)
        return bytes(5_000_000)

    parent = os.fork()
    if parent == 0:
        run_in_child(work)
        os._exit(0)
    until = time.monotonic() + 60
    while not (children := list(tmp_path.iterdir())):
        assert time.monotonic() < until
        time.sleep(0.01)
    os.kill(parent, signal.SIGKILL)
    os.waitpid(parent, 0)
    child = int(children[0].name)
    try:
        while alive(child):
            assert time.monotonic() < until
            time.sleep(0.05)
    finally:
        if alive(child):
            os.kill(child, signal.SIGKILL)
