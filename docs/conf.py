"""Configuration of the documentation, `make docs`. The reference is generated first, and code in pages is run."""

import logging
import os
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

import make_reference  # noqa: E402
from mathml import visit_block, visit_inline  # noqa: E402

import guiderail  # noqa: E402

project = "guiderail"
release = version = guiderail.__version__
author = "the authors of guiderail"
copyright = "BSD-3-Clause"

extensions = ["myst_nb"]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
smartquotes = False  # keeps two dashes before an option
suppress_warnings = ["myst.header"]  # included sections begin at the second level

# Pages with `file_format: mystnb` are notebooks. A cell that fails or times out fails the build.
nb_execution_mode = "force"
nb_execution_timeout = 300  # timeout of a cell [s]
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_ipywidgets_js = {}  # nothing is downloaded
nb_render_markdown_format = "myst"

html_theme = "furo"
html_title = "guiderail"
html_static_path = ["_static"]
html_extra_path = ["llms.txt"]
html_css_files = ["guiderail.css"]
html_math_renderer = "mathml"
html_copy_source = html_show_sourcelink = html_show_copyright = html_show_sphinx = False


# Figures of notebooks: reproducible SVG files whose text stays text.
KERNEL = """
c.InteractiveShellApp.matplotlib = "inline"
c.InlineBackend.figure_formats = {"svg"}
c.InlineBackend.print_figure_kwargs = {"bbox_inches": None}
c.InlineBackend.rc = {
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 9,
    "figure.constrained_layout.use": True,
    "font.size": 9,
    "svg.fonttype": "none",
    "svg.hashsalt": "guiderail",
}
c.HistoryManager.enabled = False
c.IPKernelApp.log_level = "ERROR"  # hides a warning about local connections
"""
ipython = tempfile.TemporaryDirectory()
profile = Path(ipython.name) / "profile_default"
profile.mkdir()
(profile / "ipython_kernel_config.py").write_text(KERNEL, encoding="utf-8")
os.environ["IPYTHONDIR"] = os.environ["JUPYTER_RUNTIME_DIR"] = ipython.name
logging.getLogger("traitlets").setLevel(logging.WARNING)  # hides messages about running notebooks


def stale_notebooks(app, env, added, changed, removed):
    """Return the notebooks that were run before the code changed."""
    code = (
        path for folder in ("models", "systems", "diagrams", "tools") for path in (HERE.parent / folder).rglob("*.*")
    )
    newest = max(path.stat().st_mtime for path in code if "__pycache__" not in path.parts)
    return [
        name
        for name, read in env.all_docs.items()
        if read / 1e6 < newest and "\nfile_format: mystnb\n" in Path(env.doc2path(name)).read_text(encoding="utf-8")
    ]


def setup(app):
    """Register the MathML renderer and generate the reference before pages are read."""
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    app.connect("env-get-outdated", stale_notebooks)
    make_reference.make(HERE / "reference")
    return {"parallel_read_safe": True}
