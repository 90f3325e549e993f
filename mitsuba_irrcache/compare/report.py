"""The report as one self-contained HTML file."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from mitsuba_irrcache.io.files import atomic_write

from .results import Measurement
from .summary import Curve, Reached, equal_time, time_to, uncertainty
from .tables import Table, percent, seconds, with_uncertainty

CSS = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #1c1c1c; margin: 0 auto; max-width: 62rem;
       padding: 2rem 1.25rem 4rem; }
h1 { font-size: 1.7rem; margin: 0 0 .25rem; } h2 { font-size: 1.2rem; margin: 2.5rem 0 .5rem; }
p { margin: .5rem 0; max-width: 46rem; }
.quiet, figcaption, .note { color: #666; font-size: .88rem; }
code { font: .92em ui-monospace, monospace; }
.lead { border-left: 4px solid #0072b2; padding: .1rem 0 .1rem 1rem; margin: 1.25rem 0; }
.failed { border-left: 4px solid #d55e00; padding: .1rem 0 .1rem 1rem; margin: 1.25rem 0; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; margin: .5rem 0; }
th, td { padding: .28rem .8rem .28rem 0; text-align: right; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
thead th { border-bottom: 1.5px solid #888; font-weight: 600; vertical-align: bottom; }
tbody tr { border-bottom: 1px solid #e6e6e6; }
td.best { font-weight: 700; color: #0b5a2b; }
.wide { font-size: .8rem; }
figure { margin: 1rem 0; } img { max-width: 100%; height: auto; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .15rem 1rem; font-size: .9rem; }
dt { color: #666; } dd { margin: 0; overflow-wrap: anywhere; }
"""


@dataclass
class Figure:
    """An image file and its caption."""

    path: Path
    caption: str


@dataclass
class Section:
    """A heading with figures and tables below it."""

    title: str
    parts: list[Figure | Table]


def write_report(
    path: Path,
    title: str,
    findings: list[str],
    sections: list[Section],
    failed: list[Measurement],
    facts: dict[str, str],
) -> None:
    """Write the page atomically, with embedded figures, so that it loads no other file."""
    body = [f"<h1>{escape(title)}</h1>", _subtitle(facts), _findings(findings), _failures(failed)]
    body += [_section(section) for section in sections]
    rows = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in facts.items())
    body.append(f"<h2>What was compared</h2><dl>{rows}</dl>")
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{CSS}</style></head><body>"
        f"{''.join(body)}</body></html>\n"
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
    said += [_ratio(ranked[0], other, errors[other]) for other in ranked[1:]]
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


def _ratio(best: Curve, other: Curve, error: float) -> str:
    if error - best.shown[-1] < 2 * np.hypot(uncertainty(best), uncertainty(other)):
        return f"{other.integrator} is as good as {best.integrator} within the uncertainty."
    ours = time_to(best, error)
    ratio = float(other.seconds[-1]) / ours.seconds
    at_least = "at least " if ours.how == "at most" else ""
    return (
        f"The error that {other.integrator} has after {seconds(float(other.seconds[-1]))} s, "
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


def _section(section: Section) -> str:
    return f"<h2>{escape(section.title)}</h2>" + "".join(
        _table(part) if isinstance(part, Table) else _figure(part) for part in section.parts
    )


def _figure(figure: Figure) -> str:
    data = base64.b64encode(figure.path.read_bytes()).decode()
    caption = escape(figure.caption)
    return (
        f'<figure><img src="data:image/png;base64,{data}" alt="{caption}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


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
