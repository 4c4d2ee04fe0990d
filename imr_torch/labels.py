"""Text that comes from data: labels as plain text in figures and as parts of file names.

An experiment may be called anything, ``$x_{bad$`` or 300 letters long. Matplotlib reads ``$`` as
mathematics and file systems read ``/`` as a folder, so a label passes through one of these
functions before it is drawn or names a file.
"""

import hashlib

_OPEN = 0.1  # error of a probability from which on it may be undecided
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


def model_probability(value: float, error: float) -> str:
    """The probability of a model with the error of its computation; undecided where that leaves it
    open.

    >>> from imr_torch.labels import model_probability
    >>> model_probability(0.964, 0.027), model_probability(1e-9, 1e-10)
    ('probability 0.964 +- 0.027', 'probability below 0.001')
    >>> model_probability(0.888, 0.838)
    'probability undecided (0.89 +- 0.84; --effort thorough draws more)'
    """
    if error > _OPEN and error >= min(value, 1.0 - value):
        return f"probability undecided ({value:.2f} +- {error:.2f}; --effort thorough draws more)"
    if value + error < 0.0005:
        return "probability below 0.001"
    return f"probability {value:.3f} +- {error:.3f}"


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
