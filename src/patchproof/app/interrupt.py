"""Ctrl-C ends a command within two seconds, at any moment.

A KeyboardInterrupt removes unfinished files on its way. But libraries swallow it while they are imported, or abort, and
it waits for long calls into them. So within an import the process ends at once, and elsewhere a thread ends it
after `STOP_AFTER_S`, unless a command has put another handler in place. That loses no more than a kill, which leaves
nothing half done under a final name.
"""

import os
import signal
import socket
import sys
import threading
import time
from types import FrameType

STOP_AFTER_S = 0.5


def handle_interrupts() -> None:
    """Install the handlers in this process; call it before anything else is imported."""
    receiver, sender = socket.socketpair()
    sender.setblocking(False)
    signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)  # written to even while Python waits for a library
    threading.Thread(target=_watch, args=(receiver, sender), daemon=True).start()
    signal.signal(signal.SIGINT, _interrupt)


def _interrupt(_: int, frame: FrameType | None) -> None:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            _end()
        frame = frame.f_back
    raise KeyboardInterrupt


def _watch(receiver: socket.socket, _: socket.socket) -> None:
    while signal.SIGINT not in receiver.recv(64) or signal.getsignal(signal.SIGINT) is not _interrupt:
        pass
    time.sleep(STOP_AFTER_S)
    _end()


def _end() -> None:
    console = sys.modules.get("patchproof.app.cli.console")  # a library may be importing: nothing more is imported
    try:
        if say := getattr(console, "say_stopped", None):
            say()
        else:
            print("Stopped: nothing was written.", file=sys.stderr, flush=True)
    finally:
        os._exit(130)
