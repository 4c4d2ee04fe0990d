"""The example gel that ships with the package: where its files are."""

from pathlib import Path


def example_gel() -> Path:
    """The table of four curves of one simulated gel, as a laboratory would store them.

    The gel is neo-Hookean Kelvin-Voigt with G = 8.31 kPa and mu = 0.093 Pa s; heat and vapour
    transport, 1 us between frames, noise of 0.3 % of the maximum radius, which is 250 to 400 um. A
    JSON file of the same name beside it gives R_inf and the medium.

    Returns:
        Path of ``example_gel.csv``, with the columns ``experiment_id``, ``time_s``, ``radius_m``.

    >>> from imr_torch import example_gel
    >>> example_gel().read_text().splitlines()[0]
    'experiment_id,time_s,radius_m'
    """
    return Path(__file__).parent / "data" / "example_gel.csv"
