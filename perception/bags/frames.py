"""`perception frames`: extracts sharp, well-spaced photos from a bag, with intrinsics and what there is of poses, depth
and gravity."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perception.bags.cameras import image_camera
from perception.bags.depth import MILLIMETRES, choose_depth, depth_topics, write_depth
from perception.bags.poses import FIXED_FRAMES, MAX_GAP, Poses, gravity, read_poses
from perception.bags.read import IMAGES, Bag, decode_image, encoded, first_message, frame_of, open_bag, stamp_of
from perception.errors import InputError, shell_word
from perception.geometry import OPENCV_FROM_OPENGL, inverse_se3
from perception.inputs.transforms import lens_values
from perception.io.atomic import atomic_directory
from perception.map.outputs import check_empty
from perception.photos.camera_file import lens_of, read_camera, write_camera
from perception.photos.lens import resized
from perception.photos.video import Chooser
from perception.types import Lens

Decoder = Callable[[Any, str], np.ndarray]


@dataclass(frozen=True)
class FrameOptions:
    """topic: of the images (None: the only one in the bag). camera_info: its topic (None: the one next to the images).

    camera: file that replaces camera_info. fixed_frame: the world frame (None: map, odom, world, or the root of the
    tree). odometry: topic whose poses are taken before all others. depth: topic, or "none" (None: the one registered to
    the images, else the only one). max_frames, spacing: see Chooser. strict: a message that cannot be used is an
    InputError; otherwise it is left out, counted and named.
    """

    topic: str | None = None
    camera_info: str | None = None
    camera: Path | None = None
    fixed_frame: str | None = None
    odometry: str | None = None
    depth: str | None = None
    max_frames: int = 200
    spacing: float = 0.08
    strict: bool = False


def run_frames(source: Path, output: Path, options: FrameOptions | None = None) -> tuple[dict[str, Any], str]:
    """Writes `output`/images, camera.yaml, depth of the images, and, with poses, transforms.json: (JSON result, text).
    Map `output` if there are poses. Otherwise map `output`/images with --camera `output`/camera.yaml."""
    options = options or FrameOptions()
    check_empty(output)
    if options.max_frames < 2 or not options.spacing > 0:
        raise InputError(f"--max-frames {options.max_frames}, --spacing {options.spacing}: expected 2 or more, above 0")
    with open_bag(source, options.strict) as bag:
        depths = depth_topics(bag)
        images = bag.of_type(*IMAGES)
        if not images:
            raise InputError(f"{bag.path}: holds no images; its topics are {', '.join(sorted(bag.topics)) or 'none'}")
        pictures = [t for t in images if t not in depths and first_message(bag, t) is not None] or images
        pictures = images if options.topic else pictures
        topic = bag.chosen(pictures, options.topic, "image", "--topic")
        info = {} if options.camera is not None else image_camera(bag, topic, options.camera_info)
        lens = lens_of(info, topic) if options.camera is None else read_camera(options.camera)
        decode = _decoder(lens)
        chooser, numbers = Chooser(options.spacing), list[int]()
        for one, picture in bag.decoded(topic, decode):
            numbers.append(one.number)
            chooser.show(picture)
        if not numbers:
            raise InputError("; ".join([f"{source}: {topic} holds no images", *bag.lines()]))
        chosen = {numbers[index] for index in chooser.chosen(options.max_frames)}
        poses = read_poses(bag, topic, options.odometry)
        with atomic_directory(output, fresh=True) as aside:
            if options.camera is None:
                write_camera(aside / "camera.yaml", info)
            else:
                shutil.copyfile(options.camera, aside / "camera.yaml")
            stamps, frame = _write_images(bag, topic, decode, chosen, aside / "images")
            depth, source_of_depth = dict[str, str](), None
            measured = choose_depth(bag, [t for t in depths if t != topic], options.depth, frame)
            try:
                if measured is not None:
                    depth, source_of_depth = write_depth(bag, measured, stamps, lens, frame, poses, aside / "depth")
                    if options.depth is None and (others := [t for t in depths if t not in (topic, measured)]):
                        source_of_depth += f"; --depth TOPIC takes {' or '.join(others)}"
            except InputError as error:  # depth that no option names and that cannot be used is left out
                if options.depth is not None or options.strict:
                    raise
                bag.left_out.pop(str(measured), None)
                shutil.rmtree(aside / "depth", ignore_errors=True)
                source_of_depth = f"left out: {error}"
            above = poses.path(frame)
            if options.odometry is not None and not any(options.odometry in poses.topics.get(f, ()) for f in above):
                found = f"it has no pose of '{frame}' or a frame above it ({', '.join(above[1:]) or 'none'})"
                raise InputError(f"{bag.path}: --odometry {options.odometry}: {found}")
            known, fixed = _camera_poses(poses, stamps, frame, options.fixed_frame)
            why = None if fixed is not None else _why_no_pose(poses, frame, options.fixed_frame)
            if why is not None and options.fixed_frame is not None:
                raise InputError(f"{bag.path}: --fixed-frame {options.fixed_frame}: {why}")
            down = None if fixed is None else gravity(bag, poses, fixed, frame)
            vertical: dict[str, Any] = {"gravity": None, "gravity_std_deg": None}
            if down is not None:
                vertical = {"gravity": down.direction.tolist(), "gravity_std_deg": down.standard_error}
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
        "poses_from": poses.told(frame),
        "why_no_pose": why,
        "camera_frame": frame,
        "size": [lens.width, lens.height],
        "camera_model": lens.model,
        "depth": source_of_depth,
        "with_depth": len(depth),
        "left_out": bag.lines(),
        **vertical,
        "gravity_source": None if down is None else down.source,
    }
    return facts, _text(facts)


def _decoder(lens: Lens) -> Decoder:
    """`decode_image` that refuses images of another size than the camera's, but those that are binned or made smaller:
    the lens is scaled when they are mapped."""

    def decode(message: Any, where: str) -> np.ndarray:
        picture = decode_image(message, where)
        size, camera = picture.shape[1::-1], (lens.width, lens.height)
        if size != camera and not (size[0] < camera[0] and resized(camera, size)):
            found = f"an image is {size[0]}x{size[1]} pixels, the camera {lens.width}x{lens.height}"
            raise InputError(f"{where}: {found}; give the camera_info of these images")
        return picture

    return decode


def _write_images(bag: Bag, topic: str, decode: Decoder, chosen: set[int], folder: Path) -> tuple[dict[str, int], str]:
    """Writes the chosen images. Returns their times in ns by name, in order, and the camera frame."""
    folder.mkdir()
    stamps, frame = dict[str, int](), ""
    for one, picture in bag.decoded(topic, decode, chosen):
        suffix, data = encoded(one.message, picture)
        name = f"{one.number:06d}{suffix}"
        (folder / name).write_bytes(data)
        stamps[name] = stamp_of(one.message) or one.time
        frame = frame_of(one.message)
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


def _why_no_pose(poses: Poses, frame: str, fixed: str | None) -> str:
    """Why no image of the camera frame has a pose; fixed: the world that was asked for."""
    above = poses.path(frame)[1:]
    if not above:
        return f"no transform or odometry leads to '{frame}', the frame of the images"
    if fixed is not None and fixed.lstrip("/") not in above:
        return f"frames above '{frame}' are {', '.join(above)}"
    found = f"no image lies between samples of {', '.join(above)} at most {MAX_GAP} s apart"
    return f"{found}; do images and transforms use one clock?"


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
    if facts["poses_from"]:
        line += f"\nposes: {facts['poses_from']} (--odometry TOPIC takes another)"
    if facts["left_out"]:
        line += "\n" + "\n".join(facts["left_out"])
    if facts["depth"]:
        line += f"\ndepth: {facts['depth']}"
    if facts["gravity"]:
        line += f"\ngravity: {facts['gravity_source']}, ±{facts['gravity_std_deg']:.1f}°"
    if facts["with_pose"]:
        return f"{line}\nnext: perception map {shell_word(folder)} -o MAP"
    images, camera = (shell_word(f"{folder}/{name}") for name in ("images", "camera.yaml"))
    return f"{line}\nno poses: {facts['why_no_pose']}\nnext: perception map {images} --camera {camera} -o MAP"
