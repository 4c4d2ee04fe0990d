"""The application for the bench (``imr-torch app``): the commands in a browser, on the
experimenter's own machine.

It reads files, shows frames, runs commands and shows their pages; all of that is done by the
functions and commands of the package, and nothing is computed here. The modules, from inside out:

- :mod:`imr_torch.app.workspace`: the folder that holds files, what is stated about them, and
  results;
- :mod:`imr_torch.app.commands`: what a form says, as the arguments of a command;
- :mod:`imr_torch.app.runs`: commands as processes, with progress, messages and what they wrote;
- :mod:`imr_torch.app.guard`: who may connect: this machine alone, with the token of this start;
- ``imr_torch.app.view_*``: the five tabs; :mod:`imr_torch.app.server`: the page and the server.

Only the views and the server need the extra ``app`` (NiceGUI).
"""
