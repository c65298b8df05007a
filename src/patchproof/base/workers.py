"""Independent work in this process, in local processes, or on a Dask cluster: one `concurrent.futures.Executor`.

In: a function and items that can be pickled. Out: results, as they finish or in order. A worker that dies costs a
retry, not a result: what was in flight is done again by others, and what was in flight when local processes died goes
alone, so that only the item that kills its worker is given up.

Other processes work on one thread each, which keeps them from fighting over the machine; with one thread here, too,
the results are the same wherever they were made. Local processes are forked where that is safe: they start in
milliseconds, and `fork_workers` gives them all that this process has loaded. Elsewhere they are spawned and import anew, and
what shares data stays in this process. A cluster's machines need this package and see the same files at the same paths.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent import futures
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from contextlib import closing, contextmanager, nullcontext
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

from patchproof.base.errors import Refused, WorkerDied

Numbered = tuple[int, Any]
TRIES = 3  # of an item whose worker dies each time
QUEUED = 1000  # items that a cluster is given at a time: enough to keep it busy, and for it to see what is to come
_QUOTA = Path("/sys/fs/cgroup/cpu.max")  # of a container: microseconds of a processor in how many
_ANSWER_S = 10  # that a cluster's scheduler may take to answer


class Workers:
    """An open executor with what it needs to start anew; `open_workers` makes and closes it. With `one_thread` each
    task sets its thread's thread count, where others started the workers.
    """

    def __init__(self, start: Callable[[], Executor], in_flight: int, one_thread: bool = False):
        self._start, self._in_flight, self._one_thread = start, in_flight, one_thread
        self._executor = start()

    def completed(self, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[tuple[int, Future]]:
        """(number of the item, its finished future), as they finish; few items more than are in work are taken."""
        suspects: list[Numbered] = []
        yield from self._flow(function, enumerate(items), self._in_flight, suspects)
        for suspect in suspects:
            yield from self._alone(function, suspect)

    def map(
        self,
        function: Callable[[Any], Any],
        items: Iterable[Any],
        on_done: Callable[[int, int], None] = lambda done, total: None,
    ) -> list[Any]:
        """The results in the order of the items; the first exception of one is raised. `on_done` gets (done, all)."""
        items = list(items)
        results = [None] * len(items)
        for done, (number, future) in enumerate(self.completed(function, items), 1):
            results[number] = result_of(future)
            on_done(done, len(items))
        return results

    def close(self) -> None:
        """Stop the workers; what has not begun is dropped."""
        self._executor.shutdown(wait=True, cancel_futures=True)

    def _flow(
        self, function, numbered: Iterable[Numbered], in_flight: int, lost: list[Numbered]
    ) -> Iterator[tuple[int, Future]]:
        """Keep `in_flight` items in work; those whose workers died are left in `lost`."""
        todo, running = iter(numbered), {}
        while True:
            while len(running) < in_flight and (taken := next(todo, None)) is not None:
                running[self._submit(function, taken[1])] = taken
            if not running:
                return
            finished = futures.wait(running, return_when=futures.FIRST_COMPLETED).done
            broken = any(map(_broke, finished))
            if broken:  # one dead process breaks the pool, and with it all that was in flight
                finished = futures.wait(running).done
            for future in finished:
                numbered_item = running.pop(future)
                if _broke(future):
                    lost.append(numbered_item)
                else:
                    yield numbered_item[0], future
            if broken:
                self._executor.shutdown(wait=True)
                self._executor = self._start()

    def _alone(self, function, suspect: Numbered) -> Iterator[tuple[int, Future]]:
        for _ in range(TRIES):
            lost: list[Numbered] = []
            yield from self._flow(function, [suspect], 1, lost)
            if not lost:
                return
        future: Future = Future()
        future.set_exception(
            WorkerDied("a worker that lives through its work", f"one that died {TRIES} times", "give it more memory")
        )
        yield suspect[0], future

    def _submit(self, function, item) -> Future:
        call = partial(_on_a_thread, function) if self._one_thread else function
        try:
            return self._executor.submit(call, item)
        except BrokenExecutor as error:  # a process died while nobody waited
            future: Future = Future()
            future.set_exception(error)
            return future


@contextmanager
def open_workers(jobs: int = 1, cluster: str | None = None, apart: bool = False) -> Iterator[Workers]:
    """`jobs` local processes (1: this one, with its own threads, or one `apart` that is spawned), or the Dask cluster
    whose scheduler is at `cluster`.

    Where processes are spawned, a script that calls this needs the `if __name__ == "__main__"` guard.
    """
    if cluster is None:
        forks = can_fork() and not apart
        start = partial(_processes, jobs, forks)
        workers = Workers(start, 2 * jobs, not forks) if jobs > 1 or apart else Workers(_Here, 1)
        with use_threads(1) if forks and jobs > 1 else nullcontext(), closing(workers):
            yield workers
        return
    if jobs > 1:
        raise Refused("--jobs or --cluster", "both", "leave one out: a cluster knows how many workers it has")
    with closing(_client(cluster)) as client:
        yield Workers(partial(client.get_executor, pure=False), QUEUED, True)


@contextmanager
def fork_workers(
    function: Callable[[Any], Any], jobs: int, in_turn: bool = False
) -> Iterator[tuple[Workers, Callable[[Any], Any]]]:
    """`jobs` forked processes that have a function with everything that it refers to, as it is now, and what to call in
    them in its place; only items and results are sent. One job, and a process that was forked for a share itself, works
    here; so does a system that cannot fork (`can_fork`), on as many threads. Items that go round `in_turn` find what
    their process kept of an earlier one; otherwise the first that is free takes the next.
    """
    alone = jobs == 1 or _function is not None
    if alone or not can_fork():
        with nullcontext() if alone else use_threads(jobs):
            yield Workers(_Here, 1), function
        return
    start = partial(_InTurn if in_turn else _processes, jobs, True, function)
    with use_threads(1), closing(Workers(start, 2 * jobs)) as workers:
        yield workers, _shared


def can_fork() -> bool:
    """Whether a forked process can compute: on Linux, where torch sees no GPU, for which it would start threads."""
    import torch

    return sys.platform == "linux" and not torch.accelerator.is_available()


def keep_freed_memory() -> None:
    """glibc keeps what pictures leave, up to a quarter of a gigabyte: fetching it anew took a fifth of a run's time."""
    if os.name == "posix" and hasattr(library := ctypes.CDLL(None), "mallopt"):
        library.mallopt(-4, 0)  # M_MMAP_MAX of its malloc.h
        library.mallopt(-1, 1 << 28)  # M_TRIM_THRESHOLD: without it limits of memory would be nobody's


