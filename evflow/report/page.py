"""Self-contained HTML pages: panels of text, tables and pictures in one file.

Pixel images are PNGs with a palette, drawings are SVG, both inlined; there are no scripts and no
network access. Made for screens, phones and paper.
"""

from __future__ import annotations

import base64
import dataclasses
import html
import io
import json
import os
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from PIL import Image

from evflow.files.atomic import atomic_text

WIDEST = 480  # pixels of a map: larger sensors are shown in blocks
COLOURS = 256
QUICK_PNG = 4  # compression level: the best takes ten times as long for a twentieth less

STYLE = """
:root { --ink: #1d2129; --soft: #5d6673; --line: #dfe3e8; --wash: #f6f7f9;
        --good: #1f7a4d; --fair: #a76a00; --poor: #b3261e; }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { margin: 0 auto; padding: 2.2rem 1.4rem 4rem; max-width: 66rem; background: #fff;
       color: var(--ink); font: 16px/1.55 -apple-system, "Segoe UI", Roboto, "Helvetica Neue",
       Arial, "DejaVu Sans", sans-serif; font-variant-numeric: tabular-nums; }
header { border-bottom: 2px solid var(--ink); padding-bottom: .8rem; }
h1 { font-size: 1.75rem; line-height: 1.2; margin: 0 0 .3rem; letter-spacing: -.01em;
     overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 0 0 .5rem; }
h2 .n { color: var(--soft); font-weight: 400; margin-right: .5em; }
h3 { font-size: .95rem; margin: 0 0 .3rem; }
section > * + h3, div > p + h3 { margin-top: 1.1rem; }
p { margin: .5rem 0; max-width: 46rem; }
.sub, figcaption, .note { color: var(--soft); font-size: .86rem; line-height: 1.45; }
section { padding: 1.6rem 0 .4rem; border-bottom: 1px solid var(--line); }
section:last-of-type { border-bottom: 0; }
.verdict { border-left: 6px solid var(--grade); background: var(--wash); padding: .9rem 1.2rem;
           margin: .4rem 0 1rem; }
.verdict strong.grade { color: var(--grade); font-size: 1.3rem; display: block; }
.good { --grade: var(--good); } .fair { --grade: var(--fair); } .poor { --grade: var(--poor); }
.badge { color: var(--grade); font-weight: 600; white-space: nowrap; }
.badge::before { content: "\\25CF"; margin-right: .35em; }
.grid { display: grid; gap: 1.1rem 1.3rem; margin: .8rem 0; align-items: start;
        grid-template-columns: repeat(auto-fill, minmax(min(100%, var(--cell, 15rem)), 1fr)); }
figure { margin: 0; min-width: 0; break-inside: avoid; }
figure img, figure > svg { display: block; width: 100%; height: auto; }
img.pixels { image-rendering: pixelated; border: 1px solid var(--line); }
figure img + img { margin-top: .5rem; }
figcaption { margin: .3rem 0 .2rem; }
.bar { height: .55rem; margin-top: .35rem; }
.ends { display: flex; justify-content: space-between; font-size: .78rem; color: var(--soft);
        margin-bottom: .5rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; margin: .6rem 0; }
th, td { text-align: left; padding: .3rem 1.1rem .3rem 0; border-bottom: 1px solid var(--line);
         vertical-align: top; }
thead th { color: var(--soft); font-weight: 600; border-bottom: 1.5px solid var(--soft); }
td.num, th.num { text-align: right; white-space: nowrap; }
ul { padding-left: 1.2rem; margin: .5rem 0; max-width: 46rem; }
li { margin: .2rem 0; }
code { font: .84em/1.45 ui-monospace, "SF Mono", Menlo, Consolas, "DejaVu Sans Mono", monospace;
       overflow-wrap: anywhere; }
@media (max-width: 40rem) { body { padding: 1.2rem .9rem 3rem; font-size: 15px; }
  h1 { font-size: 1.4rem; } .verdict { padding: .7rem .8rem; } th, td { padding-right: .7rem; } }
@media print { body { padding: 0; font-size: 10.5pt; max-width: none; }
  .grid { --cell: 8.5rem; } .grid.wide { --cell: 14rem; } h2 { break-after: avoid; } }
* { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
"""


@dataclasses.dataclass(frozen=True)
class Panel:
    """name: the section's id; title: in words; body: HTML."""

    name: str
    title: str
    body: str


def write_page(
    path: str | os.PathLike, title: str, subtitle: str, panels: Sequence[Panel],
    numbers: dict[str, Any], *, overwrite: bool = False,
) -> None:
    """Write the page, completely or not at all; `numbers` are embedded as JSON (id "numbers").

    Raises EV013 (exists), EV019 (cannot be written).
    """
    data = json.dumps(numbers).replace("<", "\\u003c")
    sections = "\n".join(
        f'<section id="{panel.name}"><h2><span class="n">{number}</span>{text(panel.title)}</h2>'
        f"\n{panel.body}\n</section>" for number, panel in enumerate(panels, 1))
    page = (f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f'<link rel="icon" href="data:,">\n<title>{text(title)}</title>\n'
            f"<style>{STYLE}</style></head>\n"
            f'<body><header><h1>{text(title)}</h1><div class="sub">{text(subtitle)}</div>'
            f"</header>\n{sections}\n"
            f'<script type="application/json" id="numbers">{data}</script>\n</body></html>\n')
    atomic_text(path, page, overwrite=overwrite)


