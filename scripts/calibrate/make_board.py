"""Write the calibration board as a page to print at 100 %, with a ruler to check the print.

./z1 calibrate board
./z1 calibrate board --columns 7 --rows 5 --square-m 0.03 --marker-m 0.022 --out board.png
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from calibration.board.board import Board
from calibration.board.sheet import save_sheet


@dataclass(frozen=True, kw_only=True)
class Config:
    """Board and paper."""

    out: Path = Path("out/board.pdf")
    """Page to write, .pdf or .png."""
    paper: Literal["A4", "Letter", "A3"] = "A4"
    """Paper of the printer."""
    board: Annotated[Board, tyro.conf.arg(name="")] = field(default_factory=Board)
    """The board."""


def main(config: Config) -> int:
    """Write the page."""
    save_sheet(config.board, config.out, paper=config.paper)
    Console(highlight=False).print(
        f"{config.out}: print it at 100 %, check its ruler, and glue it to a flat plate. If the ruler is wrong, "
        "measure "
        "a square and pass the true --square-m and --marker-m to the other commands.",
        soft_wrap=True,
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Config)))
