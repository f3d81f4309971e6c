"""Makes a posed RGB-D scene harder: noisy or no depth, noisy poses, a person who walks through, or a ROS bag.

    python tools harder.run SCENE OUT --depth-noise

--no-depth     the same photos and poses without depth images
--depth-noise  depth as a Kinect measures it: shifted lookups, noisy and rounded disparities, holes at steep edges
--pose-noise   poses off by 2 cm and 1° (standard deviations), without depth
--walker       a person walks through all but every 8th photo, the held-out ones, without depth
--bag          a ROS 2 bag in OUT/drive: JPEG photos, depth 7 ms later, camera_info, TF, a noisy IMU; 5 photos a second

SCENE is a folder with a transforms.json whose frames have depth images; for --bag it also holds gravity.txt, the
direction down, as three numbers. Depth noise follows Barron and Malik (CVPR 2013).
"""

import argparse
import json
import sys
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from perception.geometry import inverse_se3
from perception.inputs.transforms import read_frames
from support.bag_recorder import Recorder

DISPARITY = 35130.0
"""Disparity times depth in centimetres of a Kinect."""
NEAR, FAR = 40, 500
"""Depth in centimetres that a Kinect measures."""
RADIUS, HEIGHT = 0.25, 1.7
"""Of the walking person, a cylinder, in metres."""
LAP = 17
"""Photos in which the person walks once round the middle of the scene."""


def metres(file: Path, scale: float) -> np.ndarray:
    """Depth image [H, W] in metres, 0 = none."""
    return cv2.imread(str(file), cv2.IMREAD_UNCHANGED).astype(np.float64) * scale


def kinect(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Depth [H, W] in centimetres as a Kinect would measure it."""
    height, width = depth.shape
    y, x = np.mgrid[:height, :width]
    rows = np.clip(np.rint(y + rng.normal(0, 0.5, depth.shape)), 0, height - 1).astype(int)
    columns = np.clip(np.rint(x + rng.normal(0, 0.5, depth.shape)), 0, width - 1).astype(int)
    shifted = depth[rows, columns]
    disparity = DISPARITY / np.where(shifted > 0, shifted, 1e9)
    level = np.rint(disparity + rng.normal(0, 1 / 6, depth.shape) + 0.5)
    measured = np.where((shifted > 0) & (level > 0), DISPARITY / np.maximum(level - 0.5, 1e-3), 0)
    across, down = np.gradient(depth)
    steep = np.hypot(across, down) / np.maximum(depth, 1) * 523 > 6
    steep = cv2.dilate(steep.astype(np.uint8), np.ones((5, 5))) > 0
    coarse = rng.random((height // 16, width // 16)).astype(np.float32)
    patches = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_NEAREST) < 0.03
    measured[(steep & (rng.random(depth.shape) < 0.7)) | patches | (measured < NEAR) | (measured > FAR)] = 0
    return measured


def person(foot: np.ndarray, lens, camera_from_world: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [H, W] and BGR colours [H, W, 3] of a person who stands at foot (world, z up), before depth in metres."""
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    fx, fy, cx, cy = lens.params[:4]
    world_from_camera = inverse_se3(camera_from_world)
    rays = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], axis=-1) @ world_from_camera[:3, :3].T
    start = world_from_camera[:3, 3] - foot
    a, b = (rays[..., :2] ** 2).sum(axis=-1), rays[..., :2] @ start[:2]
    inside = b * b - a * (start[:2] @ start[:2] - RADIUS**2)
    away = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, np.inf)
    with np.errstate(invalid="ignore"):
        z = start[2] + away * rays[..., 2]
        around = np.arctan2(start[1] + away * rays[..., 1], start[0] + away * rays[..., 0])
        stripe = (np.nan_to_num(around) * 6).astype(int) % 2 == 0
    hit = (inside > 0) & (away > 0.05) & (z > 0) & (z < HEIGHT) & ((depth == 0) | (away < depth))
    shirt = np.where(stripe[..., None], [60, 225, 235], [50, 60, 200])
    color = np.where((z > 1.45)[..., None], [150, 180, 220], shirt)
    return hit, np.where((z < 0.9)[..., None], [120, 50, 40], color)


def with_noisy_depth(data: dict, scene: Path, out: Path, scale: float) -> None:
    rng = np.random.default_rng(0)
    (out / "depth").mkdir(exist_ok=True)
    for frame in data["frames"]:
        noisy = np.rint(10 * kinect(100 * metres(scene / frame["depth_file_path"], scale), rng)).astype(np.uint16)
        frame["depth_file_path"] = f"depth/{Path(frame['file_path']).stem}.png"
        cv2.imwrite(str(out / frame["depth_file_path"]), noisy)
    data["depth_unit_scale_factor"] = 0.001


def with_noisy_poses(data: dict, degrees: float, distance: float) -> None:
    rng = np.random.default_rng(0)
    for frame in data["frames"]:
        pose = np.array(frame["transform_matrix"], float)
        axis = rng.normal(size=3)
        turn = Rotation.from_rotvec(np.radians(rng.normal(0, degrees)) * axis / np.linalg.norm(axis)).as_matrix()
        pose[:3, :3] = turn @ pose[:3, :3]
        pose[:3, 3] += rng.normal(0, distance / np.sqrt(3), 3)
        frame["transform_matrix"] = pose.tolist()


