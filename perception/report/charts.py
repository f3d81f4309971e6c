"""Small inline SVG charts: a curve, and horizontal or vertical bars. Colours come from the page's style
sheet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

WIDTH, HEIGHT, LEFT, BOTTOM = 320, 170, 40, 22


def ticks(low: float, high: float, count: int = 4) -> list[float]:
    """About `count` round numbers (1, 2, 5 × 10^k apart) from low to high."""
    if not high > low:
        return [low]
    rough = (high - low) / count
    unit = 10 ** np.floor(np.log10(rough))
    step = float(min((m * unit for m in (1, 2, 5, 10)), key=lambda step: abs(np.log(step / rough))))
    marks = np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) * step
    return [float(x) for x in marks + 0.0]  # + 0.0: no "-0"


def short(value: float) -> str:
    """12000 -> 12k, 1500000 -> 1.5M, 0.25 -> 0.25."""
    for unit, suffix in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= unit:
            return f"{value / unit:.3g}{suffix}"
    return f"{value:.3g}"


def curve(points: Sequence[tuple[float, float]], label: str, unit: str = "") -> str:
    """A line through (x, y); points that are not finite are left out, none at all gives an empty string."""
    kept = np.array([p for p in points if np.isfinite(p).all()], float).reshape(-1, 2)
    if len(kept) < 2:
        return ""
    (x0, y0), (x1, y1) = kept.min(0), kept.max(0)
    y0, y1 = (y0 - 0.5, y1 + 0.5) if y1 == y0 else (y0, y1)
    x1 = x1 if x1 > x0 else x0 + 1
    right, top, base = WIDTH - 12, 12, HEIGHT - BOTTOM

    def at(x: float, y: float) -> tuple[float, float]:
        return LEFT + (x - x0) / (x1 - x0) * (right - LEFT), base - (y - y0) / (y1 - y0) * (base - top)

    parts = []
    for y in ticks(y0, y1):
        py = at(x0, y)[1]
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{right}" y1="{py:.1f}" y2="{py:.1f}"/>')
        parts.append(f'<text x="{LEFT - 8}" y="{py + 4:.1f}" text-anchor="end">{short(y)}</text>')
    for x in ticks(x0, x1):
        parts.append(f'<text x="{at(x, y0)[0]:.1f}" y="{HEIGHT - 6}" text-anchor="middle">{short(x)}</text>')
    path = " ".join(f"{px:.1f},{py:.1f}" for px, py in (at(x, y) for x, y in kept))
    parts.append(f'<polyline class="line" points="{path}"/>')
    last = at(*kept[-1])
    parts.append(f'<circle class="dot" cx="{last[0]:.1f}" cy="{last[1]:.1f}" r="4"/>')
    title = f"{escape(label)}: {short(kept[-1, 1])}{' ' + escape(unit) if unit else ''} at the end"
    return _svg(WIDTH, HEIGHT, title, parts)


def columns(values: Mapping[str, float], label: str, unit: str) -> str:
    """One upright bar per name, written below where there is room, and the mean; what is not finite is left out."""
    kept = {name: value for name, value in values.items() if np.isfinite(value)}
    if not kept:
        return ""
    high = max(*kept.values(), 1e-9)
    top, base, right = 12, HEIGHT - BOTTOM, WIDTH - 12
    pitch = (right - LEFT) / len(kept)
    stems = [name.rsplit("/", 1)[-1].rsplit(".", 1)[0] for name in kept]
    parts = []
    for y in ticks(0, high):
        py = base - y / high * (base - top)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{right}" y1="{py:.1f}" y2="{py:.1f}"/>')
        parts.append(f'<text x="{LEFT - 8}" y="{py + 4:.1f}" text-anchor="end">{short(y)}</text>')
    for i, (name, value) in enumerate(kept.items()):
        tall = max(value, 0) / high * (base - top)
        parts.append(
            f'<rect class="bar" x="{LEFT + (i + 0.15) * pitch:.1f}" y="{base - tall:.1f}" '
            f'width="{0.7 * pitch:.1f}" height="{tall:.1f}" rx="2">'
            f"<title>{escape(name)}: {value:.3g} {escape(unit)}</title></rect>"
        )
        if 6 * max(map(len, stems)) <= pitch:
            middle = LEFT + (i + 0.5) * pitch
            parts.append(f'<text x="{middle:.1f}" y="{HEIGHT - 7}" text-anchor="middle">{escape(stems[i])}</text>')
    mean = base - float(np.mean(list(kept.values()))) / high * (base - top)
    parts.append(f'<line class="mean" x1="{LEFT}" x2="{right}" y1="{mean:.1f}" y2="{mean:.1f}"/>')
    return _svg(WIDTH, HEIGHT, f"{label}, mean {np.mean(list(kept.values())):.3g} {unit}", parts)


def stages(seconds: Mapping[str, float]) -> str:
    """One strip divided among the stages in proportion to their seconds, with a legend beneath."""
    kept = {name: value for name, value in seconds.items() if np.isfinite(value) and value > 0}
    total = sum(kept.values())
    if not total:
        return ""
    strip, legend = [], []
    for i, (name, value) in enumerate(kept.items()):
        tone = f"--tone:{i % 8}"
        strip.append(f'<span style="{tone};flex-grow:{value / total:.4f}" title="{escape(name)}"></span>')
        legend.append(f'<li style="{tone}"><b>{escape(name)}</b> {clock(value)}</li>')
    return f'<div class="strip">{"".join(strip)}</div><ul class="legend">{"".join(legend)}</ul>'


def clock(seconds: float) -> str:
    """42.3 -> 42 s, 95 -> 1 min 35 s."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    return f"{whole} s" if whole < 60 else f"{whole // 60} min {whole % 60:02d} s"


def _svg(width: int, height: int, label: str, parts: list[str]) -> str:
    return f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{escape(label)}">{"".join(parts)}</svg>'
