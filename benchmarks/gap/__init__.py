"""The scored benchmark of the gap diagnosis: synthetic sets, verdicts on them, and how often they
are right.
"""
