"""`write_report`: one self-contained HTML page, pictures inlined, no script, nothing fetched."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from functools import partial
from html import escape
from pathlib import Path

import numpy as np

from perception.colors import instance_palette
from perception.io.atomic import atomic_file
from perception.pictures import error_map
from perception.report.charts import columns, curve, stages
from perception.report.data import InstanceRow, QueryRow, ReportData

LIMIT = 3_000_000  # bytes the page should stay under
SIZES = ((460, 82), (360, 74), (260, 66), (180, 55), (120, 45))  # (longest side, quality) tried in turn
MOST_VIEWS = 4  # held-out views shown as pictures
Inline = Callable[[np.ndarray, str], str]


def write_report(path: Path | str, data: ReportData) -> Path:
    """Writes the report as one HTML file, replacing an old one in one step. Pictures shrink until it is
    under 3 MB."""
    path = Path(path)
    page = b""
    for side, quality in SIZES:
        page = _page(data, partial(_image, side=side, quality=quality)).encode()
        if len(page) < LIMIT:
            break
    with atomic_file(path) as aside:
        aside.write_bytes(page)
    return path


def _image(picture: np.ndarray, alt: str, side: int, quality: int) -> str:
    """An <img> of a [H, W, 3] uint8 picture with its bytes inside."""
    from PIL import Image

    image = Image.fromarray(np.ascontiguousarray(picture, np.uint8))
    image.thumbnail((side, side), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    image.save(buffer, "WEBP", quality=quality, method=4)
    code = base64.b64encode(buffer.getvalue()).decode()
    size = f'width="{image.width}" height="{image.height}"'
    return f'<img {size} alt="{escape(alt)}" src="data:image/webp;base64,{code}"/>'


def _page(data: ReportData, inline: Inline) -> str:
    style = (Path(__file__).parent / "style.css").read_text(encoding="utf-8")
    sections = [
        _header(data),
        _views(data, inline),
        _charts(data),
        _overview(data, inline),
        _queries(data.queries, inline),
        _instances(data, inline),
        _settings(data),
    ]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"/>'
        '<meta name="viewport" content="width=device-width, initial-scale=1"/>'
        f"<title>{escape(data.title)}</title><style>{style}</style></head>\n"
        f"<body><main>{''.join(sections)}</main></body></html>\n"
    )


def _section(title: str, body: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{body}</section>\n" if body else ""


def _header(data: ReportData) -> str:
    figures = "".join(f"<div><dt>{escape(k)}</dt><dd>{escape(v)}</dd></div>" for k, v in data.figures.items())
    warnings = "".join(f"<li>{escape(text)}</li>" for text in data.warnings)
    return (
        f"<header><h1>{escape(data.title)}</h1>"
        + (f'<p class="sub">{escape(data.subtitle)}</p>' if data.subtitle else "")
        + (f'<dl class="figures">{figures}</dl>' if figures else "")
        + stages(data.seconds)
        + (f'<ul class="warnings">{warnings}</ul>' if warnings else "")
        + "</header>\n"
    )


def _views(data: ReportData, inline: Inline) -> str:
    rows: list[str] = []
    for view in sorted(data.views, key=lambda view: view.psnr if view.psnr is not None else float("inf")):
        if view.photo is None or view.render is None or len(rows) == MOST_VIEWS:
            continue
        quality = [
            f"{view.psnr:.2f} dB" if view.psnr is not None else "",
            f"SSIM {view.ssim:.3f}" if view.ssim is not None else "",
        ]
        cells = [
            (view.photo, f"photo {view.name}, not used for the map"),
            (view.render, "render: " + ", ".join(text for text in [*quality, view.note] if text)),
        ]
        if view.photo.shape == view.render.shape:
            cells.append((error_map(view.photo, view.render), "error: black is none, bright is a quarter of the range"))
        figures = "".join(
            f"<figure>{inline(picture, caption)}<figcaption>{escape(caption)}</figcaption></figure>"
            for picture, caption in cells
        )
        rows.append(f'<div class="three">{figures}</div>')
    return _section("Held-out photos, rendered from the map", "".join(rows))


def _charts(data: ReportData) -> str:
    psnr = {view.name: view.psnr for view in data.views if view.psnr is not None}
    ssim = {view.name: view.ssim for view in data.views if view.ssim is not None}
    charts = {
        "PSNR over iterations (dB)": curve(data.psnr_curve, "PSNR over iterations", "dB"),
        "SSIM over iterations": curve(data.ssim_curve, "SSIM over iterations"),
        "Gaussians over iterations": curve(data.gaussians_curve, "Gaussians over iterations"),
        "PSNR by view (dB; dashed: mean)": columns(psnr, "PSNR of each held-out view", "dB"),
        "SSIM by view (dashed: mean)": columns(ssim, "SSIM of each held-out view", ""),
    }
    cards = "".join(f'<div class="card"><h3>{escape(k)}</h3>{svg}</div>' for k, svg in charts.items() if svg)
    return _section("How it was learnt", f'<div class="cards">{cards}</div>' if cards else "")


def _overview(data: ReportData, inline: Inline) -> str:
    figures = "".join(
        f"<figure>{inline(picture, title)}<figcaption>{escape(title)}</figcaption></figure>"
        for title, picture in data.overview.items()
    )
    return _section("The map", f'<div class="cards">{figures}</div>' if figures else "")


def _queries(queries: Sequence[QueryRow], inline: Inline) -> str:
    cards = "".join(_query(query, inline) for query in queries)
    return _section("Asked in words", f'<div class="cards">{cards}</div>' if cards else "")


def _query(query: QueryRow, inline: Inline) -> str:
    if query.present and query.hits:
        hits = ", ".join(f"{_chip(i)}instance {i} ({score:.2f})" for i, score in query.hits)
    else:
        hits = "not present"
    verdict = ""
    if query.expected is not None:
        found = bool(query.present and query.hits)
        right = query.hits[0][0] in query.expected if found else not query.expected
        verdict = f' <b class="{"right" if right else "wrong"}">{"right" if right else "wrong"}</b>'
    picture = inline(query.picture, f"best hit for {query.text}") if query.picture is not None else ""
    head = f"<h3>“{escape(query.text)}”{verdict}</h3>"
    return f'<div class="card">{head}{picture}<p><small>{hits}</small></p></div>'


def _chip(id: int) -> str:
    r, g, b = instance_palette([id])[0]
    return f'<span class="chip" style="background:rgb({r},{g},{b})"></span>'


def _instances(data: ReportData, inline: Inline) -> str:
    if not data.instances:
        return ""
    size = "size (cm)" if data.metric else "size (map units)"
    numbers = "".join(f'<th class="n">{title}</th>' for title in ("confidence", size, "Gaussians"))
    head = f"<th></th><th>instance</th><th>name, or likeliest words</th>{numbers}"
    scale = 100.0 if data.metric else 1.0
    rows = "".join(_instance(row, inline, scale) for row in data.instances)
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"
    return _section(f"Instances ({len(data.instances)})", f'<div class="scroll">{table}</div>')


def _instance(row: InstanceRow, inline: Inline, scale: float = 1.0) -> str:
    crop = inline(row.crop[..., :3], f"instance {row.id}") if row.crop is not None else ""
    name = f"<b>{escape(row.label)}</b>" if row.label else escape(", ".join(row.names))
    size = _size([scale * side for side in row.extent]) if row.extent is not None else ""
    score = f"{row.score:.2f}" if row.score is not None else ""
    count = f"{row.num_gaussians:,}" if row.num_gaussians is not None else ""
    return (
        f"<tr><td>{crop}</td><td>{_chip(row.id)}{row.id}</td><td>{name}</td>"
        f'<td class="n">{score}</td><td class="n">{size}</td><td class="n">{count}</td></tr>'
    )


def _size(sides: Sequence[float]) -> str:
    """Sides with as many decimals as give the longest three digits."""
    longest = max(*sides, 1e-12)
    decimals = int(np.clip(2 - np.floor(np.log10(longest)), 0, 6))
    return " × ".join(f"{side:.{decimals}f}" for side in sides)


def _settings(data: ReportData) -> str:
    rerun = f"<pre>{escape(data.rerun)}</pre>" if data.rerun else ""
    rows = "".join(f"<tr><td>{escape(str(k))}</td><td>{escape(str(v))}</td></tr>" for k, v in data.settings.items())
    table = f'<details><summary>All settings</summary><div class="scroll"><table>{rows}</table></div></details>'
    return _section("Make it again", rerun + (table if rows else ""))
