"""Run independent work in this process, in local processes, or on a Dask cluster, as one `concurrent.futures.Executor`.

In: a function and items that can be pickled. Out: results, as they finish or in order. The death of a worker costs a
retry, not a result: all items in flight run again, locally one at a time, so that only the item that kills its worker
is given up.

Other processes compute on one thread each; if this process does, too, results do not depend on where they were
computed. Local processes are forked where that is safe: they start in milliseconds, and `fork_workers` shares all
loaded data with them. Elsewhere they are spawned and import all modules again, and work on shared data stays in this
process. A cluster's machines need this package, and the same files at the same paths.
"""

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
from hashlib import sha256
from logging import CRITICAL, getLogger
from pathlib import Path
from typing import Any

from patchproof.base.errors import Refused, WorkerDied
from patchproof.base.progress import Advance, no_advance

_Task = Callable[[Any], Any]
_Item = tuple[int, Any]  # its number, and the item
MAX_TRIES = 3  # of an item whose worker dies each time
_LEAST_QUEUED = 16  # on a cluster at a time, or twice its threads: its scheduler holds the function with every item
_CONNECT_TIMEOUT_S, _WORKERS_TIMEOUT_S = 10, 60  # to a cluster's scheduler, whose workers may be starting
_QUOTA = Path("/sys/fs/cgroup/cpu.max")  # of a container: microseconds of processor time per period


class Workers:
    """A restartable executor, opened and closed by `open_workers`. With `one_thread` tasks limit their own threads."""

    def __init__(self, start: Callable[[], Executor], in_flight: int, one_thread: bool = False, executors: int = 1):
        self._start, self._in_flight, self._one_thread = start, in_flight, one_thread
        self._executors = [start() for _ in range(executors)]  # of several, each gets items in its turn

    def completed(self, function: _Task, items: Iterable[Any]) -> Iterator[tuple[int, Future]]:
        """Yield (number of the item, its finished future) as they finish; items are taken only as they are needed."""
        suspects: list[_Item] = []
        yield from self._run(function, enumerate(items), self._in_flight, suspects)
        for suspect in suspects:
            yield from self._run_alone(function, suspect)

    def map(self, function: _Task, items: Iterable[Any], on_done: Advance = no_advance) -> list[Any]:
        """Return the results in the order of the items; raises the first exception. `on_done` gets (done, total)."""
        items = list(items)
        results = [None] * len(items)
        for done, (number, future) in enumerate(self.completed(function, items), 1):
            results[number] = result_of(future)
            on_done(done, len(items))
        return results

    def close(self) -> None:
        """Stop the workers; items that have not begun are dropped."""
        for executor in self._executors:
            executor.shutdown(wait=True, cancel_futures=True)

    def _run(self, function, items: Iterable[_Item], in_flight: int, lost: list[_Item]) -> Iterator[tuple[int, Future]]:
        """Keep `in_flight` items running; those whose workers died are appended to `lost`."""
        todo, running = iter(items), {}
        while True:
            while len(running) < in_flight and (item := next(todo, None)) is not None:
                running[self._submit(function, item)] = item
            if not running:
                return
            finished = futures.wait(running, return_when=futures.FIRST_COMPLETED).done
            broken = any(map(_has_dead_worker, finished))
            if broken:  # one dead process breaks the pool and all items in flight
                finished = futures.wait(running).done
            for future in finished:
                numbered_item = running.pop(future)
                if _has_dead_worker(future):
                    lost.append(numbered_item)
                else:
                    yield numbered_item[0], future
            if broken:
                self.close()
                self._executors = [self._start() for _ in self._executors]

    def _run_alone(self, function, suspect: _Item) -> Iterator[tuple[int, Future]]:
        for _ in range(MAX_TRIES):
            lost: list[_Item] = []
            yield from self._run(function, [suspect], 1, lost)
            if not lost:
                return
        error = WorkerDied("a worker that finishes its work", f"one that died {MAX_TRIES} times", "give it more memory")
        future: Future = Future()
        future.set_exception(error)
        yield suspect[0], future

    def _submit(self, function, numbered_item: _Item) -> Future:
        number, item = numbered_item
        call = partial(_call_on_one_thread, function) if self._one_thread else function
        try:
            return self._executors[number % len(self._executors)].submit(call, item)
        except BrokenExecutor as error:  # a process died between two waits
            future: Future = Future()
            future.set_exception(error)
            return future


