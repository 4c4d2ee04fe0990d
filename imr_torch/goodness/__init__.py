"""Goodness of fit: does a fitted model explain the curves? Score tests of a fit against directions
in which it may be wrong.
"""

from imr_torch.goodness.fit_test import FitTest, check_fit

__all__ = ["FitTest", "check_fit"]
