"""The HTML report of a map: its data, and `write_report`, which writes one self-contained page (images inlined, no
scripts, no external resources). The page is the Jinja2 template page.html, which escapes every value."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from perception.colors import instance_palette
from perception.io.atomic import atomic_file
from perception.pictures import error_map

LIMIT = 3_000_000  # maximum size of the page in bytes
SIZES = ((460, 82), (360, 74), (260, 66), (180, 55), (120, 45))  # (longest side, JPEG quality), tried in this order
MOST_VIEWS = 4  # maximum number of held-out views shown as images
WIDTH, HEIGHT = 320, 170
LEFT, RIGHT, TOP, BASE = 40, WIDTH - 12, 12, HEIGHT - 22
"""The plot area in pixels; tick labels are outside it."""


@dataclass(frozen=True)
class ViewRow:
    """A held-out view. photo, render: [H, W, 3] uint8 of equal size; psnr in dB, ssim in [0, 1]; note: why shown."""

    name: str
    psnr: float | None = None
    ssim: float | None = None
    photo: np.ndarray | None = None
    render: np.ndarray | None = None
    note: str = ""


@dataclass(frozen=True)
class InstanceRow:
    """An instance: best crop, the user's label or the most likely names, score in [0, 1], box sides in map units."""

    id: int
    crop: np.ndarray | None = None
    label: str | None = None
    names: Sequence[str] = ()
    score: float | None = None
    extent: Sequence[float] | None = None
    num_gaussians: int | None = None


@dataclass(frozen=True)
class QueryRow:
    """A text query and its hits, best first: (instance id, score). picture: a photo with the best hit outlined.

    expected: the correct ids if ground truth is available.
    """

    text: str
    present: bool
    hits: Sequence[tuple[int, float]] = ()
    picture: np.ndarray | None = None
    expected: Sequence[int] | None = None

    @property
    def verdict(self) -> str:
        """ "right" or "wrong" with ground truth, else ""."""
        if self.expected is None:
            return ""
        right = self.hits[0][0] in self.expected if self.present and self.hits else not self.expected
        return "right" if right else "wrong"


@dataclass(frozen=True)
class ReportData:
    """Content of a report. Everything except the title is optional; missing parts are left out.

    figures: name -> formatted value, for the header ({"PSNR held-out": "28.4 dB"}). seconds: by stage, in order.
    psnr_curve: (iteration, dB); ssim_curve: (iteration, SSIM as in training, zero-padded); gaussians_curve: (iteration,
    count). views: held-out views; those with images are shown, worst first, and all with figures appear in the bar
    chart. overview: title -> image (top view, feature colours). metric: whether extents are in metres. settings: name
    -> value. command: command line that reproduces the map.
    """

    title: str
    subtitle: str = ""
    figures: Mapping[str, str] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)
    psnr_curve: Sequence[tuple[float, float]] = ()
    ssim_curve: Sequence[tuple[float, float]] = ()
    gaussians_curve: Sequence[tuple[float, float]] = ()
    views: Sequence[ViewRow] = ()
    overview: Mapping[str, np.ndarray] = field(default_factory=dict)
    instances: Sequence[InstanceRow] = ()
    metric: bool = False
    queries: Sequence[QueryRow] = ()
    warnings: Sequence[str] = ()
    settings: Mapping[str, object] = field(default_factory=dict)
    command: str = ""


def write_report(path: Path | str, data: ReportData) -> Path:
    """Writes the report as one HTML file, replacing an old one atomically. Images shrink until it is under LIMIT."""
    path = Path(path)
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined
    )
    template = environment.get_template("page.html")
    shown = {
        "data": data,
        "stages": {name: s for name, s in data.seconds.items() if np.isfinite(s) and s > 0},
        "views": _views(data.views),
        "charts": _charts(data),
        "color": lambda i: instance_palette([i])[0].tolist(),
        "clock": clock,
        "sides": partial(_sides, scale=100.0 if data.metric else 1.0),
    }
    page = b""
    for side, quality in SIZES:
        text = template.render(shown, image=partial(_image, side=side, quality=quality))
        page = text.encode(errors="replace")  # an unpaired surrogate in a file name cannot be encoded as UTF-8
        if len(page) < LIMIT:
            break
    with atomic_file(path) as aside:
        aside.write_bytes(page)
    return path


def _image(picture: np.ndarray, side: int, quality: int) -> tuple[int, int, str]:
    """(width, height, data URI) of an image [H, W, 3] uint8, with a longer side of at most `side` pixels."""
    from PIL import Image

    image = Image.fromarray(np.ascontiguousarray(picture[..., :3], np.uint8))
    image.thumbnail((side, side), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    image.save(buffer, "WEBP", quality=quality, method=4)
    code = base64.b64encode(buffer.getvalue()).decode()
    return image.width, image.height, f"data:image/webp;base64,{code}"


def _views(views: Sequence[ViewRow]) -> list[dict[str, np.ndarray]]:
    """{caption: image} of the held-out views that have images, worst first."""
    rows = []
    for view in sorted(views, key=lambda view: view.psnr if view.psnr is not None else float("inf")):
        if view.photo is None or view.render is None:
            continue
        quality = [f"{view.psnr:.2f} dB"] if view.psnr is not None else []
        quality += [f"SSIM {view.ssim:.3f}"] if view.ssim is not None else []
        row = {
            f"photo {view.name}, not used for the map": view.photo,
            "render: " + ", ".join([*quality, *([view.note] if view.note else [])]): view.render,
        }
        if view.photo.shape == view.render.shape:
            row["error: black is none, bright is a quarter of the range"] = error_map(view.photo, view.render)
        rows.append(row)
    return rows[:MOST_VIEWS]


def _charts(data: ReportData) -> dict[str, Markup]:
    charts = {
        "PSNR over iterations (dB)": curve(data.psnr_curve, "PSNR over iterations", "dB"),
        "SSIM over iterations": curve(data.ssim_curve, "SSIM over iterations"),
        "Gaussians over iterations": curve(data.gaussians_curve, "Gaussians over iterations"),
    }
    return {title: svg for title, svg in charts.items() if svg}


def _sides(extent: Sequence[float], scale: float) -> str:
    """Box sides times `scale`, with so many decimals that the longest has three digits."""
    sides = [scale * side for side in extent]
    decimals = int(np.clip(2 - np.floor(np.log10(max(*sides, 1e-12))), 0, 6))
    return " × ".join(f"{side:.{decimals}f}" for side in sides)


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