def available_cores() -> int:
    """How many cores this process may use, by its affinity and its container's quota."""
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    quota, period = _QUOTA.read_text("ascii").split() if _QUOTA.is_file() else ("max", "1")
    return cores if quota == "max" else max(1, min(cores, int(quota) // int(period)))


def result_of(future: Future) -> Any:
    """A finished future's result or its exception; refused in a sentence where the cluster itself was lost."""
    try:
        return future.result()
    except CancelledError:
        raise Refused("a cluster that stays", "one whose scheduler is gone", "start it again") from None
    except Exception as error:
        if type(error).__name__ == "KilledWorker":  # of distributed, which need not be installed here
            do = "give workers more memory"
            raise WorkerDied("a worker that lives through its work", "several that died of it", do) from error
        raise


@contextmanager
def use_threads(count: int) -> Iterator[None]:
    """torch and OpenCV compute on so many threads inside, and as before afterwards."""
    import cv2
    import torch

    before = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(count)
    cv2.setNumThreads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        cv2.setNumThreads(before[1])


class _Here(Executor):
    """Work done at once, in this process."""

    def submit(self, fn, /, *args, **kwargs) -> Future:
        future: Future = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def _on_a_thread(function, item):
    with use_threads(1):
        return function(item)


def _processes(jobs: int, forks: bool, function: Callable[[Any], Any] | None = None) -> Executor:
    import multiprocessing

    context = multiprocessing.get_context("fork" if forks else "spawn")
    return _Quietly(jobs, context, _begin, (os.getpid(), function))


class _InTurn(Executor):
    """Processes that get items one after the other."""

    def __init__(self, jobs: int, forks: bool, function: Callable[[Any], Any]):
        self._executors = [_processes(1, forks, function) for _ in range(jobs)]
        self._next = cycle(self._executors)

    def submit(self, fn, /, *args, **kwargs) -> Future:
        return next(self._next).submit(fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        for executor in self._executors:
            executor.shutdown(wait, cancel_futures=cancel_futures)


class _Quietly(futures.ProcessPoolExecutor):
    """Forked from a process with other threads, of which Python warns. Those of torch and OpenCV have ended or rest
    by then (`use_threads`): a child that wakes them waits forever.
    """

    def submit(self, fn, /, *args, **kwargs) -> Future:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*fork", DeprecationWarning)
            return super().submit(fn, *args, **kwargs)


_function: Callable[[Any], Any] | None = None  # what this process was forked for


def _shared(item: Any) -> Any:
    assert _function is not None, "this process was made to share a function"
    return _function(item)


def _begin(parent: int, function: Callable[[Any], Any] | None) -> None:
    """In a new process: no part in Ctrl-C, and an end when its parent is gone."""
    global _function
    _function = function
    keep_freed_memory()
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def end_with_parent() -> None:
        while os.getppid() == parent:
            time.sleep(1)
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


def _client(address: str) -> Any:
    try:
        from distributed import Client
    except ImportError:
        raise Refused("dask.distributed for --cluster", "none", 'pip install "patchproof[cluster]"') from None
    try:
        return Client(address, timeout=_ANSWER_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        do = "start dask scheduler there, or mend the address"
        raise Refused("a Dask scheduler, such as tcp://host:8786", f"{address} ({reason})", do) from error


def _broke(future: Future) -> bool:
    return not future.cancelled() and isinstance(future.exception(), BrokenExecutor)
