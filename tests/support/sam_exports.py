"""segment-anything without torchvision, and its models exported to ONNX as the published exporter does.

`python tests/support/sam_exports.py vit_b OUT` writes encoder.onnx and decoder.onnx of a SAM of real size with random
weights: its speed is that of the trained one. `mobile`: SAM's decoder behind an encoder as expensive as MobileSAM's.
"""

from __future__ import annotations

import contextlib
import sys
import types
import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch


def nms(boxes, scores, _categories, iou_threshold):
    """Kept indices, best first: a box goes when it overlaps a better one that is kept."""
    keep: list[int] = []
    for i in torch.sort(scores, descending=True, stable=True).indices.tolist():
        a = boxes[i]
        for j in keep:
            b = boxes[j]
            w = torch.minimum(a[2], b[2]) - torch.maximum(a[0], b[0])
            h = torch.minimum(a[3], b[3]) - torch.maximum(a[1], b[1])
            shared = w.clamp(min=0) * h.clamp(min=0)
            union = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - shared
            if float(shared / union) > iou_threshold:
                break
        else:
            keep.append(i)
    return torch.tensor(keep, dtype=torch.int64)


def resize(image, size):
    from PIL import Image

    return image.resize(size[::-1], Image.Resampling.BILINEAR)


def pillow(array):
    from PIL import Image

    return Image.fromarray(array)


@contextlib.contextmanager
def imported() -> Iterator[Any]:
    """The package beside a torchvision that holds only what it uses: four small functions, box NMS by definition."""
    names = ("torchvision", "torchvision.ops", "torchvision.ops.boxes")
    names += ("torchvision.transforms", "torchvision.transforms.functional")
    modules = {name: types.ModuleType(name) for name in names}
    boxes, functional = modules["torchvision.ops.boxes"], modules["torchvision.transforms.functional"]
    boxes.batched_nms = nms
    boxes.box_area = lambda b: (b[:, 2] - b[:, 0]) * (b[:, 3] - b[:, 1])
    functional.resize, functional.to_pil_image = resize, pillow
    before = dict(sys.modules)
    sys.modules.update(modules)
    try:
        import segment_anything

        yield segment_anything
    finally:
        for name in [n for n in sys.modules if n.split(".")[0] in ("torchvision", "segment_anything")]:
            sys.modules.pop(name)
        sys.modules.update(before)


def local_sam(side: int, channels: int, depth: int, width: int, mlp: int = 64) -> Any:
    """A SAM with random weights whose masks gather round the prompt, as a trained one's do.

    The inner product of two positional encodings falls with distance; three cuts of it give three sizes.
    """
    from segment_anything import modeling as m

    class LocalDecoder(m.MaskDecoder):
        def predict_masks(self, image_embeddings, image_pe, sparse_prompt_embeddings, dense_prompt_embeddings):
            masks, iou = super().predict_masks(
                image_embeddings, image_pe, sparse_prompt_embeddings, dense_prompt_embeddings
            )
            near = torch.einsum("pc,chw->phw", sparse_prompt_embeddings[:, 0], image_pe[0])[:, None] * (2 / channels)
            near = torch.nn.functional.interpolate(near, scale_factor=4, mode="bilinear")
            cuts = torch.tensor([0.5, 0.2, 0.45, 0.7])[None, :, None, None]
            return 180.0 * (near - cuts) + 100.0 * masks, iou

    torch.manual_seed(0)
    heads = max(2, width // 64)
    encoder = m.ImageEncoderViT(
        depth=depth, embed_dim=width, img_size=side, mlp_ratio=2, norm_layer=partial(torch.nn.LayerNorm, eps=1e-6),
        num_heads=heads, patch_size=16, qkv_bias=True, use_rel_pos=True, global_attn_indexes=(), window_size=8,
        out_chans=channels,
    )  # fmt: skip
    grid = (side // 16, side // 16)
    prompts = m.PromptEncoder(
        embed_dim=channels, image_embedding_size=grid, input_image_size=(side, side), mask_in_chans=16
    )
    transformer = m.TwoWayTransformer(depth=2, embedding_dim=channels, mlp_dim=mlp, num_heads=2)
    decoder = LocalDecoder(
        num_multimask_outputs=3, transformer=transformer, transformer_dim=channels,
        iou_head_depth=3, iou_head_hidden_dim=32,
    )  # fmt: skip
    with torch.no_grad():
        for name, weight in transformer.named_parameters():
            if "q_proj.weight" in name or "k_proj.weight" in name:
                weight.mul_(6.0)  # sharp attention: the answer depends on where the prompt lies
        decoder.iou_prediction_head.layers[-1].bias.add_(0.9)
    return m.Sam(encoder, prompts, decoder).eval()


def export(sam: Any, folder: Path) -> None:
    """Encoder and decoder of a SAM into `folder`; to be called within `imported()`."""
    from segment_anything.utils.onnx import SamOnnxModel

    side, channels = sam.image_encoder.img_size, sam.prompt_encoder.embed_dim
    grid = side // 16
    example = (
        torch.randn(1, channels, grid, grid), torch.zeros(1, 2, 2), torch.ones(1, 2),
        torch.zeros(1, 1, 4 * grid, 4 * grid), torch.zeros(1), torch.tensor([96.0, 128.0]),
    )  # fmt: skip
    inputs = ["image_embeddings", "point_coords", "point_labels", "mask_input", "has_mask_input", "orig_im_size"]
    outputs = ["masks", "iou_predictions", "low_res_masks"]
    points = {"point_coords": {1: "num_points"}, "point_labels": {1: "num_points"}}
    to_onnx = partial(torch.onnx.export, dynamo=False, opset_version=17)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        to_onnx(
            SamOnnxModel(sam, return_single_mask=False), example, str(folder / "decoder.onnx"),
            input_names=inputs, output_names=outputs, dynamic_axes=points,
        )  # fmt: skip
        to_onnx(
            sam.image_encoder, torch.randn(1, 3, side, side), str(folder / "encoder.onnx"),
            input_names=["x"], output_names=["image_embeddings"],
        )  # fmt: skip


def main(size: str, folder: str) -> None:
    """Writes a SAM of real size with random weights."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    torch.manual_seed(0)
    with imported() as package:
        mobile = size == "mobile"
        sam = local_sam(1024, 256, 4, 320, 2048) if mobile else package.sam_model_registry[size]().eval()
        export(sam, Path(folder))


if __name__ == "__main__":
    main(*sys.argv[1:])
