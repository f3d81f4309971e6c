"""Recognising SAM exports, preparing their inputs, refusing what is none. Graphs are written byte by byte."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from perception.errors import InputError
from perception.masks import make_source
from perception.masks.sam_models import open_sam
from perception.models import check_file
from perception.types import View
from support.onnx_files import FLOAT, INT32, INT64, SAM_DECODER, write_onnx

EMBEDDING = np.zeros((1, 2, 64, 64), np.float32)
SAM2_DECODER = {
    "image_embed": ((1, 2, 64, 64), FLOAT),
    "high_res_feats_0": ((1, 1, 2, 2), FLOAT),
    "high_res_feats_1": ((1, 1, 2, 2), FLOAT),
    "point_coords": (("p", "n", 2), FLOAT),
    "point_labels": (("p", "n"), FLOAT),
    "mask_input": (("p", 1, 256, 256), FLOAT),
    "has_mask_input": (("p",), FLOAT),
    "orig_im_size": ((2,), INT64),
}
EFFICIENT_DECODER = {
    "image_embeddings": ((1, 2, 64, 64), FLOAT),
    "batched_point_coords": ((1, "q", "n", 2), FLOAT),
    "batched_point_labels": ((1, "q", "n"), FLOAT),
    "orig_im_size": ((2,), INT64),
}
OPTIMUM_DECODER = {
    "image_embeddings": ((1, 2, 64, 64), FLOAT),
    "image_positional_embeddings": ((1, 2, 64, 64), FLOAT),
    "input_points": ((1, "q", "n", 2), FLOAT),
    "input_labels": ((1, "q", "n"), INT64),
}
HF_SAM2_DECODER = {
    **{f"image_embeddings.{n}": ((1, 2, 64, 64) if n == 2 else (1, 1, 2, 2), FLOAT) for n in range(3)},
    "input_points": ((1, "q", "n", 2), FLOAT),
    "input_labels": ((1, "q", "n"), INT64),
    "input_boxes": ((1, "b", 4), FLOAT),
}
EDGE_DECODER = {name: SAM_DECODER[name] for name in ("image_embeddings", "point_coords", "point_labels")}
ORT_SAM2_DECODER = {
    "image_features_0": ((1, 1, 2, 2), FLOAT),
    "image_features_1": ((1, 1, 2, 2), FLOAT),
    "image_embeddings": ((1, 2, 64, 64), FLOAT),
    "point_coords": (("p", "n", 2), FLOAT),
    "point_labels": (("p", "n"), INT32),
    "input_masks": (("p", 1, 256, 256), FLOAT),
    "has_input_masks": (("p",), FLOAT),
    "original_image_size": ((2,), INT32),
}
FEATURE = np.zeros((1, 1, 2, 2), np.float32)
POSITIONAL = {"image_positional_embeddings": EMBEDDING}
SQUARE, WHOLE = (1, 3, 1024, 1024), (1, 3, "h", "w")
# layout: family, encoder input, its shape, embedding, other encoder outputs, decoder, names of masks and scores
LAYOUTS = {
    "MobileSAM": ("SAM", "x", SQUARE, "image_embeddings", {}, SAM_DECODER, "masks", "iou_predictions"),
    "EdgeSAM": ("SAM", "image", SQUARE, "image_embeddings", {}, EDGE_DECODER, "masks", "scores"),
    "samexporter SAM 2": (
        "SAM 2", "image", SQUARE, "image_embed", {f"high_res_feats_{n}": FEATURE for n in (0, 1)}, SAM2_DECODER,
        "masks", "iou_predictions",
    ),
    "onnxruntime SAM 2": (
        "SAM 2", "image", SQUARE, "image_embeddings", {f"image_features_{n}": FEATURE for n in (0, 1)},
        ORT_SAM2_DECODER, "low_res_masks", "iou_predictions",
    ),
    "Hugging Face SAM 2.1": (
        "SAM 2 by Hugging Face", "pixel_values", SQUARE, "image_embeddings.2",
        {f"image_embeddings.{n}": FEATURE for n in (0, 1)}, HF_SAM2_DECODER, "pred_masks", "iou_scores",
    ),
    "EfficientSAM": (
        "EfficientSAM", "batched_images", WHOLE, "image_embeddings", {}, EFFICIENT_DECODER, "output_masks",
        "iou_predictions",
    ),
    "SlimSAM": (
        "SAM by Hugging Face", "pixel_values", SQUARE, "image_embeddings", POSITIONAL, OPTIMUM_DECODER, "pred_masks",
        "iou_scores",
    ),
}  # fmt: skip
# family: where (20, 30) of an 80×60 photo lies for the decoder, and whether the point (0, 0) follows it
EXPECTED = {
    "SAM": ((256, 384), True), "SAM by Hugging Face": ((256, 384), False), "SAM 2": ((256, 512), False),
    "SAM 2 by Hugging Face": ((256, 512), False), "EfficientSAM": ((20, 30), False),
}  # fmt: skip


def write_layout(folder: Path, layout: str, encoder_passes_image: bool = False) -> None:
    """A pair with a signature; the decoder's "predicted IoU" are the coordinates it was given."""
    _, image, shape, name, extra, decoder, masks, iou = LAYOUTS[layout]
    embedding = image if encoder_passes_image else EMBEDDING
    write_onnx(folder / "encoder.onnx", {image: (shape, FLOAT)}, {name: embedding, **extra})
    points = next(name for name in decoder if "point" in name)
    nested = len(decoder[points][0]) == 4
    constant = np.zeros((1, 1, 3, 256, 256) if nested else (1, 3, 256, 256), np.float32)
    write_onnx(folder / "decoder.onnx", decoder, {masks: constant, iou: points})