def with_walker(data: dict, scene: Path, out: Path, scale: float) -> None:
    (out / "images").mkdir(exist_ok=True)
    poses = {
        name: (camera_from_world, lens) for name, camera_from_world, lens in read_frames(scene / "transforms.json")
    }
    cameras = np.array([inverse_se3(pose)[:3, 3] for pose, _ in poses.values()])
    middle, floor = np.median(cameras, axis=0), 0.0
    painted = []
    for i, frame in enumerate(sorted(data["frames"], key=lambda frame: frame["file_path"])):
        source = scene / frame["file_path"]
        photo = cv2.imread(str(source))
        pose, lens = poses[frame["file_path"]]
        angle = 2 * np.pi * i / LAP
        foot = np.array([middle[0] + np.cos(angle), middle[1] + 0.8 * np.sin(angle), floor])
        hit, color = person(foot, lens, pose, metres(scene / frame["depth_file_path"], scale))
        if i % 8 and 0 < hit.mean() < 0.4:
            photo[hit] = color[hit]
            painted.append(hit.mean())
        frame["file_path"] = f"images/{source.stem}.png"
        cv2.imwrite(str(out / frame["file_path"]), photo)
    print(f"a person in {len(painted)} of {len(data['frames'])} photos, {np.mean(painted):.1%} of their pixels")


def write_bag(data: dict, scene: Path, out: Path, scale: float) -> None:
    rng = np.random.default_rng(0)
    down = np.loadtxt(scene / "gravity.txt")
    bias = np.array([0.05, -0.04, 0.06])
    base_from_camera, base_from_imu = np.eye(4), np.eye(4)
    base_from_camera[:3, :3] = Rotation.from_euler("xyz", [-1.57, 0, -1.57]).as_matrix()
    base_from_camera[:3, 3] = [0.1, 0, 0.3]
    base_from_imu[:3, :3] = Rotation.from_euler("xyz", [0.02, -0.01, 3.1]).as_matrix()
    bag, start = Recorder(out / "drive", "mcap"), 100 * 10**9
    bag.transform("/tf_static", start, "base", "cam", base_from_camera)
    bag.transform("/tf_static", start, "base", "imu", base_from_imu)
    depths = {frame["file_path"]: scene / frame["depth_file_path"] for frame in data["frames"]}
    for i, (name, camera_from_world, lens) in enumerate(sorted(read_frames(scene / "transforms.json"))):
        fx, fy, cx, cy = lens.params[:4]
        if i == 0:
            matrix = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])  # ROS counts from pixel centres
            bag.info("/camera/color/camera_info", start, (lens.width, lens.height), matrix, [0.0] * 5)
        time = start + i * 200_000_000
        world_from_base = inverse_se3(camera_from_world) @ inverse_se3(base_from_camera)
        bag.transform("/tf", time, "map", "base", world_from_base)
        bag.jpeg("/camera/color/image_raw/compressed", time, (scene / name).read_bytes())
        depth = np.rint(1000 * metres(depths[name], scale)).astype(np.uint16)
        bag.image("/camera/aligned_depth_to_color/image_raw", time + 7_000_000, depth, "cam", "16UC1")
        imu_from_world = inverse_se3(world_from_base @ base_from_imu)[:3, :3]
        for k in range(4):
            force = imu_from_world @ (-9.81 * down / np.linalg.norm(down)) + bias + rng.normal(0, 0.15, 3)
            bag.imu("/imu", time + k * 1_000_000, force, rng.normal(0, 0.05, 3))
    bag.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    change = parser.add_mutually_exclusive_group(required=True)
    for name in ("no-depth", "depth-noise", "pose-noise", "walker", "bag"):
        change.add_argument(f"--{name}", action="store_true")
    args = parser.parse_args()
    scene = args.scene.resolve()
    data = json.loads((scene / "transforms.json").read_text())
    scale = data.get("depth_unit_scale_factor") or data.get("integer_depth_scale") or 0.001
    args.out.mkdir(parents=True, exist_ok=True)
    if args.bag:
        write_bag(data, scene, args.out, scale)
        sys.exit()
    if args.depth_noise:
        with_noisy_depth(data, scene, args.out, scale)
    elif args.walker:
        with_walker(data, scene, args.out, scale)
    elif args.pose_noise:
        with_noisy_poses(data, 1, 0.02)
    for frame in data["frames"]:
        if not args.depth_noise:
            frame.pop("depth_file_path", None)
        if not args.walker:
            frame["file_path"] = str(scene / frame["file_path"])
    if not args.depth_noise:
        data.pop("depth_unit_scale_factor", None)
        data.pop("integer_depth_scale", None)
    else:
        data.pop("integer_depth_scale", None)
    (args.out / "transforms.json").write_text(json.dumps(data))
