"""Small inline SVG line charts. The page's style sheet sets the colours; text is escaped."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from markupsafe import Markup

WIDTH, HEIGHT = 320, 170
LEFT, RIGHT, TOP, BASE = 40, WIDTH - 12, 12, HEIGHT - 22
"""The plot area in pixels; tick labels are outside it."""


def ticks(low: float, high: float, count: int = 4) -> list[float]:
    """About `count` round numbers (1, 2, 5 × 10^k apart) from low to high."""
    if not high > low:
        return [low]
    rough = (high - low) / count
    unit = 10 ** np.floor(np.log10(rough))
    step = float(min((m * unit for m in (1, 2, 5, 10)), key=lambda step: abs(np.log(step / rough))))
    marks = np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) * step
    return [float(x) for x in marks + 0.0]  # + 0.0 turns -0.0 into 0.0


def short(value: float) -> str:
    """12000 -> 12k, 1500000 -> 1.5M, 0.25 -> 0.25."""
    for unit, suffix in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= unit:
            return f"{value / unit:.3g}{suffix}"
    return f"{value:.3g}"


def clock(seconds: float) -> str:
    """42.3 -> 42 s, 95 -> 1 min 35 s."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    return f"{whole} s" if whole < 60 else f"{whole // 60} min {whole % 60:02d} s"


def curve(points: Sequence[tuple[float, float]], label: str, unit: str = "") -> Markup:
    """A line chart of (x, y). Non-finite points are left out; the chart is empty for fewer than two points."""
    kept = np.array([p for p in points if np.isfinite(p).all()], float).reshape(-1, 2)
    if len(kept) < 2:
        return Markup()
    (x0, y0), (x1, y1) = kept.min(0), kept.max(0)
    y0, y1 = (y0 - 0.5, y1 + 0.5) if y1 == y0 else (y0, y1)
    across, up = _scale(x0, x1 if x1 > x0 else x0 + 1, LEFT, RIGHT), _scale(y0, y1, BASE, TOP)
    parts = [_gridline(up(y), short(y)) for y in ticks(y0, y1)]
    parts += [_text(across(x), HEIGHT - 6, "middle", short(x)) for x in ticks(x0, x1)]
    path = " ".join(f"{across(x):.1f},{up(y):.1f}" for x, y in kept)
    parts.append(Markup('<polyline class="line" points="{}"/>').format(path))
    end = Markup('<circle class="dot" cx="{:.1f}" cy="{:.1f}" r="4"/>')
    parts.append(end.format(across(kept[-1, 0]), up(kept[-1, 1])))
    return _svg(f"{label}: {short(kept[-1, 1])} {unit}".rstrip() + " at the end", parts)


def _scale(low: float, high: float, start: float, end: float) -> Callable[[float], float]:
    """The linear function that maps low to start and high to end."""
    return lambda value: start + (value - low) / (high - low) * (end - start)


def _gridline(y: float, words: str) -> Markup:
    line = Markup('<line class="grid" x1="{}" x2="{}" y1="{:.1f}" y2="{:.1f}"/>').format(LEFT, RIGHT, y, y)
    return line + _text(LEFT - 8, y + 4, "end", words)


def _text(x: float, y: float, anchor: str, words: str) -> Markup:
    return Markup('<text x="{:.1f}" y="{:.1f}" text-anchor="{}">{}</text>').format(x, y, anchor, words)


def _svg(label: str, parts: Sequence[Markup]) -> Markup:
    head = Markup('<svg viewBox="0 0 {} {}" role="img" aria-label="{}">').format(WIDTH, HEIGHT, label)
    return head + Markup().join(parts) + Markup("</svg>")
