"""Engines that run functions on many machines, each as ``submit(function, *arguments)``, which gives a future."""

from __future__ import annotations

import concurrent.futures
import contextlib
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor
from typing import Any, TypeVar

Submit = Callable[..., "Future[Any]"]
T = TypeVar("T")

#: Most tasks that an engine holds at once. A task is a few kilobytes there, and ten thousand keep as many cores busy.
IN_FLIGHT = 10_000


@contextlib.contextmanager
def engine(on: Any, threads: int) -> Iterator[Submit]:
    """How to submit to ``on``: a Dask client, the module ``ray``, an executor, or the threads of this process (none)."""
    if on is None:
        executor = ThreadPoolExecutor(max(1, (os.cpu_count() or 1) // threads))
        try:
            yield executor.submit
        finally:
            executor.shutdown(wait=False, cancel_futures=True)
    elif hasattr(on, "get_executor"):
        # A task is not taken for done because one of the same arguments was.
        executor = on.get_executor(pure=False)
        try:
            yield executor.submit
        finally:
            executor.shutdown(wait=False)
    elif getattr(on, "__name__", None) == "ray":
        yield _ray(on, threads)
    elif isinstance(on, Executor):
        yield on.submit
    else:
        raise TypeError(
            "`on` is a Dask client, the module ray, or an executor of concurrent.futures, "
            f"not {type(on).__name__}"
        )


def _ray(ray: Any, threads: int) -> Submit:
    remotes: dict[Callable[..., Any], Any] = {}

    def submit(function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        if function not in remotes:
            remotes[function] = ray.remote(num_cpus=threads)(function)
        future: Future[Any] = remotes[function].remote(*arguments).future()
        return future

    return submit


def each(submit: Submit, function: Callable[..., Any], shared: Any, items: Iterable[T]) -> Iterator[tuple[T, Future[Any]]]:
    """``function(shared, item)`` for every item: each with its finished future, as they finish."""
    pending: dict[Future[Any], T] = {}
    coming = iter(items)
    try:
        while True:
            while len(pending) < IN_FLIGHT and (item := next(coming, None)) is not None:
                pending[submit(function, shared, item)] = item
            if not pending:
                return
            done, _ = concurrent.futures.wait(pending, return_when=FIRST_COMPLETED)
            for future in done:
                yield pending.pop(future), future
    finally:
        for future in pending:
            future.cancel()
