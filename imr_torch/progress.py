"""Progress of long work, as every stage reports it: a line of text a step."""

from collections.abc import Callable
from typing import Any

Progress = Callable[[str], None] | None
"""Called with one line of text per step of long work, perhaps a :class:`ProgressLine`; None: work is
silent."""


class ProgressLine(str):
    """A line of progress that also says, for programs, where the work stands.

    Args:
        text: the line, with all details.
        stage: key of the stage that begins with it; empty: the stage goes on.
        step: what is done within the stage.
        done: how many steps are done.
        of: how many there are; 0 where that is not known.
        part: part of the stage that is done; that of the steps by default, None where neither is
            known.
        size: how often the work of the stage is expected to be done in all, as far as that is known
            now.

    >>> from imr_torch.progress import ProgressLine
    >>> line = ProgressLine("design 5/25: We 300", step="design", done=5, of=25)
    >>> print(line, line.step, line.part)
    design 5/25: We 300 design 5 of 25 0.2
    """

    stage: str
    step: str
    part: float | None
    size: float

    def __new__(  # noqa: D102 (the class says it)
        cls,
        text: str,
        *,
        stage: str = "",
        step: str = "",
        done: int = 0,
        of: int = 0,
        part: float | None = None,
        size: float = 1.0,
    ) -> "ProgressLine":
        line = super().__new__(cls, text)
        if of:
            step = f"{step} {done} of {of}".strip()
            part = done / of if part is None else part
        vars(line).update(stage=stage, step=step, part=part, size=size)
        return line


def report_progress(progress: Progress, text: str, **place: Any) -> None:
    """Report a line of progress, if anybody listens.

    Args:
        progress: where it is reported; None: nowhere.
        text: the line.
        **place: where the work stands, as :class:`ProgressLine` takes it.

    >>> from imr_torch.progress import report_progress
    >>> report_progress(print, "design 5/25: We 300", step="design", done=5, of=25)
    design 5/25: We 300
    >>> report_progress(None, "design 6/25: We 310", step="design", done=6, of=25)
    """
    if progress:
        progress(ProgressLine(text, **place))


def within(
    progress: Progress, first: float, last: float, *, name: str = "", size: float = 1.0
) -> Progress:
    """Reports of work that is a part of a stage, from ``first`` to ``last`` of it.

    Args:
        progress: where the stage is reported.
        first: part of the stage that is done before.
        last: and after it.
        name: what its steps are named by.
        size: see :class:`ProgressLine`.

    >>> from imr_torch.progress import ProgressLine, within
    >>> report = within(lambda line: print(line.step, line.part), 0.5, 1.0, name="second search")
    >>> report(ProgressLine("design 5/25", step="design", done=5, of=25))
    second search, design 5 of 25 0.6
    """
    if progress is None:
        return None

    def report_part(text: str) -> None:
        line = text if isinstance(text, ProgressLine) else ProgressLine(text)
        part = None if line.part is None else first + (last - first) * line.part
        step = ", ".join(filter(None, (name, line.step)))
        progress(
            ProgressLine(
                line, stage=line.stage, step=step, part=part, size=size * line.size
            )
        )

    return report_part
