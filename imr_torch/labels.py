"""Text that comes from data: labels as plain text in figures and as parts of file names.

An experiment may be called anything, ``$x_{bad$`` or 300 letters long. Matplotlib reads ``$`` as
mathematics and file systems read ``/`` as a folder, so a label passes through one of these
functions before it is drawn or names a file.
"""

import hashlib

_LONGEST = 48  # characters of a label in a figure or a file name
T_STAR = r"$t^* = t\,U_\mathrm{c}/R_\mathrm{max}$"
R_STAR = r"$R^* = R/R_\mathrm{max}$"
WEBER = r"$\mathrm{We}$"
REST_RADIUS = r"$R_\infty^* = R_\infty/R_\mathrm{max}$"


def plain(label: str, longest: int = _LONGEST) -> str:
    r"""A label as plain text for a figure: one line, shortened in the middle, never parsed as
    mathematics.

    >>> from imr_torch.labels import plain
    >>> print(plain("$x_{bad$"), plain("a" * 300, longest=9))
    \$x_{bad\$ aaaa…aaaa
    """
    text = "".join(c if c.isprintable() else " " for c in label)
    if len(text) > longest:
        kept = longest - 1
        text = f"{text[: (kept + 1) // 2]}…{text[len(text) - kept // 2 :]}"
    return text.replace("$", r"\$")


def file_name(label: str) -> str:
    """A label as part of a file name; labels that differ never give the same one.

    >>> from imr_torch.labels import file_name
    >>> file_name("shot_1"), file_name("a/b"), file_name("a b")
    ('shot_1', 'a_b-c14cdd', 'a_b-c8687a')
    """
    safe = "".join(c if c.isalnum() or c in "-_" else "_" for c in label)
    if safe == label and len(label) <= _LONGEST:
        return label
    return f"{safe[:_LONGEST]}-{hashlib.sha256(label.encode()).hexdigest()[:6]}"


def p_value(value: float) -> str:
    """A p-value as text; very small ones, which rest on tails of a distribution, by an upper limit.

    >>> from imr_torch.labels import p_value
    >>> p_value(0.0312), p_value(0.0)
    ('p = 0.031', 'p < 1e-10')
    """
    return f"p = {value:.2g}" if value > 1e-10 else "p < 1e-10"
