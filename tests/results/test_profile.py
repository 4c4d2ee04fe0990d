"""Profile likelihoods in a result document: words, figure and part of the page, drawn from the JSON
that the command writes.
"""

import copy
import json
from unittest import mock

import matplotlib.pyplot as plt
import pytest

from imr_torch import characterize, wide_prior
from imr_torch.assimilate import SearchOptions
from imr_torch.cli import main
from imr_torch.cli.common import METHODS
from imr_torch.errors import InputDataError
from imr_torch.files import write_json
from imr_torch.results import document_page, draw_figures, read_document
from imr_torch.results.intervals import profile_figure
from tests.figures import rendering
from tests.results.documents import SIMULATOR, traces

QUICK = [
    "--medium",
    "density=1060",
    "--physics",
    "polytropic",
    "--rest-radius",
    "0.2:0.01",
    "--noise",
    "published",
    "--threads",
    "1",
    "--quiet",
]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """What the command writes of a gel that is nearly a liquid, whose stiffening tells nothing and whose viscosity all."""
    folder = tmp_path_factory.mktemp("profile")
    lines = ["experiment_id,time_s,radius_m"]
    for trace in traces(("a",), noise=0.002, frames=25, G=1.0):
        rows = zip(trace.time_s.tolist(), trace.radius_m.tolist(), strict=True)
        lines += [f"{trace.experiment_id},{t!r},{r!r}" for t, r in rows]
    (folder / "gel.csv").write_text("\n".join(lines))
    asked = [
        "--profile",
        "--models",
        "gen_qkv",
        "--known",
        "G=1",
        "--out",
        str(folder / "out"),
        "--html",
        str(folder / "a.html"),
    ]
    with rendering(), mock.patch.dict(METHODS, {"map": SearchOptions(raw_samples=16, starts=2)}):
        assert main(["characterize", str(folder / "gel.csv"), *asked, *QUICK]) == 0
    return folder


@pytest.fixture(scope="module")
def document(written):
    return read_document(written / "out" / "characterize.json")


def test_that_a_flat_parameter_is_called_flat_and_a_bounded_one_bounded(document, written) -> None:
    mu, alpha = (document["profiles"]["gen_qkv"][name] for name in ("mu", "alpha"))
    assert (mu["bounded"], alpha["bounded"]) == ("on both sides", "on neither side")
    assert mu["limits_95"][0] < 0.093 < mu["limits_95"][1]
    assert alpha["limits_95"] == [None, None]
    assert max(alpha["nats_lost"]) < 1.92 < min(mu["nats_lost"][0], mu["nats_lost"][-1])
    assert document["models"]["gen_qkv"]["identifiability"] == {
        "mu": "bounded by the data on both sides",
        "alpha": "not determined: the profile likelihood is flat, and the interval is that of the prior",
    }
    report = (written / "out" / "report.txt").read_text()
    assert "profile likelihood of alpha, 95 %: open to open (bounded on neither side)" in report
    assert "the profile likelihood is flat" in report


def test_that_the_figure_is_drawn_from_the_json_with_the_line_of_95_percent_and_the_posterior(
    document, written
) -> None:
    assert (written / "out" / "profile.png").stat().st_size > 5000
    (named,) = (figure for figure in draw_figures(document) if figure.name == "profile")
    figure = named.draw()
    assert [ax.get_title() for ax in figure.axes] == [
        "bounded on both sides",
        "bounded on neither side",
    ]
    for ax in figure.axes:
        assert {"95 %", "prior", "posterior", "profile"} <= {line.get_label() for line in ax.lines}
        (line,) = (line for line in ax.lines if line.get_label() == "95 %")
        assert line.get_ydata() == pytest.approx([1.920729, 1.920729])
    figure.canvas.draw()
    plt.close(figure)


def test_that_fits_that_have_not_converged_are_hollow_and_said(document) -> None:
    loose = copy.deepcopy(document)
    loose["profiles"]["gen_qkv"]["mu"]["converged"][0] = False
    figure = profile_figure(loose, "gen_qkv")
    (hollow,) = (line for line in figure.axes[0].lines if line.get_markerfacecolor() == "white")
    assert len(hollow.get_xdata()) == 1
    plt.close(figure)
    assert "1 of these fits have not converged" in document_page(loose)


def test_that_the_page_says_what_the_data_bound(written) -> None:
    page = (written / "a.html").read_text()
    assert "Do the data bound each parameter?" in page
    assert "open on both sides" in page
    assert "on neither side: flat" in page
    assert (
        "; not determined: the profile likelihood is flat" in page
    )  # beside the interval of the gel


@pytest.mark.parametrize(
    "change",
    [
        lambda x: x.update(profiles=5),
        lambda x: x["profiles"].update(qkv={"mu": {}}),
        lambda x: x["profiles"]["gen_qkv"]["mu"].pop("nats_lost"),
        lambda x: x["profiles"]["gen_qkv"]["mu"]["values"].pop(),
        lambda x: x["profiles"]["gen_qkv"]["mu"].update(limits_95=["x", 1.0]),
        lambda x: x["profiles"]["gen_qkv"].update(G=x["profiles"]["gen_qkv"]["mu"]),
    ],
)
def test_that_profiles_that_are_not_whole_are_refused(document, change, tmp_path, capsys) -> None:
    bad = json.loads(json.dumps(document))
    change(bad)
    write_json(tmp_path / "bad.json", bad)
    assert main(["plot", str(tmp_path / "bad.json"), "--quiet"]) == 2
    assert "bad.json: the " in capsys.readouterr().err


def test_that_a_profile_of_models_with_one_parameter_is_refused_before_any_fit(
    written, capsys
) -> None:
    with pytest.raises(
        InputDataError,
        match="needs a model with two free parameters or more, and newtonian has one",
    ):
        characterize(
            traces(("a",)),
            prior=wide_prior(["newtonian"]),
            simulator=SIMULATOR,
            medium="density=1060",
            profile=True,
        )
    assert (
        main(
            ["characterize", str(written / "gel.csv"), "--profile", "--models", "newtonian", *QUICK]
        )
        == 2
    )
    assert "A profile likelihood needs a model" in capsys.readouterr().err
