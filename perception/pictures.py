"""Visualisation images: instance colours, depth, errors, outlines, rows, crops. Images are [H, W, 3] uint8 RGB."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from perception.colors import instance_palette

MARGIN = 0.15  # margin around a bounding box that is cut out, as a share of its longer side


def error_map(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Mean difference of two images [H, W, 3] uint8: black = none, brightest = a quarter of the range or more."""
    difference = np.abs(a.astype(np.float32) / 255 - b.astype(np.float32) / 255).mean(-1)
    level = np.round(255 * np.clip(difference / 0.25, 0, 1)).astype(np.uint8)
    return cv2.applyColorMap(level, cv2.COLORMAP_INFERNO)[..., ::-1].copy()


def overlay(photo: np.ndarray, ids: np.ndarray, alpha: float = 0.55) -> np.ndarray:
    """A photo overlaid with instance colours and thin borders between instances; at -1 the photo is unchanged."""
    present, inverse = np.unique(ids, return_inverse=True)
    tinted = (1 - alpha) * photo + alpha * instance_palette(present)[inverse.reshape(ids.shape)]
    out = np.where((ids >= 0)[..., None], tinted, photo)
    out[:, 1:][ids[:, 1:] != ids[:, :-1]] = 255
    out[1:][ids[1:] != ids[:-1]] = 255
    return np.round(out).astype(np.uint8)


def outline(photo: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """A copy of the photo with the boundary of mask [H, W] bool drawn, everything outside it dimmed."""
    out = np.where(mask[..., None], photo, np.round(photo * 0.55)).astype(np.uint8)
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.ascontiguousarray(out), contours, -1, (255, 64, 160), 2, cv2.LINE_AA)


def features_to_rgb(features: np.ndarray) -> np.ndarray:
    """Features [..., D] -> colours [..., 3] uint8: their first three principal components, of unique signs, stretched
    to 1-99 %."""
    flat = features.reshape(-1, features.shape[-1]).astype(np.float64)
    center = flat.mean(0)
    _, axes = np.linalg.eigh(np.cov((flat - center).T, ddof=0).reshape(flat.shape[1], -1))
    axes = axes[:, ::-1][:, :3]
    strongest = np.abs(axes).argmax(0)
    axes = axes * np.sign(axes[strongest, np.arange(axes.shape[1])])
    low, high = np.percentile((flat - center) @ axes, [1, 99], axis=0)
    level = np.clip(((flat - center) @ axes - low) / np.maximum(high - low, 1e-12), 0, 1)
    level = np.pad(level, ((0, 0), (0, 3 - level.shape[1])), constant_values=0.5)
    return np.round(255 * level).astype(np.uint8).reshape(*features.shape[:-1], 3)


def titled_row(images: Sequence[np.ndarray], titles: Sequence[str]) -> np.ndarray:
    """Images of one size side by side on white, with a title above each."""
    from PIL import Image, ImageDraw, ImageFont

    (height, width), gap, head = images[0].shape[:2], 6, 22
    sheet = Image.new("RGB", (len(images) * (width + gap) + gap, height + head + 2 * gap), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=14)
    for k, (image, title) in enumerate(zip(images, titles, strict=True)):
        x = gap + k * (width + gap)
        draw.text((x + 2, gap + head // 2), title, fill=(40, 40, 40), anchor="lm", font=font)
        sheet.paste(Image.fromarray(image), (x, gap + head))
    return np.asarray(sheet)


def cut_out(picture: np.ndarray, box: tuple[int, int, int, int], side: int) -> np.ndarray | None:
    """The box (x0, y0, x1, y1) of a picture [H, W, 3] with a margin, longer side at most `side`; None outside of it."""
    x0, y0, x1, y1 = box
    margin = 2 + round(MARGIN * max(x1 - x0, y1 - y0))
    top, left = max(0, y0 - margin), max(0, x0 - margin)
    cut = picture[top : y1 + margin, left : x1 + margin]
    if not cut.size:
        return None
    height, width = cut.shape[:2]
    scale = min(1.0, side / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return cut if scale == 1 else np.asarray(cv2.resize(cut, size, interpolation=cv2.INTER_AREA))
