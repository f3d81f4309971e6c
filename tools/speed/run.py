"""Measures speed and peak memory of model files of real size with random weights.

    python tools speed.run sam PHOTO...           masks, prompts that lie in an earlier mask skipped (the default)
    python tools speed.run sam PHOTO... --full    masks, the full grid of 1,024 prompts
    python tools speed.run words                  1,500 crops, as 100 instances of 15, through a CLIP ViT-B/32

SAM is a decoder of real size behind an encoder as expensive as MobileSAM's; its masks gather round the prompt, as a
trained one's do. The models are exported to ONNX into a temporary folder first, which is not timed.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

PHOTO, INSTANCES, CROPS = 800, 100, 15
"""Long side of the photos that SAM reads; instances and crops of each for the words."""


def sam(photos: list[Path], full: bool) -> None:
    """Prints prompts, masks, seconds a photo and the peak memory."""
    from PIL import Image

    from perception.config import SamConfig
    from perception.masks.sam import SamSource, automatic_masks
    from support.paths import SUPPORT

    exporter = SUPPORT / "sam_exports.py"
    with tempfile.TemporaryDirectory() as folder:  # by another process, whose memory does not count
        subprocess.run([sys.executable, exporter, "mobile", folder], check=True)
        source = SamSource(folder, SamConfig(skip_covered=not full))
    images = []
    for path in photos:
        image = Image.open(path).convert("RGB")
        image.thumbnail((PHOTO, PHOTO))
        images.append(np.asarray(image))
    prompts, decode = [], source.model.decode

    def counted(embedding: np.ndarray, points: np.ndarray) -> object:
        prompts.append(len(points))
        return decode(embedding, points)

    source.model.decode = counted  # type: ignore[method-assign]
    before = memory()
    wall, cpu = time.perf_counter(), time.process_time()
    with ThreadPoolExecutor(source.photos_at_once) as pool:
        found = list(pool.map(lambda image: automatic_masks(source.model, image, source.settings), images))
    wall, cpu, count = time.perf_counter() - wall, time.process_time() - cpu, len(images)
    print(f"{count} photos, {sum(prompts) / count:.0f} prompts and {sum(map(len, found)) / count:.0f} masks each")
    print(f"{wall / count:.1f} s ({cpu / count:.1f} CPU s) a photo, {60 * count / wall:.1f} photos a minute")
    print(f"peak {memory()} MB, {before} MB before the first photo")


def words() -> None:
    """Prints seconds for all crops, and milliseconds for one."""
    import torch
    import transformers

    from language import test_clip as parts
    from perception.language.clip import ClipEncoder

    torch.manual_seed(0)
    config = transformers.CLIPConfig()  # its defaults are ViT-B/32's sizes
    config._attn_implementation = "eager"
    model = transformers.CLIPModel(config).eval()
    with tempfile.TemporaryDirectory() as name:
        folder, text = Path(name), torch.full((1, 77), 1)
        image = parts._Tower(model, True), torch.zeros(1, 3, 224, 224)
        parts._export(*image, folder / "vision_model.onnx", ["pixel_values"], ["image_embeds"])
        parts._export(parts._Tower(model, False), text, folder / "text_model.onnx", ["input_ids"], ["text_embeds"])
        parts._reference_tokenizer().save_pretrained(folder)
        (folder / "config.json").write_text(json.dumps({"model_type": "clip", "projection_dim": 512}))
        preprocessor = {**parts.CLIP_PREPROCESSOR, "size": 224, "crop_size": 224}
        (folder / "preprocessor_config.json").write_text(json.dumps(preprocessor))
        encoder = ClipEncoder.from_spec(name)
    rng = np.random.default_rng(0)
    crops = [rng.integers(0, 255, (side, side, 3), dtype=np.uint8) for side in rng.integers(60, 400, CROPS)]
    encoder.encode_images(crops)
    wall, cpu = time.perf_counter(), time.process_time()
    for _ in range(INSTANCES):
        encoder.encode_images(crops)
    wall, cpu, count = time.perf_counter() - wall, time.process_time() - cpu, INSTANCES * CROPS
    print(f"{count} crops in {wall:.0f} s ({cpu:.0f} CPU s), {1e3 * wall / count:.1f} ms a crop")


def memory() -> int:
    """Peak of this process so far, in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ways = parser.add_subparsers(dest="what", required=True)
    way = ways.add_parser("sam")
    way.add_argument("photos", type=Path, nargs="+")
    way.add_argument("--full", action="store_true", help="ask every prompt of the grid")
    ways.add_parser("words")
    args = parser.parse_args()
    if args.what == "sam":
        sam(args.photos, args.full)
    else:
        words()
