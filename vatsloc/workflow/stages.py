"""Bookkeeping of a run: which stage is at work, how long each took, what memory peaked at."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from vatsloc.errors import as_ours
from vatsloc.workflow.choices import Choice

Say = Callable[[str], None]
Done = TypeVar("Done")
CT, INFLATED, DEFLATED = "CT", "inflated CBCT", "deflated CBCT"
"""What the images are called in sentences."""


def quiet(_message: str) -> None:
    """Progress callback for callers who want silence."""


@dataclass(frozen=True)
class Log:
    """What stages that ran before, in another command, said. seconds: they took, by name; the rest as in `Stages`."""

    seconds: dict[str, float]
    skipped: dict[str, str]
    choices: tuple[Choice, ...]
    warnings: tuple[str, ...]


@dataclass
class Stages:
    """Log of a run. seconds, cpu_seconds (all threads) and peak_mb: by stage name, in the order they first ran, a stage
    that comes again added up; skipped: stage -> why; choices: what the scene had a say in.

    What a later stage needs can be begun on a second thread; the stage then takes as long as it has to wait.
    """

    say: Say = quiet
    seconds: dict[str, float] = field(default_factory=dict)
    cpu_seconds: dict[str, float] = field(default_factory=dict)
    peak_mb: dict[str, float] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    choices: list[Choice] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    _start: float = field(default_factory=time.perf_counter)
    _where: str = "The command"
    _image: str = ""
    _name: str = ""
    _beside: ThreadPoolExecutor | None = None
    _begun: dict[tuple[str, str], Future[Any]] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str, image: str = "") -> Iterator[None]:
        """Time a block as the stage `name` and note the highest memory while it ran.

        Whatever is raised inside leaves as one of the program's own errors that names the stage, and the image where
        the block works on one or says so by `on`.
        """
        self.say(f"{name} ...")
        self._where, self._image, self._name = f"The stage '{name}'", image, name
        reset = _reset_peak()
        start, start_cpu = time.perf_counter(), time.process_time()
        with self.named():
            yield
        took = round(time.perf_counter() - start, 3)
        self.seconds[name] = round(self.seconds.get(name, 0.0) + took, 3)
        self.cpu_seconds[name] = round(self.cpu_seconds.get(name, 0.0) + time.process_time() - start_cpu, 3)
        self.peak_mb[name] = max(round(_peak_mb(reset), 1), self.peak_mb.get(name, 0.0))
        self._where, self._image = f"What follows the stage '{name}'", ""
        self.say(f"{name}: {took:.1f} s")

    def begin(self, name: str, image: str, work: Callable[[], Done]) -> Callable[[], Done]:
        """Begin the work of the stage `name` on a second thread, after what was begun before; what is returned waits
        for it. `forget` has to follow.

        Nothing with numba's own parallel loops may be begun (a run has none): they serve one thread at a time.
        """
        if self._beside is None:
            self._beside = ThreadPoolExecutor(1, thread_name_prefix="beside")
        future = self._begun[name, image] = self._beside.submit(work)
        return future.result

    def done(self, work: Callable[[], Done]) -> Done:
        """Result of the work of the stage at work: of what was begun for it, else of doing it now."""
        begun = self._begun.pop((self._name, self._image), None)
        return work() if begun is None else begun.result()

    def fail_early(self) -> None:
        """Raise what something that was begun has failed with by now, as its own stage would do later."""
        for (name, image), future in self._begun.items():
            if future.done() and future.exception() is not None:
                with self.stage(name, image):
                    future.result()

    @contextmanager
    def beside(self) -> Iterator[None]:
        """Inside, work may be begun; what was not asked for by the end is dropped."""
        try:
            yield
        finally:
            self.forget()

    def forget(self) -> None:
        """Drop what was begun and not asked for; what is at work ends by itself."""
        if self._beside is not None:
            self._beside.shutdown(wait=False, cancel_futures=True)
            self._beside = None
        self._begun.clear()

    def on(self, image: str) -> None:
        """Say which image the stage at work looks at from here on."""
        self._image = image

    @contextmanager
    def named(self) -> Iterator[None]:
        """What is raised inside leaves as one of the program's own errors that names the last stage and its image."""
        try:
            yield
        except Exception as error:
            ours = as_ours(error, self._where, self._image)
            if ours is error:
                raise
            raise ours from error

    def skip(self, name: str, why: str) -> None:
        """Note that the stage `name` was left out."""
        self.skipped[name] = why
        self.say(f"{name}: skipped, {why}")

    def choose(self, choice: Choice) -> bool:
        """Note a choice, and whether its part is kept."""
        self.choices.append(choice)
        if not choice.kept:
            self.skip(choice.part, choice.why)
        return choice.kept

    def warn(self, sentence: str) -> None:
        """Note something the reader of the result has to know."""
        self.warnings.append(sentence)
        self.say(f"warning: {sentence}")

    def log(self) -> Log:
        """What a later command has to know of these stages."""
        return Log(dict(self.seconds), dict(self.skipped), tuple(self.choices), tuple(self.warnings))

    def resume(self, log: Log) -> None:
        """Take over what stages of an earlier command said; their seconds stay theirs."""
        self.skipped |= log.skipped
        self.choices += log.choices
        for sentence in log.warnings:
            self.warn(sentence)

    @property
    def total_seconds(self) -> float:
        """Seconds since the log was opened."""
        return round(time.perf_counter() - self._start, 3)


def _reset_peak() -> bool:
    """Ask Linux to forget the process's memory peak, so that each stage shows its own; False where that is refused."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return False
    return True


def _peak_mb(was_reset: bool) -> float:
    if was_reset:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) / 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024**2 if sys.platform == "darwin" else 1024)
