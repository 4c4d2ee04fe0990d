"""``python -m imr_torch.simulate.compiled``: compile the engine ahead of its first use."""

import torch

from imr_torch.material import PARAMETERS
from imr_torch.simulate import PolytropicSimulator, TransportSimulator

design = torch.tensor([300.0, 0.3], dtype=torch.float64)
times = torch.tensor([0.0, 0.1], dtype=torch.float64)
for simulator in (PolytropicSimulator(threads=1), TransportSimulator(threads=1)):
    simulator(PARAMETERS.neutral(), design, times)
