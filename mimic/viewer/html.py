"""Numbers, heat maps and curves as HTML and SVG, which are fast enough to replace at every frame."""

import html
import math
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from mimic.evaluation.labels import similarity_texts

EXPERT, LEARNER, BOUND, HOLD = "#3b6fd4", "#1b9e77", "#222222", "#9a9a9a"
_BLUES, _ORANGES = (8, 69, 148), (200, 80, 10)
_WIDTH, _HEIGHT, _LEFT, _BOTTOM, _TOP = 360, 96, 34, 18, 8  # pixels of a chart and its margins
LAST = 1e12  # order of an element below all others, whose orders are times in seconds
_SHORT_NAME, _LONG_NAME = 4, 6  # characters: names that fit into a column of numbers, and the longest that is not cut
_MIN_TOP = 0.01  # of a chart's scale, so that the scale is readable at distance 0


def short_names(names: Sequence[str]) -> list[str]:
    """Link names without the prefix "link": link1, link2+link3, link_hand -> 1, 2+3, hand."""
    return [name.replace("link_", "").replace("link", "") or name for name in names]


def _cut(name: str) -> str:
    return name if len(name) <= _LONG_NAME or "+" in name else f"{name[: _LONG_NAME - 1]}…"


def heat_map(
    values: Float[np.ndarray, "rows columns"],
    rows: Sequence[str],
    columns: Sequence[str],
    title: str,
    *,
    name: str,
    colour: tuple[int, int, int] = _BLUES,
) -> str:
    """Returns a matrix as a table of coloured cells.

    Args:
      values: values of at least 0.
      rows: names of the expert's links.
      columns: names of the learner's links.
      title: title above the table.
      name: id of the HTML element.
      colour: full colour as red, green and blue from 0 to 255.
    """
    scale = max(float(values.max()), 1e-9)
    head = "".join(f"<th>{html.escape(column)}</th>" for column in columns)
    width = f' style="width:{_LONG_NAME / 2}em"' if max(map(len, rows)) > _SHORT_NAME else ""
    body = "".join(
        f"<tr><th>{html.escape(_cut(row))}</th>{''.join(_cell(float(value), scale, colour) for value in line)}</tr>"
        for row, line in zip(rows, values, strict=True)
    )
    style = (
        "border-collapse:separate;border-spacing:1px;font-size:9px;letter-spacing:-0.3px;line-height:14px;width:100%;"
        "table-layout:fixed"
    )
    return (
        f'<div style="flex:1 1 0;min-width:0"><div style="font-size:11px">{html.escape(title)}</div>'
        f'<table id="{name}" style="{style}"><tr><th{width}></th>{head}</tr>{body}</table></div>'
    )


def _cell(value: float, scale: float, colour: tuple[int, int, int]) -> str:
    fraction = min(max(value / scale, 0.0), 1.0)
    mixed = ",".join(str(round(255 + fraction * (channel - 255))) for channel in colour)
    ink = "#fff" if fraction > 0.55 else "#333"
    text = "" if value < 0.005 else f"{value:.2f}" if value < 9.995 else f"{value:.1f}"  # four characters fit
    return f'<td style="background:rgb({mixed});color:{ink};text-align:center;height:14px">{text}</td>'


def heat_maps(
    matrix: Float[np.ndarray, "expert learner"],
    links: Float[np.ndarray, "expert learner"],
    expert_links: Sequence[str],
    learner_links: Sequence[str],
) -> str:
    """Returns heat maps of the correspondence and of the distances of all pairs of links."""
    names = short_names(expert_links), short_names(learner_links)
    return (
        '<div style="display:flex;gap:10px;padding:0 12px">'
        + heat_map(matrix, *names, "correspondence W", name="mimic-correspondence")
        + heat_map(links, *names, "link distances", name="mimic-links", colour=_ORANGES)
        + '</div><div style="font-size:10px;color:#777;padding:2px 12px">rows: links of the expert, columns: of the '
        "learner</div>"
    )


def title(text: str) -> str:
    """Returns the title of a page."""
    return f'<div style="font-weight:bold;font-size:13px;padding:2px 12px 0">{html.escape(text)}</div>'


