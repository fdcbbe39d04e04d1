"""Numbers of the documents' tables, and of the tables that experiments wrote."""

from __future__ import annotations

import functools
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "experiments" / "results"
NUMBER = re.compile(r"(?<![\w.^])[-+−]?(?:\d[\d,]*\.?\d*|\.\d+)(?:e[-+]?\d+)?(?![\w.]*[A-Za-z_])")
LINK = re.compile(r"\(?\[[^]]*\]\([^)]*\)\)?")
SUBSCRIPT = re.compile(r"<sub>[^<]*</sub>")


def numbers(text: str) -> list[str]:
    """As they are printed, without signs of their own."""
    text = SUBSCRIPT.sub("", LINK.sub("", text)).replace("10⁵", "")
    return [found.lstrip("+") .replace("−", "-").replace(",", "") for found in NUMBER.findall(text)]


@functools.cache
def tables(path: Path) -> list[tuple[str, list[str], list[list[str]]]]:
    """Of a markdown file: the line of text before each table, its heads, its rows."""
    found: list[tuple[str, list[str], list[list[str]]]] = []
    title, heads = "", None
    for line in path.read_text().splitlines():
        if not line.startswith("|"):
            title, heads = line.strip() or title, None
            continue
        cells = [c.strip() for c in re.split(r"(?<!\\)\|", line)[1:-1]]
        if heads is None:
            heads = cells
            found.append((title, heads, []))
        elif not set(line) <= set("|-: "):
            found[-1][2].append(cells)
    return found


def cells(source: str, rows: str, column: str | int, table: str = "") -> list[str]:
    """Of results/SOURCE/*.md: what stands under `column` (the beginning of its head, or its place
    where heads are alike) in rows whose cells, joined by "|", fit the expression `rows`, in tables
    under a line that has `table`, or whose first head it is."""
    path, = (RESULTS / source).glob("*.md")
    found = []
    for title, heads, lines in tables(path):
        at = [k for k, head in enumerate(heads) if column == k or
              (isinstance(column, str) and head.startswith(column))]
        if (table in title or table == heads[0]) and at:
            found += [line[at[0]] for line in lines if re.match(rows, "|".join(line))]
    assert found, (source, rows, column, table)
    return found


def values(
    source: str, rows: str, column: str | int, k: int = 0, table: str = ""
) -> list[float]:
    """The number k of each of those cells."""
    return [float(numbers(cell)[k]) for cell in cells(source, rows, column, table)]


def mean(
    source: str, rows: str, column: str | int, k: int = 0, table: str = ""
) -> float:
    found = values(source, rows, column, k, table)
    return sum(found) / len(found)


def span(
    source: str, rows: str, column: str | int, k: int = 0, table: str = ""
) -> list[float]:
    """The least and the greatest of those numbers; one where they are the same."""
    return sorted({min(found := values(source, rows, column, k, table)), max(found)})


def printed(document: str, heading: str, label: str) -> list[str]:
    """The numbers in the row of a document's table that begins with `label`, below the heading or
    line that has `heading`; those of its label are left out."""
    text = (ROOT / document).read_text()
    assert text.count(heading) >= 1, (document, heading)
    for line in text[text.index(heading):].splitlines():
        if line.startswith(f"| {label}"):
            return numbers(line.split("|", 2)[2])
    raise AssertionError(f"no row {label!r} below {heading!r} of {document}")


def agrees(text: str, value: float) -> bool:
    """Is `text` what `value`, itself rounded to its fourth place, is printed as?"""
    decimals = len(text.partition(".")[2])
    return abs(float(text) - value) <= 0.5 * 10.0**-decimals + 0.51e-4 * max(1.0, abs(value))


def wrong(document: str, heading: str, figures: dict[str, list[float]]) -> str:
    """What rows of a document's table, by their labels, print that is not so; "" where all is."""
    lines = []
    for label, expected in figures.items():
        found = printed(document, heading, label)
        if len(found) != len(expected) or not all(map(agrees, found, expected)):
            lines.append(f"{label!r}: {found}, but {[round(v, 4) for v in expected]}")
    return "\n".join(lines)
