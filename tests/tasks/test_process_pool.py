"""The ranked process pool: order of work, errors, dead workers and shutdown."""

from __future__ import annotations

import os
import threading
from concurrent.futures import CancelledError, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path

import pytest

from flows.pipeline import chain
from tasks.execution.chain import calls_after, outline
from tasks.execution.process_pool import RankedPool
from worldline_core.pipeline.pipeline_config import PipelineConfig


def test_of_what_waits_the_highest_rank_goes_first_and_what_is_cancelled_never() -> None:
    ranks, done, taken, hold = iter([0, 1, 3, 3, 2]), list[str](), threading.Event(), threading.Event()
    pool = RankedPool(ThreadPoolExecutor(2), 1, lambda: next(ranks))
    pool.submit(lambda: (taken.set(), hold.wait()))
    assert taken.wait(10)
    others = [pool.submit(lambda name=name: done.append(name)) for name in ("low", "high", "high too", "cancelled")]
    assert others[-1].cancel()
    hold.set()
    others[0].result(10)
    assert done == ["high", "high too", "low"]
    pool.shutdown(wait=True, cancel_futures=True)


def test_a_successor_that_ranks_higher_goes_before_what_waits() -> None:
    ranks, done = iter([4, 1, 3]), list[str]()
    pool = RankedPool(ThreadPoolExecutor(1), 1, lambda: next(ranks))
    hold = threading.Event()
    first = pool.submit(hold.wait)
    waiting = pool.submit(lambda: done.append("waiting"))
    first.add_done_callback(
        lambda _: threading.Timer(0.1, lambda: pool.submit(lambda: done.append("successor"))).start()
    )
    hold.set()
    waiting.result(10)
    assert done == ["successor", "waiting"]
    pool.shutdown(wait=True, cancel_futures=True)


def test_an_error_and_a_worker_that_ends_reach_who_waits() -> None:
    pool = RankedPool(ProcessPoolExecutor(1), 1, lambda: 0)
    with pytest.raises(FileNotFoundError):
        pool.submit(Path("nothing").read_text).result(30)
    lost = [pool.submit(os.getppid), pool.submit(partial(os._exit, 1)), pool.submit(os.getppid)]
    assert lost[0].result(30) == os.getpid()
    for future in lost[1:]:
        with pytest.raises(BrokenProcessPool):
            future.result(30)
    pool.shutdown(wait=True, cancel_futures=True)


def test_what_waits_at_the_end_is_cancelled() -> None:
    hold = threading.Event()
    pool = RankedPool(ThreadPoolExecutor(1), 1, lambda: 0)
    taken = threading.Event()
    first, second = pool.submit(lambda: taken.set() or hold.wait()), pool.submit(hold.wait)
    assert taken.wait(10)
    threading.Timer(0.1, hold.set).start()
    pool.shutdown(wait=True, cancel_futures=True)
    assert first.result(10) is True
    with pytest.raises(CancelledError):
        second.result(10)
    with pytest.raises(RuntimeError, match="shut down"):
        pool.submit(hold.wait)


def test_the_chain_of_models_goes_before_predictions_by_finished_ones() -> None:
    after = calls_after(outline(chain, PipelineConfig.load("demo")))
    assert after["report"] == 0
    assert (
        after["encode_latents"]
        > after["train_stage1"]
        > after["train_stage2"]
        > after["distill"]
        > after["rollout.causal"]
    )
    assert after["distill"] > after["rollout.shipped_stage2"] == after["rollout.causal"] == after["evaluate_video"] + 1
