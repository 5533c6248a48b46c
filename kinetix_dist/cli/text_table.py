"""Tables of rates as lines of text: the first column on the left, the others on the right."""

from __future__ import annotations

from collections.abc import Sequence

MAX_ROWS = 100  # levels in a printed table; a JSON file always has all of them


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """A line a row, all equally long."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        "  ".join([row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:]))])
        for row in rows
    ]


def rows_left_out(num_levels: int) -> list[str]:
    """A line that says how many levels the table leaves out, if it does."""
    return [f"... {num_levels - MAX_ROWS} more levels; --json FILE has all"] if num_levels > MAX_ROWS else []
