"""A few lasting threads for kernels that release the interpreter; what is computed does not depend on their number."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

_crews: dict[int, ThreadPoolExecutor] = {}


def side_by_side(tasks: Sequence[Callable[[], Any]], threads: int) -> list[Any]:
    """Run independent tasks on so many threads, this one among them; returns their results in order."""
    if threads == 1 or len(tasks) == 1:
        return [task() for task in tasks]
    crew = _crews.setdefault(threads, ThreadPoolExecutor(threads - 1, thread_name_prefix="kpconv"))
    waiting = [crew.submit(task) for task in tasks]
    results = []
    for future, task in zip(waiting, tasks, strict=True):
        results.append(task() if future.cancel() else future.result())  # not begun: do it here
    return results
