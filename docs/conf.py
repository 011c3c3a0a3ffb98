"""The site of these pages: ./dev sphinx-build -W docs out/docs."""

from docutils.nodes import Node, SkipNode
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

from estune import __version__

project = "estune"
author = project_copyright = "The estune authors"
version = release = __version__

extensions = [
    "cyclopts.ext.sphinx",
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
]
exclude_patterns = ["_build"]
nb_execution_mode = "off"  # the tests execute the notebooks
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
suppress_warnings = ["ref.python"]  # a name that is documented where it is defined and re-exported

default_role = "code"
smartquotes = False  # two hyphens are an option
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the signature has them
napoleon_custom_sections = [("Class attributes", "Attributes")]
napoleon_use_ivar = True

html_theme = "furo"
html_title = f"estune {version}"
html_copy_source = False
html_css_files = ["narrow.css"]
html_static_path = ["_static"]
html_math_renderer = "mathml"


def _inline_math(self: HTML5Translator, node: Node) -> None:
    self.body.append(convert(node.astext()))
    raise SkipNode


def _block_math(self: HTML5Translator, node: Node) -> None:
    self.body.append(convert(node.astext(), display="block"))
    raise SkipNode


def setup(app: Sphinx) -> None:
    """Formulas become MathML, which browsers draw without a script."""
    app.add_html_math_renderer("mathml", (_inline_math, None), (_block_math, None))
