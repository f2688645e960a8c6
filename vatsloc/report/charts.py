"""Small charts as inline SVG: bars of the stages' seconds, box plots of registration errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from xml.etree import ElementTree as ET

import numpy as np
from markupsafe import Markup

from registration.volume import Array

BLUE, ORANGE, INK, FAINT = "#0072B2", "#D55E00", "#1b1f24", "#c9ced6"
TICKS_MM = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
PLOT_WIDTH, BARS_WIDTH, LABEL = 760, 560, 200


def bars(values: Mapping[str, float], unit: str, described_as: str) -> Markup:
    """Horizontal bars, one per name, value written at the end of each; `described_as` is what a screen reader says."""
    row = 24
    svg = _svg(BARS_WIDTH, row * len(values) + 8, described_as)
    longest = max([*values.values(), 1e-9])
    room = BARS_WIDTH - LABEL - 80
    for m, (name, value) in enumerate(values.items()):
        y = 4 + m * row
        _text(svg, LABEL - 8, y + 16, name, "end")
        _add(svg, "rect", x=LABEL, y=y + 4, width=max(room * value / longest, 1.0), height=row - 8, fill=BLUE)
        _text(svg, LABEL + room * value / longest + 6, y + 16, f"{value:.4g} {unit}", "start")
    return _markup(svg)


def box_plot(groups: Mapping[str, Array], described_as: str) -> Markup:
    """Errors (n,) mm per group: quartiles as a box, whiskers at 5 and 95 %, a dot per landmark, diamond mean.

    The axis is logarithmic, since what registrations leave is a tenth of what they start from; errors below its first
    tick are drawn there.
    """
    row, top = 40, 10
    svg = _svg(PLOT_WIDTH, top + row * len(groups) + 34, described_as)
    finite = {name: np.asarray(e)[np.isfinite(e)] for name, e in groups.items()}
    longest = max([float(e.max()) for e in finite.values() if e.size] + [1.0])
    ticks = [*(mm for mm in TICKS_MM if mm < longest), next(mm for mm in (*TICKS_MM, longest) if mm >= longest)]
    decades = np.log10(ticks[-1] / ticks[0])

    def at(mm: float) -> float:
        return LABEL + (PLOT_WIDTH - LABEL - 20) * float(np.log10(max(mm, ticks[0]) / ticks[0]) / decades)

    bottom = top + row * len(groups)
    for tick in ticks:
        _add(svg, "line", x1=at(tick), x2=at(tick), y1=top, y2=bottom, stroke=FAINT)
        _text(svg, at(tick), bottom + 16, f"{tick:g}", "middle")
    _text(svg, at(ticks[-1]), bottom + 30, "mm", "end")
    for m, (name, errors) in enumerate(finite.items()):
        y = top + m * row + row / 2
        _text(svg, LABEL - 8, y + 5, name, "end")
        if errors.size:
            _box(svg, errors, y, at, ORANGE if name.startswith("rigid") else BLUE)
    return _markup(svg)


def _box(svg: ET.Element, errors: Array, y: float, at: Callable[[float], float], colour: str) -> None:
    low, q1, q2, q3, high = (at(v) for v in np.percentile(errors, [5, 25, 50, 75, 95]))
    for n, error in enumerate(errors):
        # The golden ratio spreads the dots over the row without a random number and without a pattern.
        dy = ((n * 0.618) % 1 - 0.5) * 22
        _add(svg, "circle", cx=at(error), cy=y + dy, r=1.8, fill=colour, opacity=0.45)
    _add(svg, "line", x1=low, x2=high, y1=y, y2=y, stroke=INK)
    _add(svg, "rect", x=q1, y=y - 9, width=max(q3 - q1, 0.5), height=18, fill="white", opacity=0.6)
    _add(svg, "rect", x=q1, y=y - 9, width=max(q3 - q1, 0.5), height=18, fill="none", stroke=INK)
    _add(svg, "line", x1=q2, x2=q2, y1=y - 9, y2=y + 9, stroke=colour, stroke_width=3)
    x = at(float(errors.mean()))
    _add(svg, "path", d=f"M{x - 5:.1f} {y:.1f}l5 -5l5 5l-5 5z", fill=INK)


def _svg(width: float, height: float, described_as: str) -> ET.Element:
    svg = ET.Element(
        "svg", {"viewBox": f"0 0 {width:g} {height:g}", "role": "img", "aria-label": described_as, "class": "chart"}
    )
    ET.SubElement(svg, "title").text = described_as
    return svg


def _add(svg: ET.Element, tag: str, **attributes: float | str) -> None:
    ET.SubElement(
        svg,
        tag,
        {
            k.replace("_", "-"): v if isinstance(v, str) else f"{v:.2f}".rstrip("0").rstrip(".")
            for k, v in attributes.items()
        },
    )


def _text(svg: ET.Element, x: float, y: float, words: str, anchor: str) -> None:
    ET.SubElement(svg, "text", {"x": f"{x:.1f}", "y": f"{y:.1f}", "text-anchor": anchor}).text = words


def _markup(svg: ET.Element) -> Markup:
    return Markup(ET.tostring(svg, encoding="unicode"))
