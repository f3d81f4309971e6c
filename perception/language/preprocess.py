"""Image preprocessing of the CLIP family: size, resize mode, filter, mean and standard deviation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from perception.errors import InputError
from perception.onnx.sessions import read_config

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


@dataclass(frozen=True)
class Family:
    """A family of models. preprocess: that of all its models; None: it must stand in a file beside the model.

    canonical: texts are lower case without punctuation (SigLIP). pooled: `pooler_output` is the embedding; for CLIP it
    is the state before the projection.
    """

    name: str
    preprocess: Preprocess | None = None
    canonical: bool = False
    pooled: bool = False


CLIP_FAMILY = Family("CLIP")
# Names of the model in `config.json` (`model_type` of transformers, names of timm in open_clip's) -> family.
FAMILIES = {
    "siglip": Family("SigLIP", SIGLIP, canonical=True, pooled=True),
    "fastvit_mci": Family("MobileCLIP", MOBILECLIP),
    "mobileclip": Family("MobileCLIP", MOBILECLIP),
    "pe_core": Family("PE-Core"),
    "clip": CLIP_FAMILY,
}
_HINT = "preprocessor_config.json, preprocess_cfg.json or open_clip_config.json"


def find_preprocess(model: Path, input_side: int | None) -> Preprocess:
    """Preprocessing from the config files beside a model, else its family's. input_side: the model's, if fixed.

    InputError if neither is known: guessed normalisation gives wrong embeddings that look right.
    """
    family = family_of(model)
    known = _from_configs(model) or (family and family.preprocess)
    if not known:
        raise InputError(
            f"{model}: its preprocessing is not known; put the model's own {_HINT} beside it or into the folder above"
        )
    return replace(known, size=input_side) if input_side else known


def family_of(model: Path) -> Family | None:
    """The family that the config files beside a model name; None if they name none. Names of folders do not count."""
    known = {**read_config(model, "config.json"), **read_config(model, "open_clip_config.json").get("model_cfg", {})}
    vision, text = known.get("vision_cfg") or {}, known.get("text_cfg") or {}
    named = [vision.get("timm_model_name"), known.get("model_type"), text.get("hf_tokenizer_name")]
    names = " ".join(str(name) for name in named if name).lower()
    if vision and not vision.get("timm_model_name"):
        names += " clip"  # open_clip's own vision transformers and ResNets
    return next((family for key, family in FAMILIES.items() if key in names), CLIP_FAMILY if vision else None)


def _from_configs(model: Path) -> Preprocess | None:
    """From transformers' `preprocessor_config.json` or open_clip's `preprocess_cfg` (own file, or in the config)."""
    hugging = read_config(model, "preprocessor_config.json")
    if "image_mean" in hugging or "size" in hugging:
        return _from_transformers(model, hugging)
    own = read_config(model, "preprocess_cfg.json")
    described = own or read_config(model, "open_clip_config.json").get("preprocess_cfg", {})
    if not {"size", "mean", "std"} <= set(described):
        return None
    size = described["size"]
    sides = set(size) if isinstance(size, list) else {size}
    mode, filtering = described.get("resize_mode", "shortest"), described.get("interpolation", "bicubic")
    return _checked(model, sides, mode, filtering, described["mean"], described["std"])


def _from_transformers(model: Path, config: dict[str, Any]) -> Preprocess:
    crop = config.get("crop_size") if config.get("do_center_crop") else None
    size = crop or config.get("size", 224)
    squash = isinstance(config.get("size"), dict) and "height" in config["size"] and not config.get("do_center_crop")
    named = size if isinstance(size, dict) else {"height": size}
    sides = {named[key] for key in ("height", "width", "shortest_edge") if key in named}
    plain = not config.get("do_normalize", True)
    mean, std = config.get("image_mean", CLIP.mean), config.get("image_std", CLIP.std)
    filtering = {2: "bilinear", 3: "bicubic"}.get(config.get("resample", 3), str(config.get("resample")))
    mode = "squash" if squash else "shortest"
    return _checked(model, sides, mode, filtering, (0, 0, 0) if plain else mean, (1, 1, 1) if plain else std)


def _checked(model: Path, sides: set[Any], mode: Any, filtering: Any, mean: Any, std: Any) -> Preprocess:
    """InputError for what is not done here: pictures that are not square, other filters, padding."""
    if len(sides) != 1 or mode not in ("shortest", "squash") or filtering not in ("bicubic", "bilinear"):
        raise InputError(
            f"{model}: its preprocessing is sides {sorted(sides)}, resize '{mode}', filter '{filtering}'; "
            "supported are squares, shortest or squash, and bicubic or bilinear"
        )
    return Preprocess(int(sides.pop()), mode, filtering, _triple(mean), _triple(std))


def _triple(values: Any) -> Triple:
    if not isinstance(values, (list, tuple)) or len(values) != 3:
        raise InputError(f"preprocessing: expected three numbers (red, green, blue), found {values!r}")
    return float(values[0]), float(values[1]), float(values[2])