def text(words: object) -> str:
    """Words as HTML."""
    return html.escape(str(words))


def paragraph(words: str, kind: str = "") -> str:
    return f'<p class="{kind}">{text(words)}</p>' if kind else f"<p>{text(words)}</p>"


def bullets(sentences: Iterable[str]) -> str:
    return f"<ul>{''.join(f'<li>{text(s)}</li>' for s in sentences)}</ul>"


def badge(grade: str, words: str) -> str:
    """Words after a dot in the grade's colour: "good", "fair" or "poor"."""
    return f'<span class="badge {grade}">{text(words)}</span>'


def table(head: Sequence[str], rows: Iterable[Sequence[str]], numeric: bool = True) -> str:
    """head and rows of ready HTML; numeric: all columns but the first are aligned right."""
    def cells(tag: str, row: Sequence[str]) -> str:
        kinds = [' class="num"' if numeric and i else "" for i in range(len(row))]
        return "".join(f"<{tag}{k}>{c}</{tag}>" for k, c in zip(kinds, row, strict=True))

    top = f"<thead><tr>{cells('th', head)}</tr></thead>" if any(head) else ""
    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return f'<div class="scroll"><table>{top}<tbody>{body}</tbody></table></div>'


def number(value: float | None, digits: int = 3) -> str:
    """A number with `digits` significant digits and no exponent; a dash if there is none."""
    if value is None or not np.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    decimals = max(0, digits - 1 - int(np.floor(np.log10(abs(value)))))
    return f"{value:,.{min(decimals, 6)}f}".replace("-", "−")


def short(value: float) -> str:
    """Three significant digits without zeros at the end or an exponent: "5", "1,500"."""
    return number(value) if abs(value) >= 1000 else f"{value:.3g}"


def plural(count: int, noun: str) -> str:
    """"1 window", "2 windows"."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def spread(value: float, std: float) -> str:
    """value ± std: the std at two significant digits, the value at the same decimals."""
    if not (np.isfinite(value) and np.isfinite(std)):
        return f"{number(value)} ± {number(std, 2)}"
    decimals = 1 - int(np.floor(np.log10(std))) if std > 0 else 3
    decimals = min(max(decimals, 0), 6)
    return f"{value:,.{decimals}f} ± {std:,.{decimals}f}"


def grid(figures: Iterable[str], cell_rem: float = 15.0, kind: str = "wide") -> str:
    """Figures side by side, as many as fit at cell_rem width."""
    return f'<div class="grid {kind}" style="--cell:{cell_rem}rem">{"".join(figures)}</div>'


def figure(body: str, caption: str = "", title: str = "") -> str:
    """A figure with ready HTML inside."""
    head = f"<h3>{text(title)}</h3>" if title else ""
    tail = f"<figcaption>{text(caption)}</figcaption>" if caption else ""
    return f"<figure>{head}{body}{tail}</figure>"


def picture(image: np.ndarray, alt: str) -> str:
    """An <img> of (H, W, 3) floats in 0..1, pixel for pixel, in at most 256 colours."""
    return f'<img class="pixels" alt="{text(alt)}" src="{png_uri(image)}">'


def png_uri(image: np.ndarray) -> str:
    """(H, W, 3) floats in 0..1 as a data URI: a PNG with a palette."""
    rgb = Image.fromarray(np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8))
    exact = rgb.getcolors(COLOURS) is not None
    small = (rgb.convert("P", palette=Image.Palette.ADAPTIVE, colors=COLOURS) if exact
             else rgb.quantize(COLOURS, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE))
    buffer = io.BytesIO()
    small.save(buffer, "png", compress_level=QUICK_PNG)
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"


def drawing(svg: bytes, alt: str) -> str:
    """An <img> of an SVG document."""
    return (f'<img alt="{text(alt)}" '
            f'src="data:image/svg+xml;base64,{base64.b64encode(svg).decode()}">')


def blocks(values: np.ndarray, widest: int = WIDEST) -> tuple[np.ndarray, int]:
    """(H, W, ...) as means of k x k blocks, so that no side exceeds `widest`; and k. The last ones
    are filled up by their edge."""
    k = -(-max(values.shape[:2]) // widest)
    if k == 1:
        return values, 1
    more = [(0, -side % k) for side in values.shape[:2]] + [(0, 0)] * (values.ndim - 2)
    values = np.pad(values, more, mode="edge")
    height, width = values.shape[:2]
    parts = values.reshape(height // k, k, width // k, k, *values.shape[2:])
    return parts.mean((1, 3)), k
