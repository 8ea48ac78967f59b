"""HTML pages from the templates in `templates/`, each one file that needs nothing else."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

_TEMPLATES = Path(__file__).parent / "templates"


def write_page(path: Path, template: str, **context: object) -> None:
    """Render `template` with `context` to `path`, which is replaced once the page is complete."""
    partial = path.with_suffix(".partial")
    partial.write_text(_environment().get_template(template).render(context), encoding="utf-8")
    partial.replace(path)


@cache
def _environment() -> Environment:
    return Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,  # a misspelt name must not become an empty cell
        trim_blocks=True,
        lstrip_blocks=True,
    )
