"""Parity of the CLIP-family encoder with transformers: same architecture, random weights, exported here."""

from __future__ import annotations

import json
import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

os.environ["HF_HUB_OFFLINE"] = "1"
torch = pytest.importorskip("torch")
pytest.importorskip("onnxruntime")
transformers = pytest.importorskip("transformers")

from perception.errors import InputError  # noqa: E402
from perception.language.clip import ClipEncoder  # noqa: E402
from perception.language.encoders import make_encoder  # noqa: E402
from perception.language.preprocess import CLIP, MOBILECLIP, SIGLIP, find_preprocess  # noqa: E402
from perception.language.tokenizer import find_tokenizer  # noqa: E402
from perception.models import add_model, check_file  # noqa: E402
from support.onnx_files import FLOAT, write_onnx  # noqa: E402

MERGES = [("r", "e"), ("re", "d</w>"), ("m", "u"), ("mu", "g</w>"), ("c", "u"), ("cu", "p</w>"), ("t", "h")]
TEXTS = ["red mug", "a cup, two cups & the MUG's handle", "чашка 杯子 ☕", "x" * 400]
SIDE = 32
CLIP_PREPROCESSOR = {
    "do_center_crop": True, "crop_size": SIDE, "size": SIDE, "resample": 3, "image_mean": CLIP.mean,
    "image_std": CLIP.std,
}  # fmt: skip


class _Tower(torch.nn.Module):
    """One tower of a transformers model as exporters publish it."""

    def __init__(self, model: Any, image: bool) -> None:
        super().__init__()
        self.model, self.image = model, image

    def forward(self, x: Any) -> Any:
        found = self.model.get_image_features(x) if self.image else self.model.get_text_features(x)
        return found if torch.is_tensor(found) else found.pooler_output


def _export(
    module: Any, example: Any, path: Path, inputs: list[str], outputs: list[str], axes: dict | None = None
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module.eval(),
            example,
            str(path),
            input_names=inputs,
            output_names=outputs,
            dynamic_axes=axes or {name: {0: "batch"} for name in [*inputs, *outputs]},
            opset_version=17,
            dynamo=False,
        )


def _vocabulary() -> dict[str, int]:
    """Ids in OpenAI's order: 256 bytes, the same ending a word, the merges, then the two marks."""
    printable = [*range(0x21, 0x7F), *range(0xA1, 0xAD), *range(0xAE, 0x100)]
    letters = [chr(b) for b in printable] + [chr(256 + n) for n in range(256 - len(printable))]
    words = letters + [letter + "</w>" for letter in letters] + ["".join(pair) for pair in MERGES]
    return {word: n for n, word in enumerate([*words, "<|startoftext|>", "<|endoftext|>"])}


def _reference_tokenizer() -> Any:
    return transformers.CLIPTokenizer(vocab=_vocabulary(), merges=MERGES)


def _pictures() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    smooth = [rng.integers(0, 255, (6, 6, 3), dtype=np.uint8) for _ in range(3)]
    from PIL import Image

    sizes = [(64, 64), (90, 50), (40, 73)]
    return [np.asarray(Image.fromarray(s).resize(z, 3)) for s, z in zip(smooth, sizes, strict=True)]


def _cosines(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)