def photo(height: int = 60, width: int = 80) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3)).astype(np.uint8)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_family_and_where_its_points_lie(tmp_path, layout):
    """A photo of 80×60: the long side fills 1024 (SAM), both sides do (SAM 2), or nothing is scaled."""
    write_layout(tmp_path, layout)
    model = open_sam(str(tmp_path))
    assert model.family == LAYOUTS[layout][0] and model.provider == "CPUExecutionProvider" and model.warnings == []
    _, given = model.decode(model.encode(photo()), np.array([[20.0, 30.0]]))
    (x, y), padded = EXPECTED[model.family]
    # x, y, 0, 0, of which the first of four is dropped
    np.testing.assert_allclose(given[0], [y, 0, 0] if padded else [x, y], rtol=1e-6)


def test_prompts_go_one_by_one_where_an_export_only_claims_to_take_several(tmp_path):
    write_layout(tmp_path, "samexporter SAM 2")  # its axes are dynamic, its masks are those of one prompt
    model = open_sam(str(tmp_path))
    assert not model.batched
    _, given = model.decode(model.encode(photo()), np.array([[20.0, 30.0], [40.0, 30.0]]))
    np.testing.assert_allclose(given, [[256, 512], [512, 512]])


def test_of_a_hugging_face_cache_the_most_precise_graphs_are_taken(tmp_path):
    """`models--ORG--NAME/snapshots/REVISION/onnx`, links into `blobs/`, siblings in other precisions."""
    (tmp_path / "blobs").mkdir()
    home = tmp_path / "snapshots" / "814a066" / "onnx"
    home.mkdir(parents=True)
    write_layout(tmp_path / "blobs", "Hugging Face SAM 2.1")
    for link, blob in (("vision_encoder", "encoder"), ("prompt_encoder_mask_decoder", "decoder")):
        (home / f"{link}.onnx").symlink_to(f"../../../blobs/{blob}.onnx")
        for precision in ("_fp16", "_quantized", "_q4f16"):
            (home / f"{link}{precision}.onnx").write_bytes(b"not to be opened")
    model = open_sam(str(tmp_path))
    assert model.encoder.path == home / "vision_encoder.onnx" and model.family == "SAM 2 by Hugging Face"
    (home / "vision_encoder.onnx").unlink()
    with pytest.raises(InputError, match=r"vision_encoder_fp16\.onnx: not an ONNX model"):
        open_sam(str(tmp_path))


def test_one_mask_a_prompt_is_told(tmp_path):
    write_layout(tmp_path, "MobileSAM")
    one = {"masks": np.zeros((1, 1, 256, 256), np.float32), "iou_predictions": np.zeros((1, 1), np.float32)}
    write_onnx(tmp_path / "decoder.onnx", SAM_DECODER, one)
    assert "one mask a prompt" in make_source(f"sam:{tmp_path}").check([])[0]
    assert "one mask a prompt" in check_file(str(tmp_path))["warnings"][0]


def test_other_normalisation_is_read_beside_the_graphs(tmp_path):
    write_layout(tmp_path, "Hugging Face SAM 2.1", encoder_passes_image=True)
    (tmp_path / "preprocessor_config.json").write_text('{"image_mean": [0.5, 0.5, 0.5], "image_std": [0.5, 0.5, 0.5]}')
    image = open_sam(str(tmp_path)).encode(np.full((60, 80, 3), 255, np.uint8)).tensors["embedding"]
    assert image.min() == image.max() == 1


def test_normalisation_and_padding(tmp_path):
    write_layout(tmp_path, "MobileSAM", encoder_passes_image=True)
    grey = np.full((60, 80, 3), 100, np.uint8)
    image = open_sam(str(tmp_path)).encode(grey).tensors["embedding"]
    expected = (100 - np.array([123.675, 116.28, 103.53])) / [58.395, 57.12, 57.375]
    np.testing.assert_allclose(image[0, :, :768].mean(axis=(1, 2)), expected, rtol=1e-5)
    assert not image[0, :, 768:].any()


def test_raw_encoder_takes_the_photo_as_it_is(tmp_path):
    write_onnx(tmp_path / "a_encoder.onnx", {"input_image": (("h", "w", 3), FLOAT)}, {"image_embeddings": EMBEDDING})
    write_onnx(tmp_path / "a_decoder.onnx", SAM_DECODER, {"masks": EMBEDDING, "iou_predictions": "point_coords"})
    model = open_sam(str(tmp_path / "a_encoder.onnx"))
    encoded = model.encode(photo(60, 80))
    assert encoded.used == (768, 1024)
    _, given = model.decode(encoded, np.array([[20.0, 30.0]]))
    np.testing.assert_allclose(given[0, 0], 384)


