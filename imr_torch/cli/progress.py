"""Progress for people: the stage, the step within it and the time left, on one line that rewrites
itself on a terminal.

The stages of the package report lines of detail (:class:`imr_torch.progress.ProgressLine`).
``--verbose`` prints them as they are. Else they are condensed: on a terminal into one line that is
rewritten, also while nothing is reported, elsewhere (a log file) into a short line whenever the
stage changes and every half minute, and for a program into events, each a line of JSON.
"""

import json
import shutil
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, redirect_stdout
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, TextIO

from imr_torch.files import read_table
from imr_torch.progress import ProgressLine


@dataclass(frozen=True)
class Stage:
    """A stage of a command.

    Args:
        name: what is done.
        share: of the command's time, roughly.
        key: stage of the reported line with which it begins; the first begins at once.
    """

    name: str
    share: float
    key: str = ""


@dataclass(eq=False)
class Terminal:
    """Where a command reports its progress; a context manager that ends the line.

    Args:
        command: its name.
        quiet: whether to say nothing.
        verbose: whether to print every reported line as it is.
        events: whether to print the state as events: ``line``, and ``part`` of the work that is
            done, null as long as it is not known.
        stream: where to; standard error by default.
        live: whether the line is rewritten; if the stream is a terminal, by default.
        clock: seconds, for tests.
        every: seconds between two lines or events while nothing is reported.
        log_every: seconds between two lines in a log.
        early: part of the work before which no time left is said.

    >>> import io
    >>> from imr_torch.cli.progress import Terminal
    >>> from imr_torch.progress import ProgressLine
    >>> stream = io.StringIO()
    >>> with Terminal("diagnose", stream=stream, clock=lambda: 0.0) as terminal:
    ...     _ = terminal.plan_stages(noise=True)
    ...     terminal(ProgressLine("assimilation: iteration 3, nhkv cost -606.92", step="iteration 3"))
    >>> print(stream.getvalue().strip())
    diagnose, stage 1 of 4, 0:00: fit of the base model and test for a gap, iteration 3
    """

    command: str
    _: KW_ONLY
    quiet: bool = False
    verbose: bool = False
    events: bool = False
    stream: TextIO = field(default_factory=lambda: sys.stderr)
    live: bool | None = None
    clock: Callable[[], float] = time.monotonic
    every: float = 0.5
    log_every: float = 30.0
    early: float = 0.05

    def __post_init__(self) -> None:
        wanted = self.stream.isatty() if self.live is None else self.live
        self.live = (wanted or self.events) and not (self.quiet or self.verbose)
        self._drawn = 0
        self._lock = threading.RLock()
        self._stop = threading.Event()
        self._open = ExitStack()
        self.plan_stages()
        self._begun = False

    def plan_stages(self, **given: bool) -> "Terminal":
        """Begin with the first of the command's stages (``data/stages.toml``); returns itself.

        Args:
            given: what decides which stages there are: whether there are ``curves``, the ``noise``
                is inferred, a ``population`` is, ``figures`` are drawn.
        """
        with self._lock:
            self.stages = [
                Stage(row["name"], row["share"], row.get("key", ""))
                for row in read_table("stages").get(self.command, ())
                if row.get("where", {}).items() <= given.items()
            ]
            self.shares = [stage.share for stage in self.stages]
            self.at = 0
            self.step = ""
            self.part = 0.0
            self.size = self.tick = 1.0
            self.counted = 0.0
            self.started = self._due = self.clock()
            self._begun = True
        return self

    def __call__(self, text: str) -> None:
        """Report one line of detail."""
        if self.quiet:
            return
        with self._lock:
            self._begun = True
            if self.verbose:
                elapsed = self.clock() - self.started
                print(f"[{elapsed:6.1f} s] {text}", file=self.stream, flush=True)
                return
            self._take_step(text if isinstance(text, ProgressLine) else ProgressLine(text))
            if self.live:
                self._show_state()
            elif self.clock() >= self._due:
                self._due = self.clock() + self.log_every
                print(self.describe_state(), file=self.stream, flush=True)

    def describe_state(self) -> str:
        """The state in one line, what matters most first, since a narrow terminal cuts the end off."""
        elapsed = self.clock() - self.started
        done = self._part_done()
        parts = [self.command]
        if len(self.stages) > 1:
            parts.append(f"stage {self.at + 1} of {len(self.stages)}")
        parts.append(_format_clock(elapsed))
        if done >= self.early:
            # since the last step that counts the time left has become less, and a step or a stage
            # that lasts longer than planned lets the others do so
            next_done = self._part_done(min(1.0, self.part + self.tick))
            left = max(self.counted / done, elapsed / next_done) - elapsed
            parts.append(
                f"{100 * done:.0f} %" + f", about {_format_clock(left)} left" * (left > 0.5)
            )
        stage = self.stages[self.at].name if self.stages else ""
        doing = ", ".join(filter(None, (stage, self.step)))
        return ", ".join(parts) + (f": {doing}" if doing else "")

    def _part_done(self, of_stage: float | None = None) -> float:
        """Part of the work that is done, roughly, or is when a part of the present stage is; 0 where
        no stages are planned.
        """
        if not self.stages:
            return 0.0
        part = self.part if of_stage is None else of_stage
        share = self.shares[self.at] * self.size
        before, after = sum(self.shares[: self.at]), sum(self.shares[self.at + 1 :])
        return (before + part * share) / (before + share + after)

    def _take_step(self, line: ProgressLine) -> None:
        """Take stage and step from a reported line."""
        before = self._part_done()
        following = range(self.at + 1, len(self.stages))
        new = next((i for i in following if self.stages[i].key == line.stage), None)
        if new is not None:
            # what was done of it was all, and what lies between was not done
            self.shares[self.at] *= self.size * (self.part or 1.0)
            self.shares[self.at + 1 : new] = [0.0] * (new - self.at - 1)
            self.at = new
            self.part = 0.0
            self.size = self.tick = 1.0
            self.step = ""
            self._due = self.clock()
        if line.part is not None:
            # what is done stays done where more is expected than before
            done = self.part * self.size / line.size
            self.part = min(1.0, max(done, line.part))
            self.size = line.size
            if self.part > done:
                self.tick = self.part - done
        if line.step or new is None:
            self.step = line.step or line.partition(":")[0][:40]
        if self._part_done() != before:
            self.counted = self.clock() - self.started

    def _show_state(self) -> None:
        """Rewrite the line, or print an event."""
        if self.events:
            part = self._part_done()
            state = {
                "line": self.describe_state(),
                "part": part if part >= self.early else None,
            }
            print(json.dumps(state), file=self.stream, flush=True)
        else:
            self._draw_line(self.describe_state())

    def _draw_line(self, text: str) -> None:
        width = max(20, shutil.get_terminal_size().columns - 1)
        self.stream.write("\r" + text[:width].ljust(self._drawn))
        self.stream.flush()
        self._drawn = len(text[:width])

    def wipe_line(self) -> None:
        """Wipe the line, so that something else can be printed."""
        with self._lock:
            if self._drawn:
                self._draw_line("")
                self.stream.write("\r")
                self.stream.flush()

    def __enter__(self) -> "Terminal":
        if self.live:
            self._open.enter_context(redirect_stdout(_Clearing(sys.stdout, self)))  # type: ignore[type-var]
            beat = threading.Thread(target=self._show_steadily, daemon=True)
            beat.start()
            self._open.callback(beat.join)
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._open.close()
        self.wipe_line()

    def _show_steadily(self) -> None:
        """Show the state while nothing is reported, so that a long step is no silence."""
        while not self._stop.wait(self.every):
            with self._lock:
                if self._begun:
                    self._show_state()


@dataclass(eq=False)
class _Clearing:
    """Standard output that wipes the progress line before anything is printed."""

    stream: TextIO
    terminal: Terminal

    def write(self, text: str) -> int:
        self.terminal.wipe_line()
        return self.stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def _format_clock(seconds: float) -> str:
    """``1:05`` of 65 seconds.

    >>> from imr_torch.cli.progress import _format_clock
    >>> _format_clock(65.0), _format_clock(3671.0)
    ('1:05', '1:01:11')
    """
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