@pytest.fixture(scope="module")
def clip_folder(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    folder = tmp_path_factory.mktemp("tiny-clip")
    torch.manual_seed(0)
    words = _vocabulary()
    text = {"vocab_size": len(words), "hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2}
    text |= {"num_attention_heads": 2, "max_position_embeddings": 77, "eos_token_id": words["<|endoftext|>"]}
    vision = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 2}
    vision |= {"image_size": SIDE, "patch_size": 8}
    config = transformers.CLIPConfig(text_config=text, vision_config=vision, projection_dim=16)
    config._attn_implementation = "eager"
    model = transformers.CLIPModel(config).eval()
    _export(
        _Tower(model, True),
        torch.zeros(1, 3, SIDE, SIDE),
        folder / "vision_model.onnx",
        ["pixel_values"],
        ["image_embeds"],
    )
    ids = torch.full((1, 77), words["<|endoftext|>"])
    _export(_Tower(model, False), ids, folder / "text_model.onnx", ["input_ids"], ["text_embeds"])
    _reference_tokenizer().save_pretrained(folder)
    (folder / "config.json").write_text(json.dumps({"model_type": "clip", "projection_dim": 16}))
    (folder / "preprocessor_config.json").write_text(json.dumps(CLIP_PREPROCESSOR))
    return folder, model


@pytest.mark.slow
def test_clip_pair_matches_transformers(clip_folder: tuple[Path, Any]) -> None:
    folder, model = clip_folder
    encoder = make_encoder(f"clip:{folder}")
    assert encoder is not None and encoder.dim == 16
    processor = transformers.CLIPImageProcessorPil if hasattr(transformers, "CLIPImageProcessorPil") else None
    processor = (processor or transformers.CLIPImageProcessor)(
        size={"shortest_edge": SIDE}, crop_size={"height": SIDE, "width": SIDE}
    )
    tokenizer = _reference_tokenizer()
    with torch.no_grad():
        pixels = processor(_pictures(), return_tensors="pt")["pixel_values"]
        images = _Tower(model, True)(pixels).numpy()
        tokens = tokenizer(TEXTS, padding="max_length", truncation=True, max_length=77, return_tensors="pt")
        texts = _Tower(model, False)(tokens["input_ids"]).numpy()
    ours_images, ours_texts = encoder.encode_images(_pictures()), encoder.encode_texts(TEXTS)
    assert np.all(_cosines(ours_images, images) > 1 - 1e-3)
    assert np.all(_cosines(ours_texts, texts) > 1 - 1e-5)
    assert np.allclose(np.linalg.norm(ours_images, axis=1), 1, atol=1e-6)


def test_identity_names_weights_and_preprocessing(clip_folder: tuple[Path, Any], tmp_path: Path) -> None:
    folder, _ = clip_folder
    first = ClipEncoder.from_spec(f"{folder}/vision_model.onnx,{folder}/text_model.onnx")
    assert first.identity == ClipEncoder.from_spec(str(folder)).identity
    for file in folder.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / "preprocessor_config.json").write_text(
        json.dumps({"size": {"height": SIDE, "width": SIDE}, "image_mean": [0.5] * 3, "image_std": [0.5] * 3})
    )
    assert ClipEncoder.from_spec(str(tmp_path)).identity != first.identity


