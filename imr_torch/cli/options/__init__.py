"""Help and options of the subcommands, one module each, in the order of ``imr-torch --help``.

These modules import nothing but the standard library, so that help, version and a mistyped option
answer at once; what a subcommand computes is in the module of the same name in
:mod:`imr_torch.cli`, imported when it runs. Of the options of all subcommands, those that would do
nothing are named in ``WITHOUT``.
"""

from types import ModuleType

from imr_torch.cli.options import (
    app,
    batch,
    campaign,
    characterize,
    compare,
    demo,
    design,
    diagnose,
    plot,
    simulate,
)

COMMANDS: tuple[ModuleType, ...] = (
    demo,
    app,
    simulate,
    characterize,
    batch,
    compare,
    design,
    campaign,
    diagnose,
    plot,
)
