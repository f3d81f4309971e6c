"""What fuzzing found, one test a defect: input that once crashed, hung, filled the memory or passed as good."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import perception
from perception import _core
from perception.config import load_config
from perception.errors import InputError
from perception.inputs.colmap import read_workspace
from perception.inputs.load import load_scene
from perception.inputs.transforms import read_frames, read_transforms
from perception.io.arrays import map_npy, read_npz
from perception.io.cloud import read_cloud, write_cloud
from perception.io.ply import read_ply
from perception.masks.label_files import load_labels, stored_key
from perception.photos.camera_file import read_camera
from perception.photos.decode import photo_size, read_photo
from perception.photos.views import rigid_pose
from perception.progress import Progress
from perception.sfm.options import ReadOptions
from perception.types import PointCloud, View


def refused(reader: Any, *arguments: Any, match: str) -> None:
    with pytest.raises(InputError, match=match) as told:
        reader(*arguments)
    assert "\n" not in str(told.value)


quiet = Progress(quiet=True)


# ------------------------------------------------------------------ the compiled core


def scene(n: int, dtype: Any, size: int = 8) -> Any:
    rng = np.random.default_rng(0)
    kind = "f32" if dtype == np.float32 else "f64"
    K = np.array([[[size, 0, size / 2], [0, size, size / 2], [0, 0, 1]]], dtype)
    means = rng.normal(size=(n, 3)).astype(dtype) + np.array([0, 0, 4], dtype)
    arrays = (rng.normal(size=(n, 4)), np.ones((n, 3)), np.full(n, 0.5), np.ones((n, 3)))
    inputs = getattr(_core, f"RasterizerInputs_{kind}")(
        means, *(a.astype(dtype) for a in arrays), None, np.eye(4, dtype=dtype)[None], K, None,
        size, size, -1, 0.01, 0.3, 1, True, False, 0,
    )  # fmt: skip
    images = getattr(_core, f"RasterizerImages_{kind}")(
        np.zeros((1, size, size, 3), dtype), np.zeros((1, size, size), dtype), None, None, None
    )
    return kind, inputs, images, (np.zeros((1, n), np.uint8), np.zeros((1, n), dtype))


def backward(kind: str, inputs: Any, frames: Any, images: Any, depths: np.ndarray | None = None) -> None:
    cotangents = getattr(_core, f"RasterizerCotangents_{kind}")(None, None, depths, None, None)
    gradients = getattr(_core, f"RasterizerGradients_{kind}")(*[None] * 9)
    getattr(_core, f"rasterize_backward_{kind}")(inputs, frames, images, cotangents, gradients, False)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("other", [{"n": 2}, {"n": 60}, {"n": 40, "size": 9}])
def test_backward_refuses_the_frames_of_another_scene(dtype: Any, other: dict[str, int]) -> None:
    """It wrote gradients of 40 Gaussians into arrays of 2: heap corruption."""
    kind, inputs, images, seen = scene(40, dtype)
    frames = getattr(_core, f"rasterize_forward_{kind}")(inputs, images, *seen, "auto")
    _, inputs, images, _ = scene(dtype=dtype, **other)
    with pytest.raises(ValueError, match="frames: not of inputs"):
        backward(kind, inputs, frames, images)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_backward_refuses_a_gradient_of_depths_that_are_missing(dtype: Any) -> None:
    """It read them through a null pointer."""
    kind, inputs, images, seen = scene(40, dtype)
    frames = getattr(_core, f"rasterize_forward_{kind}")(inputs, images, *seen, "auto")
    with pytest.raises(ValueError, match="depths: missing"):
        backward(kind, inputs, frames, images, depths=np.ones((1, 8, 8), dtype))


def unaligned(array: np.ndarray) -> np.ndarray:
    memory = np.zeros(array.nbytes + 1, np.uint8)[1:].view(array.dtype).reshape(array.shape)
    memory[...] = array
    return memory


def test_arrays_must_be_aligned() -> None:
    """Undefined behaviour under the sanitizer: numbers read where their type cannot lie."""
    values, out = unaligned(np.ones(9, np.float32)), np.zeros(9, np.float32)
    with pytest.raises(ValueError, match="values: its numbers are not aligned"):
        _core.training.sum(values, False)
    with pytest.raises(ValueError, match="out: its numbers are not aligned"):
        _core.training.scale(out, 2.0, unaligned(out))
    with pytest.raises(ValueError, match="points: its numbers are not aligned"):
        _core.KdTree(unaligned(np.ones((4, 3), np.float32)))
    with pytest.raises(ValueError, match="labels: its numbers are not aligned"):
        edges, weights = np.zeros((1, 2), np.int32), np.zeros(1, np.float32)
        _core.felzenszwalb(edges, weights, 1.0, 0, unaligned(np.zeros(3, np.int32)))


@pytest.mark.parametrize("threads", [-(2**31), 0, 100_000, 2**31 - 1])
def test_any_number_of_threads_gives_the_same_neighbours(threads: int) -> None:
    """A hundred thousand threads ended the process when the system started no more."""
    points = np.random.default_rng(0).normal(size=(5000, 3)).astype(np.float32)
    found = [np.zeros((len(points), 3), np.int32) for _ in range(2)]
    for indices, number in zip(found, (1, threads), strict=True):
        tree = _core.KdTree(points, number)
        tree.knn(points, indices, np.zeros(indices.shape, np.float32), float("inf"), number)
    assert (found[0] == found[1]).all()
    normals = [np.zeros_like(points) for _ in range(2)]
    for out, number in zip(normals, (1, threads), strict=True):
        _core.plane_normals(points, found[0], out, number)
    assert (normals[0] == normals[1]).all()


def test_refusals_of_the_training_kernels_name_the_argument() -> None:
    images = [np.zeros((4, 5, 3), np.float32) for _ in range(3)]
    with pytest.raises(ValueError, match="gradient: expected the shape of render"):
        _core.training.photometric(images[0], images[1], None, np.zeros((4, 5, 1), np.float32), 0.2)
    with pytest.raises(ValueError, match="first, counts: every label needs a pixel"):
        ids, slots = np.array([0]), np.zeros(2, np.int32)
        _core.training.prototypes(np.zeros((2, 3)), slots, ids, ids, np.zeros((1, 3)), np.zeros(1))


def test_the_public_call_names_what_is_not_finite() -> None:
    one = torch.ones(1, 3)
    with pytest.raises(InputError, match="means"):
        perception.rasterize(
            one * float("nan"), torch.ones(1, 4), one, torch.ones(1), one, torch.eye(4)[None], torch.eye(3)[None], 4, 4
        )


# ------------------------------------------------------------------ PLY, PCD, NPZ and text clouds

HEAD = "ply\nformat {} 1.0\n{}end_header\n"
LITTLE = "binary_little_endian"


@pytest.mark.parametrize(
    ("order", "elements", "body"),
    [
        ("ascii", f"element vertex {10**30}\n", b""),  # OverflowError
        ("ascii", "element vertex -3\nproperty float x\n", b"1 2 3 4 5 6"),
        ("ascii", "element face 1\nproperty list uchar int v\n", b"nan 1 2"),  # int(nan)
        ("ascii", "element face 1\nproperty list uchar int v\n", b"inf 1 2"),
        (LITTLE, "element face 1\nproperty list uint double v\n", b"\xff" * 12),  # a row type of 32 GB
        (LITTLE, f"element vertex {10**40}\nproperty float x\n", bytes(8)),
    ],
)
def test_ply_headers_that_make_no_sense(tmp_path: Path, order: str, elements: str, body: bytes) -> None:
    file = tmp_path / "a.ply"
    file.write_bytes(HEAD.format(order, elements).encode() + body)
    refused(read_ply, file, match="a.ply")


@pytest.mark.parametrize("order, body", [("ascii", b"1 2 3\n"), ("binary_little_endian", struct.pack("<3f", 1, 2, 3))])
def test_a_ply_without_any_face(tmp_path: Path, order: str, body: bytes) -> None:
    """A list property of no rows, as mesh tools write it for a cloud."""
    vertex = "element vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    head = HEAD.format(order, vertex + "element face 0\nproperty list uchar int vertex_indices\n")
    (tmp_path / "a.ply").write_bytes(head.encode() + body)
    assert read_cloud(tmp_path / "a.ply").points.tolist() == [[1, 2, 3]]


PCD = "FIELDS {}\nSIZE {}\nTYPE {}\nCOUNT {}\nWIDTH 1\nHEIGHT 1\nPOINTS {}\nDATA {}\n"


@pytest.mark.parametrize(
    ("header", "body"),
    [
        (("x y z", "4 4 4", "F F F", "2 1 1", 1, "binary"), bytes(16)),  # x was a pair, points [1, 2, 3]
        (("x y z", "4 4 4", "F F F", "1 1 1", 10**30, "ascii"), b"1 2 3"),  # OverflowError
    ],
)
def test_pcd_headers_that_make_no_sense(tmp_path: Path, header: tuple, body: bytes) -> None:
    file = tmp_path / "a.pcd"
    file.write_bytes(PCD.format(*header).encode() + body)
    refused(read_cloud, file, match="a.pcd")


def test_neighbour_lists_of_no_columns_hold_no_edge_however_many_they_are() -> None:
    """An array of 2^40 rows of nothing takes no memory; a loop over its rows would take an hour."""
    assert _core.undirected(np.zeros((2**40, 0), np.int32), np.zeros((1, 2), np.int32)) == 0


def npz(**members: bytes) -> bytes:
    import zipfile

    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return out.getvalue()


def npy(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def _giant() -> bytes:
    head = npy(np.zeros((1, 3)))
    return head.replace(b"'shape': (1, 3), }            ", b"'shape': (99999999999, 3), }  ")


@pytest.mark.parametrize(
    "content",
    [
        b"not a zip at all",  # numpy took it for a pickle, and zipfile's errors came through
        npz(points=npy(np.zeros((2, 3))))[:-40],
        npz(points=b"bytes that are no array"),  # came back as bytes without a shape
        npz(points=npy(np.zeros((2, 3)))).replace(b"False", b"(((("),  # numpy's tokenizer
        npz(points=_giant()),  # 2.4 TB asked for before a byte was read
    ],
)
def test_npz_files_that_hold_no_arrays(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "a.npz"
    file.write_bytes(content)
    refused(read_cloud, file, match="a.npz: (cannot be read|expected an array 'points')")


@pytest.mark.parametrize("order", ["<", ">"])
def test_text_of_code_points_that_do_not_exist(order: str, tmp_path: Path) -> None:
    """Unicode ends at 0x10ffff; numpy takes any 32 bits, and str() of them raises SystemError."""
    good = np.array(["a.jpg", "\U0010ffff"], np.dtype("U5").newbyteorder(order))
    file = tmp_path / "names.npz"
    file.write_bytes(npz(**{"names": npy(good)}))
    assert read_npz(file, file, "")["names"].tolist() == good.tolist()
    last = 0x10FFFF.to_bytes(4, "little" if order == "<" else "big")
    beyond = 0x110000.to_bytes(4, "little" if order == "<" else "big")
    file.write_bytes(npz(**{"names": npy(good).replace(last, beyond)}))
    refused(read_npz, file, file, "", match="code point 0x110000")


def test_an_npy_header_longer_than_its_file_is_not_asked_for(tmp_path: Path) -> None:
    """numpy would ask for 3 GiB to hold it."""
    import resource

    file = tmp_path / "features.npy"
    np.save(file, np.arange(6, dtype=np.float32).reshape(2, 3))
    array = map_npy(file)
    np.testing.assert_array_equal(array, [[0, 1, 2], [3, 4, 5]])
    assert not array.flags.writeable
    file.write_bytes(b"\x93NUMPY\x02\x00" + struct.pack("<I", 3 << 30) + b"{'descr': '<f4'}")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match="header of 3221225472 bytes, 16 are there"):
        map_npy(file)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1 << 20  # KiB


def test_photos_with_damaged_exif(tmp_path: Path) -> None:
    photo = tmp_path / "x.jpg"
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (40, 30)).save(photo, exif=exif, dpi=(72, 72))  # else Pillow looks for them in the EXIF data
    assert photo_size(photo) == (30, 40)
    content = photo.read_bytes()
    start = content.index(b"Exif\0\0") + 6
    assert content[start : start + 4] in (b"MM\0*", b"II*\0")
    photo.write_bytes(content[:start] + b"MM\0II*" + content[start + 6 :])
    for reader in (photo_size, read_photo):
        refused(reader, photo, match="x.jpg: the photo's EXIF data are damaged; save it anew")


def test_npz_arrays_come_back_as_they_were(tmp_path: Path) -> None:
    points = np.asfortranarray(np.random.default_rng(0).normal(size=(5, 3)))
    np.savez_compressed(tmp_path / "a.npz", points=points, colors=np.zeros((5, 3), np.uint8), empty=np.empty((0, 2)))
    cloud = read_cloud(tmp_path / "a.npz")
    assert (cloud.points == points).all() and cloud.points.flags.writeable


# ------------------------------------------------------------------ cameras, poses, settings

CAMERA = """image_width: {0}
image_height: 480
distortion_model: {1}
camera_matrix: {{data: {2}}}
distortion_coefficients: {{data: [0, 0, 0, 0, 0]}}
"""


@pytest.mark.parametrize(
    "text",
    [
        CAMERA.format("2001-02-30", "plumb_bob", "[1, 0, 1, 0, 1, 1, 0, 0, 1]"),  # a date that does not exist
        CAMERA.format("!!bool maybe", "plumb_bob", "[1]"),  # KeyError
        CAMERA.format("!!timestamp x", "plumb_bob", "[1]"),  # AttributeError
        CAMERA.format("!!int ''", "plumb_bob", "[1]"),  # IndexError
        CAMERA.format("0b_", "plumb_bob", "[1]"),  # ValueError
        CAMERA.format("640", "[plumb_bob]", "[1, 0, 1, 0, 1, 1, 0, 0, 1]"),  # TypeError: unhashable
        CAMERA.format("1e300", "plumb_bob", "[1, 0, 1, 0, 1, 1, 0, 0, 1]"),
        CAMERA.format("9" * 400, "plumb_bob", "[1, 0, 1, 0, 1, 1, 0, 0, 1]"),  # OverflowError
        "[" * 600,  # RecursionError
    ],
)
def test_camera_files_with_values_yaml_stumbles_over(tmp_path: Path, text: str) -> None:
    file = tmp_path / "camera.yaml"
    file.write_text(text)
    refused(read_camera, file, match="camera.yaml")


def test_a_camera_file_cannot_unfold_into_a_billion_numbers(tmp_path: Path) -> None:
    """Nine lines of aliases, 10**9 numbers as an array."""
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 9)]
    file = tmp_path / "camera.yaml"
    file.write_text("\n".join([*lines, "image_width: *a8"]))
    refused(read_camera, file, match="aliases are not taken")


IDENTITY = np.eye(4).tolist()


@pytest.mark.parametrize(
    "change",
    [
        {"w": 10**400},  # OverflowError
        {"w": True},
        {"frames": [{"file_path": "a.png", "transform_matrix": [[10**400, 0, 0, 0], *IDENTITY[1:]]}]},
        {"frames": [{"file_path": "a.png", "transform_matrix": [[1, 0, 0, 1e300], *IDENTITY[1:]]}]},  # beyond float32
        {"fl_x": 1e-300},  # a singular K
        {"frames": [{"file_path": "", "transform_matrix": IDENTITY}]},  # a path without a name
        {"frames": [{"file_path": "x" * 5000, "transform_matrix": IDENTITY}]},  # OSError: name too long
        {"ply_file_path": "x" * 5000},
    ],
)
def test_transforms_that_no_camera_wrote(tmp_path: Path, change: dict[str, Any]) -> None:
    Image.new("RGB", (8, 6)).save(tmp_path / "a.png")
    write_cloud(tmp_path / "c.ply", PointCloud(np.array([[0, 0, 1], [0, 1, 2.0]])))
    good = {"w": 8, "h": 6, "fl_x": 7, "ply_file_path": "c.ply"}
    good["frames"] = [{"file_path": "a.png", "transform_matrix": IDENTITY}]
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps(good))
    assert len(read_transforms(file, ReadOptions(tmp_path, progress=quiet)).views) == 1
    file.write_text(json.dumps({**good, **change}))
    refused(read_transforms, file, ReadOptions(tmp_path, progress=quiet), match=r"transforms.json|camera PINHOLE")


@pytest.mark.parametrize("text", ["[" * 200_000, '{"frames": [' + "1" * 5000 + "]}"])
def test_json_that_python_gives_up_on(tmp_path: Path, text: str) -> None:
    """RecursionError; more digits than int() takes."""
    file = tmp_path / "transforms.json"
    file.write_text(text)
    refused(read_frames, file, match="not readable JSON")


def test_poses_far_beyond_any_scene_are_refused() -> None:
    pose = np.eye(4)
    pose[0, 3] = 1e6  # georeferenced
    assert (rigid_pose(pose, "p") == pose).all()
    pose[0, 3] = 1e13
    refused(rigid_pose, pose, "p", match="more than 1e")


def test_an_infinite_whole_number_in_a_settings_file(tmp_path: Path) -> None:
    """OverflowError: cannot convert float infinity to integer."""
    file = tmp_path / "c.toml"
    file.write_text("[train]\niterations = inf\n")
    refused(load_config, file, match=r"train\.iterations.*found inf, expected a whole number")


def test_settings_nested_without_end(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text("seed = " + "[" * 20_000)
    refused(load_config, file, match="not valid TOML")


# ------------------------------------------------------------------ COLMAP


def workspace(folder: Path) -> Path:
    (folder / "images").mkdir()
    (folder / "sparse" / "0").mkdir(parents=True)
    Image.new("RGB", (8, 6)).save(folder / "images" / "1.png")
    camera = struct.pack("<QIiQQ4d", 1, 1, 1, 8, 6, 7, 7, 4, 3)
    (folder / "sparse/0/cameras.bin").write_bytes(camera)
    (folder / "sparse/0/images.bin").write_bytes(image(b"1.png\0"))
    point = b"".join(struct.pack("<QdddBBBdQ", i, i, 2, 3, 1, 2, 3, 0.5, 0) for i in range(60))
    (folder / "sparse/0/points3D.bin").write_bytes(struct.pack("<Q", 60) + point)
    return folder


def image(name: bytes, pose: tuple = (1, 0, 0, 0, 0, 0, 1), camera: int = 1, points: int = 0, count: int = 1) -> bytes:
    return struct.pack("<QI7dI", count, 1, *pose, camera) + name + struct.pack("<Q", points)


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("images.bin", image(b"1.png")[:-8]),  # a name without an end: pycolmap never came back
        ("images.bin", image(b"1.png\0", points=1 << 40)),  # 24 TB reserved
        ("images.bin", image(b"1.png\0", count=1 << 50)),
        ("images.bin", image(b"1.png\0", camera=7)),
        ("images.bin", image(b"1.png\0", pose=(float("nan"), 0, 0, 0, 0, 0, 1))),
        ("images.bin", image(b"1.png\0", pose=(0, 0, 0, 0, 0, 0, 1))),
        ("images.bin", image(b"\xff\xfe.png\0")),
        ("cameras.bin", struct.pack("<QIiQQ4d", 1, 1, 99, 8, 6, 7, 7, 4, 3)),
        ("cameras.bin", struct.pack("<QIiQQ4d", 1 << 60, 1, 1, 8, 6, 7, 7, 4, 3)),
        ("cameras.bin", struct.pack("<QIiQQ4d", 1, 1, 1, 8, 6, 1e-310, 7, 4, 3)),  # a singular K
        ("points3D.bin", struct.pack("<QQdddBBBdQ", 1, 1, 1, 2, 3, 1, 2, 3, 0.5, 1 << 50)),
        ("points3D.bin", b"\0\0"),
        ("rigs.bin", struct.pack("<QII", 1, 1, 0xFFFFFFFF)),
        ("frames.bin", struct.pack("<QII7dI", 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0xFFFFFFFF)),
    ],
)
def test_damaged_binary_models(tmp_path: Path, file: str, content: bytes) -> None:
    folder = workspace(tmp_path)
    assert len(read_workspace(folder, ReadOptions(folder / "work", progress=quiet)).points) == 60
    (folder / "sparse/0" / file).write_bytes(content)
    refused(read_workspace, folder, ReadOptions(folder / "work", progress=quiet), match=r"sparse|camera")


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.webp", "a.tif"])
def test_an_orientation_that_exif_does_not_know(name: str, tmp_path: Path) -> None:
    """The size was told as of a photo on its side, which then was read upright; that of a TIFF was turned twice."""
    file, exif = tmp_path / name, Image.Exif()
    for orientation, turned in ((6, True), (9, False), (22341, False)):
        exif[0x0112] = orientation
        Image.new("RGB", (8, 6)).save(file, exif=exif)
        assert photo_size(file) == ((6, 8) if turned else (8, 6)) == read_photo(file).shape[1::-1]


def test_faces_whose_corners_are_no_list(tmp_path: Path) -> None:
    """IndexError: tuple index out of range."""
    file = tmp_path / "a.ply"
    head = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    file.write_text(head + "element face 1\nproperty int vertex_indices\nend_header\n0 1 2\n0\n")
    refused(read_cloud, file, match="expected a property list")


# ------------------------------------------------------------------ label images


@pytest.mark.slow
def test_damaged_label_images_of_an_earlier_run(tmp_path: Path) -> None:
    view = View("a.jpg", Path("a.jpg"), np.eye(3), 8, 6, np.eye(4))
    file = tmp_path / "a.jpg.png"
    for content in (b"", b"\x89PNG\r\n\x1a\n", b"GIF89a"):  # Pillow's own error came through
        file.write_bytes(content)
        assert stored_key(file) is None
        refused(load_labels, tmp_path, view, match="damaged or cut short|not a PNG")
    Image.new("L", (1 << 14, 1 << 14)).save(file)
    refused(load_labels, tmp_path, view, match="16384×16384 pixels of a smaller photo")
    Image.new("RGB", (8, 6)).save(file)  # came back as [6, 8, 3]
    refused(load_labels, tmp_path, view, match="one channel")


def test_an_error_is_one_line_whatever_a_file_is_called(tmp_path: Path) -> None:
    frame = {"file_path": "a\nb\x1b[31m\u2028.png", "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 7, "w": 8, "h": 6, "frames": [frame]}))
    refused(load_scene, tmp_path, ReadOptions(tmp_path / "work"), match=r"a\\nb\\x1b\[31m\\u2028\.png")
    assert str(InputError("grand-mère’s 杯子 🍵")) == "grand-mère’s 杯子 🍵"
