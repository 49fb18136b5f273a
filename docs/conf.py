"""The documentation site: `make docs`. Sphinx: pages are Markdown, the reference is the docstrings."""

from importlib.metadata import version as installed_version

project = "trueflight"
author = "The trueflight maintainers"
copyright = "the trueflight maintainers, Apache-2.0"
release = version = installed_version("trueflight")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
source_suffix = {".md": "markdown"}
suppress_warnings = ["misc.highlighting_failure", "myst.xref_ambiguous"]

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "show-inheritance": False}
default_role = "code"
python_use_unqualified_type_names = True

html_theme = "furo"
html_title = "trueflight"
html_copy_source = False
html_show_sphinx = False
