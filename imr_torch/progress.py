"""Progress of long work, as every stage reports it: a line of text a step."""

from collections.abc import Callable

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

    >>> from imr_torch.progress import ProgressLine
    >>> line = ProgressLine("design 5/25: We 300", step="design", done=5, of=25)
    >>> print(line, line.done, line.of)
    design 5/25: We 300 5 25
    """

    stage: str
    step: str
    done: int
    of: int

    def __new__(  # noqa: D102 (the class says it)
        cls, text: str, *, stage: str = "", step: str = "", done: int = 0, of: int = 0
    ) -> "ProgressLine":
        line = super().__new__(cls, text)
        vars(line).update(stage=stage, step=step, done=done, of=of)
        return line
