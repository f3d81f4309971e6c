"""The model store against a local hub that breaks off, lies, or lacks files; and what check says."""

from __future__ import annotations

import hashlib
import json
import shutil
import threading
from collections.abc import Iterator, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from perception import models
from perception.cli import main
from perception.errors import InputError, home_path
from perception.masks import make_source
from perception.models import add_model, check_file, get_model
from perception.onnx.store import Entry, StoredModel, catalogue, find_model, models_folder
from support.onnx_files import FLOAT, INT64, SAM_DECODER, write_onnx

IMAGE = ((1, 3, 1024, 1024), FLOAT)


class Server(ThreadingHTTPServer):
    """A hub. files: path -> bytes. breaks: how many answers stop half way. asked: the Range of each GET."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.files: dict[str, bytes] = {}
        self.breaks = 0
        self.asked: list[str | None] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class Handler(BaseHTTPRequestHandler):
    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        server: Server = self.server
        body, wanted = server.files.get(self.path), self.headers.get("Range")
        if body is None:
            self.send_error(404)
            return
        start = int(wanted.removeprefix("bytes=").split("-")[0]) if wanted else 0
        self.send_response(206 if wanted else 200)
        if wanted:
            self.send_header("Content-Range", f"bytes {start}-{len(body) - 1}/{len(body)}")
        self.send_header("ETag", f'"{hashlib.md5(body).hexdigest()}"')
        self.send_header("X-Repo-Commit", "abc123")
        self.send_header("Content-Length", str(len(body) - start))
        self.end_headers()
        if self.command == "HEAD":
            return
        server.asked.append(wanted)
        rest = body[start:]
        if server.breaks > 0 and len(rest) > 900:
            server.breaks -= 1
            rest = rest[: len(rest) // 2]
        self.wfile.write(rest)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server()
    threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
    yield server
    server.shutdown()
    server.server_close()


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.delenv("PERCEPTION_SAM", raising=False)


@pytest.fixture
def sam(tmp_path: Path) -> tuple[Path, Path]:
    """Encoder and decoder by SAM's signatures that do nothing."""
    embedding = np.zeros((1, 2, 64, 64), np.float32)
    masks, iou = np.zeros((1, 4, 8, 8), np.float32), np.zeros((1, 4), np.float32)
    folder = tmp_path / "published"
    folder.mkdir()
    write_onnx(folder / "a.encoder.onnx", {"x": IMAGE}, {"image_embeddings": embedding})
    write_onnx(folder / "a.decoder.onnx", SAM_DECODER, {"masks": masks, "iou_predictions": iou})
    return folder / "a.encoder.onnx", folder / "a.decoder.onnx"


# ----------------------------------------------------------------------- the store


