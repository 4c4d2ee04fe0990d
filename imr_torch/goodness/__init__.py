"""Goodness of fit: does a fitted model explain the curves? Score tests of a fit against directions
in which it may be wrong.
"""

from imr_torch.goodness.fit_test import FitTest, check_fit
from imr_torch.goodness.parts import PartsTest, compare_parts, follow_gel

__all__ = ["FitTest", "PartsTest", "check_fit", "compare_parts", "follow_gel"]
