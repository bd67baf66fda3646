"""Sphinx, for rosdoc2: the Markdown pages as they are, beside the API that it generates."""

project = "mems6dof_ros"
author = "mems6dof developers"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
source_suffix = {".rst": "restructuredtext", ".md": "markdown"}
myst_heading_anchors = 3