def numbers(distance: float, bound: float, note: str = "", similarity: Mapping[str, float] | None = None) -> str:
    """Returns distance and bound in large type, a note, and the measures of `mimic.metric.similarity`."""

    def cell(name: str, label: str, value: float, colour: str) -> str:
        return (
            f'<div><div style="font-size:11px;color:#777">{label}</div>'
            f'<div id="{name}" style="font-size:22px;font-variant-numeric:tabular-nums;color:{colour}">'
            f"{'…' if math.isnan(value) else f'{value:.4f}'}</div></div>"
        )

    return (
        '<div style="display:flex;gap:22px;padding:4px 12px">'
        + cell("mimic-distance", "embodiment distance", distance, LEARNER)
        + cell("mimic-bound", "kinematic bound", bound, BOUND)
        + f'</div><div id="mimic-note" style="font-size:11px;color:#777;padding:0 12px;min-height:16px;'
        f'white-space:pre-line">'
        f"{html.escape(note)}</div>{_measures(similarity or {})}"
    )


def _measures(similarity: Mapping[str, float]) -> str:
    """The similarity measures in one line, each below its name."""
    cells = "".join(
        f'<div><div style="font-size:10px;color:#777">{html.escape(label)}</div>'
        f'<div id="mimic-{name}" style="font-size:13px;font-variant-numeric:tabular-nums">{text}</div></div>'
        for name, (label, text) in similarity_texts(similarity).items()
    )
    return f'<div style="display:flex;gap:14px;padding:4px 12px">{cells}</div>' if cells else ""


def chart(
    time: Float[np.ndarray, " samples"],
    curves: Sequence[tuple[str, Float[np.ndarray, " samples"], str]],
    *,
    now: float | None = None,
) -> str:
    """Returns curves over time as SVG.

    Args:
      time: time of the samples [s], ascending.
      curves: label, values of at least 0, and colour of each curve; all but the first are dashed.
      now: time to mark [s].
    """
    first, last = (float(time[0]), float(time[-1])) if len(time) else (0.0, 1.0)
    span = max(last - first, 1e-6)
    top = max([float(np.nanmax(values)) for _, values, _ in curves if np.isfinite(values).any()] + [_MIN_TOP]) * 1.08
    inner = _WIDTH - _LEFT - 6, _HEIGHT - _BOTTOM - _TOP

    def x(t: np.ndarray) -> np.ndarray:
        return _LEFT + (t - first) / span * inner[0]

    def y(value: np.ndarray) -> np.ndarray:
        return _TOP + (1 - value / top) * inner[1]

    parts = [_grid_line(float(tick), float(y(tick))) for tick in np.array([0.0, 0.5, 1.0]) * top / 1.08]
    for label, values, colour in curves:
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x(time), y(values), strict=True) if b == b)
        dashes = ' stroke-dasharray="4 3"' if label != curves[0][0] else ""
        parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.6"{dashes}/>')
    if now is not None:
        mark = float(x(np.array(now)))
        parts.append(f'<line x1="{mark:.1f}" x2="{mark:.1f}" y1="{_TOP}" y2="{_HEIGHT - _BOTTOM}" stroke="#d62728"/>')
    for index, (label, _, colour) in enumerate(curves):
        x_label = _LEFT + 6 + 78 * index
        parts.append(f'<text x="{x_label}" y="{_HEIGHT - 3}" fill="{colour}">{html.escape(label)}</text>')
    parts.append(f'<text x="{_WIDTH - 6}" y="{_HEIGHT - 3}" text-anchor="end">{last:.1f} s</text>')
    return (
        f'<svg id="mimic-chart" viewBox="0 0 {_WIDTH} {_HEIGHT}" style="width:100%;padding:0 8px" '
        f'font-size="9" fill="#666" font-family="sans-serif">{"".join(parts)}</svg>'
    )


def _grid_line(value: float, height: float) -> str:
    return (
        f'<line x1="{_LEFT}" x2="{_WIDTH - 6}" y1="{height:.1f}" y2="{height:.1f}" stroke="#e4e4e4"/>'
        f'<text x="{_LEFT - 4}" y="{height + 3:.1f}" text-anchor="end">{value:.3f}</text>'
    )
