"""A video as input: which frames are taken, how they are turned, and files that are no video."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from perception.errors import InputError
from perception.inputs.load import load_scene, photo_sizes
from perception.photos.folder import list_photos
from perception.photos.video import FRAMES_RECORD, frame_size, frames, video_frames
from perception.pipeline.checkpoint import frames_folder, working
from perception.progress import QUIET
from perception.sfm.options import ReadOptions
from support.progress import Told
from support.videos import turn_video, write_video


def pan(count: int, step: int = 4, blurred: tuple[int, ...] = ()) -> list[np.ndarray]:
    """Frames [120, 160, 3] of a camera that pans over one texture by `step` pixels a frame."""
    coarse = np.random.default_rng(0).integers(0, 255, (20, (160 + count * step) // 8, 3), dtype=np.uint8)
    wide = cv2.resize(coarse, (160 + count * step, 120), interpolation=cv2.INTER_CUBIC)
    frames = [wide[:, i * step : i * step + 160].copy() for i in range(count)]
    return [cv2.GaussianBlur(f, (0, 0), 5) if i in blurred else f for i, f in enumerate(frames)]


def test_frames_are_sharp_and_well_spaced(tmp_path: Path) -> None:
    """30 frames a second, every second looked at: 8 pixels of 160 are 5 % of the width, one stretch of 8 % or two."""
    blurred = tuple(range(0, 120, 4))
    video = write_video(tmp_path / "v.mp4", pan(120, blurred=blurred))
    record = video_frames(video, tmp_path / "frames", Told())
    numbers = [int(photo.stem) for photo in list_photos(tmp_path / "frames")]
    assert record["frames"] == 119 or record["frames"] == 120
    assert len(numbers) == record["chosen"] and 25 <= len(numbers) <= 65
    assert np.diff(numbers).min() >= 2 and np.diff(numbers).max() <= 8
    assert len(set(numbers) & set(blurred)) <= 1
    (tmp_path / "frames" / numbers_name(numbers[0])).unlink()
    assert video_frames(video, tmp_path / "frames", Told()) == record  # used again


def numbers_name(number: int) -> str:
    return f"{number:06d}.jpg"


def test_a_video_held_upright_gives_upright_frames(tmp_path: Path) -> None:
    frames = pan(40)
    video = write_video(tmp_path / "v.mov", frames)
    turn_video(video, 120)
    assert frame_size(video) == (120, 160)
    video_frames(video, tmp_path / "frames", Told())
    for photo in list_photos(tmp_path / "frames"):
        expected = np.rot90(frames[int(photo.stem)], -1).astype(float)
        assert np.abs(np.asarray(Image.open(photo)) - expected).mean() < 12  # two lossy codecs


@pytest.mark.parametrize("name", ["v.3gp", "v.mpg", "V.MTS", "v.wmv"])
def test_videos_of_phones_and_camcorders(name: str, tmp_path: Path) -> None:
    """The wrapper is by the name of the file that OpenCV writes."""
    rate, frames = 25, pan(3)
    writer = cv2.VideoWriter(str(tmp_path / name), cv2.VideoWriter_fourcc(*"mp4v"), rate, (160, 120))  # type: ignore[attr-defined]
    for frame in frames:
        writer.write(frame)
    writer.release()
    assert photo_sizes(tmp_path / name).sizes[0] == (160, 120)


def test_a_video_named_by_the_time_of_day(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """FFmpeg takes what stands before a colon for a protocol."""
    write_video(tmp_path / "v.mp4", pan(3))
    (tmp_path / "v.mp4").rename(tmp_path / "2024-05-01T12:30:01.mp4")
    monkeypatch.chdir(tmp_path)
    assert frame_size(Path("2024-05-01T12:30:01.mp4")) == (160, 120)


def test_a_video_that_does_not_state_its_length(tmp_path: Path) -> None:
    """As browsers record: OpenCV tells a negative number of frames."""
    file = tmp_path / "v.avi"
    file.write_bytes(b"".join(cv2.imencode(".jpg", frame)[1].tobytes() for frame in pan(40)))
    assert cv2.VideoCapture(str(file)).get(cv2.CAP_PROP_FRAME_COUNT) < 0
    numbers, shares, _ = zip(*frames(file), strict=True)
    np.testing.assert_allclose(shares, (np.array(numbers) + 1) / 40)
    assert [number for number, _, _ in frames(file, most=8)] == [0, 5, 10, 15, 20, 25, 30, 35]
    assert [(number, share) for number, share, _ in frames(file, {3, 7})] == [(3, 0.5), (7, 1.0)]


def test_files_that_are_no_video(tmp_path: Path) -> None:
    file = tmp_path / "v.mp4"
    file.write_bytes(b"no video at all" * 50)
    for _ in range(2):
        with pytest.raises(InputError, match=r"v\.mp4: not a readable video"):
            load_scene(file, ReadOptions(tmp_path / "work", frames=tmp_path / "v.frames"))
        assert not (tmp_path / "v.frames").exists()
    write_video(file, pan(30))
    (tmp_path / "v.frames").mkdir()
    with pytest.raises(InputError, match=r"v\.frames: exists already"):
        load_scene(file, ReadOptions(tmp_path / "work", frames=tmp_path / "v.frames"))


def test_a_folder_of_videos_says_what_to_give(tmp_path: Path) -> None:
    (tmp_path / "v.mp4").write_bytes(b"x")
    with pytest.raises(InputError, match=r"files, or a video itself; 1 videos beside the photos .*: v\.mp4$"):
        load_scene(tmp_path, ReadOptions(tmp_path / "w"))


def test_names_that_are_no_utf8(tmp_path: Path) -> None:
    """OpenCV crashes on such a path; frames are written where the map is, under any name."""
    video = write_video(tmp_path / "v.mp4", pan(30))
    odd = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xe9"))
    odd.mkdir()
    assert video_frames(video, odd / "v.frames", QUIET)["chosen"] == len(list((odd / "v.frames").glob("*.jpg"))) > 1
    shutil.copyfile(video, odd / "v.mp4")
    with pytest.raises(InputError, match="the path holds bytes that are no UTF-8; rename the video"):
        frame_size(odd / "v.mp4")


def test_a_video_that_cannot_be_posed_leaves_no_frames(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 255, (120, 160, 3), dtype=np.uint8) for _ in range(20)]
    video = write_video(tmp_path / "v.mp4", noise)
    with pytest.raises(InputError, match="could be registered"):
        load_scene(video, ReadOptions(tmp_path / "work", frames=tmp_path / "v.frames"))
    assert not (tmp_path / "v.frames").exists()


def test_a_video_of_a_camera_that_stands_still_is_told_by_its_name(tmp_path: Path) -> None:
    video = write_video(tmp_path / "v.mp4", [pan(1)[0]] * 20)
    with pytest.raises(InputError, match=r"v\.mp4: 1 of (19|20) frames of v\.mp4 are sharp .* 1 photo"):
        load_scene(video, ReadOptions(tmp_path / "work", frames=tmp_path / "v.frames"))


def test_frames_of_maps_with_points_in_their_names_lie_apart() -> None:
    assert [frames_folder(Path(f"floor.{n}")).name for n in (1, 2)] == ["floor.1.frames", "floor.2.frames"]


def test_a_record_that_is_none_is_no_record(tmp_path: Path) -> None:
    video = write_video(tmp_path / "v.mp4", pan(20))
    (tmp_path / "frames").mkdir()
    for content, told in (("[", "not readable JSON"), (json.dumps([1]), "exists already")):
        (tmp_path / "frames" / "frames.json").write_text(content)
        with pytest.raises(InputError, match=told):
            video_frames(video, tmp_path / "frames", Told())


@pytest.mark.parametrize("earlier", [False, True])
def test_a_refused_run_leaves_only_frames_that_were_there(tmp_path: Path, earlier: bool) -> None:
    video, output = tmp_path / "v.mp4", tmp_path / "v.gsmap"
    video.write_bytes(b"x")
    if earlier:
        frames_folder(output).mkdir()
    with pytest.raises(InputError, match="later"), working(video, output, resume=False):
        frames_folder(output).mkdir(exist_ok=True)
        (frames_folder(output) / FRAMES_RECORD).write_text("{}")  # as a run writes it
        raise InputError("found later")
    assert {path.name for path in tmp_path.iterdir()} == {"v.mp4", *(["v.gsmap.frames"] if earlier else [])}
