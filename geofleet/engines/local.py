"""Tiles on the threads of this machine.

Threads, not processes: the compiled kernels and the Parquet reader release the interpreter lock, and nothing has to be
copied between them. A task is plain data and the function stands at module level, so that other engines can ship both.
"""

from __future__ import annotations

import ctypes
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import islice
from typing import TYPE_CHECKING, TypeVar

import pyarrow as pa

from geofleet.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

Task = TypeVar("Task")
Result = TypeVar("Result")

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of malloc.h


def run_tasks(
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    *,
    n_workers: int,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[Result]:
    """Yield the result of every task in the order of the tasks, whatever order they finish in.

    At most two tasks a worker are under way or waiting to be taken, so that results do not pile up.

    Parameters
    ----------
    function
        What to do with a task; defined at module level.
    tasks
        Plain data.
    n_workers
        Tasks that run at the same time.
    progress
        Called with the number of results taken and the number of tasks.

    Raises
    ------
    ConfigError
        `n_workers` is below 1. What a task raises is raised here, and tasks that have not begun are dropped.
    """
    if n_workers < 1:
        raise ConfigError(f"{n_workers} workers cannot run anything.", where="--workers", todo="Give 1 or more.")
    waiting = iter(tasks)
    with ThreadPoolExecutor(n_workers) as pool:
        running = deque(pool.submit(function, task) for task in islice(waiting, 2 * n_workers))
        done = 0
        try:
            while running:
                result = running.popleft().result()
                running.extend(pool.submit(function, task) for task in islice(waiting, 1))
                done += 1
                if progress:
                    progress(done, len(tasks))
                yield result
        finally:
            for future in running:
                future.cancel()


def keep_freed_memory() -> None:
    """Let the C library keep what is freed until `release_memory`.

    glibc hands freed memory back at once, and has every page cleared anew when the next batch asks for it: a third of
    the time of a batch. These thresholds are those that it arrives at by itself once a block of 32 MB has been freed.
    """
    with suppress(AttributeError, OSError, TypeError):
        library = ctypes.CDLL(None)
        library.mallopt(_M_MMAP_THRESHOLD, 32 << 20)
        library.mallopt(_M_TRIM_THRESHOLD, 64 << 20)


def release_memory() -> None:
    """Give what Arrow and the C library keep for later back to the system.

    glibc keeps what threads have freed in heaps of their own, which the next threads do not always find: a fifth of the
    peak of a large job. Other C libraries have no `malloc_trim`, and keep less.
    """
    pa.default_memory_pool().release_unused()
    with suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
