"""Tables of the documentation: each lies between two marks, and a script replaces what is there.

<!-- table: NAME -->
...
<!-- end -->
"""

from __future__ import annotations

import re
import time
from pathlib import Path

from mitsuba_irrcache.compare.tables import Table
from mitsuba_irrcache.io.files import atomic_write
from mitsuba_irrcache.machine import doctor


def plain_number(value: float, digits: int = 2) -> str:
    """Return a number of so many significant digits without an exponent: 170 and not 1.7e+02."""
    rounded = float(f"{value:.{digits}g}")
    return f"{rounded:.0f}" if abs(rounded) >= 10 ** (digits - 1) else f"{rounded:g}"


def replace_tables(
    document: Path, tables: dict[str, Table], origin: str | None = None
) -> list[str]:
    """Replaces the blocks of ``document`` that have the names of ``tables``; returns these names.

    Below each table stands its ``origin``; None: when and where it was measured. Raises ValueError
    where the document has none of the tables, or several of one name.
    """
    text, found = document.read_text(), []
    origin = provenance() if origin is None else origin
    below = f"\n\n*{origin}*\n" if origin else "\n"
    for name, table in tables.items():
        block = re.compile(
            rf"(?<=<!-- table: {re.escape(name)} -->\n).*?(?=<!-- end -->)", re.DOTALL
        )
        if text.count(f"<!-- table: {name} -->") > 1:
            raise ValueError(f"{document} has several tables of the name {name}; rename one.")
        if block.search(text):
            new = as_markdown(table) + below
            text = block.sub(lambda _, new=new: new, text, count=1)
            found.append(name)
    if not found:
        marks = ", ".join(f"<!-- table: {name} -->" for name in tables)
        raise ValueError(f"{document} has none of these marks: {marks}; add one and run again.")
    with atomic_write(document) as file:
        file.write(text.encode())
    return found


def as_markdown(table: Table) -> str:
    """The table, its best cells bold, and its note."""
    rows = [
        [f"**{cell}**" if (r, c) in table.best else cell for c, cell in enumerate(row)]
        for r, row in enumerate(table.rows)
    ]
    lines = [_line(table.head), _line(["---"] * len(table.head)), *map(_line, rows)]
    return "\n".join(lines + ([f"\n{table.note}"] if table.note else []))


def provenance() -> str:
    """When and where the table was made."""
    system = doctor.examine_system()
    return f"Measured {time.strftime('%d %B %Y')}; {system['processor']}, {system['cores']} cores."


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cell.replace("|", r"\|").replace("\n", " ") for cell in cells) + " |"
