"""Independent work: order, errors, and workers that die."""

from __future__ import annotations

import os
import pickle
import re
import signal
import sys
import time
from concurrent.futures import Future

import cv2
import numpy as np
import pytest
import torch
import toy_studies as toy
from threadpoolctl import threadpool_info, threadpool_limits

from patchlab.study.study import Work, run_cells
from patchproof.base import workers as processes
from patchproof.base.errors import Refused
from patchproof.base.workers import available_cores, can_fork, fork_workers, open_workers, result_of, use_threads

forks = pytest.mark.skipif(not can_fork(), reason="processes are forked on Linux without a GPU")


def test_results_come_in_the_order_of_items_with_progress():
    calls = []
    with open_workers() as workers:
        assert workers.map(toy.double, range(9), lambda *call: calls.append(call)) == [2 * i for i in range(9)]
        assert workers.map(toy.double, []) == []
    assert calls == [(i, 9) for i in range(1, 10)]


def test_here_items_are_taken_when_their_turn_comes():
    taken = []

    def items():
        for i in range(5):
            taken.append(i)
            yield i

    with open_workers() as workers:
        for number, future in workers.completed(toy.double, items()):
            assert result_of(future) == 2 * number and len(taken) == number + 1


def test_a_refusal_survives_pickling_with_its_sentence():
    error = Refused("a", "b", "c. d")
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_other_processes_do_as_this_one_on_one_thread_and_die_at_the_cost_of_a_retry(tmp_path):
    (tmp_path / "4").touch()
    with open_workers(2) as workers:
        assert workers.map(toy.double, range(9)) == [2 * i for i in range(9)]
        assert workers.map(toy.threads, range(3)) == [1, 1, 1]
        if hasattr(signal, "setitimer"):  # a photograph's limit, which the processes that measure them keep
            assert workers.map(toy.given_up, [0.05, 3.0]) == [0.05, "too_costly"]
        with pytest.raises(Refused, match=r"^Expected a, got 7: c\.$"):
            workers.map(toy.refuse, [7])
        assert workers.map(toy.double_or_die, [(tmp_path, i) for i in range(8)]) == [2 * i for i in range(8)]
    assert not (tmp_path / "4").exists()  # one died


def test_only_the_item_that_kills_its_worker_each_time_is_given_up():
    with open_workers(2) as workers:
        done = dict(workers.completed(toy.double_unless_three, range(6)))
    assert {i: result_of(f) for i, f in done.items() if i != 3} == {i: 2 * i for i in range(6) if i != 3}
    with pytest.raises(Refused, match="died 3 times"):
        result_of(done[3])


@forks
def test_a_share_has_what_its_function_refers_to_also_after_a_worker_died(tmp_path):
    """A lambda over an open network and a matrix: nothing of it could be pickled."""
    net, weights = torch.nn.Linear(3, 2), np.eye(3, dtype=np.float32)
    (tmp_path / "2").touch()

    def answer(i: int) -> tuple[int, float, int, int]:
        if i == 2 and (tmp_path / "2").exists():
            (tmp_path / "2").unlink()
            os.kill(os.getpid(), signal.SIGKILL)
        net.zero_grad()
        net(torch.tensor(weights * i)).sum().backward()
        nested = None
        with fork_workers(lambda n: os.getpid(), 2) as (inner, share):  # a share of a share stays where it is
            nested = inner.map(share, range(2)) == [os.getpid()] * 2
        return i * int(nested), float(net.weight.grad.sum()), torch.get_num_threads(), os.getpid()

    with fork_workers(answer, 2) as (crew, share):
        answers = crew.map(share, range(6))
    assert [a[:3] for a in answers] == [(i, 6.0 * i, 1) for i in range(6)]
    assert os.getpid() not in {a[3] for a in answers} and not (tmp_path / "2").exists()
    with fork_workers(answer, 1) as (crew, share):
        assert [a[3] for a in crew.map(share, range(2))] == [os.getpid()] * 2


