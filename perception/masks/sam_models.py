"""Segment Anything exports with separate encoder and decoder, recognised by the names of their inputs and outputs.

Exporters and the names they use: segment-anything and samexporter (SAM, MobileSAM), EdgeSAM, EfficientSAM, transformers
and optimum (SAM, SlimSAM, SAM 2 and 2.1), samexporter, onnxruntime and osam (SAM 2). `FAMILIES` lists the differences.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from perception.errors import InputError, home_path
from perception.onnx import sessions
from perception.onnx.store import known_names, resolve

# Role -> names of it in public exporters. Masks at low resolution come first: some exports fix the photo size that they
# were traced with, or give no logits at full size.
_NAMES = {
    "image": "input_image image batched_images pixel_values x input images",
    "embedding": "image_embeddings image_embed image_embedding embeddings image_embeddings.2",
    "high_res_0": "high_res_feats_0 high_res_feat_0 high_res_features1 image_features_0 image_embeddings.0",
    "high_res_1": "high_res_feats_1 high_res_feat_1 high_res_features2 image_features_1 image_embeddings.1",
    "positional": "image_positional_embeddings",
    "points": "point_coords batched_point_coords input_points",
    "labels": "point_labels batched_point_labels input_labels",
    "boxes": "input_boxes",
    "mask_input": "mask_input input_masks",
    "has_mask": "has_mask_input has_input_masks",
    "size": "orig_im_size original_image_size",
    "masks": "low_res_masks pred_masks masks output_masks",
    "iou": "iou_predictions iou_scores iou_preds scores",
}
_ROLES = {name: role for role, names in reversed(_NAMES.items()) for name in names.split()}
_MEAN, _STD = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)  # ImageNet's, RGB in 0–255


@dataclass(frozen=True)
class Family:
    """What the exports of a family have in common.

    fit: the photo in the encoder's input: "pad" (long side fills the square, padded bottom and right), "squash" (both
    sides do) or "own size" (in 0–1, and prompts in its pixels). nested: prompts are [1, P, 1, 2], else
    [P, n, 2]. pads: a point prompt is followed by the point (0, 0) with label −1, as in the published predictor; the
    others' decoders add it themselves.
    """

    name: str
    fit: str = "pad"
    nested: bool = False
    pads: bool = False


# (an input of the decoder, whether it takes high-resolution features) -> family
FAMILIES = {
    ("point_coords", False): Family("SAM", pads=True),
    ("point_coords", True): Family("SAM 2", "squash"),
    ("batched_point_coords", False): Family("EfficientSAM", "own size", nested=True),
    ("input_points", False): Family("SAM by Hugging Face", nested=True),
    ("input_points", True): Family("SAM 2 by Hugging Face", "squash", nested=True),
}


@dataclass(frozen=True)
class Graph:
    """An opened ONNX file with its inputs and outputs by role."""

    path: Path
    session: Any
    inputs: dict[str, Any]
    outputs: dict[str, str]

    @property
    def is_decoder(self) -> bool:
        return "points" in self.inputs and "embedding" in self.inputs

    @property
    def is_encoder(self) -> bool:
        return "image" in self.inputs and "embedding" in self.outputs and "points" not in self.inputs

    def run(self, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Runs the graph. values: inputs by role, cast to the graph's dtypes. Returns the outputs by role."""
        import onnxruntime

        feeds: dict[str, np.ndarray] = {
            x.name: values[role].astype(sessions.dtype_of(x), copy=False) for role, x in self.inputs.items()
        }
        options = onnxruntime.RunOptions()
        options.only_execute_path_to_fetches = True  # no masks at the photo's size when those at low resolution do
        results = sessions.run_graph(self.path, self.session, list(self.outputs.values()), feeds, options)
        return dict(zip(self.outputs, results, strict=True))


@dataclass(frozen=True)
class Encoded:
    """size, used, canvas: (h, w) of the photo, of the photo in the input, of the input; scale: (x, y) used / size."""

    tensors: dict[str, np.ndarray]
    size: tuple[int, int]
    scale: tuple[float, float]
    used: tuple[int, int]
    canvas: tuple[int, int]


