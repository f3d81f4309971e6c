"""PSNR and SSIM between pictures."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from perception.errors import InputError

_SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"}
_C1, _C2 = 0.01**2, 0.03**2  # Wang et al. 2004, for a data range of 1
_WINDOW, _SIGMA = 11, 1.5

PROTOCOL = {
    "psnr": "10 log10(1 / mean squared error), RGB in [0, 1], all pixels",
    "ssim": "Wang et al. 2004: Gaussian window 11x11, sigma 1.5, K .01 .03, biased covariance, channel mean",
    "ssim_padding": "valid (windows wholly inside the picture, as scikit-image and torchmetrics)",
    "missing_prediction": "psnr 0, ssim 0",
    "mean": "over views",
}


def psnr(prediction: np.ndarray, truth: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB of pictures [H, W, 3] in [0, 1]; infinite when they are equal."""
    error = float(np.mean((prediction.astype(np.float64) - truth) ** 2))
    return math.inf if error == 0 else -10 * math.log10(error)


def ssim(prediction: np.ndarray, truth: np.ndarray, padding: str = "valid") -> float:
    """Structural similarity of pictures [H, W, 3] in [0, 1] (Wang et al. 2004, equation 13), mean over
    channels.

    padding "valid": only windows inside the picture; "same": zeros beyond the border, as 3DGS trains and
    reports.
    """
    x, y = (np.asarray(image, np.float64) for image in (prediction, truth))
    if min(x.shape[:2]) < _WINDOW:
        raise InputError(f"pictures are {x.shape[1]}x{x.shape[0]} pixels; SSIM needs at least {_WINDOW} a side")
    border = {"valid": cv2.BORDER_REFLECT, "same": cv2.BORDER_CONSTANT}[padding]
    taps = cv2.getGaussianKernel(_WINDOW, _SIGMA, cv2.CV_64F)

    def blur(image: np.ndarray) -> np.ndarray:
        return cv2.sepFilter2D(image, cv2.CV_64F, taps, taps, borderType=border)

    mx, my = blur(x), blur(y)
    vx, vy, vxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    value = (2 * mx * my + _C1) * (2 * vxy + _C2) / ((mx * mx + my * my + _C1) * (vx + vy + _C2))
    if padding == "valid":
        half = _WINDOW // 2
        value = value[half:-half, half:-half]
    return float(value.mean())


def read_rgb(path: Path) -> np.ndarray:
    """A picture as [H, W, 3] float64 in [0, 1]; 8 or 16 bit, grey is repeated, alpha is dropped."""
    raw = cv2.imdecode(np.frombuffer(path.read_bytes() or b"\0", np.uint8), cv2.IMREAD_UNCHANGED)
    if raw is None or raw.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path}: is not a readable 8 or 16 bit picture")
    image = raw[..., None] if raw.ndim == 2 else raw
    image = np.repeat(image[..., :1], 3, axis=2) if image.shape[2] < 3 else image[..., 2::-1]
    return image / (255.0 if raw.dtype == np.uint8 else 65535.0)


def pictures(folder: str | Path) -> dict[str, Path]:
    """Pictures below a folder by relative path without suffix."""
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
    """PSNR and SSIM of each true picture and their means; pictures are paired by stem, a missing one scores
    0.
    """
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
        views[stem] = {
            "psnr": min(psnr(predicted, true), 100.0),
            "ssim": ssim(predicted, true),
            "missing": False,
        }
    return {
        "psnr": float(np.mean([v["psnr"] for v in views.values()])),
        "ssim": float(np.mean([v["ssim"] for v in views.values()])),
        "views": views,
        "num_views": len(views),
        "missing": [stem for stem, v in views.items() if v["missing"]],
        "without_truth": sorted(predictions.keys() - truths.keys()),
        "protocol": PROTOCOL | {"psnr_of_equal_pictures": 100.0},
    }
