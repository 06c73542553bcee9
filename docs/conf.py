"""The documentation's site: `make docs` builds it with Sphinx, and plays real drives in its text."""

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import get_type_hints

import gymnasium
import matplotlib.font_manager  # noqa: F401 - finds the fonts, or the notebook would, and warn
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.ext.napoleon import GoogleDocstring

import gridsim
from cluster.settings import DqnSettings, EvolveSettings, RunSettings

# Compiles for environments now; else the notebook would, and show the notice of it on its page.
gymnasium.make("GridSim/Curved-v0").reset()

project = "GridSim"
author = project_copyright = "The GridSim contributors"
extensions = ["myst_nb", "sphinx.ext.autodoc"]
exclude_patterns = ["*.py"]

html_theme = "furo"
html_title = "GridSim"
html_static_path = ["site.css"]
html_css_files = ["site.css"]
html_copy_source = html_show_sourcelink = False

# Links between pages name the headings as GitHub does.
myst_heading_anchors = 3
# The notebook is run anew by each build, in a folder that is then deleted.
nb_execution_mode = "force"
nb_execution_in_temp = nb_execution_raise_on_error = True
nb_execution_timeout = 400  # s
nb_merge_streams = True
nb_output_stderr = "warn"  # a warning fails the build

# Docstrings put code between single backquotes, and flags in plain text.
default_role, smartquotes = "code", False
autodoc_class_signature = "separated"
autodoc_default_options = {"exclude-members": "__new__"}
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
add_module_names = False
python_maximum_signature_line_length = 90

for settings in (RunSettings, EvolveSettings, DqnSettings):  # types alone, without what the command line adds to them
    hints = get_type_hints(settings)
    settings.__annotations__ = {name: hints[name] for name in settings.__annotations__}


def format_docstring(app: Sphinx, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """Turn the arguments into a list, and begin a paragraph at what running text says is returned and raised."""
    text = "\n".join(lines)
    if what != "attribute":  # one that begins with `Network: ` would be taken for a type
        text = str(GoogleDocstring(text, what=what))
    lines[:] = re.sub(r"^(Args|Returns|Raises|Attributes):(?= )", r"\n**\1:**", text, flags=re.MULTILINE).split("\n")


def check_notebook(app: Sphinx, error: Exception | None) -> None:
    """Raise ExtensionError if the notebook's outputs lack its picture or its page, or it has installed something."""
    if error or app.builder.name != "html":
        return
    page = Path(app.outdir, "first_driver.html").read_text(encoding="utf-8")
    if "restart the kernel" in page or not all(shown in page for shown in ("<iframe srcdoc", 'src="_images/')):
        raise ExtensionError("the notebook's page lacks a picture or a drive, or it installed something")


def add_drives(app: Sphinx, error: Exception | None) -> None:
    """Write the pages that frames in the text play: the run of start.md, and a champion in traffic."""
    drives = Path(app.outdir, "drives")
    if error or app.builder.name != "html":
        return
    drives.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        gridsim.evolve(scenario="curved", folder=f"{folder}/first")
        shutil.copy(f"{folder}/first/drive.html", drives / "first.html")
    watch = [
        Path(sys.executable).with_name("gridsim-watch"),
        "champion_traffic.npz",
        "--output",
        drives / "traffic.html",
    ]
    subprocess.run(watch, cwd=Path(__file__).parents[1] / "benchmarks", check=True)


def setup(app: Sphinx) -> None:
    """Sphinx calls this."""
    app.connect("autodoc-process-docstring", format_docstring)
    app.connect("build-finished", check_notebook)
    app.connect("build-finished", add_drives)