class SamModel:
    """An encoder and a matching decoder. batched: whether the decoder takes several point prompts per call."""

    def __init__(self, encoder: Graph, decoder: Graph) -> None:
        self.encoder, self.decoder = encoder, decoder
        self.kind = decoder_family(decoder)
        self.family = self.kind.name
        _check_pair(encoder, decoder)
        self.fingerprint = f"{sessions.fingerprint(encoder.path)}-{sessions.fingerprint(decoder.path)}"
        self.provider = " + ".join(dict.fromkeys(g.session.get_providers()[0] for g in (encoder, decoder)))
        self.warnings = list(filter(None, (sessions.provider_warning(g.path, g.session) for g in (encoder, decoder))))
        config = sessions.read_config(encoder.path, "preprocessor_config.json")
        self._mean, self._std = (
            np.asarray(config[key], np.float32) * 255 if config.get(key) else np.asarray(usual, np.float32)
            for key, usual in (("image_mean", _MEAN), ("image_std", _STD))
        )
        self.batched = self._probe()

    def encode(self, photo: np.ndarray) -> Encoded:
        """photo: [h, w, 3] uint8 RGB."""
        h, w = photo.shape[:2]
        image, used, canvas = self._prepare(photo)
        tensors = self.encoder.run({"image": image})
        return Encoded(tensors, (h, w), (used[1] / w, used[0] / h), used, canvas)

    def decode(self, embedding: Encoded, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """points: [P, 2] (x, y) in photo pixels. Raw masks [P, m, ?, ?] and predicted IoU [P, m], float32."""
        if self.batched:
            return self._decode(embedding, points)
        parts = [self._decode(embedding, points[i : i + 1]) for i in range(len(points))]
        return np.concatenate([logits for logits, _ in parts]), np.concatenate([iou for _, iou in parts])

    def _probe(self) -> bool:
        """Whether two prompts of an empty embedding are answered in one call. Declared axes are not to be trusted.
        Warns of a decoder that gives one mask a prompt. InputError if the decoder does not run at all."""
        shapes = {role: sessions.shape_of(x) for role, x in self.decoder.inputs.items() if role in self.encoder.outputs}
        axis = 1 if self.kind.nested else 0
        fixed = sessions.shape_of(self.decoder.inputs["points"])[axis]
        if None in {size for shape in shapes.values() for size in shape[1:]}:
            return fixed is None
        tensors = {role: np.zeros([n or 1 for n in shape]) for role, shape in shapes.items()}
        side = 16 * tensors["embedding"].shape[-1]
        empty = Encoded(tensors, (side, side), (1.0, 1.0), (side, side), (side, side))
        points = np.full((2, 2), side / 2.0)
        for count in (2, 1)[fixed == 1 :]:
            try:
                _, iou = self._decode(empty, points[:count])
            except ValueError as error:
                if count == 1:
                    raise InputError(f"{self.decoder.path}: a point prompt fails ({error}); export it anew") from error
                continue
            if iou.shape[1] == 1:
                self.warnings.append(
                    f"{self.decoder.path.name}: gives one mask a prompt; the published masks need all three "
                    "(return_single_mask=False)"
                )
            break
        return count == 2

    def _prepare(self, photo: np.ndarray) -> tuple[np.ndarray, tuple[int, int], tuple[int, int]]:
        """The encoder's input, the (h, w) that the photo covers in it, and the input's (h, w)."""
        shape = sessions.shape_of(self.encoder.inputs["image"])
        if self.kind.fit == "own size":
            return photo.transpose(2, 0, 1)[None] / np.float32(255), photo.shape[:2], photo.shape[:2]
        raw = len(shape) == 3  # [h, w, 3] in 0–255, normalised by the graph
        height, width = (n or 1024 for n in (shape[:2] if raw else shape[2:]))
        used = (height, width)
        if self.kind.fit == "pad":
            ratio = min(height / photo.shape[0], width / photo.shape[1])
            used = (int(photo.shape[0] * ratio + 0.5), int(photo.shape[1] * ratio + 0.5))
        # Pillow's bilinear filter, with anti-aliasing, is the published predictor's.
        resized = np.asarray(Image.fromarray(photo).resize(used[::-1], Image.Resampling.BILINEAR), np.float32)
        if raw and shape[0] is None:
            return resized, used, used  # the graph pads internally
        padded = np.zeros((height, width, 3), np.float32)
        padded[: used[0], : used[1]] = resized if raw else (resized - self._mean) / self._std
        return (padded if raw else padded.transpose(2, 0, 1)[None]), used, (height, width)

    def _decode(self, embedding: Encoded, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values = {**embedding.tensors, **self._prompts(embedding, points)}
        result = self.decoder.run(values)
        masks, iou = result["masks"], result["iou"]
        if masks.shape[1 if self.kind.nested else 0] != len(points):
            raise ValueError(f"masks of shape {list(masks.shape)} for {len(points)} prompts")
        masks = masks.reshape(len(points), -1, *masks.shape[-2:]).astype(np.float32, copy=False)
        iou = iou.reshape(len(points), -1).astype(np.float32, copy=False)
        if iou.shape[1] == 4:  # index 0 is the output for several prompts, not for a single point
            masks, iou = masks[:, 1:], iou[:, 1:]
        return masks, iou

    def _prompts(self, embedding: Encoded, points: np.ndarray) -> dict[str, np.ndarray]:
        scaled = (points * np.array(embedding.scale)).astype(np.float32)[:, None]
        labels = np.ones((len(points), 1), np.float32)
        if self.kind.pads:
            scaled = np.concatenate([scaled, np.zeros_like(scaled)], axis=1)
            labels = np.concatenate([labels, -labels], axis=1)
        shapes = {role: sessions.shape_of(x) for role, x in self.decoder.inputs.items()}
        side = 4 * embedding.tensors["embedding"].shape[-1]
        prior = shapes.get("mask_input", [None, 1, None, None])
        # SAM's graph assumes that the long side fills the square. Encoders with a fixed non-square input differ.
        fills = max(embedding.used) == _square(embedding) == max(embedding.canvas)
        return {
            "points": scaled[None] if self.kind.nested else scaled,
            "labels": labels[None] if self.kind.nested else labels,
            "boxes": np.zeros((1, 0, 4)),
            "mask_input": np.zeros((prior[0] or len(points), 1, prior[2] or side, prior[3] or side)),
            # One flag for all prompts: exporters multiply by it as if it were a scalar.
            "has_mask": np.zeros(shapes.get("has_mask", [None])[0] or 1),
            "size": np.array(embedding.size if fills or self.kind.fit != "pad" else embedding.canvas),
        }

    def upscale(self, embedding: Encoded, raw: np.ndarray) -> np.ndarray:
        """raw: one mask as output by the graph. Returns logits [h, w] float32 at the photo's size."""
        import cv2

        height, width = embedding.size
        if raw.shape == (height, width):
            return raw
        if self.kind.fit == "pad":  # a quarter of the padded square; the photo covers its top left
            if raw.shape != embedding.canvas:
                side = _square(embedding)
                raw = cv2.resize(raw, (side, side), interpolation=cv2.INTER_LINEAR)
            raw = raw[: embedding.used[0], : embedding.used[1]]
        return cv2.resize(raw, (width, height), interpolation=cv2.INTER_LINEAR)


def open_sam(spec: str, threads: int = 0) -> SamModel:
    """spec: a folder with both graphs, an encoder file next to its decoder, `ENCODER,DECODER`, or a stored name.
    threads: of one run; 0: all cores."""
    spec = resolve(spec)
    paths = [home_path(part.strip()) for part in spec.split(",")] if "," in spec else sam_graphs(home_path(spec))
    graphs = [open_graph(path, threads) for path in paths]
    encoders, decoders = [g for g in graphs if g.is_encoder], [g for g in graphs if g.is_decoder]
    if len(encoders) == 1 and len(decoders) == 1:
        return SamModel(encoders[0], decoders[0])
    kinds = (
        "encoder" if g.is_encoder else "decoder" if g.is_decoder else sessions.signature(g.session) for g in graphs
    )
    roles = "; ".join(f"{g.path.name}: {kind}" for g, kind in zip(graphs, kinds, strict=True))
    what = f"expected one SAM encoder and its decoder, found {roles}"
    raise InputError(f"sam:{spec}: {what}; put both into one folder or write sam:ENCODER,DECODER")


def open_graph(path: Path, threads: int = 0) -> Graph:
    """Opens an ONNX file and assigns roles to its inputs and outputs."""
    session = sessions.open_session(path, threads)
    inputs = {_ROLES.get(argument.name, argument.name): argument for argument in session.get_inputs()}
    return Graph(path, session, inputs, _outputs([argument.name for argument in session.get_outputs()]))


def _outputs(names: list[str]) -> dict[str, str]:
    """Role -> output name. Of several mask outputs the first in the order of _NAMES is used."""
    outputs: dict[str, str] = {}
    for role in ("embedding", "high_res_0", "high_res_1", "positional", "masks", "iou"):
        if known := [name for name in _NAMES[role].split() if name in names]:
            outputs[role] = known[0]
    if len(names) == 1 and not outputs:
        outputs["embedding"] = names[0]  # encoders whose only output has a generic name
    return outputs


def sam_graphs(path: Path) -> list[Path]:
    """The ONNX files of a folder, or a file and the partner beside it. InputError where there are none."""
    if path.is_dir():
        return sessions.model_graphs(path)[0]
    if not path.is_file():
        missing = "no such file or folder, nor a stored model; expected a SAM encoder and decoder as ONNX"
        raise InputError(f"sam:{path}: {missing}; {known_names()}")
    partners = [path.with_name(path.name.replace(a, b)) for a, b in (("encoder", "decoder"), ("decoder", "encoder"))]
    beside = [partner for partner in partners if partner != path and partner.is_file()]
    other = [file for file in sorted(path.parent.glob("*.onnx")) if file != path and "decoder" in file.name]
    return [path, *(beside or (other if len(other) == 1 else []))]


def decoder_family(decoder: Graph) -> Family:
    """The family of a decoder, from the names of its inputs."""
    family = FAMILIES.get((decoder.inputs["points"].name, "high_res_0" in decoder.inputs))
    if family is None:
        raise InputError(f"{decoder.path}: a decoder of no known family ({sessions.signature(decoder.session)})")
    return family


def encoder_family(encoder: Graph) -> str:
    """The family of an encoder as far as it can be determined without its decoder."""
    if "high_res_0" in encoder.outputs:
        return "SAM 2"
    return "EfficientSAM" if encoder.inputs["image"].name == "batched_images" else "SAM"


def _check_pair(encoder: Graph, decoder: Graph) -> None:
    known = {"points", "labels", "boxes", "mask_input", "has_mask", "size"}
    unmet = [a.name for role, a in decoder.inputs.items() if role not in known and role not in encoder.outputs]
    if unmet:
        raise InputError(f"{decoder.path}: needs {', '.join(unmet)}, which {encoder.path.name} does not give")
    lacking = [role for role in ("masks", "iou") if role not in decoder.outputs]
    if lacking:
        outputs = ", ".join(argument.name for argument in decoder.session.get_outputs())
        raise InputError(f"{decoder.path}: no output for {' and '.join(lacking)} (found {outputs}); not a SAM decoder")
    logits = next(x for x in decoder.session.get_outputs() if x.name == decoder.outputs["masks"])
    if "bool" in logits.type:
        raise InputError(f"{decoder.path}: gives masks without logits; stability cannot be measured")


def _square(embedding: Encoded) -> int:
    """Side of the padded square in pixels. SAM's encoders have a stride of 16."""
    return 16 * embedding.tensors["embedding"].shape[-1]