def test_combined_export_equals_the_pair(clip_folder: tuple[Path, Any], tmp_path: Path) -> None:
    """optimum writes both towers into one file whose four outputs include the logits."""
    folder, model = clip_folder

    class Both(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.model = model

        def forward(self, input_ids: Any, pixel_values: Any, attention_mask: Any) -> Any:
            out = self.model(input_ids=input_ids, pixel_values=pixel_values, attention_mask=attention_mask)
            return out.logits_per_image, out.logits_per_text, out.text_embeds, out.image_embeds

    for file in folder.glob("*.json"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    ids = torch.full((2, 77), _vocabulary()["<|endoftext|>"])
    inputs = ["input_ids", "pixel_values", "attention_mask"]
    outputs = ["logits_per_image", "logits_per_text", "text_embeds", "image_embeds"]
    _export(
        Both(),
        (ids, torch.zeros(1, 3, SIDE, SIDE), torch.ones_like(ids)),
        tmp_path / "model.onnx",
        inputs,
        outputs,
    )
    both, pair = ClipEncoder.from_spec(str(tmp_path)), ClipEncoder.from_spec(str(folder))
    assert np.allclose(both.encode_texts(TEXTS), pair.encode_texts(TEXTS), atol=1e-5)
    assert np.allclose(both.encode_images(_pictures()), pair.encode_images(_pictures()), atol=1e-5)
    assert both.reading.scale == pytest.approx(model.logit_scale.exp().item(), rel=1e-3) and both.reading.even is None
    assert pair.reading.colors and pair.reading.scale == 100 and check_file(str(tmp_path))["warnings"] == []


class _Joint(torch.nn.Module):
    """Both towers and the logits, as optimum exports them."""

    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model

    def forward(self, input_ids: Any, pixel_values: Any) -> Any:
        out = self.model(input_ids=input_ids, pixel_values=pixel_values)
        return out.logits_per_image, out.text_embeds, out.image_embeds


def _siglip() -> Any:
    torch.manual_seed(1)
    text = {"vocab_size": len(_vocabulary()), "hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 1}
    text |= {"num_attention_heads": 2, "max_position_embeddings": 64, "projection_size": 32}
    vision = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 1, "num_attention_heads": 2}
    vision |= {"image_size": SIDE, "patch_size": 8}
    config = transformers.SiglipConfig(text_config=text, vision_config=vision)
    config._attn_implementation = "eager"
    model = transformers.SiglipModel(config).eval()
    with torch.no_grad():
        model.logit_scale.fill_(np.log(117.0)), model.logit_bias.fill_(-12.9)
    return model


@pytest.mark.parametrize("joint", [False, True])
def test_siglip_matches_transformers(tmp_path: Path, joint: bool) -> None:
    """SigLIP looks at its padding, squashes pictures, normalises by .5 and drops case and punctuation.

    The folder's name says nothing; one graph with both towers also tells scale and bias of the log-odds.
    """
    folder, model, words = tmp_path / "export", _siglip(), _vocabulary()
    folder.mkdir()
    pixels, zeros = torch.zeros(1, 3, SIDE, SIDE), torch.ones(1, 64).long()
    if joint:
        outputs = ["logits_per_image", "text_embeds", "image_embeds"]
        _export(
            _Joint(model), (zeros.repeat(2, 1), pixels), folder / "model.onnx", ["input_ids", "pixel_values"], outputs
        )
    else:
        _export(_Tower(model, True), pixels, folder / "vision_model.onnx", ["pixel_values"], ["pooler_output"])
        _export(_Tower(model, False), zeros, folder / "text_model.onnx", ["input_ids"], ["pooler_output"])
    backend = _reference_tokenizer().backend_tokenizer
    backend.save(str(folder / "tokenizer.json"))
    (folder / "tokenizer_config.json").write_text(json.dumps({"pad_token": "u"}))
    (folder / "config.json").write_text(json.dumps({"model_type": "siglip"}))
    encoder = ClipEncoder.from_spec(str(folder))
    texts = ["Red MUG!", "a_cup, two-cups & the MUG's  handle"]
    ids = [encoding.ids for encoding in backend.encode_batch(["red mug", "a cup twocups the mugs handle"])]
    padded = torch.tensor([row + [words["u"]] * (64 - len(row)) for row in ids])
    processor = transformers.SiglipImageProcessor(size={"height": SIDE, "width": SIDE})
    with torch.no_grad():
        seen = processor(_pictures(), return_tensors="pt")["pixel_values"]
        images, embedded = _Tower(model, True)(seen).numpy(), _Tower(model, False)(padded).numpy()
    assert np.all(_cosines(encoder.encode_texts(texts), embedded) > 1 - 1e-5)
    assert np.all(_cosines(encoder.encode_images(_pictures()), images) > 1 - 1e-3)
    if joint:
        assert encoder.reading.scale == pytest.approx(117, rel=1e-3)
        assert encoder.reading.even == pytest.approx((-10 + 12.9) / 117, abs=1e-3)


@pytest.mark.parametrize("side", ["left", "right"])
def test_siglip_2_keeps_punctuation_and_pads_where_its_tokenizer_says(tmp_path: Path, side: str) -> None:
    """A vocabulary of Gemma's size is SigLIP 2's: transformers' own tokenizer is the reference."""
    words = {word: n for n, word in enumerate(["<pad>", "<eos>", "<bos>", "<unk>", "<mask>", "▁", *"abcdr!e"])}
    words |= {f"<filler {n}>": len(words) + n for n in range(200_000)}
    reference = transformers.Siglip2Tokenizer(vocab=words, merges=[], padding_side=side)
    reference.save_pretrained(tmp_path)
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "siglip"}))
    ours = find_tokenizer(tmp_path / "text_model.onnx", None)
    texts = ["A RED bee!", "abc" * 40]
    expected = reference(texts, padding="max_length", truncation=True, max_length=64)
    assert ours.length == 64 and ours.clean == "lower"
    assert ours(texts)[0].tolist() == expected["input_ids"]


