"""Groups of scenes and tables in Markdown."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class Column(Generic[T]):
    """One column of a table: its head, and the text of its cell for one row.

    With `form`, `value` gives a number that is printed so, or None for a dash; without, the text itself.
    """

    head: str
    value: Callable[[T], float | str | None]
    form: str = "{}"

    def cell(self, row: T) -> str:
        """The text of the cell."""
        value = self.value(row)
        return "-" if value is None else self.form.format(value)


def markdown_table(head: str, columns: Sequence[Column[T]], rows: Iterable[tuple[str, T]]) -> str:
    """Formats one table with the names of the rows in the first column, headed `head`."""
    lines = [f"| {head} | " + " | ".join(c.head for c in columns) + " |", "|---" * (len(columns) + 1) + "|"]
    lines += [f"| {name} | " + " | ".join(c.cell(row) for c in columns) + " |" for name, row in rows]
    return "\n".join(lines)


def group_by(items: Sequence[T], key: str) -> list[tuple[str, list[T]]]:
    """Groups items by an attribute, in alphabetical order of its values."""
    values = sorted({str(getattr(item, key)) for item in items})
    return [(value, [item for item in items if str(getattr(item, key)) == value]) for value in values]
