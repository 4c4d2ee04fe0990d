"""Progress for people: the stage, the step within it and the time left, on one line that rewrites
itself on a terminal.

The stages of the package report lines of detail (:data:`imr_torch.types.Progress`). ``--verbose``
prints them as they are. Else they are condensed: on a terminal into one line that is rewritten,
also while nothing is reported, elsewhere (a log file) into a short line whenever the stage changes
and every half minute.
"""

import re
import shutil
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, redirect_stdout
from dataclasses import dataclass
from typing import Any, TextIO

_EVERY = 0.5  # seconds between lines on a terminal
_LOG_EVERY = 30.0  # seconds between lines in a log
_EARLY = 0.1  # part of the work before which no time left is said
_LONGEST = 140
_OF = re.compile(r"(.*?)(\d+)\s*/\s*(\d+)")
_STEP = re.compile(r"(cycle \d+, )?(iteration|round) \d+")


@dataclass(frozen=True)
class Stage:
    """A stage of a command.

    Args:
        name: what is done.
        share: of the command's time, roughly.
        begins: regular expression of the reported line with which it begins; the first begins at
            once.
    """

    name: str
    share: float
    begins: str = ""


def characterize_stages(
    noise_rounds: int, *, scores: bool = False, population: bool = False, profile: bool = False
) -> tuple[Stage, ...]:
    """The stages of ``characterize``: one fit per noise law, draws, the fit test and perhaps
    scores, each shot alone, profiles.

    >>> from imr_torch.cli.progress import characterize_stages
    >>> [stage.name for stage in characterize_stages(1)]
    ['fit of all models', 'fit with the estimated noise, and draws', 'fit test and figures']
    """
    # measured on the example gel, with one model and three, and on long records
    stages = [
        Stage(
            "fit of all models" + ("" if noise_rounds else ", and draws"),
            0.5 if noise_rounds else 2.0,
        )
    ]
    for number in range(1, noise_rounds + 1):
        again = f" (round {number} of {noise_rounds})" if noise_rounds > 1 else ""
        draws = ", and draws" if number == noise_rounds else ""
        share = 1.5 if number == noise_rounds else 0.4
        stages.append(Stage(f"fit with the estimated noise{again}{draws}", share, r"^noise "))
    figures = "" if population or profile else " and figures"
    for wanted, stage in (
        (scores, Stage("scores of held-out curves", 2.0, r"^scores")),
        (True, Stage(f"fit test{figures}", 0.3, r"^fit test")),
        (population, Stage("each shot by itself, and the population", 3.0, r"^shots: ")),
        (profile, Stage("profile likelihoods, and figures", 0.5, r"^profile of")),
    ):
        stages += [stage] if wanted else []
    return tuple(stages)


DIAGNOSE = (
    Stage("fit of the base model and test for a gap", 0.3),
    Stage("fits of the effects", 0.4, r"^(gap test|attribution)"),
    Stage("location, reduction, next design", 0.3, r"^location"),
)
DESIGN = (Stage("search of designs", 1.0),)


