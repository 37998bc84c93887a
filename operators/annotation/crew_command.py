"""Who does the work of `retracer annotate`: this process, several here, or those of a Ray cluster."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, Protocol, TypeVar

from graph.errors import UserError
from operators.annotation.stages_command import Job

Result = TypeVar("Result")
Tell = Callable[[float], None]
Stage = Callable[[Job, Path, Tell], Result]


class Crew(Protocol):
    """Does one stage for all sessions; gives the results in the order of the sessions."""

    def __call__(self, stage: Stage[Result], job: Job, paths: Sequence[Path], tell: Tell) -> Iterator[Result]: ...


@contextlib.contextmanager
def crew(workers: int, ray_address: str | None = None) -> Iterator[Crew]:
    """Hire workers for a `with` block. Raises UserError where Ray is wanted and is not there."""
    if ray_address is not None:
        with _ray(ray_address) as hired:
            yield hired
    elif workers == 1:
        yield _alone
    else:
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(workers, mp_context=context, initializer=_one_thread) as pool:
            yield lambda stage, job, paths, tell: _together(pool, stage, job, paths, tell)


def _alone(stage: Stage[Result], job: Job, paths: Sequence[Path], tell: Tell) -> Iterator[Result]:
    for number, path in enumerate(paths):
        begun = number / len(paths)
        yield stage(job, path, lambda share, begun=begun: tell(begun + share / len(paths)))  # type: ignore[misc]


def _one_thread() -> None:
    """Keep the libraries of a worker from starting threads of their own: the workers share the cores."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ[name] = "1"


def _silent(stage: Stage[Result], job: Job, path: Path) -> Result:
    return stage(job, path, lambda share: None)


def _together(
    pool: ProcessPoolExecutor, stage: Stage[Result], job: Job, paths: Sequence[Path], tell: Tell
) -> Iterator[Result]:
    futures = [pool.submit(_silent, stage, job, path) for path in paths]
    try:
        for number, _ in enumerate(as_completed(futures), start=1):
            tell(number / len(futures))
        for future in futures:
            yield future.result()
    finally:
        for future in futures:
            future.cancel()


@contextlib.contextmanager
def _ray(address: str) -> Iterator[Crew]:
    try:
        import ray  # type: ignore[import-not-found]
    except ImportError:
        raise UserError("--ray wants Ray, which is not installed: pip install 'retracer[ray]'") from None
    try:
        if address == "local":
            ray.init(logging_level="error", include_dashboard=False)
        else:
            ray.init(address=address, logging_level="error")
    except Exception as error:
        raise UserError(f"--ray {address}: no Ray cluster answers there: {error}") from None

    def distributed(stage: Stage[Any], job: Job, paths: Sequence[Path], tell: Tell) -> Iterator[Any]:
        remote = ray.remote(num_cpus=1)(_silent)
        waiting = [remote.remote(stage, job, path) for path in paths]
        left = list(waiting)
        while left:
            _, left = ray.wait(left, num_returns=1)
            tell(1.0 - len(left) / len(waiting))
        for one in waiting:
            try:
                yield ray.get(one)
            except ray.exceptions.RayTaskError as error:
                raise UserError(str(error.cause)) from None

    try:
        yield distributed
    finally:
        ray.shutdown()
