"""PSNR and SSIM between images."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from perception.errors import InputError
from perception.photos.decode import read_picture

_SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"}
WINDOW = 11  # pixels a side

PROTOCOL = {
    "psnr": "10 log10(1 / mean squared error), RGB in [0, 1], all pixels",
    "ssim": "Wang et al. 2004: Gaussian window 11x11, sigma 1.5, K .01 .03, biased covariance, channel mean",
    "ssim_padding": "valid (windows wholly inside the picture, as scikit-image and torchmetrics)",
    "missing_prediction": "psnr 0, ssim 0",
    "mean": "over views",
}


def psnr(prediction: np.ndarray, truth: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB of images [H, W, 3] in [0, 1]; infinite when they are equal."""
    error = float(np.mean((prediction.astype(np.float64) - truth) ** 2))
    return math.inf if error == 0 else -10 * math.log10(error)


def ssim(prediction: np.ndarray, truth: np.ndarray, weight: np.ndarray | None = None) -> float:
    """Structural similarity of images [H, W, 3] in [0, 1] (Wang et al. 2004, equation 13), mean over channels.

    Equal to scikit-image's with the paper's parameters: Gaussian window of 11 × 11 pixels, σ = 1.5, K1 = 0.01, K2 =
    0.03, biased covariances, mean over windows that lie completely inside the image, weighted by weight [H, W] of their
    centres. The training loss and its curve differ: they pad with zeros, as 3DGS does. Raises InputError for images
    smaller than the window.
    """
    from skimage.metrics import structural_similarity

    if min(prediction.shape[:2]) < WINDOW:
        height, width = prediction.shape[:2]
        raise InputError(f"pictures are {width}x{height} pixels; SSIM needs at least {WINDOW} a side")
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "K1": 0.01, "K2": 0.03}
    pictures64 = [np.asarray(image, np.float64) for image in (prediction, truth)]
    mean, windows = structural_similarity(*pictures64, data_range=1.0, channel_axis=2, full=True, **options)
    inside = slice(WINDOW // 2, -(WINDOW // 2))
    if weight is None or not weight[inside, inside].any():
        return float(mean)
    return float(np.average(windows.mean(axis=2)[inside, inside], weights=weight[inside, inside]))


def read_rgb(path: Path) -> np.ndarray:
    """An image as [H, W, 3] float64 in [0, 1]. 8 or 16 bit; grey is repeated to 3 channels, alpha is dropped."""
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    image = read_picture(path, path, "8 or 16 bit picture", flags)
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path}: holds {image.dtype}, expected an 8 or 16 bit picture")
    return image[..., ::-1] / (255.0 if image.dtype == np.uint8 else 65535.0)


def pictures(folder: str | Path) -> dict[str, Path]:
    """Images below a folder, keyed by relative path without suffix."""
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: is no folder; expected a folder of pictures")
    found: dict[str, Path] = {}
    for path in sorted(p for p in folder.rglob("*") if p.suffix.lower() in _SUFFIXES):
        stem = path.relative_to(folder).with_suffix("").as_posix()
        if stem in found:
            raise InputError(f"{folder}: two pictures share the stem '{stem}' ({found[stem].name}, {path.name})")
        found[stem] = path
    return found


def evaluate_images(prediction_dir: str | Path, truth_dir: str | Path) -> dict[str, Any]:
    """PSNR and SSIM of each reference image and their means. Images are paired by stem; a missing one scores 0."""
    predictions, truths = pictures(prediction_dir), pictures(truth_dir)
    if not truths:
        raise InputError(f"{truth_dir}: holds no pictures")
    views: dict[str, dict[str, Any]] = {}
    for stem, path in truths.items():
        if stem not in predictions:
            views[stem] = {"psnr": 0.0, "ssim": 0.0, "missing": True}
            continue
        predicted, true = read_rgb(predictions[stem]), read_rgb(path)
        if predicted.shape != true.shape:
            raise InputError(
                f"{predictions[stem]}: is {predicted.shape[1]}x{predicted.shape[0]} pixels, the truth {path} "
                f"is {true.shape[1]}x{true.shape[0]}; render at the truth's size"
            )
        views[stem] = {"psnr": min(psnr(predicted, true), 100.0), "ssim": ssim(predicted, true), "missing": False}
    return {
        **{name: float(np.mean([view[name] for view in views.values()])) for name in ("psnr", "ssim")},
        "views": views,
        "num_views": len(views),
        "missing": [stem for stem, v in views.items() if v["missing"]],
        "without_truth": sorted(predictions.keys() - truths.keys()),
        "protocol": PROTOCOL | {"psnr_of_equal_pictures": 100.0},
    }


def run_images(prediction_dir: str | Path, truth_dir: str | Path) -> tuple[dict[str, Any], str]:
    """PSNR and SSIM of a folder of rendered images against the reference images: (result, table)."""
    result = evaluate_images(prediction_dir, truth_dir)
    width = max([len(name) for name in result["views"]] + [4]) + 2
    lines = [f"{'view':<{width}}{'PSNR':>8}{'SSIM':>8}"]
    for name, view in result["views"].items():
        note = "  missing" if view["missing"] else ""
        lines.append(f"{name:<{width}}{view['psnr']:>8.2f}{view['ssim']:>8.4f}{note}")
    lines.append(f"{'mean':<{width}}{result['psnr']:>8.2f}{result['ssim']:>8.4f}")
    return result, "\n".join(lines)
