"""SAM and SAM 2 of transformers with random weights, exported in Hugging Face's layout, against the models."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

os.environ["HF_HUB_OFFLINE"] = "1"
import torch
import transformers
from PIL import Image

from perception.masks.sam_models import open_sam

SIDE, POINTS = 128, np.array([[20.0, 30.0], [70.0, 11.5], [40.0, 55.0]])
PROMPT = ["input_points", "input_labels"]


class _Vision(torch.nn.Module):
    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model

    def forward(self, pixel_values: Any) -> Any:
        found = self.model.get_image_embeddings(pixel_values)
        if isinstance(found, (list, tuple)):
            return tuple(found)
        return found, self.model.get_image_wide_positional_embeddings()


class _Decoder(torch.nn.Module):
    """SAM 2's takes boxes too: without any, a point is padded, as transformers does when it is given none."""

    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model

    def forward(self, points: Any, labels: Any, *rest: Any) -> Any:
        if len(rest) == 2:
            embedding, positional = rest
            sparse, dense = self.model.prompt_encoder(points, labels, None, None)
            return self.model.mask_decoder(embedding, positional, sparse, dense, multimask_output=True)[:2]
        boxes, first, second, embedding = rest
        corners = boxes.reshape(1, 1, -1, 2)
        encoder = self.model.prompt_encoder
        prompt = torch.cat([points, corners.expand(1, points.shape[1], -1, 2)], dim=2)
        sparse = encoder._embed_points(prompt, labels, pad=True)
        dense = encoder.no_mask_embed.weight.reshape(1, -1, 1, 1).expand(1, -1, *embedding.shape[-2:])
        return self.model.mask_decoder(
            embedding, self.model.get_image_wide_positional_embeddings(), sparse, dense, True, [first, second]
        )[:2]


def _export(module: Any, example: Any, path: Path, inputs: list[str], outputs: list[str], axes: dict) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module.eval(), example, str(path), input_names=inputs, output_names=outputs, dynamic_axes=axes,
            opset_version=17, dynamo=False,
        )  # fmt: skip


def sam() -> Any:
    vision = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2, "image_size": SIDE, "mlp_dim": 64}
    vision |= {"output_channels": 32, "window_size": 4, "global_attn_indexes": [1], "num_pos_feats": 16}
    prompt = {"hidden_size": 32, "image_size": SIDE, "image_embedding_size": SIDE // 16}
    decoder = {"hidden_size": 32, "mlp_dim": 64, "num_attention_heads": 2, "iou_head_hidden_dim": 32}
    config = transformers.SamConfig(vision_config=vision, prompt_encoder_config=prompt, mask_decoder_config=decoder)
    return transformers.SamModel(config)


def sam2() -> Any:
    backbone = {
        "hidden_size": 16,
        "num_attention_heads": 1,
        "image_size": [SIDE, SIDE],
        "blocks_per_stage": [1, 1, 1, 1],
    }
    backbone |= {"embed_dim_per_stage": [16, 32, 64, 128], "num_attention_heads_per_stage": [1, 1, 2, 4]}
    backbone |= {"global_attention_blocks": [], "window_positional_embedding_background_size": [7, 7]}
    vision = {"backbone_config": {"model_type": "sam2_hiera_det_model", **backbone}, "fpn_hidden_size": 32}
    vision |= {"backbone_channel_list": [128, 64, 32, 16]}
    vision |= {"backbone_feature_sizes": [[SIDE // n] * 2 for n in (4, 8, 16)]}
    prompt = {"hidden_size": 32, "image_size": SIDE}
    decoder = {"hidden_size": 32, "mlp_dim": 64, "num_attention_heads": 2, "iou_head_hidden_dim": 32}
    config = transformers.Sam2Config(vision_config=vision, prompt_encoder_config=prompt, mask_decoder_config=decoder)
    return transformers.Sam2Model(config)


@pytest.mark.slow
@pytest.mark.parametrize("make", [sam, sam2])
def test_masks_and_scores_are_those_of_transformers(make: Any, tmp_path: Path) -> None:
    torch.manual_seed(0)
    model = make().eval()
    with torch.no_grad():
        for weight in model.parameters():
            weight.copy_(torch.randn_like(weight) * (0.3 if weight.dim() > 1 else 0.1) + (weight.dim() == 1))
    second = make is sam2
    (tmp_path / "onnx").mkdir()
    pixels = torch.zeros(1, 3, SIDE, SIDE)
    names = ["image_embeddings.0", "image_embeddings.1", "image_embeddings.2"]
    names = names if second else ["image_embeddings", "image_positional_embeddings"]
    _export(_Vision(model), (pixels,), tmp_path / "onnx/vision_encoder.onnx", ["pixel_values"], names, {})
    with torch.no_grad():
        features = _Vision(model)(pixels)
    boxes = {"input_boxes": torch.zeros(1, 0, 4)} if second else {}
    prompt = (torch.zeros(1, 2, 1, 2), torch.ones(1, 2, 1, dtype=torch.int64), *boxes.values())
    axes = {"input_points": {1: "prompts", 2: "n"}, "input_labels": {1: "prompts", 2: "n"}}
    _export(
        _Decoder(model), (*prompt, *features), tmp_path / "onnx/prompt_encoder_mask_decoder.onnx",
        [*PROMPT, *boxes, *names], ["pred_masks", "iou_scores"], axes,
    )  # fmt: skip
    ours = open_sam(str(tmp_path))
    assert ours.family == ("SAM 2 by Hugging Face" if second else "SAM by Hugging Face") and ours.warnings == []
    photo = np.asarray(Image.effect_noise((90, 60), 80).convert("RGB").resize((90, 60)))
    embedding = ours.encode(photo)
    masks, scores = ours.decode(embedding, POINTS)

    ratio = SIDE / np.array([90.0, 60.0]) if second else np.array([SIDE / 90.0] * 2)
    size = (SIDE, SIDE) if second else (SIDE, round(60 * SIDE / 90))
    fitted = np.asarray(Image.fromarray(photo).resize(size, Image.Resampling.BILINEAR), np.float32) / 255
    canvas = np.zeros((SIDE, SIDE, 3), np.float32)
    canvas[: size[1]] = (fitted - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    with torch.no_grad():
        expected = model(
            pixel_values=torch.tensor(canvas).permute(2, 0, 1)[None],
            input_points=torch.tensor(POINTS * ratio, dtype=torch.float32)[None, :, None],
            input_labels=torch.ones(1, 3, 1, dtype=torch.int64),
            multimask_output=True,
        )
    np.testing.assert_allclose(masks, expected.pred_masks[0].numpy(), atol=2e-3 * expected.pred_masks.std().item())
    np.testing.assert_allclose(scores, expected.iou_scores[0].numpy(), rtol=1e-3, atol=1e-3)
    apart = np.abs(masks - expected.pred_masks[0].numpy()).max()
    assert np.ptp(masks, axis=0).max() > 20 * apart  # prompts differ by far more than the two programs
    upscaled = ours.upscale(embedding, masks[0, 0])
    assert upscaled.shape == (60, 90)
