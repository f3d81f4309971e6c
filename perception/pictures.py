"""Small pictures people look at: instance colours, depth, errors, outlines, montages. Images are [H, W, 3]
uint8 RGB."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from perception.boxes import BOX_EDGES, box_corners
from perception.colors import instance_palette
from perception.types import OrientedBox


def colorize_instances(ids: np.ndarray) -> np.ndarray:
    """Instance ids [H, W] (-1 = none) -> picture."""
    present, inverse = np.unique(ids, return_inverse=True)
    return instance_palette(present)[inverse.reshape(ids.shape)]


def _colormap(level: np.ndarray, name: int) -> np.ndarray:
    return cv2.applyColorMap(np.round(255 * level).astype(np.uint8), name)[..., ::-1].copy()


def error_map(a: np.ndarray, b: np.ndarray, full: float = 0.25) -> np.ndarray:
    """Where two pictures (uint8, or float in [0, 1]) differ: black = equal, bright = `full` or more (of 1)."""
    if a.shape != b.shape:
        raise ValueError(f"error_map: pictures of shapes {a.shape} and {b.shape}; they must agree")
    difference = np.abs(_unit(a) - _unit(b)).mean(-1)
    return _colormap(np.clip(difference / full, 0, 1), cv2.COLORMAP_INFERNO)


def _unit(picture: np.ndarray) -> np.ndarray:
    return picture.astype(np.float32) / 255 if picture.dtype == np.uint8 else picture.astype(np.float32)


def overlay(photo: np.ndarray, ids: np.ndarray, alpha: float = 0.55) -> np.ndarray:
    """Instance colours laid over a photo with a thin border between instances; -1 leaves the photo as it is."""
    tinted = (1 - alpha) * photo + alpha * colorize_instances(ids)
    out = np.where((ids >= 0)[..., None], tinted, photo)
    out[_borders(ids)] = 255
    return np.round(out).astype(np.uint8)


def _borders(ids: np.ndarray) -> np.ndarray:
    edge = np.zeros(ids.shape, bool)
    edge[:, 1:] |= ids[:, 1:] != ids[:, :-1]
    edge[1:] |= ids[1:] != ids[:-1]
    return edge


def outline(
    photo: np.ndarray, mask: np.ndarray, color: tuple[int, int, int] = (255, 64, 160), thickness: int = 2
) -> np.ndarray:
    """A copy of the photo with the boundary of mask [H, W] bool drawn, everything outside it dimmed."""
    out = np.where(mask[..., None], photo, np.round(photo * 0.55)).astype(np.uint8)
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.ascontiguousarray(out), contours, -1, color, thickness, cv2.LINE_AA)


def draw_boxes(
    image: np.ndarray,
    boxes: Mapping[int, OrientedBox],
    K: np.ndarray,
    camera_from_world: np.ndarray,
    depth: np.ndarray | None = None,
    names: Mapping[int, str] | None = None,
) -> np.ndarray:
    """A copy of a view's picture with the edges of boxes (by instance id, in the world frame) in instance colours.

    K [3, 3], pixel centres at +0.5; camera_from_world [4, 4]. depth [H, W], 0 = unknown: edges behind it are drawn
    thin. names: written beside the box.
    """
    out = np.ascontiguousarray(image).copy()
    colors = instance_palette(list(boxes))
    for color, (i, box) in zip(colors.tolist(), boxes.items(), strict=True):
        corners = box_corners(box) @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
        for a, b in BOX_EDGES:
            _draw_edge(out, corners[a], corners[b], K, depth, color)
        if names is not None and corners[:, 2].min() > 0:
            pixels = corners @ K.T
            u, v = (pixels[:, :2] / pixels[:, 2:])[(pixels[:, 1] / pixels[:, 2]).argmin()]
            place = (int(np.clip(u, 2, out.shape[1] - 20)), int(np.clip(v - 4, 10, out.shape[0] - 2)))
            cv2.putText(out, names[i], place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 3, cv2.LINE_AA)
            cv2.putText(out, names[i], place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, color, 1, cv2.LINE_AA)
    return out


def _draw_edge(
    out: np.ndarray, a: np.ndarray, b: np.ndarray, K: np.ndarray, depth: np.ndarray | None, color: Sequence[int]
) -> None:
    """One edge between camera points, in short pieces so that what is hidden can be told piece by piece."""
    steps = np.linspace(0, 1, 33)[:, None]
    points = a * (1 - steps) + b * steps
    pixels = points @ K.T
    for start, end in zip(range(32), range(1, 33), strict=True):
        if min(points[start, 2], points[end, 2]) <= 1e-6:
            continue
        (x0, y0), (x1, y1) = pixels[start, :2] / pixels[start, 2], pixels[end, :2] / pixels[end, 2]
        if max(abs(x0), abs(y0), abs(x1), abs(y1)) > 1e5:  # beyond what OpenCV's fixed point can hold
            continue
        hidden = False
        x, y = int((x0 + x1) / 2), int((y0 + y1) / 2)
        if depth is not None and 0 <= y < out.shape[0] and 0 <= x < out.shape[1]:
            middle = (points[start, 2] + points[end, 2]) / 2
            hidden = bool(0 < depth[y, x] < 0.98 * middle)
        ends = [(round((x0 - 0.5) * 16), round((y0 - 0.5) * 16)), (round((x1 - 0.5) * 16), round((y1 - 0.5) * 16))]
        weight = [c * 0.7 for c in color] if hidden else color
        cv2.line(out, ends[0], ends[1], weight, 1 if hidden else 2, cv2.LINE_AA, shift=4)


def features_to_rgb(features: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """Features [..., D] -> colours [..., 3] uint8: their first three principal components, stretched to 1-99 %.

    mask [...]: which entries decide the axes and the stretch (default all); the sign of an axis is made definite.
    """
    flat = features.reshape(-1, features.shape[-1]).astype(np.float64)
    basis = flat if mask is None or not mask.any() else flat[mask.ravel()]
    center = basis.mean(0)
    _, axes = np.linalg.eigh(np.cov((basis - center).T).reshape(flat.shape[1], -1))
    axes = axes[:, ::-1][:, :3]
    strongest = np.abs(axes).argmax(0)
    axes = axes * np.sign(axes[strongest, np.arange(axes.shape[1])])
    low, high = np.percentile((basis - center) @ axes, [1, 99], axis=0)
    level = np.clip(((flat - center) @ axes - low) / np.maximum(high - low, 1e-12), 0, 1)
    level = np.pad(level, ((0, 0), (0, 3 - level.shape[1])), constant_values=0.5)
    return np.round(255 * level).astype(np.uint8).reshape(*features.shape[:-1], 3)


def montage(
    images: Sequence[np.ndarray], columns: int, titles: Sequence[str] | None = None, gap: int = 6
) -> np.ndarray:
    """Pictures in a grid on white, each scaled to the size of the first, a small title above each."""
    if not images:
        raise ValueError("montage: no images")
    height, width = images[0].shape[:2]
    head = 22 if titles else 0
    rows = -(-len(images) // columns)
    sheet = np.full((rows * (height + head + gap) + gap, columns * (width + gap) + gap, 3), 255, np.uint8)
    for i, image in enumerate(images):
        y, x = gap + (i // columns) * (height + head + gap), gap + (i % columns) * (width + gap)
        if titles and i < len(titles):
            _title(sheet[y : y + head, x : x + width], titles[i])
        if image.shape[:2] != (height, width):
            image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        sheet[y + head : y + head + height, x : x + width] = image
    return sheet


def _title(strip: np.ndarray, text: str) -> None:
    """Writes text into a strip of a picture, in place."""
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(strip)
    ImageDraw.Draw(image).text(
        (2, strip.shape[0] // 2), text, fill=(40, 40, 40), anchor="lm", font=ImageFont.load_default(size=14)
    )
    strip[:] = np.asarray(image)
