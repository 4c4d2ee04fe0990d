"""What the forms of the application say, as the arguments of the commands."""

from collections.abc import Sequence
from dataclasses import dataclass

from imr_torch.cli.options.names import COLLAPSES, DEFAULT_MODELS, EFFECTS_ADDED, EVALUATIONS


@dataclass(frozen=True)
class Data:
    """What is read.

    Args:
        files: names of files, relative to the folder.
        layout: how they are to be read; empty: as their names say.
        medium: what is stated of the medium; empty: nothing.
        experiments: the chosen curves; empty: all.
    """

    files: Sequence[str]
    layout: str = ""
    medium: str = ""
    experiments: Sequence[str] = ()

    def arguments(self) -> list[str]:
        """Files and options that say how they are read."""
        pairs = (
            ("--layout", self.layout),
            ("--experiments", ",".join(self.experiments)),
            ("--medium", self.medium),
        )
        return [*self.files, *(part for option, text in pairs if text for part in (option, text))]


@dataclass(frozen=True)
class Characterize:
    """``imr-torch characterize``.

    Args:
        data: what is read.
        models: candidate models.
        known: independently measured parameters, ``NAME=VALUE,...``.
        physics: which simulator.
        collapses: collapses in the fitted window.
        rest_radius: assumed R_inf/Rmax, ``VALUE:SD``.
        further: which of ``population``, ``profile``, ``scores`` to add.
        robust: whether single bad frames are left out.

    >>> from imr_torch.app.commands import Characterize, Data
    >>> Characterize(Data(["files/gel.csv"]), robust=True).arguments("results/001")[:4]
    ['characterize', 'files/gel.csv', '--frames', 'robust']
    """

    data: Data
    models: Sequence[str] = tuple(DEFAULT_MODELS.split(","))
    known: str = ""
    physics: str = "transport"
    collapses: int = COLLAPSES
    rest_radius: str = ""
    further: Sequence[str] = ()
    robust: bool = False

    def arguments(self, folder: str) -> list[str]:
        """The arguments; results go to ``folder``."""
        words = ["characterize", *self.data.arguments()]
        words += (
            ["--models", ",".join(self.models)] if ",".join(self.models) != DEFAULT_MODELS else []
        )
        words += ["--known", self.known] if self.known else []
        words += ["--rest-radius", self.rest_radius] if self.rest_radius else []
        words += ["--collapses", str(self.collapses)] if self.collapses != COLLAPSES else []
        words += ["--physics", self.physics] if self.physics != "transport" else []
        words += ["--frames", "robust"] if self.robust else []
        words += [f"--{name}" for name in self.further]
        return [*words, "--out", folder, "--html", f"{folder}/page.html"]


@dataclass(frozen=True)
class Diagnose:
    """``imr-torch diagnose``.

    Args:
        data: what is read.
        base: the model that is put to the test.
        known: independently measured parameters.
        physics: which simulator.
        collapses: collapses in the fitted window.
        rest_radius: assumed R_inf/Rmax, ``VALUE:SD``.
        most: effects that are added one after the other.

    >>> from imr_torch.app.commands import Data, Diagnose
    >>> Diagnose(Data(["files/gel.csv"])).arguments("results/002")[:4]
    ['diagnose', 'files/gel.csv', '--base', 'nhkv']
    """

    data: Data
    base: str = "nhkv"
    known: str = ""
    physics: str = "transport"
    collapses: int = COLLAPSES
    rest_radius: str = ""
    most: int = EFFECTS_ADDED

    def arguments(self, folder: str) -> list[str]:
        """The arguments; results go to ``folder``."""
        words = ["diagnose", *self.data.arguments(), "--base", self.base]
        words += ["--known", self.known] if self.known else []
        words += ["--rest-radius", self.rest_radius] if self.rest_radius else []
        words += ["--collapses", str(self.collapses)] if self.collapses != COLLAPSES else []
        words += ["--physics", self.physics] if self.physics != "transport" else []
        words += ["--most", str(self.most)] if self.most != EFFECTS_ADDED else []
        return [*words, "--json", f"{folder}/diagnose.json", "--html", f"{folder}/page.html"]


@dataclass(frozen=True)
class Design:
    """``imr-torch design``.

    Args:
        belief: result of an earlier characterisation that the design builds on; empty: the wide
            prior over ``models``.
        models: candidate models, where there is no earlier result.
        medium: what is stated of the medium.
        physics: which simulator.
        weber: Weber numbers that can be shot, ``LOW:HIGH``.
        rest: R_inf/Rmax that can be shot, ``LOW:HIGH``.
        target: what the information is to be about.
        count: designs to prepare together.
        evaluations: designs evaluated in each search.

    >>> from imr_torch.app.commands import Design
    >>> Design(belief="results/001/characterize.json", count=2).arguments("results/003")[:5]
    ['design', '--belief', 'results/001/characterize.json', '--q', '2']
    """

    belief: str = ""
    models: Sequence[str] = tuple(DEFAULT_MODELS.split(","))
    medium: str = ""
    physics: str = "transport"
    weber: str = ""
    rest: str = ""
    target: str = "both"
    count: int = 1
    evaluations: int = EVALUATIONS

    def arguments(self, folder: str) -> list[str]:
        """The arguments; results go to ``folder``."""
        words = [
            "design",
            *(["--belief", self.belief] if self.belief else ["--models", ",".join(self.models)]),
        ]
        for option, text, default in (
            ("--q", str(self.count), "1"),
            ("--medium", self.medium, ""),
            ("--physics", self.physics, "transport"),
            ("--we-range", self.weber, ""),
            ("--rinf-range", self.rest, ""),
            ("--target", self.target, "both"),
            ("--evaluations", str(self.evaluations), str(EVALUATIONS)),
        ):
            words += [option, text] if text != default else []
        return [*words, "--out", folder, "--html", f"{folder}/page.html"]