@contextmanager
def open_workers(jobs: int = 1, cluster: str | None = None, spawn: bool = False) -> Iterator[Workers]:
    """Open `jobs` local processes, or the Dask cluster whose scheduler is at `cluster`. One job runs in this process,
    on all of its threads; with `spawn` every job gets a spawned process, and the calling script needs a `__main__`
    guard.
    """
    if cluster is None:
        forks = can_fork() and not spawn
        start = partial(_process_pool, jobs, forks)
        workers = Workers(start, 2 * jobs, not forks) if jobs > 1 or spawn else Workers(_InProcessExecutor, 1)
        with use_threads(1) if forks and jobs > 1 else nullcontext(), closing(workers):
            yield workers
        return
    if jobs > 1:
        raise Refused("--jobs or --cluster", "both", "leave one out: a cluster has its own number of workers")
    with closing(_connect_client(cluster)) as client:
        threads = sum(client.nthreads().values())
        yield Workers(partial(client.get_executor, pure=False), max(_LEAST_QUEUED, 2 * threads), True)


def _connect_client(address: str) -> Any:
    """A client of the scheduler at an address; refused if there is none."""
    try:
        from distributed import Client
    except ImportError:
        raise Refused("dask.distributed for --cluster", "none", 'pip install "patchproof[cluster]"') from None
    getLogger("distributed.client").setLevel(CRITICAL)  # a lost scheduler is said in one sentence
    try:
        client: Any = Client(address, timeout=_CONNECT_TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError, TypeError, TimeoutError) as error:  # TypeError: tls:// without its certificates
        reason = " ".join(str(error).split()) or type(error).__name__
        do = "start dask scheduler there, or correct the address"
        raise Refused("a Dask scheduler, such as tcp://host:8786", f"{address} ({reason})", do) from error
    try:
        client.wait_for_workers(1, timeout=_WORKERS_TIMEOUT_S)
    except TimeoutError as error:
        client.close()
        raise Refused(f"workers of {address}", "none", f"start some: dask worker {address}") from error
    try:
        codes = set(client.run(_read_code).values())
    except Exception:  # a module that they lack, or whatever else they run
        codes = {None}
    if codes != {_read_code()}:
        client.close()
        do = "install this version there, and start them again"
        raise Refused("workers with the code of this patchproof", "another or none on some of them", do)
    return client


def _read_code() -> str:
    """SHA-256 of the package's code."""
    files = sorted(Path(__file__).parents[1].rglob("*.py"))
    return sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


@contextmanager
def fork_workers(function: _Task, jobs: int, in_turn: bool = False) -> Iterator[tuple[Workers, _Task]]:
    """Fork `jobs` processes that share `function` and all that it refers to. Yields the workers and the callable to
    give them in its place, so that only items and results are sent.

    One job runs in this process, as does work within a forked worker; a system that cannot fork uses `jobs` threads
    here. With `in_turn` every call deals its items to the processes in the same rotation, so that each finds what it
    cached for an earlier one; otherwise the first free process takes the next item.
    """
    in_process = jobs == 1 or _function is not None
    if in_process or not can_fork():
        with nullcontext() if in_process else use_threads(jobs):
            yield Workers(_InProcessExecutor, 1), function
        return
    start = partial(_process_pool, 1 if in_turn else jobs, True, function)
    with use_threads(1), closing(Workers(start, 2 * jobs, executors=jobs if in_turn else 1)) as workers:
        yield workers, _call_shared_function


