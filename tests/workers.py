"""What kills its process; importable by worker processes."""

import os
import signal


def fatal(traces, options) -> dict[str, str]:
    """Characterises a shot of a batch: kills its process for one of them, and is quick for others."""
    if traces.ids[0] == "gel_1":
        os.kill(os.getpid(), signal.SIGKILL)
    return {"error": f"{traces.ids[0]} was here"}