@pytest.mark.parametrize("spec", ["{0}", "{0}/encoder.onnx", "{0}/decoder.onnx", "{0}/encoder.onnx,{0}/decoder.onnx"])
def test_ways_to_name_a_pair(tmp_path, spec):
    write_layout(tmp_path, "MobileSAM")
    assert open_sam(spec.format(tmp_path)).family == "SAM"


def test_photo_in_which_nothing_is_found(tmp_path):
    write_layout(tmp_path, "MobileSAM")
    scores = {
        "masks": np.zeros((1, 4, 256, 256), np.float32),
        "iou_predictions": np.zeros((1, 4), np.float32),
    }
    write_onnx(tmp_path / "decoder.onnx", SAM_DECODER, scores)
    source = make_source(f"sam:{tmp_path}")
    view = View("a.jpg", tmp_path / "a.jpg", np.eye(3), 80, 60, np.eye(4))
    assert source.check([view]) == []
    labels = source.label_image(view, photo())
    assert labels.shape == (60, 80) and labels.dtype == np.int32 and not labels.any()


def test_identity_follows_the_weights(tmp_path):
    write_layout(tmp_path, "MobileSAM")
    before = make_source(f"sam:{tmp_path}").identity
    write_onnx(tmp_path / "encoder.onnx", {"x": ((1, 3, 1024, 1024), FLOAT)}, {"image_embeddings": EMBEDDING + 1})
    assert make_source(f"sam:{tmp_path}").identity != before


def test_no_onnx(tmp_path):
    (tmp_path / "model.onnx").write_bytes(b"these are no weights")
    with pytest.raises(InputError, match=r"model\.onnx: not an ONNX model"):
        make_source(f"sam:{tmp_path / 'model.onnx'}")


def test_nothing_there(tmp_path):
    with pytest.raises(InputError, match=r"no \.onnx file"):
        open_sam(str(tmp_path))
    with pytest.raises(InputError, match="no such file or folder"):
        open_sam(str(tmp_path / "absent"))


@pytest.mark.parametrize(("kept", "missing"), [("decoder", "encoder"), ("encoder", "decoder")])
def test_one_half_of_a_pair(tmp_path, kept, missing):
    write_layout(tmp_path, "MobileSAM")
    (tmp_path / f"{missing}.onnx").unlink()
    with pytest.raises(InputError, match=rf"expected one SAM encoder and its decoder, found {kept}\.onnx: {kept}; put"):
        open_sam(str(tmp_path))


def test_another_kind_of_network(tmp_path):
    write_onnx(tmp_path / "net.onnx", {"tokens": ((1, 4), INT64)}, {"logits": np.zeros((1, 2), np.float32)})
    write_onnx(tmp_path / "two.onnx", {"tokens": ((1, 4), INT64)}, {"a": EMBEDDING, "b": EMBEDDING})
    with pytest.raises(InputError, match=r"found net\.onnx: inputs tokens.*; two\.onnx: inputs tokens.*; put both"):
        open_sam(str(tmp_path))


def test_decoder_without_scores(tmp_path):
    write_layout(tmp_path, "MobileSAM")
    write_onnx(tmp_path / "decoder.onnx", SAM_DECODER, {"masks": np.zeros((1, 4, 256, 256), np.float32)})
    with pytest.raises(InputError, match="no output for iou"):
        open_sam(str(tmp_path))


def test_pair_of_two_families(tmp_path):
    write_layout(tmp_path, "samexporter SAM 2")
    write_onnx(tmp_path / "encoder.onnx", {"x": ((1, 3, 1024, 1024), FLOAT)}, {"image_embeddings": EMBEDDING})
    with pytest.raises(InputError, match=r"needs high_res_feats_0.*does not give"):
        open_sam(str(tmp_path))


def test_two_decoders_in_a_folder(tmp_path):
    write_layout(tmp_path, "MobileSAM")
    (tmp_path / "other_decoder.onnx").write_bytes((tmp_path / "decoder.onnx").read_bytes())
    with pytest.raises(InputError, match=r"found decoder\.onnx: decoder; .*other_decoder\.onnx: decoder; put"):
        open_sam(str(tmp_path))


@pytest.mark.parametrize("broken", ["encoder", "decoder"])
def test_models_that_fail_or_overflow_are_told(tmp_path, broken):
    write_layout(tmp_path, "MobileSAM")
    found = np.full((1, 4, 256, 256), np.nan, np.float32)
    if broken == "encoder":
        write_onnx(tmp_path / "encoder.onnx", {"x": (SQUARE, FLOAT)}, {"image_embeddings": np.nan * EMBEDDING})
    else:
        outputs = {"masks": found, "iou_predictions": found[..., 0, 0]}
        write_onnx(tmp_path / "decoder.onnx", SAM_DECODER, outputs)
    with pytest.raises(
        InputError, match=rf"{broken}\.onnx: its output \w+ holds NaN; take the model in full precision"
    ):
        open_sam(str(tmp_path)).encode(photo())
