"""A folder as a phone exports it, mapped from the command line: HEIC, Live Photos, turned photos, bursts, damage."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from perception.cli import main
from perception.geometry import align_similarity, camera_centres
from perception.map.write import read_map
from perception.photos.folder import view_name
from support.videos import turn_video, write_video
from worlds import make_photos

pytestmark = pytest.mark.slow

VIEWS, WIDTH, HEIGHT = 14, 400, 300  # of a path of 18
SETTINGS = ["train.iterations=60", "train.budget=3000", "language.encoder=none", "photos.max_side=120"]


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[np.ndarray], np.ndarray]:
    """Photos [300, 400, 3] of the demo's tabletop in the order of the camera path, and camera centres [V, 3]."""
    folder = tmp_path_factory.mktemp("rendered")
    truth = make_photos(folder / "images", views=18, width=WIDTH, height=HEIGHT, light_samples=1)
    cameras = json.loads((folder / "truth" / "transforms.json").read_text())
    pictures = [np.asarray(Image.open(folder / "images" / name).convert("RGB")) for name in truth.names[:VIEWS]]
    poses = {Path(f["file_path"]).name: np.array(f["transform_matrix"]) for f in cameras["frames"]}
    return pictures, np.stack([poses[name][:3, 3] for name in truth.names[:VIEWS]])


def phone_folder(folder: Path, pictures: list[np.ndarray]) -> list[str]:
    """Writes the photos as a phone would; returns the name of each."""
    import pillow_heif

    pillow_heif.register_heif_opener()
    (folder / "#extra\n").mkdir(parents=True)
    turned = Image.Exif()
    turned[0x0112] = 6  # stored on its side, shown turned by 90° clockwise
    names = []
    for index, picture in enumerate(pictures):
        name = f"IMG_{index:04d}"
        image = Image.fromarray(picture)
        if index % 5 == 1:
            names.append(f"{name}.jpg")
            Image.fromarray(np.rot90(picture)).save(folder / names[-1], exif=turned, quality=95)
        elif index % 5 == 2:
            names.append(f"{name}.JPG")
            image.resize((WIDTH * 3 // 2, HEIGHT * 3 // 2), Image.Resampling.LANCZOS).save(
                folder / names[-1], quality=95
            )
        else:
            names.append(f"{name}.HEIC")
            image.save(folder / names[-1], quality=90)
    odd = os.fsdecode(b"IMG_6\xe9#\n.jpg")  # bytes that are no UTF-8, and a line end
    (folder / names[6]).rename(folder / odd)
    names[6] = view_name(folder / odd, folder)
    write_video(folder / "IMG_0000.MOV", [pictures[0]] * 5)  # the Live Photo of the first
    Image.fromarray(pictures[3]).save(folder / "IMG_0003_burst.HEIC", quality=60)
    (folder / "IMG_0050.HEIC").write_bytes((folder / names[0]).read_bytes()[:2000])
    Image.fromarray(pictures[7]).save(folder / "#extra\n" / "copy.png")
    return names


def test_a_phones_folder_becomes_a_map(
    rendered: tuple[list[np.ndarray], np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pillow_heif")
    pictures, centres = rendered
    names = phone_folder(tmp_path / "photos", pictures)
    out = tmp_path / "photos" / "m.gsmap"  # beside the photos, as people do
    assert main(["map", str(tmp_path / "photos"), "-o", str(out), *[f"--set={s}" for s in SETTINGS]]) == 0
    told = capsys.readouterr().err
    assert "trained at up to 120 pixels: about" in told and "GiB" in told
    assert "1 videos beside the photos are not read, 1 of them belong to Live Photos" in told
    gmap = read_map(out)
    found = {view.name: view.camera_from_world for view in gmap.views}
    left_out = {entry["name"]: entry["why"] for entry in gmap.info["scene"]["left_out"]}
    assert "damaged" in left_out["IMG_0050.HEIC"] or "not a readable" in left_out["IMG_0050.HEIC"]
    assert len({"IMG_0003.HEIC", "IMG_0003_burst.HEIC"} & left_out.keys()) == 1
    posed = [index for index, name in enumerate(names) if name in found]
    assert len(posed) >= 0.8 * VIEWS and names[6] == "IMG_6%E9#%0A.jpg" in found
    mapped = camera_centres(np.stack([found[names[index]] for index in posed]))
    scale, rotation, shift = align_similarity(centres[posed], mapped)
    errors = np.linalg.norm(centres[posed] - (scale * mapped @ rotation.T + shift), axis=1)
    spread = np.linalg.norm(centres - centres.mean(0), axis=1).mean()
    assert np.median(errors) < 0.03 * spread


def test_a_video_becomes_a_map(
    rendered: tuple[list[np.ndarray], np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The photos of the path, each shown for three frames, from a phone held upright."""
    frames = [np.ascontiguousarray(np.rot90(picture)) for picture in rendered[0] for _ in range(3)]
    video = write_video(tmp_path / "kitchen.mp4", frames, rate=15)
    turn_video(video, WIDTH)
    out = tmp_path / "kitchen.gsmap"
    assert main(["map", str(video), "-o", str(out), *[f"--set={s}" for s in SETTINGS]]) == 0
    gmap = read_map(out)
    assert len(gmap.views) >= 0.6 * VIEWS
    assert {view.photo.resolve().parent for view in gmap.located_views()} == {tmp_path / "kitchen.gsmap.frames"}
    assert "kitchen.gsmap.frames" in capsys.readouterr().err
    assert not (tmp_path / "kitchen.gsmap.work").exists()