def test_tokenizer_equals_transformers(clip_folder: tuple[Path, Any], tmp_path: Path) -> None:
    """Padding, cutting and the mark at the end, with the `tokenizer.json` of an export."""
    words, reference = _vocabulary(), _reference_tokenizer()
    ours = find_tokenizer(clip_folder[0] / "text_model.onnx", 77)
    texts = [*TEXTS, "it's  RED,\tdon't\n'll 12345 café naïve ﬁ 🙂🙂", "a"]
    expected = reference(texts, padding="max_length", truncation=True, max_length=77)
    ids, mask = ours(texts)
    assert ids.tolist() == expected["input_ids"]
    assert mask.tolist() == expected["attention_mask"]
    assert ids[3, 0] == words["<|startoftext|>"] and ids[3, -1] == words["<|endoftext|>"]
    with pytest.raises(InputError, match=r"no tokenizer\.json in"):
        find_tokenizer(tmp_path / "alone" / "text_model.onnx", 77)


OPEN_CLIP = {
    "size": [224, 224],
    "mean": CLIP.mean,
    "std": CLIP.std,
    "interpolation": "bicubic",
    "resize_mode": "shortest",
}
# what lies beside the model: {file: content}, and the preprocessing that follows
BESIDE = [
    ({"visual/preprocess_cfg.json": OPEN_CLIP, "config.json": {"vision_cfg": {"layers": 12}}}, CLIP),
    ({"config.json": {"vision_cfg": {"timm_model_name": "vit_base_patch16_siglip_224"}}}, SIGLIP),
    ({"config.json": {"model_type": "siglip"}}, SIGLIP),
    ({"config.json": {"vision_cfg": {"timm_model_name": "fastvit_mci2"}}}, MOBILECLIP),
    (
        {"open_clip_config.json": {"preprocess_cfg": {**OPEN_CLIP, "size": 256, "mean": [0] * 3, "std": [1] * 3,
                                                      "interpolation": "bilinear"}}},
        MOBILECLIP,
    ),
]  # fmt: skip


@pytest.mark.parametrize(("files", "expected"), BESIDE)
def test_preprocessing_stands_in_the_files_beside_the_model(tmp_path: Path, files: dict, expected: Any) -> None:
    """Also in a folder that is called after another model."""
    home = tmp_path / "ViT-B-32__openai"
    for name, content in files.items():
        (home / name).parent.mkdir(parents=True, exist_ok=True)
        (home / name).write_text(json.dumps(content))
    assert find_preprocess(home / "visual" / "model.onnx", None) == expected


@pytest.mark.parametrize(
    ("files", "told"),
    [
        ({}, "its preprocessing is not known"),
        ({"config.json": {"model_type": "clip"}}, "its preprocessing is not known"),
        ({"config.json": {"vision_cfg": {"timm_model_name": "vit_pe_core_base_patch16_224"}}}, "is not known"),
        ({"preprocess_cfg.json": {**OPEN_CLIP, "resize_mode": "longest"}}, "resize 'longest'"),
        ({"preprocess_cfg.json": {**OPEN_CLIP, "size": [224, 336]}}, r"sides \[224, 336\]"),
        ({"preprocessor_config.json": {"size": 224, "resample": 0}}, "filter '0'"),
    ],
)
def test_unknown_preprocessing_is_refused(tmp_path: Path, files: dict, told: str) -> None:
    home = tmp_path / "siglip-base"
    home.mkdir()
    for name, content in files.items():
        (home / name).write_text(json.dumps(content))
    with pytest.raises(InputError, match=told):
        find_preprocess(home / "visual.onnx", 224)


