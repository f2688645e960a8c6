"""Where cases of a cohort run: threads of this process, or the workers of a Dask scheduler."""

from __future__ import annotations

import os
import secrets
import socket
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from vatsloc.errors import CaseError
from vatsloc.formats.casefile import FILE_NAME
from vatsloc.formats.folder import PROGRAM

CONNECT_S = 3.0
WORKERS_S = 10.0
"""How long to wait for the first worker of a scheduler that answers."""
RETRIES = 2
"""How often a task that raised is given to a worker again; one whose worker died is given to others anyway."""


@dataclass(frozen=True)
class Place:
    """Where cases run. shares: threads of a case's kernels by address of a Dask worker, empty for local threads."""

    executor: Executor
    shares: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Seen:
    """What a worker says of itself. cores: that it may use; missing: cases that it does not see."""

    host: str
    cores: tuple[int, ...]
    threads: int
    version: str
    mark: str
    missing: tuple[str, ...]


@contextmanager
def pool(jobs: int, scheduler: str | None, out: Path, cases: Sequence[Path]) -> Iterator[Place]:
    """An executor of `jobs` threads, or of a Dask scheduler's workers, which have to see `out` and `cases`.

    Raises CaseError at once when Dask is not installed, nothing answers at the address, it has no workers, or these
    have another version of the program or do not see the files; and when the scheduler dies while cases run.
    """
    if scheduler is None:
        with ThreadPoolExecutor(jobs) as threads:
            try:
                yield Place(threads)
            except BaseException:
                threads.shutdown(cancel_futures=True)
                raise
        return
    try:
        from distributed import Client
    except ImportError as missing:
        raise CaseError(
            '--scheduler needs Dask; install it by: pip install "vatsloc[cluster]", or leave the option out.'
        ) from missing
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
        shares = _shares(checked_workers(client, out, cases))
        try:
            yield Place(client.get_executor(pure=False, retries=RETRIES), shares)
        except (CancelledError, OSError) as error:
            if isinstance(error, OSError) and client.status == "running":
                raise
            raise CaseError(
                f"the Dask scheduler at {scheduler} stopped answering; start it and run again, what is done is kept."
            ) from error


def checked_workers(client: Any, out: Path, cases: Sequence[Path]) -> dict[str, Seen]:
    """What every worker says, by its address. Raises CaseError where one cannot run the program, has another version of
    it, or does not share the disk: it must see the cases, and what either side writes into `out`."""
    token = f".shared-{secrets.token_hex(4)}"
    mark = out / token
    mark.touch()
    try:
        try:
            told: dict[str, Seen] = client.run(look, str(out), token, [str(case) for case in cases])
        except Exception as error:  # whatever a worker raises that cannot load this module
            raise CaseError(
                f"the Dask workers cannot run {PROGRAM} ({error}); install it where they run, in the same version."
            ) from error
        for address, seen in told.items():
            if seen.version != version(PROGRAM):
                raise CaseError(
                    f"the Dask worker {address} has {PROGRAM} {seen.version}, this is {version(PROGRAM)}; "
                    "install the same."
                )
            if not seen.mark or not (out / seen.mark).exists():
                raise CaseError(
                    f"the Dask worker {address} on {seen.host} does not share {out} with this machine; start workers "
                    "where it is mounted under the same name, or give another --out."
                )
            if seen.missing:
                raise CaseError(
                    f"the Dask worker {address} on {seen.host} does not see {len(seen.missing)} of {len(cases)} cases "
                    f"({seen.missing[0]}); put them where all machines have them under the same name."
                )
        return told
    finally:
        for file in out.glob(f"{token}*"):
            file.unlink(missing_ok=True)


def look(out: str, token: str, cases: Sequence[str], dask_worker: Any) -> Seen:
    """Run on a worker, which Dask hands on under this name: what it sees, and a mark for the other side to see."""
    mark = ""
    if (Path(out) / token).exists():
        mark = f"{token}-{socket.gethostname()}-{os.getpid()}"
        (Path(out) / mark).touch()
    missing = tuple(case for case in cases if not (Path(case) / FILE_NAME).is_file())
    cores = tuple(sorted(os.sched_getaffinity(0)))
    return Seen(socket.gethostname(), cores, dask_worker.state.nthreads, version(PROGRAM), mark, missing)


def _shares(told: Mapping[str, Seen]) -> dict[str, int]:
    """Threads of a case on each worker: the cores that it may use, over the cases that run on them at once."""
    at_once: Counter[tuple[str, tuple[int, ...]]] = Counter()
    for seen in told.values():
        at_once[seen.host, seen.cores] += seen.threads
    return {address: max(1, len(seen.cores) // at_once[seen.host, seen.cores]) for address, seen in told.items()}
