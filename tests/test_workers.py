"""Independent work: order, errors, and workers that die."""

from __future__ import annotations

import pickle
import signal
from concurrent.futures import Future

import pytest

import toy_studies as toy
from patchproof.strict import Refused
from patchproof.workers import open_workers, result_of


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


def test_jobs_and_a_cluster_exclude_each_other():
    with pytest.raises(Refused, match="both"), open_workers(2, "tcp://127.0.0.1:1"):
        pass


@pytest.mark.filterwarnings("ignore")  # distributed's own, at the end of its processes
def test_a_cluster_gives_the_same_also_when_workers_die(tmp_path):
    distributed = pytest.importorskip("distributed", reason="needs dask: pip install 'patchproof[cluster]'")
    (tmp_path / "5").touch()
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        open_workers(cluster=cluster.scheduler_address) as workers,
    ):
        assert workers.map(toy.double_or_die, [(tmp_path, i) for i in range(8)]) == [2 * i for i in range(8)]
        assert workers.map(toy.threads, range(3)) == [1, 1, 1]
        with pytest.raises(Refused, match=r"^Expected a, got 7: c\.$"):
            workers.map(toy.refuse, [7])
    assert not (tmp_path / "5").exists()
    killer = Future()
    killer.set_exception(distributed.scheduler.KilledWorker("task", cluster, 3))
    with pytest.raises(Refused, match="several that died of it"):
        result_of(killer)


@pytest.mark.filterwarnings("ignore")
def test_a_cluster_that_does_not_answer_is_refused_in_a_sentence(monkeypatch):
    pytest.importorskip("distributed", reason="needs dask: pip install 'patchproof[cluster]'")
    monkeypatch.setattr("patchproof.workers._ANSWER_S", 1)
    for address in ("tcp://127.0.0.1:9", "not an address"):
        with pytest.raises(Refused, match="a Dask scheduler"), open_workers(cluster=address):
            pass