def test_immich_layout_and_siblings(
    clip_folder: tuple[Path, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`visual/`, `textual/`, open_clip's config; other precisions are left out, told and not stored."""
    folder, _ = clip_folder
    home = tmp_path / "nllb-clip"
    for part, graph in (("visual", "vision_model.onnx"), ("textual", "text_model.onnx")):
        (home / part).mkdir(parents=True)
        (home / part / "model.onnx").write_bytes((folder / graph).read_bytes())
        (home / part / "model_fp16.onnx").write_bytes(b"not to be opened")
    for name in ("tokenizer.json", "tokenizer_config.json"):
        (home / "textual" / name).write_bytes((folder / name).read_bytes())
    (home / "visual/preprocess_cfg.json").write_text(json.dumps({**OPEN_CLIP, "size": SIDE}))
    described = {"embed_dim": 16, "vision_cfg": {"layers": 2}, "text_cfg": {"context_length": 77}}
    (home / "config.json").write_text(json.dumps(described))
    encoder, pair = ClipEncoder.from_spec(str(home)), ClipEncoder.from_spec(str(folder))
    assert np.array_equal(encoder.encode_images(_pictures()), pair.encode_images(_pictures()))
    assert np.array_equal(encoder.encode_texts(TEXTS), pair.encode_texts(TEXTS))
    checked = check_file(str(home))
    assert checked["family"] == "CLIP" and checked["warnings"] == [] and len(checked["left_out"]) == 2
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    stored = add_model("mine", [str(home)])
    assert not [f["name"] for f in stored.files if "fp16" in f["name"]]
    assert ClipEncoder.from_spec("mine").identity == encoder.identity
    (home / "textual/config.json").write_text(json.dumps({"model_type": "siglip"}))
    with pytest.raises(InputError, match="towers of CLIP and SigLIP; take both from one model"):
        ClipEncoder.from_spec(str(home))


def test_clip_without_projection_is_refused(clip_folder: tuple[Path, Any], tmp_path: Path) -> None:
    folder, _ = clip_folder
    for file in folder.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    rows = np.zeros((1, 32), np.float32)
    write_onnx(tmp_path / "vision_model.onnx", {"pixel_values": ((1, 3, SIDE, SIDE), FLOAT)}, {"pooler_output": rows})
    with pytest.raises(InputError, match="pooler_output is CLIP's state before the projection"):
        ClipEncoder.from_spec(str(tmp_path))
    assert "before the projection" in check_file(str(tmp_path))["warnings"][0]
    write_onnx(tmp_path / "vision_model.onnx", {"pixel_values": ((1, 3, SIDE, SIDE), FLOAT)}, {"output": rows[:, :16]})
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "clip", "projection_dim": 32}))
    with pytest.raises(InputError, match=r"have 16 numbers, config\.json states 32"):
        ClipEncoder.from_spec(str(tmp_path))


def test_bad_models_are_told_in_one_line(clip_folder: tuple[Path, Any], tmp_path: Path) -> None:
    folder, model = clip_folder
    (tmp_path / "no.onnx").write_text("this is no model")
    vision, text = folder / "vision_model.onnx", folder / "text_model.onnx"
    with pytest.raises(InputError, match=r"no\.onnx: not an ONNX model"):
        make_encoder(f"clip:{vision},{tmp_path / 'no.onnx'}")
    with pytest.raises(InputError, match="no such file"):
        make_encoder(f"clip:{tmp_path / 'gone.onnx'},{text}")
    with pytest.raises(InputError, match=r"no input takes token ids.*IMAGE\.onnx,TEXT\.onnx"):
        make_encoder(f"clip:{text},{vision}")
    with pytest.raises(InputError, match=r"expected vision_model\.onnx"):
        make_encoder(f"clip:{tmp_path}")
    with pytest.raises(InputError, match="expected conse"):
        make_encoder("clap")
    hidden = tmp_path / "vision_hidden.onnx"
    _export(model.vision_model.embeddings, torch.zeros(1, 3, SIDE, SIDE), hidden, ["pixel_values"], ["hidden"])
    with pytest.raises(InputError, match="no output holds one embedding a row"):
        ClipEncoder(hidden, text)
    narrow = tmp_path / "narrow.onnx"
    _export(torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(3 * SIDE * SIDE, 8)), torch.zeros(1, 3, SIDE, SIDE),
            narrow, ["pixel_values"], ["image_embeds"])  # fmt: skip
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(CLIP_PREPROCESSOR))
    with pytest.raises(InputError, match=r"have 8 numbers.*16; take both towers from one model"):
        ClipEncoder(narrow, text)


