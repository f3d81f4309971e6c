"""Image preprocessing of the CLIP family: size, resize mode, filter, mean and standard deviation."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from perception.errors import InputError

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Preprocess:
    """Resizes to `size` (shortest edge with centre crop, or directly to a square), scales to [0, 1], normalises."""

    size: int = 224
    mode: Literal["shortest", "squash"] = "shortest"
    resample: Literal["bicubic", "bilinear"] = "bicubic"
    mean: Triple = (0.48145466, 0.4578275, 0.40821073)
    std: Triple = (0.26862954, 0.26130258, 0.27577711)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """RGB uint8 [H, W, 3] → float32 [3, size, size]."""
        from PIL import Image

        height, width = image.shape[:2]
        resample = Image.Resampling.BICUBIC if self.resample == "bicubic" else Image.Resampling.BILINEAR
        picture = Image.fromarray(image)
        if self.mode == "squash":
            picture = picture.resize((self.size, self.size), resample)
        else:
            scale = self.size / min(height, width)
            # Both reference pipelines round the long side down.
            size = [self.size if side == min(height, width) else int(scale * side) for side in (width, height)]
            picture = picture.resize((size[0], size[1]), resample)
            left, top = (size[0] - self.size) // 2, (size[1] - self.size) // 2
            picture = picture.crop((left, top, left + self.size, top + self.size))
        pixels = np.asarray(picture, np.float32) / 255.0
        normal = (pixels - np.array(self.mean, np.float32)) / np.array(self.std, np.float32)
        return np.ascontiguousarray(normal.transpose(2, 0, 1))

    def __str__(self) -> str:
        mean = ",".join(f"{m:.4g}" for m in self.mean)
        return f"{self.mode}{self.size}-{self.resample}-{mean}-{','.join(f'{s:.4g}' for s in self.std)}"


CLIP = Preprocess()
SIGLIP = Preprocess(mode="squash", mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5))
MOBILECLIP = Preprocess(size=256, resample="bilinear", mean=(0.0, 0.0, 0.0), std=(1.0, 1.0, 1.0))


def find_preprocess(model: Path, input_side: int | None) -> Preprocess:
    """Preprocessing from config files next to a model, else from its name. input_side: the model's, if fixed."""
    found = _from_configs(model) or _from_name(model)
    return replace(found, size=input_side) if input_side else found


def family_of(model: Path) -> str:
    """ "siglip", "mobileclip" or "clip", from the names of the file and its two parent folders, or from config.json."""
    names = " ".join([model.name, *(parent.name for parent in list(model.parents)[:2])]).lower()
    config = read_config(model, "config.json")
    names += " " + str(config.get("model_type", "")).lower()
    if "siglip" in names:
        return "siglip"
    return "mobileclip" if "mobileclip" in names.replace("-", "").replace("_", "") else "clip"


def read_config(model: Path, name: str) -> dict[str, Any]:
    """A JSON file in the model's folder or its parent (exports often lie in `onnx/`); {} if there is none."""
    for folder in (model.parent, model.parent.parent):
        path = folder / name
        if path.is_file():
            try:
                known = json.loads(path.read_text(encoding="utf-8"))
            except ValueError as error:
                raise InputError(f"{path}: not valid JSON ({error})") from error
            return known if isinstance(known, dict) else {}
    return {}


def _from_name(model: Path) -> Preprocess:
    return {"siglip": SIGLIP, "mobileclip": MOBILECLIP, "clip": CLIP}[family_of(model)]


def _from_configs(model: Path) -> Preprocess | None:
    hugging = read_config(model, "preprocessor_config.json")
    if "image_mean" in hugging or "size" in hugging:
        return _from_transformers(hugging)
    described = read_config(model, "open_clip_config.json").get("preprocess_cfg")
    if described is not None:
        base = _from_name(model)
        size = described.get("size", base.size)
        return Preprocess(
            size=int(size[0] if isinstance(size, list) else size),
            mode="squash" if described.get("resize_mode", base.mode) == "squash" else "shortest",
            resample="bilinear" if described.get("interpolation", base.resample) == "bilinear" else "bicubic",
            mean=_triple(described.get("mean", base.mean)),
            std=_triple(described.get("std", base.std)),
        )
    return None


def _from_transformers(config: dict[str, Any]) -> Preprocess:
    size = config.get("crop_size") if config.get("do_center_crop") else None
    size = size or config.get("size", 224)
    squash = isinstance(config.get("size"), dict) and "height" in config["size"] and not config.get("do_center_crop")
    if isinstance(size, dict):
        size = size.get("height") or size.get("shortest_edge") or 224
    normalise = config.get("do_normalize", True)
    return Preprocess(
        size=int(size),
        mode="squash" if squash else "shortest",
        resample="bilinear" if config.get("resample", 3) == 2 else "bicubic",
        mean=_triple(config.get("image_mean", CLIP.mean)) if normalise else (0.0, 0.0, 0.0),
        std=_triple(config.get("image_std", CLIP.std)) if normalise else (1.0, 1.0, 1.0),
    )


def _triple(values: Any) -> Triple:
    if not isinstance(values, (list, tuple)) or len(values) != 3:
        raise InputError(f"preprocessing: expected three numbers (red, green, blue), found {values!r}")
    return float(values[0]), float(values[1]), float(values[2])
