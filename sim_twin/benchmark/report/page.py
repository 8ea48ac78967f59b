"""HTML pages from the templates in `templates/`, each one file that needs nothing else."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from hal.base.files import atomic_write

_TEMPLATES = Path(__file__).parent / "templates"


def write_page(path: Path, template: str, **context: object) -> None:
    """Render `template` with `context` to `path`, which is replaced once the page is complete."""
    atomic_write(path, _environment().get_template(template).render(context))


@cache
def _environment() -> Environment:
    return Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,  # a misspelt name must not become an empty cell
        trim_blocks=True,
        lstrip_blocks=True,
    )
