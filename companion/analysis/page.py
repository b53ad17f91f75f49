"""One HTML page that needs nothing else: figures inside as SVG, style inside, no script, no network."""

from __future__ import annotations

import base64
import errno
import io
import os
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from companion.config.errors import UserError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TEMPLATE = Path(__file__).with_name("report.html")
LARGEST_PAGE_BYTES = 8 << 20
MISSING = "the HTML report needs matplotlib and jinja2: pip install 'dtlannc-companion[report]'"


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell of a table; `judgement` is good, bad or empty."""

    text: str
    judgement: str = ""


@dataclass(frozen=True, slots=True)
class HtmlTable:
    """One table: header and rows of cells."""

    title: str
    header: list[str]
    rows: list[list[Cell]]


@dataclass(frozen=True, slots=True)
class Picture:
    """One figure, as a data URL."""

    caption: str
    source: str


@dataclass(slots=True)
class Page:
    """What stands on the page, top to bottom."""

    title: str
    subtitle: str
    notes: list[str] = field(default_factory=list)
    tables: list[HtmlTable] = field(default_factory=list)
    groups: list[dict[str, Any]] = field(default_factory=list)
    events: list[dict[str, str]] = field(default_factory=list)
    facts: list[tuple[str, list[tuple[str, str]]]] = field(default_factory=list)
    files: list[tuple[str, str]] = field(default_factory=list)

    def add_figures(self, title: str, figures: list[tuple[str, Figure | None]]) -> None:
        """Add a group of figures under a heading; those that are None are left out."""
        pictures = [Picture(caption, embed(figure)) for caption, figure in figures if figure is not None]
        self.groups.append({"title": title, "figures": pictures})

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the page. Raises UserError when the file cannot be written."""
        jinja2 = require_report_extra()
        environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
        template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
        names = ("title", "subtitle", "notes", "tables", "groups", "events", "facts", "files")
        html = template.render({name: getattr(self, name) for name in names})
        try:
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            Path(path).write_text(html, encoding="utf-8")
        except OSError as error:
            raise UserError(f"cannot write the report {path}: {error.strerror or error}") from error


def check_room(path: str | os.PathLike[str]) -> None:
    """Raise UserError where a page could not be written to `path` later; makes the folder, leaves no file."""
    require_report_extra()
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, "it is a folder")
        if path.exists():
            path.open("ab").close()
        with tempfile.TemporaryFile(dir=path.parent) as file:
            file.write(bytes(LARGEST_PAGE_BYTES))
    except OSError as error:
        raise UserError(
            f"cannot write the report {path}: {error.strerror or error}; choose another file with --report"
        ) from error


def require_report_extra() -> Any:
    """Return jinja2. Raises UserError with the remedy when it or matplotlib is not installed."""
    try:
        import jinja2
        import matplotlib.figure  # noqa: F401  an installation that is not whole fails here
    except Exception as error:
        raise UserError(MISSING) from error
    return jinja2


def embed(figure: Figure) -> str:
    """Return the figure as a data URL; the same figure gives the same text."""
    import matplotlib

    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "companion"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
