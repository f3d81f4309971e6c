"""Permissively licensed public exports on the Hugging Face hub that `perception models get` fetches.

Revisions are commits, so that the files cannot change. Digests are those that several public projects pin for the same
revision; where none is known, the size and digest that the hub states are used. None of these files was downloaded by
this project.
"""

from __future__ import annotations

import http.client
import json
import os
import urllib.request
from dataclasses import dataclass
from urllib.parse import quote

from perception.errors import InputError
from perception.io.download import TIMEOUT

HUB = "https://huggingface.co"


@dataclass(frozen=True)
class Entry:
    """A model. files: path in the repository -> (bytes, sha256), None where not known."""

    purpose: str
    repository: str
    revision: str
    licence: str
    files: dict[str, tuple[int | None, str | None]]


CATALOGUE = {
    "slimsam-77": Entry(
        "sam", "Xenova/slimsam-77-uniform", "5850ab45f587c112167512ffef949107115e26a0", "Apache-2.0",
        {
            "onnx/vision_encoder.onnx":
                (23276014, "9f8433273a6750b587779baa0cf5508111001bf7e7acfcf585d370139fd366d0"),
            "onnx/prompt_encoder_mask_decoder.onnx":
                (16557892, "f4514391764fbd56e08e119060d874ecd7d52994bfb1968af159e12d4943b5bb"),
        },
    ),
    "sam2.1-tiny": Entry(
        "sam", "onnx-community/sam2.1-hiera-tiny-ONNX", "814a066640debee5a91e70aa401fb8e17e030503", "Apache-2.0",
        {
            "onnx/vision_encoder.onnx":
                (354238, "4f30aacd3aaefbca81a0b7fe4c1fc96345570ea0a6f80ced599493d1b3be2e8c"),
            "onnx/vision_encoder.onnx_data":
                (134084864, "e83df9866a5afe68ea7f0f721f18f65137fc3acbf0da1c74e946d363e09c69cc"),
            "onnx/prompt_encoder_mask_decoder.onnx":
                (213114, "874414704c5d686db7d206a35f6e15d26563d50c8c4468fccc6739bd7e491dcf"),
            "onnx/prompt_encoder_mask_decoder.onnx_data":
                (20958208, "e9874d900dd4134ed60eab1e97910327c2419e0b2954485d8fd6e7f1a1470f47"),
        },
    ),
    "siglip-base": Entry(
        "clip", "Xenova/siglip-base-patch16-224", "4649052661e53c7000355844105f8a1792088239", "Apache-2.0",
        {
            "onnx/vision_model.onnx": (None, None),
            "onnx/text_model.onnx": (None, "3aa7fdbd20eaa8740cce17bf82913de641fcb632a768fed59f661cdcd0c32553"),
            "tokenizer.json": (None, "4a17c975210be5ab4c36b47d8dae4eefb866dbfb1e676e394aad85dc30a3ae08"),
            "tokenizer_config.json": (None, None),
            "config.json": (None, None),
            "preprocessor_config.json": (None, None),
        },
    ),
}  # fmt: skip


def entry_of(name: str) -> Entry:
    """The entry of the catalogue; InputError for another name."""
    if name not in CATALOGUE:
        raise InputError(f"models get {name}: not in the catalogue; it holds {', '.join(CATALOGUE)}")
    return CATALOGUE[name]


def hub_files(entry: Entry) -> dict[str, tuple[int | None, str | None]]:
    """Address of each file -> (bytes, sha256), as far as the catalogue or the hub knows. HF_ENDPOINT names a mirror.

    InputError when the hub does not have a file, or states another size or digest than the catalogue.
    """
    home = (os.environ.get("HF_ENDPOINT") or HUB).rstrip("/")
    url = f"{home}/api/models/{entry.repository}/revision/{entry.revision}?blobs=true"
    try:
        request = urllib.request.Request(url, headers={"User-Agent": "perception"})
        with urllib.request.urlopen(request, timeout=TIMEOUT) as answer:
            listed = {file["rfilename"]: file for file in json.load(answer)["siblings"]}
    except (OSError, http.client.HTTPException, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{url}: cannot be read ({error}); check the connection, or name a mirror in HF_ENDPOINT"
        ) from error
    found = {}
    for path, known in entry.files.items():
        if path not in listed:
            raise InputError(f"{url}: has no {path}; the catalogue is out of date")
        stated = listed[path].get("size"), (listed[path].get("lfs") or {}).get("sha256")
        for ours, theirs in zip(known, stated, strict=True):
            if ours is not None and theirs is not None and ours != theirs:
                raise InputError(f"{url}: states {theirs} for {path}, the catalogue {ours}; nothing was fetched")
        address = f"{home}/{entry.repository}/resolve/{entry.revision}/{quote(path)}"
        found[address] = (known[0] or stated[0], known[1] or stated[1])
    return found
