"""``python -m imr_torch`` is ``imr-torch``."""

import sys

from imr_torch.cli import main

sys.exit(main())
