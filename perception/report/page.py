"""The report of a map: one self-contained HTML page, images inlined, no scripts, no external resources.

The page is the Jinja2 template report.html, which escapes every value.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from perception.colors import instance_palette
from perception.config import flat
from perception.errors import InputError
from perception.gaussians.model import as_gaussians
from perception.gaussians.photos import training_view
from perception.gaussians.views import TrainingView, render, render_view
from perception.instances.crops import expand_box, mask_box
from perception.instances.silhouettes import render_silhouettes
from perception.io.atomic import write_file
from perception.map.files import read_info
from perception.map.history import stood
from perception.map.map import MAX_SIDE, Map
from perception.map.write import REPORT
from perception.pictures import cut_out, error_map, features_to_rgb, outline, overlay, titled_row
from perception.progress import Progress
from perception.query import Hit, QueryMap, load_map
from perception.query.hit import printed_texts
from perception.report.text import changes_parts, depth_figures, names_of
from perception.types import OrientedBox

SHOWN = ("worst", "middle", "best")  # held-out views shown beside their photos, by PSNR
LIMIT = 3_000_000  # maximum size of the page in bytes
SIZES = ((460, 82), (360, 74), (260, 66), (180, 55), (120, 45))
"""(longest side, quality) of the images, tried in this order."""


def write_own_report(path: Path, progress: Progress) -> dict[str, Any]:
    """Writes report.html into the map; the content of its map.json. A failure to write is only a warning:
    `perception report` can be run later."""
    try:
        write_map_report(load_map(path), path / REPORT, [])
    except InputError as error:
        progress.log(f"warning: no report: {error}")
    return read_info(path)


def write_map_report(opened: QueryMap, path: Path, queries: list[str]) -> Path:
    """The one-page report of a map, with the answers to `queries`; missing photos are left out."""
    asked = [(text, opened.query(text)) for text in queries]  # first: one may be refused
    info, album = opened.info, _Album(opened)
    data = {
        "title": (opened.path or path).stem,
        "subtitle": f"from {info.get('source', 'unknown photos')}",
        "figures": _figures(opened),
        "seconds": {name: value for name, value in info.get("seconds", {}).items() if name != "total" and value > 0},
        "views": _view_rows(album),
        "overview": _overview(opened, album),
        "changes": _changes(opened, album),
        "instances": _instance_rows(opened, album),
        "metric": opened.metric,
        "queries": [_query_row(opened, text, hits, album) for text, hits in asked],
        "warnings": _warnings(info, album.scored),
        "settings": dict(flat(info.get("config", {}))),
    }
    return write_page(path, data)


def write_page(path: Path, data: Mapping[str, Any]) -> Path:
    """Writes the page, replacing an old one atomically. Images shrink until it is under LIMIT.

    data: what `write_map_report` gives; images are [H, W, 3] uint8.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    folder = FileSystemLoader(Path(__file__).parent)
    template = Environment(loader=folder, autoescape=True, undefined=StrictUndefined).get_template("report.html")
    sides = partial(_sides, scale=100.0 if data["metric"] else 1.0)
    page = b""
    for side, quality in SIZES:
        image = partial(_image, side=side, quality=quality)
        text = template.render(data=data, image=image, sides=sides, clock=clock, palette=instance_palette)
        page = text.encode(errors="replace")  # an unpaired surrogate in a file name cannot be encoded as UTF-8
        if len(page) < LIMIT:
            break
    write_file(path, page)
    return path