@forks
def test_items_in_turn_go_to_the_process_that_had_the_one_so_many_before(tmp_path):
    had = {}

    def before(i: int | str) -> tuple[int, int] | None:
        if i == "":
            return None
        had.setdefault(i % 3, []).append(i)
        return os.getpid(), len(had[i % 3])

    with fork_workers(before, 3, in_turn=True) as (crew, share):
        answers = []
        for _ in range(4):
            answers += crew.map(share, range(6))
            crew.map(share, [""])  # of however many: the first process gets the first of the next call, too
    assert len({pid for pid, _ in answers}) == 3
    assert [times for _, times in answers] == [at // 3 + 1 for at in range(24)]


@forks
def test_a_share_begins_where_torch_and_opencv_already_have_threads():
    """Children that told OpenCV to leave the threads of their parent, which they do not have, waited forever."""
    before = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(2)
    cv2.setNumThreads(2)
    try:
        picture = np.zeros((2000, 2000, 3), np.uint8)
        cv2.GaussianBlur(picture, (0, 0), 3)
        (torch.rand(512, 512) @ torch.rand(512, 512)).sum()
        with fork_workers(lambda i: float(cv2.GaussianBlur(picture, (0, 0), 3).max() + torch.ones(i).sum()), 2) as (
            crew,
            f,
        ):
            assert crew.map(f, range(4)) == [0.0, 1.0, 2.0, 3.0]
        assert (torch.get_num_threads(), cv2.getNumThreads()) == (2, 2)
    finally:
        torch.set_num_threads(before[0])
        cv2.setNumThreads(before[1])


@forks
def test_blas_of_numpy_computes_on_one_thread_in_this_process_and_in_the_others():
    """Its threads spin: beside two workers they took a third of a verification's seconds."""

    def threads(_=None) -> set[int]:
        np.linalg.svd(np.eye(100))
        return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

    with threadpool_limits(2, user_api="blas"):
        before = threads()
        with fork_workers(threads, 2) as (crew, share):
            assert threads() == {1} and crew.map(share, range(2)) == [{1}, {1}]
        assert threads() == before == {2}


def test_a_system_that_cannot_fork_works_here_on_as_many_threads(monkeypatch):
    monkeypatch.setattr(processes, "can_fork", lambda: False)
    before = torch.get_num_threads()
    with use_threads(1):
        with fork_workers(lambda i: (os.getpid(), torch.get_num_threads()), 2) as (crew, share):
            assert crew.map(share, range(2)) == [(os.getpid(), 2)] * 2
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == before


@forks
def test_children_end_when_their_parent_is_killed(tmp_path):

    def work() -> None:
        with fork_workers(lambda i: (tmp_path / str(os.getpid())).touch() or time.sleep(60), 2) as (crew, share):
            crew.map(share, range(2))

    parent = os.fork()
    if parent == 0:
        try:
            work()
        finally:
            os._exit(1)
    until = time.monotonic() + 60
    while len(children := [int(path.name) for path in tmp_path.iterdir()]) < 2:
        assert time.monotonic() < until
        time.sleep(0.05)
    os.kill(parent, signal.SIGKILL)
    os.waitpid(parent, 0)
    while any(alive(child) for child in children):
        assert time.monotonic() < until
        time.sleep(0.1)


def alive(pid: int) -> bool:
    """Whether a process runs; one that nobody waited for has ended."""
    try:
        with open(f"/proc/{pid}/stat", encoding="ascii") as stat:
            return stat.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_free_cores_are_those_of_affinity_and_quota(monkeypatch, tmp_path):
    assert 1 <= available_cores() <= (os.cpu_count() or 1)
    if hasattr(os, "sched_getaffinity"):
        monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(8)))
        for text, cores in (("max 100000", 8), ("250000 100000", 2), ("50000 100000", 1), ("1600000 100000", 8)):
            (tmp_path / "cpu.max").write_text(text + "\n")
            monkeypatch.setattr(processes, "_QUOTA", tmp_path / "cpu.max")
            assert available_cores() == cores


def test_jobs_and_a_cluster_exclude_each_other():
    with pytest.raises(Refused, match="both"), open_workers(2, "tcp://127.0.0.1:1"):
        pass


