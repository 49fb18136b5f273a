"""The documentation site: `make docs`. Sphinx: pages are Markdown, the reference is the docstrings."""

from dataclasses import is_dataclass
from importlib.metadata import version as installed_version
from typing import Any

project = "trueflight"
author = "The trueflight maintainers"
copyright = "the trueflight maintainers, Apache-2.0"
release = version = installed_version("trueflight")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
source_suffix = {".md": "markdown"}
highlight_language = "none"
suppress_warnings = ["misc.highlighting_failure", "myst.xref_ambiguous"]

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True}
default_role = "code"
python_use_unqualified_type_names = True

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_title = "trueflight"
html_copy_source = False
html_show_sphinx = False


def _without_fields(
    app: Any, what: str, name: str, obj: object, options: Any, signature: str, answer: str
) -> tuple[str, str] | None:
    """A result of the library is never made by hand: its fields are told in its text, not in a signature."""
    made = (
        what == "class" and is_dataclass(obj) and str(obj.__module__).startswith("trueflight.groundstation")
    )
    return ("", "") if made else None


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("autodoc-process-signature", _without_fields)