class Terminal:
    """Where a command reports its progress; a context manager that ends the line.

    Args:
        command: its name.
        quiet: whether to say nothing.
        verbose: whether to print every reported line as it is.
        stream: where to; standard error by default.
        live: whether the line is rewritten; if the stream is a terminal, by default.
        clock: seconds, for tests.

    >>> import io
    >>> from imr_torch.cli.progress import DIAGNOSE, Terminal
    >>> stream = io.StringIO()
    >>> with Terminal("diagnose", stream=stream, clock=lambda: 0.0) as terminal:
    ...     terminal.plan(DIAGNOSE)
    ...     terminal("assimilation: iteration 3, nhkv cost -606.92 gradient 5.6e+01")
    >>> print(stream.getvalue().strip())
    diagnose, stage 1 of 3, 0:00: fit of the base model and test for a gap, iteration 3
    """

    def __init__(
        self,
        command: str,
        *,
        quiet: bool = False,
        verbose: bool = False,
        stream: TextIO | None = None,
        live: bool | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.command = command
        self.quiet = quiet
        self.verbose = verbose
        self.stream = stream or sys.stderr
        self.clock = clock
        self.live = (self.stream.isatty() if live is None else live) and not quiet and not verbose
        self._drawn = 0
        self._lock = threading.RLock()
        self._stop = threading.Event()
        self._open = ExitStack()
        self.plan(())
        self._begun = False

    def plan(self, stages: Sequence[Stage]) -> None:
        """Name the stages to come, from the first."""
        with self._lock:
            self.stages = tuple(stages)
            self.at = 0
            self.step = ""
            self.part = 0.0
            self.counted = 0.0
            self.started = self.said = self.clock()
            self._said_stage = -1
            self._begun = True

    def __call__(self, text: str) -> None:
        """Report one line of detail."""
        if self.quiet:
            return
        with self._lock:
            self._begun = True
            if self.verbose:
                print(
                    f"[{self.clock() - self.started:6.1f} s] {text}", file=self.stream, flush=True
                )
                return
            self._read(text)
            if self.live:
                self._draw(self.line())
            else:
                self._log()

    def line(self) -> str:
        """The state in one line, what matters most first, since a narrow terminal cuts the end off."""
        elapsed = self.clock() - self.started
        done = self._done()
        parts = [self.command]
        if len(self.stages) > 1:
            parts.append(f"stage {self.at + 1} of {len(self.stages)}")
        parts.append(_clock(elapsed))
        if done >= _EARLY:
            # since the last step that counts the time left has become less
            left = self.counted / done - elapsed
            parts.append(f"{100 * done:.0f} %, about {_clock(max(left, 0.0))} left")
        stage = self.stages[self.at].name if self.stages else ""
        doing = ", ".join(filter(None, (stage, self.step)))
        return ", ".join(parts) + (f": {doing}" if doing else "")

    def _done(self) -> float:
        """Part of the work that is done, roughly.

        Of the step that counts, where no stages are planned.
        """
        shares = [stage.share for stage in self.stages] or [1.0]
        return (sum(shares[: self.at]) + self.part * shares[self.at]) / sum(shares)

    def _read(self, text: str) -> None:
        """Take stage and step from a reported line."""
        before = self._done()
        following = range(self.at + 1, len(self.stages))
        new = next((i for i in following if re.search(self.stages[i].begins, text)), None)
        if new is not None:
            self.at = new
            self.part = 0.0
            self.step = ""
        counted = _OF.match(text)
        if counted and int(counted[3]) > 0:
            self.part = min(1.0, int(counted[2]) / int(counted[3]))
            self.step = f"{counted[1].strip(' :,')} {counted[2]} of {counted[3]}".strip()
        elif step := _STEP.search(text):
            self.step = step[0]
        elif new is None:
            self.step = text.partition(":")[0][:40]
        if self._done() != before:
            self.counted = self.clock() - self.started

    def _log(self) -> None:
        """A line for a log: when the stage has changed, else seldom."""
        now = self.clock()
        if self._said_stage != self.at or now - self.said >= _LOG_EVERY:
            self._said_stage = self.at
            self.said = now
            print(self.line()[:_LONGEST], file=self.stream, flush=True)

    def _draw(self, text: str) -> None:
        width = max(20, shutil.get_terminal_size().columns - 1)
        self.stream.write("\r" + text[:width].ljust(self._drawn))
        self.stream.flush()
        self._drawn = len(text[:width])

    def clear(self) -> None:
        """Wipe the line, so that something else can be printed."""
        with self._lock:
            if self._drawn:
                self._draw("")
                self.stream.write("\r")
                self.stream.flush()

    def __enter__(self) -> "Terminal":
        if self.live:
            self._open.enter_context(redirect_stdout(_Clearing(sys.stdout, self)))  # type: ignore[type-var]
            beat = threading.Thread(target=self._beat, daemon=True)
            beat.start()
            self._open.callback(beat.join)
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._open.close()
        self.clear()

    def _beat(self) -> None:
        """Rewrite the line while nothing is reported, so that a long step is no silence."""
        while not self._stop.wait(_EVERY):
            with self._lock:
                if self._begun:
                    self._draw(self.line())


class _Clearing:
    """Standard output that wipes the progress line before anything is printed."""

    def __init__(self, stream: TextIO, terminal: Terminal) -> None:
        self._stream = stream
        self._terminal = terminal

    def write(self, text: str) -> int:
        self._terminal.clear()
        return self._stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _clock(seconds: float) -> str:
    """``1:05`` of 65 seconds.

    >>> from imr_torch.cli.progress import _clock
    >>> _clock(65.0), _clock(3671.0)
    ('1:05', '1:01:11')
    """
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
