"""Help and options of the subcommands, in the order of ``imr-torch --help``.

These modules import nothing but the standard library, so that help, version and a mistyped option
answer at once; what a subcommand computes is in the module of its name in :mod:`imr_torch.cli`,
imported when it runs.
"""

from collections.abc import Callable

from imr_torch.cli.options import fits, shots
from imr_torch.cli.options.shared import Options

COMMANDS: dict[str, tuple[str, Callable[[], Options]]] = {
    "demo": ("the example gel and a simulated campaign; start here", shots.list_demo_options),
    "app": ("the same in the browser, on this machine", shots.list_app_options),
    "simulate": ("R(t) of one bubble in a gel", shots.list_simulate_options),
    "characterize": (
        "properties of a gel from measured R(t) files",
        fits.list_characterize_options,
    ),
    "batch": (
        "characterise every file of a folder, in processes; resumes",
        fits.list_batch_options,
    ),
    "compare": ("whether two gels differ, and by how much", fits.list_compare_options),
    "design": ("the most informative next experiment", shots.list_design_options),
    "campaign": ("design, shoot, learn, and again", shots.list_campaign_options),
    "diagnose": ("where the model fails, and which effect it lacks", fits.list_diagnose_options),
    "plot": ("the figures of a result, from its JSON", fits.list_plot_options),
}
"""Name -> summary, and the function that lists its options and whose docstring is its help."""
