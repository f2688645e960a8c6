"""Where cases of a cohort run: threads of this process, or the workers of a Dask scheduler."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import CancelledError, Executor, ThreadPoolExecutor
from contextlib import contextmanager

from vatsloc.errors import CaseError

CONNECT_S = 3.0
WORKERS_S = 10.0
"""How long to wait for the first worker of a scheduler that answers."""


@contextmanager
def pool(jobs: int, scheduler: str | None) -> Iterator[Executor]:
    """An executor of `jobs` threads, or of a Dask scheduler's workers.

    Raises CaseError at once when Dask is not installed, nothing answers at the address, or it has no workers, and when
    the scheduler dies while cases run.
    """
    if scheduler is None:
        with ThreadPoolExecutor(jobs) as threads:
            try:
                yield threads
            except BaseException:
                threads.shutdown(cancel_futures=True)
                raise
        return
    try:
        from distributed import Client
    except ImportError as missing:
        raise CaseError('--scheduler needs Dask: install "distributed", or leave the option out.') from missing
    try:
        client = Client(scheduler, timeout=CONNECT_S)
    except (OSError, ValueError) as error:  # ValueError: an address without a port, or of an unknown protocol
        raise CaseError(
            f"no Dask scheduler answers at {scheduler} ({error}); start it (dask scheduler), or correct --scheduler."
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=WORKERS_S)
        except TimeoutError as error:
            raise CaseError(
                f"the Dask scheduler at {scheduler} has no workers after {WORKERS_S:g} s; "
                f"start some (dask worker {scheduler}), or leave --scheduler out."
            ) from error
        try:
            yield client.get_executor()
        except (CancelledError, OSError) as error:
            if isinstance(error, OSError) and client.status == "running":
                raise
            raise CaseError(
                f"the Dask scheduler at {scheduler} stopped answering; start it and run again, what is done is kept."
            ) from error