def _image(picture: np.ndarray, side: int, quality: int) -> tuple[int, int, str]:
    """(width, height, data URI) of an image [H, W, 3] uint8, with a longer side of at most `side` pixels."""
    image = Image.fromarray(np.ascontiguousarray(picture[..., :3], np.uint8))
    image.thumbnail((side, side), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    image.save(buffer, "WEBP", quality=quality, method=4)
    code = base64.b64encode(buffer.getvalue()).decode()
    return image.width, image.height, f"data:image/webp;base64,{code}"


def _sides(extent: Sequence[float], scale: float) -> str:
    """Box sides times `scale`, with so many decimals that the longest has three digits."""
    sides = [scale * side for side in extent]
    decimals = int(np.clip(2 - np.floor(np.log10(max(*sides, 1e-12))), 0, 6))
    return " × ".join(f"{side:.{decimals}f}" for side in sides)


def clock(seconds: float) -> str:
    """42.3 -> 42 s, 95 -> 1 min 35 s."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


def _warnings(info: dict[str, Any], scored: dict[str, dict[str, float]]) -> list[str]:
    """Warnings on the quality of the map, most severe first."""
    mean, scene = info.get("quality", {}).get("psnr") or 0.0, info.get("scene", {})
    bad = [f"{name} ({figures['psnr']:.1f} dB)" for name, figures in scored.items() if mean - figures["psnr"] > 6]
    lines = [*_left_out(scene), *scene.get("warnings", []), *info.get("masks", {}).get("warnings", [])]
    if skipped := info.get("training", {}).get("skipped_gradients"):
        lines.append(f"{skipped} gradients were not finite and were skipped")
    if bad:
        lines.append(f"held-out views far below the mean of {mean:.1f} dB: {', '.join(bad)}")
    return lines


def _left_out(scene: dict[str, Any], most: int = 12) -> list[str]:
    """The photos that are not in the map, one line per reason."""
    reasons: dict[str, list[str]] = {}
    for entry in scene.get("left_out", []):
        reasons.setdefault(entry["why"], []).append(entry["name"])
    lines = []
    for why, names in reasons.items():
        more = f" and {len(names) - most} more" if len(names) > most else ""
        count = "1 photo" if len(names) == 1 else f"{len(names)} photos"
        lines.append(f"{count} not in the map, {why}: {', '.join(names[:most])}{more}")
    return lines


class _Album:
    """Photos, renders and silhouettes of the map's views at training size, computed on first use.

    `render`, `ids` and `features` are for views whose `photo` can be read. scored: the held-out views with figures.
    """

    def __init__(self, gmap: Map):
        self.gmap, self.gaussians = gmap, as_gaussians(gmap)
        self.side = gmap.setting("photos", "max_side", MAX_SIDE)
        self.views = {view.name: view for view in gmap.views}
        figures = gmap.info.get("quality", {}).get("views", {})
        self.scored = {name: own for name, own in figures.items() if name in self.views and None not in own.values()}
        self.trained, self.ids = cache(self._trained), cache(self._ids)

    def _trained(self, name: str) -> TrainingView | None:
        """The view as it was trained; None when its photo can no longer be read, or is none of the map's."""
        try:
            return training_view(self.gmap.with_photo(self.views[name]), self.side)
        except (InputError, KeyError):
            return None

    def photo(self, name: str) -> np.ndarray | None:
        """[h, w, 3] uint8; None without one."""
        view = self.trained(name)
        return None if view is None else view.photo.numpy()

    def visit(self, name: str) -> int:
        """The number of the visit that took a view's photo; 0 for a name that is none of the map's."""
        return int(getattr(self.views.get(name), "visit", 0))

    def _view(self, name: str) -> TrainingView:
        view = self.trained(name)
        assert view is not None  # see the class
        return view

    def _camera(self, name: str) -> tuple[torch.Tensor, torch.Tensor, int, int]:
        """camera_from_world [4, 4], K [3, 3], width and height of a view's photo as it was trained."""
        view = self._view(name)
        height, width = view.photo.shape[:2]
        return view.camera_from_world, view.K, width, height

    def render(self, name: str) -> np.ndarray:
        """[h, w, 3] uint8: the map rendered from the camera of the photo."""
        return (render_view(self.gaussians, self._view(name)) * 255 + 0.5).to(torch.uint8).numpy()

    def _ids(self, name: str) -> np.ndarray:
        """[h, w] instance ids rendered from the camera of the photo, −1 = none."""
        return render_silhouettes(self.gaussians, [self.gmap.instance_ids], *self._camera(name))[0].ids

    def spot(self, box: dict[str, Any], first: int, last: int) -> np.ndarray | None:
        """The photo of the visits `first` to `last` that shows most of the box, as in instances.json, cut out with a
        margin; None when none shows half of it."""
        corners, boxes = OrientedBox.from_json(box).corners, []
        for name, view in self.views.items():
            x, y, depth = view.camera_from_world[:3, :3] @ corners.T + view.camera_from_world[:3, 3:]
            if first <= self.visit(name) <= last and depth.min() > 0:
                u, v = (view.K[:2, :2] @ [x, y] / depth + view.K[:2, 2:]) / [[view.width], [view.height]]
                seen = [np.clip(side, 0, 1) for side in (u, v)]
                area, whole = (float(np.ptp(x) * np.ptp(y)) for x, y in (seen, (u, v)))
                if area >= whole / 2:
                    boxes.append((area, name, [end(side) for end in (np.min, np.max) for side in seen]))
        for _, name, shares in sorted(boxes, reverse=True):
            if (photo := self.photo(name)) is not None:
                x0, y0, x1, y1 = (int(share * side) for share, side in zip(shares, photo.shape[1::-1] * 2, strict=True))
                return cut_out(photo, (x0, y0, x1, y1), SIZES[0][0])
        return None

    def features(self, name: str) -> np.ndarray:
        """[h, w, 3] uint8: rendered features, first three principal components as RGB."""
        out = render(self.gaussians, *self._camera(name), features=self.gaussians.features)
        assert out.features is not None  # features were given
        return features_to_rgb(out.features[0].numpy())


def map_picture(opened: QueryMap, text: str) -> np.ndarray:
    """Four images in a row for the photo that best shows the answer to `text`: photo, render, instances, answer."""
    album = _Album(opened)
    hits = opened.query(text, top_k=1)
    names = list(album.views)
    name = hits[0].views[0] if hits and hits[0].views else names[len(names) // 2]
    photo = album.photo(name)
    if photo is None:
        raise InputError(f"{album.views[name].photo}: cannot be read any more; the picture needs the photo")
    ids = album.ids(name)
    answer = outline(photo, ids == hits[0].instance_id) if hits else photo
    titles = ["photo", "the map from the same camera", "instances", f'"{text}"']
    return titled_row([photo, album.render(name), overlay(photo, ids), answer], titles)


def _figures(gmap: Map) -> dict[str, str]:
    info, quality = gmap.info, gmap.info.get("quality", {})
    figures = {"Gaussians": f"{len(gmap):,}", "Instances": str(len(gmap.instances))}
    if None not in (psnr := quality.get("psnr"), similarity := quality.get("ssim")):
        figures |= {"Held-out PSNR": f"{psnr:.2f} dB", "SSIM": f"{similarity:.3f}"}
    if quality.get("depth"):
        median, share, tolerance = depth_figures(quality["depth"])
        figures |= {"Median depth error": median, f"Depth within {tolerance}": share}
    figures["Time"] = f"{info.get('seconds', {}).get('total', 0):.0f} s"
    figures["Peak memory"] = f"{info.get('peak_memory_mib', 0):.0f} MiB"
    return figures


def _view_rows(album: _Album) -> list[dict[str, np.ndarray]]:
    """{caption: image} of the held-out views in SHOWN: the photo, the render, their difference."""
    scored = album.scored
    by_psnr = sorted(scored, key=lambda name: float(scored[name]["psnr"]))
    places = zip((0, len(by_psnr) // 2, -1), SHOWN, strict=True)
    rows = []
    for name, rank in {by_psnr[i]: rank for i, rank in places if by_psnr}.items():
        photo = album.photo(name)
        if photo is None:
            continue
        render, note = album.render(name), f", {rank} of {len(by_psnr)}" if len(by_psnr) > 1 else ""
        figures = f"{scored[name]['psnr']:.2f} dB, SSIM {scored[name]['ssim']:.3f}"
        rows.append(
            {
                f"photo {name}, not used for the map": photo,
                f"render: {figures}{note}": render,
                "error: black is none, bright is a quarter of the range": error_map(photo, render),
            }
        )
    return rows


def _overview(gmap: Map, album: _Album) -> dict[str, np.ndarray]:
    """Instances and features of the middle photo of the newest visit."""
    names = [name for name in album.views if album.visit(name) == gmap.newest_visit]
    still = gmap.info.get("scene", {}).get("still")
    name = names[len(names) // 2] if names else ""
    photo, shown = album.photo(name), {}
    if still:
        mask = Image.open(io.BytesIO(base64.b64decode(still["mask"]))).convert("RGB")
        shown[f"black: stays in the picture and is ignored, {still['share']:.1%}"] = np.asarray(mask)
    if photo is None or not gmap.instances:
        return shown
    return shown | {
        f"instances in {name}": overlay(photo, album.ids(name)),
        "instance features (main components)": album.features(name),
    }


def _best_picture(opened: QueryMap, index: int, album: _Album, cropped: bool) -> np.ndarray | None:
    """The photo that shows the instance best where it stands today, with its outline; cropped: cut out with a margin.
    Of one that only photos of its earlier spots show well, a cut of these. None without a photo."""
    hit, entry = opened.hit(index), opened.instances[index]
    name = next((name for name in hit.views if stood(entry, album.visit(name)) is entry), None)
    if name is None and (best := opened.best_view(hit.instance_id)) is not None:
        earlier = album.photo(best[0].name)
        return None if earlier is None else cut_out(earlier, best[1], SIZES[0][0])
    photo = None if name is None else album.photo(name)
    if photo is None or not (mask := album.ids(name) == hit.instance_id).any():
        return None
    picture = outline(photo, mask)
    if not cropped:
        return picture
    x0, y0, x1, y1 = expand_box(mask_box(mask) or (0, 0, *mask.shape[::-1]), 0.15, *mask.shape[::-1])
    return picture[y0:y1, x0:x1]


def _changes(opened: QueryMap, album: _Album) -> dict[str, Any]:
    """What changed since the visit before the newest, with photos of the spots from before and after; {} for a map of
    one visit."""
    if not opened.newest_visit:
        return {}
    since = opened.newest_visit - 1
    title, rows, rest = changes_parts(opened, since, names_of(opened))
    entries, shown = {entry["id"]: entry for entry in opened.record.instances}, []
    for change, cells in rows:
        entry = entries[change["instance_id"]]
        then = stood(entry, since) or entry
        pictures = album.spot(then["obb"], 0, since), album.spot(entry["obb"], since + 1, opened.newest_visit)
        shown.append({"id": entry["id"], "pictures": pictures, "cells": cells})
    return {"title": title, "rows": shown, "rest": rest}


def _instance_rows(opened: QueryMap, album: _Album) -> list[dict[str, Any]]:
    """Every instance with its best crop, printed texts and likely names; names need an encoder."""
    names = opened.likely_names() if opened.problem is None else [[] for _ in opened.instances]
    return [
        {
            "id": entry["id"],
            "crop": _best_picture(opened, i, album, cropped=True),
            "label": entry.get("label"),
            "names": printed_texts(entry)[:2] + names[i],
            "score": entry["score"],
            "extent": entry["obb"]["extent"],
            "num_gaussians": entry["num_gaussians"],
        }
        for i, entry in enumerate(opened.instances)
    ]


def _query_row(opened: QueryMap, text: str, hits: list[Hit], album: _Album) -> dict[str, Any]:
    picture = _best_picture(opened, opened.position(hits[0].instance_id), album, cropped=False) if hits else None
    return {"text": text, "hits": [(hit.instance_id, hit.score) for hit in hits], "picture": picture}
