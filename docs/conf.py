"""How the pages are built: `make docs`. Pictures and the reference are made from the code first."""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

import make_gallery  # noqa: E402
import make_pictures  # noqa: E402
import make_reference  # noqa: E402
from mathml import visit_block, visit_inline  # noqa: E402

import guiderail  # noqa: E402

project = "guiderail"
release = version = guiderail.__version__
author = "the authors of guiderail"
copyright = "BSD-3-Clause"

extensions = ["myst_parser"]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
smartquotes = False  # two dashes before an option stay two
suppress_warnings = ["myst.header"]  # included sections begin at the second level

html_theme = "furo"
html_title = "guiderail"
html_static_path = ["_static"]
html_css_files = ["guiderail.css"]
html_math_renderer = "mathml"
html_copy_source = html_show_sourcelink = html_show_copyright = html_show_sphinx = False


def setup(app):
    """Equations as MathML, which browsers show without a script; pictures and reference before any page is read."""
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    make_reference.make(HERE / "reference")
    make_pictures.make(HERE / "pictures")
    make_gallery.make(HERE / "pictures")
    return {"parallel_read_safe": True}
