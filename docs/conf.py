"""Settings of the documentation, and the pages that are generated from the package when it is
built.
"""

import sys
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent
sys.path[:0] = [str(HERE / "_ext"), str(ROOT)]

import api  # noqa: E402
import catalogue  # noqa: E402
import copied  # noqa: E402

import imr_torch  # noqa: E402

project = "imr_torch"
author = copyright = "The imr_torch developers"
version = release = imr_torch.__version__
html_title = f"imr_torch {version}"

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_design",
    "myst_nb",
    "mathml",
]
exclude_patterns = ["_build", "_ext"]
nitpicky = False
suppress_warnings = ["mystnb.unknown_mime_type"]

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # notebooks come with their outputs; tests run them

autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autoclass_content = "class"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False

copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["own.css"]
html_show_sourcelink = False
html_theme_options = {"navigation_with_keys": True}
html_math_renderer = "mathml"


def _generate(app: object) -> None:
    """Write the pages that come from the package, the notebooks and the records."""
    catalogue.generate(HERE / "catalogue")
    api.generate(HERE / "api")
    copied.generate(HERE)


def setup(app) -> None:
    """Called by Sphinx."""
    app.connect("builder-inited", _generate)