def can_fork() -> bool:
    """True if a forked process can compute: on Linux, if torch sees no GPU, for which it would start threads."""
    import torch

    return sys.platform == "linux" and not torch.accelerator.is_available()


def keep_freed_memory() -> None:
    """Let glibc keep up to 256 MB of freed memory: getting it from the system again took a fifth of a run's time."""
    if os.name == "posix" and hasattr(library := ctypes.CDLL(None), "mallopt"):
        library.mallopt(-4, 0)  # M_MMAP_MAX of glibc's malloc.h
        library.mallopt(-1, 1 << 28)  # M_TRIM_THRESHOLD: freed memory beyond it goes back to the system


def available_cores() -> int:
    """The number of cores that this process may use, by its affinity and its container's quota."""
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    quota, period = _QUOTA.read_text("ascii").split() if _QUOTA.is_file() else ("max", "1")
    return cores if quota == "max" else max(1, min(cores, int(quota) // int(period)))


@contextmanager
def share_cores(jobs: int | None, device: str = "cpu", cluster: str | None = None) -> Iterator[int]:
    """Yield `jobs`: by default one for each free core, but a single one with a GPU, with a cluster, or if processes
    cannot be forked. Where they can be, for work on the CPU, compute on one thread within the block.
    """
    import multiprocessing

    by_processes = can_fork() and device == "cpu"
    if jobs is None:
        may_fork = by_processes and cluster is None and not multiprocessing.current_process().daemon
        jobs = available_cores() if may_fork else 1
    with use_threads(1) if by_processes else nullcontext():
        yield jobs


def result_of(future: Future) -> Any:
    """Return a finished future's result or raise its exception; refused if the cluster itself was lost."""
    try:
        return future.result()
    except CancelledError:
        raise Refused("a running cluster", "one whose scheduler has stopped", "start it again") from None
    except Exception as error:
        if type(error).__name__ == "KilledWorker":  # of distributed, which need not be installed
            do = "give workers more memory"
            raise WorkerDied("a worker that finishes its work", "several that died", do) from error
        raise


@contextmanager
def use_threads(count: int) -> Iterator[None]:
    """Within the block torch, OpenCV and the BLAS of NumPy and SciPy compute on `count` threads."""
    import cv2
    import torch
    from threadpoolctl import threadpool_limits

    counts = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(count)
    cv2.setNumThreads(count)
    try:
        with threadpool_limits(count, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(counts[0])
        cv2.setNumThreads(counts[1])


class _InProcessExecutor(Executor):
    """An executor that runs each task at once, in this process."""

    def submit(self, fn, /, *args, **kwargs) -> Future:
        future: Future = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def _call_on_one_thread(function, item):
    with use_threads(1):
        return function(item)


def _process_pool(jobs: int, forks: bool, function: _Task | None = None) -> Executor:
    import multiprocessing

    context = multiprocessing.get_context("fork" if forks else "spawn")
    return _QuietProcessPool(jobs, context, _init_worker, (os.getpid(), function))


class _QuietProcessPool(futures.ProcessPoolExecutor):
    """A pool without Python's warning of forks with threads, since torch's and OpenCV's are idle (`use_threads`)."""

    def submit(self, fn, /, *args, **kwargs) -> Future:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*fork", DeprecationWarning)
            return super().submit(fn, *args, **kwargs)


_function: _Task | None = None  # in a forked worker the function that it was forked for


def _call_shared_function(item: Any) -> Any:
    assert _function is not None, "only for processes that were forked with a function"
    return _function(item)


def _init_worker(parent: int, function: _Task | None) -> None:
    """Set up a new process: it ignores Ctrl-C, and ends when its parent has ended."""
    global _function
    _function = function
    keep_freed_memory()
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def end_with_parent() -> None:
        while os.getppid() == parent:
            time.sleep(0.25)
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


def _has_dead_worker(future: Future) -> bool:
    return not future.cancelled() and isinstance(future.exception(), BrokenExecutor)
