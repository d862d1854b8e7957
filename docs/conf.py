"""Settings of Sphinx for the documentation; CONTRIBUTING.md says how to build it."""

from __future__ import annotations

import re
import sys
from importlib.resources import files
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.util import logging

ROOT = Path(__file__).parents[1]
MATHJAX = Path(str(files("sphinx-mathjax-offline"))) / "static" / "mathjax" / "tex-svg.js"
LOGGER = logging.getLogger(__name__)
LOADED_FROM_OUTSIDE = re.compile(
    r"""<(?:script|img|iframe|source|video)\b[^>]*\bsrc=["']?(?:https?:)?//"""
    r"""|<link\b[^>]*\brel=["']?(?:stylesheet|preload)\b[^>]*\bhref=["']?(?:https?:)?//"""
    r"""|@import\s+(?:url\()?["']?(?:https?:)?//|\burl\(["']?(?:https?:)?//"""
)
"""What a browser would load from the internet when it shows a page; links are no such thing."""

sys.path[:0] = [str(ROOT), str(ROOT / "docs")]
import configuration_page  # noqa: E402

import suspnet  # noqa: E402

project = "suspnet"
author = "the suspnet developers"
copyright = f"2026, {author}"
release = version = suspnet.__version__

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
]
root_doc = "index"
exclude_patterns = ["_build", "_templates"]
templates_path = ["_templates"]
smartquotes = False
default_role = "py:obj"
nitpicky = True
# docstrings write names of arguments and values in single backticks too
nitpick_ignore_regex = [("py:obj", r"[a-z]\w*|X"), ("py:.*", r"sklearn\..*")]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
highlight_language = "none"
copybutton_prompt_text = r">>> |\.\.\. "
copybutton_prompt_is_regexp = True

# the data of the measured rig are no part of the repository
HAS_SHELF = any((folder / "shared" / "real" / "shelf").is_dir() for folder in ROOT.parents)
sphinx_gallery_conf = {
    "ignore_pattern": "__init__" if HAS_SHELF else "plot_rig",
    "examples_dirs": "../examples",
    "gallery_dirs": "gallery",
    "backreferences_dir": "generated/examples_of",
    "doc_module": ("suspnet",),
    "within_subsection_order": "gallery_order.place",
    "download_all_examples": False,
    "show_signature": False,
    "write_computation_times": False,
}

autodoc_typehints = "none"
autosummary_generate = True
numpydoc_show_class_members = False
numpydoc_xref_param_type = False

html_theme = "pydata_sphinx_theme"
html_title = f"suspnet {release}"
# MathJax with its fonts in one file, whose menu would offer to load more from the internet
html_static_path = ["_static", str(MATHJAX)]
mathjax_path = MATHJAX.name
mathjax3_config = {"options": {"enableMenu": False}, "svg": {"scale": 0.9}}
html_css_files = ["style.css"]
html_show_sphinx = False
html_copy_source = False
html_sidebars = {"**": ["all-pages"]}
html_theme_options = {
    "navbar_center": [],
    "navbar_end": ["theme-switcher"],
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
    "show_toc_level": 2,
}


def write_configuration(app: Sphinx) -> None:
    """Write the page of all settings, unless it is there already, so that it is not built again."""
    path = Path(app.srcdir) / "generated" / "configuration.md"
    page = configuration_page.page()
    if not path.exists() or path.read_text(encoding="utf-8") != page:
        path.parent.mkdir(exist_ok=True)
        path.write_text(page, encoding="utf-8")


def link_downloads(app: Sphinx, page: str, source: list[str]) -> None:
    """Make links to files outside this folder downloads; Sphinx takes those to .md for pages."""
    source[0] = re.sub(r"(?<!!)(\[[^\]]*\])\((\.\./[^)#]+)[^)]*\)", r"\1(path:\2)", source[0])


def check_offline(app: Sphinx, failure: Exception | None) -> None:
    """Warn of every page and style sheet that would load something from the internet."""
    for file in () if failure else sorted(app.outdir.rglob("*")):
        if file.suffix in (".html", ".css"):
            found = LOADED_FROM_OUTSIDE.search(file.read_text(encoding="utf-8"))
            if found:
                LOGGER.warning("%s needs the internet: %s", file, found[0])


def setup(app: Sphinx) -> None:
    """Register what is done to pages before and after."""
    app.connect("builder-inited", write_configuration)
    app.connect("source-read", link_downloads)
    app.connect("build-finished", check_offline)
