"""Our automatic masks against `SamAutomaticMaskGenerator`: a small SAM with random weights, exported to ONNX.

Needs `segment-anything` and `onnx` (the exporter); skips without.
"""

from __future__ import annotations

import importlib.util
from functools import partial

import numpy as np
import pytest

pytest.importorskip("onnx")
torch = pytest.importorskip("torch")

from perception.masks.sam import SamSettings, automatic_masks, paint  # noqa: E402
from perception.masks.sam_models import open_sam  # noqa: E402
from support.sam_exports import export, imported  # noqa: E402

SIDE, CHANNELS = 256, 32


@pytest.fixture(scope="module")
def segment_anything():
    if importlib.util.find_spec("segment_anything") is None:
        pytest.skip("needs segment-anything")
    with imported() as package:
        yield package


def local_decoder(segment_anything):
    """A mask decoder with random weights whose masks gather round the prompt, as a trained one's do.

    The inner product of two positional encodings falls with distance; three cuts of it give three sizes.
    """
    from segment_anything.modeling import MaskDecoder

    class LocalDecoder(MaskDecoder):
        def predict_masks(self, image_embeddings, image_pe, sparse_prompt_embeddings, dense_prompt_embeddings):
            masks, iou = super().predict_masks(
                image_embeddings, image_pe, sparse_prompt_embeddings, dense_prompt_embeddings
            )
            near = torch.einsum("pc,chw->phw", sparse_prompt_embeddings[:, 0], image_pe[0])[:, None] * (2 / CHANNELS)
            near = torch.nn.functional.interpolate(near, scale_factor=4, mode="bilinear")
            cuts = torch.tensor([0.5, 0.2, 0.45, 0.7])[None, :, None, None]
            return 180.0 * (near - cuts) + 100.0 * masks, iou

    return LocalDecoder


@pytest.fixture(scope="module")
def sam(segment_anything):
    """A two-block SAM whose random decoder gives logits and scores spread around the thresholds."""
    from segment_anything import modeling as m

    torch.manual_seed(0)
    encoder = m.ImageEncoderViT(
        depth=2, embed_dim=32, img_size=SIDE, mlp_ratio=2, norm_layer=partial(torch.nn.LayerNorm, eps=1e-6),
        num_heads=2, patch_size=16, qkv_bias=True, use_rel_pos=True, global_attn_indexes=[1], window_size=8,
        out_chans=CHANNELS,
    )  # fmt: skip
    grid = (SIDE // 16, SIDE // 16)
    prompts = m.PromptEncoder(
        embed_dim=CHANNELS, image_embedding_size=grid, input_image_size=(SIDE, SIDE), mask_in_chans=16
    )
    transformer = m.TwoWayTransformer(depth=2, embedding_dim=CHANNELS, mlp_dim=64, num_heads=2)
    decoder = local_decoder(segment_anything)(
        num_multimask_outputs=3, transformer=transformer, transformer_dim=CHANNELS,
        iou_head_depth=3, iou_head_hidden_dim=32,
    )  # fmt: skip
    with torch.no_grad():
        for name, weight in transformer.named_parameters():
            if "q_proj.weight" in name or "k_proj.weight" in name:
                weight.mul_(6.0)  # sharp attention: the answer depends on where the prompt lies
        decoder.iou_prediction_head.layers[-1].bias.add_(0.9)
    return m.Sam(encoder, prompts, decoder).eval()


@pytest.fixture(scope="module")
def exported(sam, tmp_path_factory):
    folder = tmp_path_factory.mktemp("sam")
    export(sam, folder)
    return folder


def photo(height: int, width: int, seed: int) -> np.ndarray:
    """Coloured rectangles and noise."""
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 40, (height, width, 3))
    for _ in range(12):
        y, x = rng.integers(0, height - 10), rng.integers(0, width - 10)
        image[y : y + rng.integers(8, height), x : x + rng.integers(8, width)] += rng.integers(0, 90, 3)
    return image.clip(0, 255).astype(np.uint8)


CASES = [
    ({}, (96, 128), 7),
    ({}, (131, 87), 7),
    ({"stability": 0.8, "pred_iou": 0.5}, (96, 128), 6),
]


@pytest.mark.parametrize(("changes", "size", "side"), CASES)
def test_same_masks_in_the_same_order(segment_anything, sam, exported, changes, size, side):
    settings = SamSettings(points_per_side=side, **changes)
    image = photo(*size, seed=side)
    theirs = segment_anything.SamAutomaticMaskGenerator(
        sam,
        points_per_side=side,
        pred_iou_thresh=settings.pred_iou,
        stability_score_thresh=settings.stability,
    ).generate(image)
    ours = automatic_masks(open_sam(str(exported)), image, settings)
    print(f"{len(theirs)} masks")
    assert len(ours) == len(theirs) >= 5
    for found, record in zip(ours, theirs, strict=True):
        mask, expected = found.pixels(), record["segmentation"]
        assert (mask & expected).sum() >= 0.995 * (mask | expected).sum()
        assert found.pred_iou == pytest.approx(record["predicted_iou"], abs=1e-4)
        assert found.stability == pytest.approx(record["stability_score"], abs=5e-3)
        np.testing.assert_allclose(found.point, record["point_coords"][0], atol=1e-9)


def test_label_image_gives_every_pixel_to_the_best_mask(exported):
    image = photo(96, 128, seed=10)
    settings = SamSettings(points_per_side=10, stability=0.8, pred_iou=0.5)
    masks = automatic_masks(open_sam(str(exported)), image, settings)
    labels = paint(masks, image.shape[:2])
    stack = np.stack([mask.pixels() for mask in masks])
    of_mask = np.array([mask.pred_iou * mask.stability for mask in masks])
    scores = np.where(stack, of_mask[:, None, None], -np.inf)
    winners = np.where(stack.any(axis=0), scores.max(axis=0), 0.0)
    np.testing.assert_allclose(np.concatenate([[0.0], np.sort(of_mask)])[labels], winners)
