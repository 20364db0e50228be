"""Two threads for a stream: the next item is made while one is worked on."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

Item = TypeVar("Item")


def work_behind(work: Callable[[Item], object], items: Iterable[Item]) -> None:
    """Work on every item, in their order, on another thread than the one that makes them.

    What the work raises is raised here, before a further item is worked on. Two items are held at most.
    """
    with ThreadPoolExecutor(1) as pool:
        working = None
        for item in items:
            if working:
                working.result()
            working = pool.submit(work, item)
        if working:
            working.result()
