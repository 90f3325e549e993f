"""The report as one self-contained HTML file."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

import numpy as np

from mitsuba_irrcache.io.files import atomic_write

from . import embedded
from .embedded import PAGE, Images
from .results import Measurement
from .summary import Curve, Reached, equal_time, time_to, uncertainty
from .tables import Table, percent, seconds, with_uncertainty

#: Ratio of times from which a lower bound of it is stated.
LEAST_RATIO = 1.5


@dataclass
class Figure:
    """An image file (PNG or SVG) and its caption.

    ``points`` are texts for the markers of an SVG, by the id of their group; they are displayed
    when the pointer is near.
    """

    path: Path
    caption: str
    points: dict[str, list[str]] = field(default_factory=dict)


@dataclass
class Section:
    """A heading with figures, tables and interactive images below it."""

    title: str
    parts: list[Figure | Table | Images]


def write_report(
    path: Path,
    title: str,
    findings: list[str],
    sections: list[Section],
    failed: list[Measurement],
    facts: dict[str, str],
) -> None:
    """Write the page atomically, with embedded figures and scripts, so that it loads no file."""
    body = [f"<h1>{escape(title)}</h1>", _subtitle(facts), _findings(findings), _failures(failed)]
    body += [_section(section) for section in sections]
    rows = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in facts.items())
    body.append(f"<h2>What was compared</h2><dl>{rows}</dl>")
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_page('report.css')}</style></head><body>"
        f"{''.join(body)}<script>{_page('images.js')}</script>"
        f"<script>{_page('plots.js')}</script></body></html>\n"
    )
    with atomic_write(path) as file:
        file.write(page.encode())


def findings(
    curves: list[Curve], budgets: list[float], rows: list[dict], depths: dict[str, int]
) -> list[str]:
    """Return the conclusions of the comparison as sentences; errors are RMSE."""
    if not curves:
        return ["No integrator produced an image."]
    said = []
    table = dict(zip(sorted(budgets), equal_time(curves, budgets), strict=True))
    # The longest budget at which most integrators have an image.
    longest = max(table, key=lambda budget: (sum(e is not None for e in table[budget]), budget))
    errors = dict(zip(curves, table[longest], strict=True))
    ranked = sorted((c for c in curves if errors[c] is not None), key=lambda c: errors[c])
    if ranked:
        others = ", ".join(f"{c.integrator} {percent(errors[c])}" for c in ranked[1:])
        said.append(
            f"After {longest:g} s {ranked[0].integrator} has an RMSE of "
            f"{percent(errors[ranked[0]])} of the mean radiance{f'; {others}' if others else ''}."
        )
    best = ranked[0] if ranked else None
    said += [_ratio(best, errors[best], other, errors[other], longest) for other in ranked[1:]]
    if len(set(depths.values())) > 1:
        said.append(
            "Their images differ systematically, because max_depth differs: "
            f"{', '.join(f'{depth} in {name}' for name, depth in depths.items())}. Plugins have "
            "different defaults; set it in braces."
        )
    said += [_biased(row) for row in _last_rows(rows) if _is_biased(row)]
    said += [
        f"{row['integrator']}: {percent(row['invalid'])} of the values are not finite; "
        "they count as 0."
        for row in _last_rows(rows)
        if row["invalid"]
    ]
    return said


def _ratio(best: Curve, least: float, other: Curve, error: float, budget: float) -> str:
    """Compare the errors ``least`` and ``error`` that two integrators have after ``budget`` s."""
    reached = np.flatnonzero(np.isclose(other.shown, error, rtol=1e-9))
    if reached.size:
        budget = min(budget, float(other.seconds[reached[0]]))
    if error - least < 2 * np.hypot(uncertainty(best), uncertainty(other)):
        return f"{other.integrator} is as good as {best.integrator} within the uncertainty."
    ours = time_to(best, error)
    ratio = budget / ours.seconds
    if ours.how == "at most" and ratio < LEAST_RATIO:
        return (
            f"The first image of {best.integrator}, after {seconds(ours.seconds)} s, is better "
            f"than {other.integrator}'s after {seconds(budget)} s; a smaller first budget tells "
            "how much faster it is."
        )
    at_least = "at least " if ours.how == "at most" else ""
    return (
        f"The error that {other.integrator} has after {seconds(budget)} s, "
        f"{best.integrator} reaches in {_words(ours)}: {at_least}{ratio:.2g} times faster."
    )


def _words(reached: Reached) -> str:
    return f"{'at most ' if reached.how == 'at most' else ''}{seconds(reached.seconds)} s"


def _last_rows(rows: list[dict]) -> list[dict]:
    return list({row["integrator"]: row for row in rows}.values())


def _is_biased(row: dict) -> bool:
    return abs(row["bias"]) > max(4 * row["bias_uncertainty"], 1e-3)


def _biased(row: dict) -> str:
    error = with_uncertainty(row["bias"], row["bias_uncertainty"])
    return (
        f"{row['integrator']} has a mean error of {error} of the mean radiance in its last image, "
        "more than the noise of independent pixels explains: most likely bias, which more samples "
        "do not reduce."
    )


def _subtitle(facts: dict[str, str]) -> str:
    shown = " · ".join(
        escape(facts[k]) for k in ("image", "variant", "machine", "date") if k in facts
    )
    return f'<p class="quiet">{shown}</p>'


def _findings(sentences: list[str]) -> str:
    return f'<div class="lead">{"".join(f"<p>{escape(s)}</p>" for s in sentences)}</div>'


def _failures(failed: list[Measurement]) -> str:
    return "".join(
        f'<div class="failed"><p><strong>{escape(m.integrator)} did not finish.</strong> '
        f"{escape(m.error)} "
        f"{'Its finished results are shown.' if m.snapshots else 'It has no image to show.'}"
        "</p></div>"
        for m in failed
    )


def _page(name: str) -> str:
    return (PAGE / name).read_text(encoding="utf-8")


def _section(section: Section) -> str:
    return f"<h2>{escape(section.title)}</h2>" + "".join(map(_part, section.parts))


def _part(part: Figure | Table | Images) -> str:
    if isinstance(part, Images):
        return embedded.html(part)
    return _table(part) if isinstance(part, Table) else _figure(part)


def _figure(figure: Figure) -> str:
    caption = escape(figure.caption)
    if figure.path.suffix == ".svg":
        drawing = _inline(figure.path.read_text(encoding="utf-8"))
        points = escape(json.dumps(figure.points), quote=True)
        return (
            f'<figure data-points="{points}">{drawing}<figcaption>{caption}</figcaption></figure>'
        )
    data = base64.b64encode(figure.path.read_bytes()).decode()
    return (
        f'<figure><img src="data:image/png;base64,{data}" alt="{caption}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _inline(svg: str) -> str:
    """Return an SVG as an element of HTML: without prolog, metadata and names of XML spaces."""
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg[svg.index("<svg") :], flags=re.DOTALL)
    return re.sub(r' xmlns(:\w+)?="[^"]*"', "", svg)


def _table(table: Table) -> str:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in table.head)
    rows = "".join(
        "<tr>"
        + "".join(
            f'<td class="best">{escape(cell)}</td>'
            if (r, c) in table.best
            else f"<td>{escape(cell)}</td>"
            for c, cell in enumerate(row)
        )
        + "</tr>"
        for r, row in enumerate(table.rows)
    )
    wide = ' class="wide"' if len(table.head) > 9 else ""
    note = f'<p class="note">{escape(table.note)}</p>' if table.note else ""
    return (
        f'<div class="scroll"><table{wide}><thead><tr>{head}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div>{note}"
    )