@pytest.fixture
def quick_start():
    """Processes of a cluster, three with the one that takes a dead one's place, are forked off one that has imported
    what they need: each on its own would import it for 2 s.
    """
    dask = pytest.importorskip("dask", reason="needs dask: pip install 'patchproof[cluster]'")
    utils = pytest.importorskip("distributed.utils", reason="needs dask: pip install 'patchproof[cluster]'")
    if sys.platform != "linux":
        yield
        return
    with dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}):
        utils.get_mp_context().set_forkserver_preload(["distributed", "torch", "patchlab.study.study"])
        yield


@pytest.mark.filterwarnings("ignore")  # distributed's own, at the end of its processes
def test_a_cluster_gives_the_same_also_when_workers_die(tmp_path, monkeypatch, quick_start):
    """Of single items, and to the byte of a whole study, in whose midst a worker dies."""
    import distributed

    monkeypatch.setattr("patchproof.report.tables.draw_figure", lambda *_, **__: b"drawn here, not by workers")
    settings = toy.ToySettings(numbers=tuple(range(8)), die_in=str(tmp_path))
    run_cells(toy.STUDY, settings, tmp_path, tmp_path / "here")
    (tmp_path / "n3").touch()
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        with open_workers(cluster=cluster.scheduler_address) as workers:
            assert workers.map(toy.double, range(8)) == [2 * i for i in range(8)]
            assert workers.map(toy.threads, range(3)) == [1, 1, 1]
            next(workers.completed(toy.double, items := iter(range(500))))
            assert next(items) < 20  # a scheduler holds few at a time
            with pytest.raises(Refused, match=r"^Expected a, got 7: c\.$"):
                workers.map(toy.refuse, [7])
        run_cells(toy.STUDY, settings, tmp_path, tmp_path / "there", Work(cluster=cluster.scheduler_address))
    assert not (tmp_path / "n3").exists()
    here, there = (
        {path.relative_to(out): path.read_bytes() for path in out.rglob("*.*")}
        for out in (tmp_path / "here", tmp_path / "there")
    )
    assert here == there and len(here) > 16
    killer = Future()
    killer.set_exception(distributed.scheduler.KilledWorker("task", cluster, 3))
    with pytest.raises(Refused, match="several that died"):
        result_of(killer)


@pytest.mark.filterwarnings("ignore")
def test_a_cluster_that_does_not_answer_is_refused_in_a_sentence(monkeypatch):
    pytest.importorskip("distributed", reason="needs dask: pip install 'patchproof[cluster]'")
    monkeypatch.setattr("patchproof.base.workers._CONNECT_TIMEOUT_S", 1)
    for address in ("tcp://127.0.0.1:9", "not an address", "tls://127.0.0.1:9"):
        with pytest.raises(Refused, match="a Dask scheduler"), open_workers(cluster=address):
            pass


@pytest.mark.filterwarnings("ignore")
def test_a_cluster_without_workers_is_refused_in_a_sentence(monkeypatch):
    distributed = pytest.importorskip("distributed", reason="needs dask: pip install 'patchproof[cluster]'")
    monkeypatch.setattr("patchproof.base.workers._WORKERS_TIMEOUT_S", 0.5)
    with distributed.LocalCluster(n_workers=0, dashboard_address=None, processes=False) as cluster:
        start = re.escape(f"got none: start some: dask worker {cluster.scheduler_address}")
        with pytest.raises(Refused, match=start), open_workers(cluster=cluster.scheduler_address):
            pass


@pytest.mark.filterwarnings("ignore")
def test_workers_with_other_code_are_refused(monkeypatch):
    distributed = pytest.importorskip("distributed", reason="needs dask: pip install 'patchproof[cluster]'")
    monkeypatch.setattr("patchproof.base.workers._read_code", lambda: os.urandom(4).hex())
    with distributed.LocalCluster(n_workers=1, dashboard_address=None, processes=False) as cluster:
        with pytest.raises(Refused, match="code of this patchproof"), open_workers(cluster=cluster.scheduler_address):
            pass
