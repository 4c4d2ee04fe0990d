"""Help and options of the subcommands, in the order of ``imr-torch --help``.

These modules import nothing but the standard library, so that help, version and a mistyped option
answer at once; what a subcommand computes is in the module of its name in :mod:`imr_torch.cli`,
imported when it runs.
"""

import argparse
from collections.abc import Callable

from imr_torch.cli.options import fits, shots

COMMANDS: dict[str, tuple[str, Callable[[argparse.ArgumentParser], None]]] = {
    "demo": ("the example gel and a simulated campaign; start here", shots.add_demo),
    "app": ("the same in the browser, on this machine", shots.add_app),
    "simulate": ("R(t) of one bubble in a gel", shots.add_simulate),
    "characterize": ("properties of a gel from measured R(t) files", fits.add_characterize),
    "batch": ("characterise every file of a folder, in processes; resumes", fits.add_batch),
    "compare": ("whether two gels differ, and by how much", fits.add_compare),
    "design": ("the most informative next experiment", shots.add_design),
    "campaign": ("design, shoot, learn, and again", shots.add_campaign),
    "diagnose": ("where the model fails, and which effect it lacks", fits.add_diagnose),
    "plot": ("the figures of a result, from its JSON", fits.add_plot),
}
"""Name -> summary, and the function that adds its options and whose docstring is its help."""

WITHOUT = {
    "demo": ("import",),
    "app": ("seed", "engine", "json", "import"),
    "simulate": ("seed",),
    "compare": ("seed", "engine"),
    "plot": ("seed", "engine", "json"),
}
"""Of the options of all subcommands, those that would do nothing."""
