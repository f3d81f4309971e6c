"""`perception frames`: extracts sharp, well-spaced photos from a bag, with intrinsics and what there is of poses, depth
and gravity."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perception.bags.depth import MILLIMETRES, choose_depth, depth_topics, write_depth
from perception.bags.poses import FIXED_FRAMES, Poses, gravity, read_poses
from perception.bags.read import CAMERA_INFO, IMAGES, Bag, camera_of, decode_image, encoded, open_bag, stamp_of
from perception.errors import InputError
from perception.geometry import OPENCV_FROM_OPENGL, inverse_se3
from perception.inputs.transforms import lens_values
from perception.io.atomic import atomic_directory
from perception.map.outputs import check_empty
from perception.photos.camera_file import camera_info, read_camera, write_camera
from perception.photos.video import Chooser
from perception.types import Lens


@dataclass(frozen=True)
class FrameOptions:
    """topic: of the images (None: the only one in the bag). camera_info: its topic (None: the one next to the images).

    camera: file that replaces camera_info. fixed_frame: the world frame (None: map, odom, world, or the root of the
    tree). depth: topic, or "none" (None: the one registered to the images, else the only one). max_frames, spacing: see
    Chooser.
    """

    topic: str | None = None
    camera_info: str | None = None
    camera: Path | None = None
    fixed_frame: str | None = None
    depth: str | None = None
    max_frames: int = 200
    spacing: float = 0.08


def run_frames(source: Path, output: Path, options: FrameOptions | None = None) -> tuple[dict[str, Any], str]:
    """Writes `output`/images, camera.yaml, depth of the images, and, with poses, transforms.json: (JSON result, text).
    Map `output` if there are poses. Otherwise map `output`/images with --camera `output`/camera.yaml."""
    options = options or FrameOptions()
    check_empty(output)
    if options.max_frames < 2 or not options.spacing > 0:
        raise InputError(f"--max-frames {options.max_frames}, --spacing {options.spacing}: expected 2 or more, above 0")
    with open_bag(source) as bag:
        depths = depth_topics(bag)
        images = bag.of_type(*IMAGES)
        if not images:
            raise InputError(f"{bag.path}: holds no images; its topics are {', '.join(sorted(bag.topics)) or 'none'}")
        topic = bag.chosen([t for t in images if t not in depths] or images, options.topic, "image", "--topic")
        info = None if options.camera is not None else _camera_info(bag, topic, options.camera_info)
        chooser = Chooser(options.spacing)
        size = None
        for _, _, message in bag.messages([topic]):
            picture = decode_image(message, f"{source}: {topic}")
            size = size or (picture.shape[1], picture.shape[0])
            chooser.show(picture)
        if size is None:
            raise InputError(f"{source}: {topic} holds no images")
        chosen = chooser.chosen(options.max_frames)
        poses = read_poses(bag)
        with atomic_directory(output, fresh=True) as aside:
            lens = _write_camera(aside / "camera.yaml", options.camera, info, topic, size, source)
            stamps, frame = _write_images(bag, topic, chosen, aside / "images")
            depth, source_of_depth = dict[str, str](), None
            try:
                measured = choose_depth(bag, depths, options.depth, frame)
                if measured is not None:
                    depth, source_of_depth = write_depth(bag, measured, stamps, lens, frame, poses, aside / "depth")
            except InputError as error:  # depth that no option names and that cannot be used is left out
                if options.depth is not None:
                    raise
                shutil.rmtree(aside / "depth", ignore_errors=True)
                source_of_depth = f"left out: {error}"
            known, fixed = _camera_poses(poses, stamps, frame, options.fixed_frame)
            measured_down = None if fixed is None else gravity(bag, poses, fixed)
            down, down_error = (None, None) if measured_down is None else (measured_down[0].tolist(), measured_down[1])
            vertical = {"gravity": down, "gravity_std_deg": down_error}
            if fixed is not None:
                data = {**_transforms(known, stamps, lens, depth), "world_frame": fixed, **(vertical if down else {})}
                (aside / "transforms.json").write_text(json.dumps(data, indent=1), encoding="utf-8")
    facts = {
        "output": str(output),
        "topic": topic,
        "images": len(chooser.motion),
        "chosen": len(stamps),
        "with_pose": len(known),
        "fixed_frame": fixed,
        "camera_frame": frame,
        "size": list(size),
        "camera_model": lens.model,
        "depth": source_of_depth,
        "with_depth": len(depth),
        **vertical,
    }
    return facts, _text(facts)


def _camera_info(bag: Bag, topic: str, wanted: str | None) -> Any:
    """The first CameraInfo of the camera that publishes `topic`."""
    topics, (beside, _) = bag.of_type(CAMERA_INFO), camera_of(topic)
    name = wanted or (topics[0] if len(topics) == 1 else beside)
    if name not in topics:
        advice = "give its topic with --camera-info, or a camera file with --camera (perception calibrate makes one)"
        raise InputError(f"{bag.path}: has no camera_info '{name}' (found {', '.join(topics) or 'none'}); {advice}")
    for _, _, message in bag.messages([name]):
        return message
    raise InputError(f"{bag.path}: {name} holds no message; give a camera file with --camera")


def _write_camera(path: Path, camera: Path | None, info: Any, topic: str, size: tuple[int, int], source: Path) -> Lens:
    if camera is not None:
        path.write_bytes(Path(camera).read_bytes() if Path(camera).is_file() else b"")
        lens = read_camera(camera)
    else:
        write_camera(path, camera_info(info, rectified=camera_of(topic)[1]))
        lens = read_camera(path)
    if (lens.width, lens.height) != size:
        found = f"images of {topic} are {size[0]}x{size[1]} pixels, the camera {lens.width}x{lens.height}"
        raise InputError(f"{source}: {found}; give the camera_info of these images")
    return lens


def _write_images(bag: Bag, topic: str, chosen: list[int], folder: Path) -> tuple[dict[str, int], str]:
    """Writes the chosen images. Returns their times in ns by name, in order, and the camera frame."""
    folder.mkdir()
    wanted, stamps, frame = set(chosen), {}, ""
    for number, (_, recorded, message) in enumerate(bag.messages([topic])):
        if number not in wanted:
            continue
        suffix, data = encoded(message, decode_image(message, f"{bag.path}: {topic}"))
        name = f"{number:06d}{suffix}"
        (folder / name).write_bytes(data)
        stamps[name] = stamp_of(message) or recorded
        frame = str(message.header.frame_id)
    return stamps, frame


def _camera_poses(
    poses: Poses, stamps: dict[str, int], frame: str, fixed: str | None
) -> tuple[dict[str, np.ndarray], str | None]:
    """camera_from_world by image, in order, and the world frame, None without poses: the first of FIXED_FRAMES (or the
    tree's root) with poses for 80 % of the images, else that with the most."""
    best, world = dict[str, np.ndarray](), None
    for name in [fixed] if fixed else [*FIXED_FRAMES, poses.path(frame)[-1]]:
        found = {image: poses.camera_from_world(name, frame, time) for image, time in stamps.items()}
        known = {image: pose for image, pose in found.items() if pose is not None}
        if len(known) > len(best):
            best, world = known, name
        if len(known) >= 0.8 * len(stamps):
            break
    return best, world


def _transforms(
    known: dict[str, np.ndarray], stamps: dict[str, int], lens: Lens, depth: dict[str, str]
) -> dict[str, Any]:
    """nerfstudio's format: frames with a pose, OpenGL camera axes, pixel centres at +0.5, depth in millimetres."""
    frames = [
        {
            "file_path": f"images/{name}",
            "transform_matrix": (inverse_se3(pose) @ OPENCV_FROM_OPENGL).tolist(),
            "stamp_ns": stamps[name],
            **({"depth_file_path": depth[name]} if name in depth else {}),
        }
        for name, pose in known.items()
    ]
    unit = {"depth_unit_scale_factor": 1 / MILLIMETRES} if depth else {}
    return {**lens_values(lens), **unit, "metric": True, "frames": frames}  # ROS measures in metres (REP 103)


def _text(facts: dict[str, Any]) -> str:
    folder = facts["output"]
    line = f"{folder}: {facts['chosen']} of {facts['images']} images of {facts['topic']}, {facts['camera_model']}"
    if facts["with_pose"]:
        line += f"; {facts['with_pose']} with a pose in '{facts['fixed_frame']}'"
    if facts["depth"]:
        line += f"\ndepth: {facts['depth']}"
    if facts["gravity"]:
        line += f"\ngravity: from the IMU, ±{facts['gravity_std_deg']:.1f}°"
    if facts["with_pose"]:
        return f"{line}\nnext: perception map {folder} -o MAP"
    return f"{line}\nno poses\nnext: perception map {folder}/images --camera {folder}/camera.yaml -o MAP"