@pytest.mark.parametrize(
    ("side", "dim", "weight", "told"),
    [
        (SIDE, 8, 1.0, "its embeddings have 8 numbers, those of .* 16; take both towers from one model"),
        (SIDE // 2, 16, 1.0, rf"fails on pixel_values\[1, 3, {SIDE}, {SIDE}\] .*export it anew"),
        (SIDE, 16, float("nan"), "its output image_embeds holds NaN; take the model in full precision"),
    ],
)
def test_a_graph_that_only_claims_to_take_any_picture_is_told_before_work(
    clip_folder: tuple[Path, Any], tmp_path: Path, side: int, dim: int, weight: float, told: str
) -> None:
    tower = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(3 * side * side, dim))
    torch.nn.init.constant_(tower[1].weight, weight)
    axes = {"pixel_values": {0: "batch", 2: "height", 3: "width"}, "image_embeds": {0: "batch", 1: "dim"}}
    loose = tmp_path / "loose.onnx"
    _export(tower, torch.zeros(1, 3, side, side), loose, ["pixel_values"], ["image_embeds"], axes)
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(CLIP_PREPROCESSOR))
    with pytest.raises(InputError, match=rf"loose\.onnx: {told}"):
        make_encoder(f"clip:{loose},{clip_folder[0] / 'text_model.onnx'}", pictures=True)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("config.json", {"vision_cfg": [1]}),
        ("config.json", {"text_config": 77}),
        ("open_clip_config.json", {"model_cfg": None}),
        ("preprocessor_config.json", {"size": {"height": None, "width": 224}}),
        ("preprocessor_config.json", {**CLIP_PREPROCESSOR, "image_mean": ["a", 0, 0]}),
    ],
)
def test_a_damaged_file_beside_the_model_is_told_in_one_line(
    clip_folder: tuple[Path, Any], tmp_path: Path, name: str, content: dict[str, Any]
) -> None:
    for file in clip_folder[0].iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / name).write_text(json.dumps(content))
    with pytest.raises(InputError, match=f"clip:{tmp_path}: a file beside the model is not understood") as error:
        make_encoder(f"clip:{tmp_path}")
    assert "\n" not in str(error.value)


def test_a_silent_fall_back_from_cuda_is_told(clip_folder: tuple[Path, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    names = ["CUDAExecutionProvider", "CPUExecutionProvider"]
    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: names)
    with pytest.warns(RuntimeWarning, match=r"CUDAExecutionProvider did not load, running on CPUExecutionProvider"):
        ClipEncoder.from_spec(str(clip_folder[0]))


def test_bad_texts_and_pictures(clip_folder: tuple[Path, Any]) -> None:
    encoder = make_encoder(f"clip:{clip_folder[0]}")
    assert encoder is not None
    with pytest.raises(InputError, match="text 2 of 2: it is empty"):
        encoder.encode_texts(["mug", " \n"])
    with pytest.raises(InputError, match=r"expected RGB uint8 \[H, W, 3\], found float32"):
        encoder.encode_images([np.zeros((4, 4, 3), np.float32)])
    assert encoder.encode_texts([]).shape == (0, 16)
    assert encoder.encode_images([]).shape == (0, 16)