def test_auto_takes_a_stored_model_by_its_name(sam: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    assert make_source("auto").name.startswith("built")
    add_model("tiny", [str(sam[0]), str(sam[1])])
    monkeypatch.setenv("PERCEPTION_SAM", "tiny")
    assert make_source("auto").name.startswith("sam (SAM")


def test_what_is_no_model_is_not_stored(tmp_path: Path, sam: tuple[Path, Path]) -> None:
    (tmp_path / "fake.onnx").write_bytes(b"<html>not found</html>")
    with pytest.raises(InputError, match="not an ONNX model"):
        add_model("fake", [str(tmp_path / "fake.onnx")])
    assert find_model("fake") is None and not list(models_folder().glob("*fake*"))
    for name in ("../up", "a/b", "", ".hidden"):
        with pytest.raises(InputError, match="model name"):
            add_model(name, [str(sam[0])])
    with pytest.raises(InputError, match=r"no \.onnx file"):
        add_model("text", [__file__])
    with pytest.raises(InputError, match="no such file"):
        add_model("gone", [str(tmp_path / "gone.onnx")])


def test_files_that_were_not_added_are_not_replaced(sam: tuple[Path, Path]) -> None:
    for _ in range(2):
        add_model("mine", [str(file) for file in sam])
    notes = models_folder() / "mine" / "notes.txt"
    notes.symlink_to("nowhere")
    with pytest.raises(InputError, match=r"notes\.txt: was not added"):
        add_model("mine", [str(file) for file in sam])
    notes.unlink()
    notes.symlink_to(models_folder(), target_is_directory=True)
    with pytest.raises(InputError, match=r"notes\.txt: was not added"):
        add_model("mine", [str(file) for file in sam])
    notes.unlink()
    notes.write_text("where it came from")
    with pytest.raises(InputError, match=r"notes\.txt: was not added"):
        add_model("mine", [str(sam[0])])
    assert notes.read_text() == "where it came from" and (notes.parent / sam[1].name).is_file()


# ----------------------------------------------------------------------- the catalogue


@pytest.fixture
def hub(server: Server, sam: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> dict[str, tuple[int, str]]:
    """A hub with one model, as the catalogue's "tiny": path -> (bytes, sha256)."""
    files = {f"onnx/{file.name}": file.read_bytes() for file in sam} | {"config.json": b"{}"}
    facts = {path: (len(body), hashlib.sha256(body).hexdigest()) for path, body in files.items()}
    known = {path: [fact[0], None if path == "config.json" else fact[1]] for path, fact in facts.items()}
    held = catalogue() | {"tiny": Entry("sam", "org/tiny-ONNX", "abc123", "MIT", known)}
    monkeypatch.setattr("perception.models.catalogue", lambda: held)
    monkeypatch.setenv("HF_ENDPOINT", server.url)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    server.files |= {f"/org/tiny-ONNX/resolve/abc123/{path}": data for path, data in files.items()}
    return facts


def test_get_fetches_an_entry_of_the_catalogue(
    server: Server, hub: dict[str, tuple[int, str]], capsys: pytest.CaptureFixture[str]
) -> None:
    megabytes = sum(size for size, _ in hub.values()) / 1e6
    assert main(["models", "get", "tiny"]) == 0
    said = capsys.readouterr()
    assert f"tiny: 3 files, {megabytes:.1f} MB, of org/tiny-ONNX at abc123, licence MIT, to " in said.err
    assert "use it with --masks sam:tiny" in said.out and make_source("sam:tiny").name.startswith("sam (SAM")
    asked = len(server.asked)
    assert main(["models", "get", "tiny"]) == 0 and len(server.asked) == asked  # it is there
    assert main(["models", "get"]) == 0
    assert "slimsam-77" in capsys.readouterr().out


def test_get_goes_on_after_a_broken_connection(
    server: Server, hub: dict[str, tuple[int, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("huggingface_hub.constants.DOWNLOAD_CHUNK_SIZE", 100)
    server.breaks = 1
    model = get_model("tiny")
    encoder = next(file for file in model.files if "encoder" in file["name"])
    resumed = next(asked for asked in server.asked if asked)
    assert 0 < int(resumed.removeprefix("bytes=").rstrip("-")) < encoder["bytes"]
    assert (encoder["bytes"], encoder["sha256"]) == hub["onnx/a.encoder.onnx"]
    assert not list((models_folder() / ".parts").iterdir())


def test_get_beside_another_process_that_gets_the_same(
    hub: dict[str, tuple[int, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It throws away what both have fetched."""

    def installed(name: str, files: Sequence[tuple[str, Path, str]]) -> StoredModel:
        model = install(name, files)
        shutil.rmtree(models_folder() / ".parts" / name)
        return model

    install = models._install
    monkeypatch.setattr(models, "_install", installed)
    assert get_model("tiny").name == "tiny"


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"onnx/a.encoder.onnx": None}, r"encoder\.onnx: sha256 is .*thrown away"),
        ({"onnx/a.decoder.onnx": b""}, r"decoder\.onnx: sha256 is .*thrown away"),
    ],
)
def test_get_refuses_what_is_not_the_file(
    server: Server, hub: dict[str, tuple[int, str]], change: dict[str, bytes | None], told: str
) -> None:
    for path, body in change.items():
        key = f"/org/tiny-ONNX/resolve/abc123/{path}"
        server.files[key] = server.files[key][:-1] + b"?" if body is None else body
    with pytest.raises(InputError, match=told):
        get_model("tiny")
    assert find_model("tiny") is None


def test_get_refuses_what_the_hub_lacks(server: Server, hub: dict[str, tuple[int, str]]) -> None:
    with pytest.raises(InputError, match=r"models get mini: not in the catalogue; it holds slimsam-77, .*tiny"):
        get_model("mini")
    server.files.clear()
    with pytest.raises(InputError, match=r"encoder\.onnx: cannot be fetched .*run the command again"):
        get_model("tiny")
    assert find_model("tiny") is None


# ----------------------------------------------------------------------- check


def test_check_names_family_roles_and_providers(sam: tuple[Path, Path], tmp_path: Path) -> None:
    whole = check_file(str(sam[0].parent))
    assert (whole["family"], whole["purpose"], whole["warnings"]) == ("SAM", "sam", [])
    assert [entry["role"] for entry in whole["files"]] == ["decoder", "encoder"]
    decoder = whole["files"][0]
    assert decoder["inputs"][0] == {"name": "image_embeddings", "shape": [1, 2, 64, 64], "type": "tensor(float)"}
    assert decoder["providers"] == ["CPUExecutionProvider"]
    assert check_file(str(sam[1]))["warnings"] == ["the encoder is missing; both are needed"]

    rows = np.zeros((1, 8), np.float32)
    (tmp_path / "text").mkdir()
    (tmp_path / "text/config.json").write_text('{"model_type": "siglip"}')
    write_onnx(tmp_path / "text/text.onnx", {"input_ids": (("n", 64), INT64)}, {"text_embeds": rows})
    write_onnx(tmp_path / "vision.onnx", {"pixel_values": IMAGE}, {"image_embeds": rows})
    write_onnx(tmp_path / "other.onnx", {"audio": ((1, 5), FLOAT)}, {"sound": np.zeros((5,), np.float32)})
    text, vision, other = (check_file(str(tmp_path / f"{n}.onnx")) for n in ("text/text", "vision", "other"))
    assert (text["family"], text["files"][0]["role"]) == ("SigLIP", "text tower")
    assert (vision["family"], vision["files"][0]["role"]) == ("CLIP-like", "image tower")
    assert other["family"] is None and "unknown" in other["warnings"][0]


def test_a_cuda_that_did_not_come_up_is_told(sam: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    import onnxruntime

    names = ["CUDAExecutionProvider", "CPUExecutionProvider"]
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: names)
    warnings = check_file(str(sam[0].parent))["warnings"]
    assert warnings[0] == "a.decoder.onnx: CUDAExecutionProvider did not load, running on CPUExecutionProvider"


def test_the_command_line(sam: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["models", "list"]) == 0 and "no models" in capsys.readouterr().out
    assert main(["models", "add", "tiny", str(sam[0]), str(sam[1])]) == 0
    assert "use it with --masks sam:tiny" in capsys.readouterr().out
    assert main(["models", "list", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)["models"]
    assert [(m["name"], m["family"]) for m in listed] == [("tiny", "SAM")]
    assert main(["models", "check", "tiny"]) == 0
    assert "runs on CPUExecutionProvider" in capsys.readouterr().out
    assert main(["models", "check", "nowhere"]) == 2
    assert "the store holds tiny" in capsys.readouterr().err


def test_a_user_without_a_home(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(_: object) -> None:
        raise KeyError

    for name in ("HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name in ("getpwuid", "getpwnam"):
        monkeypatch.setattr(f"pwd.{name}", unknown)
    assert models_folder() == Path("/.cache/perception/models")
    assert [str(home_path(text)) for text in ("~", "~other/x", "a")] == ["~", "~other/x", "a"]
