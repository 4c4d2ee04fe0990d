"""The release checklist finds files that disagree on the version, and archives that lack a file."""

import pytest

from tools.release import IN_SDIST, ROOT, disagreements, missing, version

CITATION, CHANGELOG = (
    "cff-version: 1.2.0\nversion: 1.4.0\n",
    "# Changelog\n\n## [Unreleased]\n\n## [1.4.0] - 2026-11-24\n",
)


def test_that_files_that_agree_pass():
    assert disagreements("1.4.0", CITATION, CHANGELOG) == []


@pytest.mark.parametrize(
    ("citation", "changelog", "culprit"),
    [
        (CITATION.replace("1.4.0", "1.3.0"), CHANGELOG, "CITATION.cff has version 1.3.0"),
        ("cff-version: 1.4.0\n", CHANGELOG, "CITATION.cff has version none"),
        (
            CITATION,
            CHANGELOG.replace("[1.4.0] - 2026-11-24", "[1.4.0]"),
            "CHANGELOG.md has no heading",
        ),
        (CITATION, CHANGELOG.replace("1.4.0", "114.0"), "CHANGELOG.md has no heading"),
    ],
)
def test_that_a_file_of_another_version_is_named(citation, changelog, culprit):
    (line,) = disagreements("1.4.0", citation, changelog)
    assert line.startswith(culprit)


def test_that_a_draft_needs_no_heading_and_the_citation_all_the_same():
    assert disagreements("1.4.0", CITATION, "", draft=True) == []
    assert len(disagreements("1.5.0", CITATION, "", draft=True)) == 1


def test_that_the_citation_of_this_checkout_is_of_its_version():
    assert (
        disagreements(version(), (ROOT / "CITATION.cff").read_text(), "", draft=True) == []
    )


def test_that_a_file_that_an_archive_lacks_is_named():
    assert missing({"a", "b"}, ("a", "c")) == ["c is missing"]
    assert [name for name in IN_SDIST if not (ROOT / name).exists()] == []
