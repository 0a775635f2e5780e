"""How the site is built: `make site` reads the Markdown of the whole tree.

The tree is the source, so that a link from docs/ to the README or to an example is one on the site
too. Nothing is loaded from elsewhere, neither while building nor in the pages.
"""

from __future__ import annotations

project = "ecatspec"
extensions = ["myst_parser"]
root_doc = "docs/index"
include_patterns = ["*.md", "docs/**.md", "examples/**.md"]
exclude_patterns = [".*", "build", "site", "typings"]
highlight_language = "none"
myst_heading_anchors = 4

html_theme = "furo"
html_title = "ecatspec"
html_copy_source = False
html_show_copyright = False
html_show_sourcelink = False
templates_path = ["templates"]
html_additional_pages = {"index": "start.html"}
