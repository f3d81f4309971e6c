"""What is fuzzed: one target a reader. A target is a folder of good files, one of which the fuzzer replaces."""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np

from perception.errors import InputError
from support.views_at import views_at

Data = bytes


@dataclass
class Target:
    """Files that are read together by read(folder, which file was replaced).

    variants: (file to replace, what turns fuzz bytes into its content, a seed that is read without an error).
    """

    read: Callable[[Path, str], None]
    files: dict[str, bytes]
    variants: list[tuple[str, Callable[[bytes], bytes], bytes]]
    words: list[str] = field(default_factory=list)
    memory: int = 512  # MiB that reading one input may take
    decides: bool = False  # the bytes are decisions rather than content: any will do
    folder: TemporaryDirectory[str] | None = None

    def seeds(self) -> list[bytes]:
        """One input for each variant that reads without an error: the variant's number, then the file."""
        return [bytes([n]) + seed for n, (_, _, seed) in enumerate(self.variants)]

    def run(self, data: bytes) -> bool:
        """True when the input was read, False when it was refused as it should be; anything else is a defect."""
        if not data:
            return False
        folder = self._place()
        name, make, _ = self.variants[data[0] % len(self.variants)]
        file = folder / name
        file.write_bytes(make(data[1:]))
        try:
            self.read(folder, name)
        except InputError as error:
            _refuse_memory_errors(error)
            if "\n" in str(error):
                raise AssertionError(f"the message has more than one line: {error}") from error
            if len(str(error)) > 2000:
                raise AssertionError(f"the message has {len(str(error))} characters") from error
            return False
        finally:
            if name in self.files:
                file.write_bytes(self.files[name])
            else:
                file.unlink()
        return True

    def _place(self) -> Path:
        if self.folder is None:
            self.folder = TemporaryDirectory(prefix="fuzz-", dir=in_memory())
            for name, content in self.files.items():
                file = Path(self.folder.name, name)
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(content)
        return Path(self.folder.name)


def in_memory() -> Path | None:
    """A folder that is not on a disk, where there is one."""
    return Path("/dev/shm") if Path("/dev/shm").is_dir() else None


def _refuse_memory_errors(error: BaseException) -> None:
    """A refusal that came from running out of memory means that too much was asked for."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError):
            raise AssertionError("more memory was asked for than the limit allows") from error
        cause = cause.__cause__ or cause.__context__


def same(data: bytes) -> bytes:
    """The fuzz bytes are the file."""
    return data


def archive_of(members: dict[str, bytes]) -> bytes:
    """A zip of stored members with good checksums."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name), content)
    return out.getvalue()


def npy(array: np.ndarray) -> bytes:
    """An array as a .npy file."""
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def member(name: str, others: dict[str, np.ndarray]) -> Callable[[bytes], bytes]:
    """The fuzz bytes are one array of an .npz whose other arrays and checksums are good."""
    rest = {f"{key}.npy": npy(value) for key, value in others.items() if key != name}
    return lambda data: archive_of({f"{name}.npy": data, **rest})


# ------------------------------------------------------------------ point clouds and splats


def _vertices(kind: str = "binary_little_endian", face: bool = True) -> bytes:
    from perception.io.ply import ply_bytes

    vertex = {axis: np.arange(4, dtype=np.float32) for axis in "xyz"}
    vertex |= {name: np.arange(4, dtype=np.uint8) for name in ("red", "green", "blue")}
    vertex["instance_id"] = np.arange(4, dtype=np.int32)
    elements = {"vertex": vertex}
    if face:
        elements["face"] = {"vertex_indices": np.array([[0, 1, 2, 3], [1, 2, 3, 0]], np.int32)}
    if kind != "ascii":
        return ply_bytes(elements)
    head = ply_bytes({"vertex": {k: v[:0] for k, v in vertex.items()}}).decode().replace("vertex 0", "vertex 2")
    rows = "0 1 2 3 4 5 6\n1.5 nan -2e3 255 0 1 -1\n"
    face_head = "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    head = head.replace("end_header\n", face_head).replace("binary_little_endian", "ascii")
    return (head + rows + "3 0 1 1\n4 0 1 0 1\n").encode()


_RAGGED = (
    (
        b"ply\nformat binary_big_endian 1.0\nelement vertex 1\nproperty double x\nproperty double y\n"
        b"property double z\nelement face 2\nproperty list uchar ushort vertex_index\nproperty uchar flag\nend_header\n"
    )
    + struct.pack(">ddd", 0, 1, 2)
    + bytes([3, 0, 0, 0, 0, 0, 0, 9])
    + bytes([4] + [0] * 8 + [7])
)

_PCD = (
    b"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb label normal_x normal_y normal_z\nSIZE 4 4 4 4 4 4 4 4\n"
    b"TYPE F F F U I F F F\nCOUNT 1 1 1 1 1 1 1 1\nWIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\n"
)
_PACKED = bytes([7, 0, 0, 0, 64, 0, 0, 0, 0, 0, 0xE0, 53, 0, 0, 0])
"""64 zeros by LibLZF: one as it is, 62 that repeat it, and another."""


def _cloud() -> Target:
    from perception.io.cloud import read_cloud

    arrays = {
        "points": np.zeros((2, 3)),
        "colors": np.ones((2, 3), np.uint8),
        "normals": np.ones((2, 3), np.float32),
        "faces": np.zeros((1, 3), np.int64),
        "instance_id": np.arange(2),
    }
    seeds = [
        ("a.ply", same, _vertices()),
        ("a.ply", same, _vertices("ascii")),
        ("a.ply", same, _RAGGED),
        ("a.pcd", same, _PCD + b"DATA ascii\n0 1 2 255 4 5 6 7\nnan 1 2 3 4 5 6 7\n"),
        ("a.pcd", same, _PCD + b"DATA binary\n" + bytes(64)),
        ("a.pcd", same, _PCD + b"DATA binary_compressed\n" + _PACKED),
        ("a.npz", same, archive_of({f"{k}.npy": npy(v) for k, v in arrays.items()})),
        *(("a.npz", member(name, arrays), npy(value)) for name, value in arrays.items()),
    ]

    def read(folder: Path, name: str) -> None:
        cloud = read_cloud(folder / name)
        assert cloud.points.ndim == 2 and cloud.points.shape[1] == 3 and len(cloud.points)
        assert cloud.colors is None or (cloud.colors.dtype == np.uint8 and cloud.colors.shape == cloud.points.shape)
        assert cloud.normals is None or cloud.normals.shape == cloud.points.shape
        assert cloud.faces is None or (cloud.faces.ndim == 2 and cloud.faces.shape[1] == 3)
        assert all(v.shape == (len(cloud.points),) and v.dtype.kind in "iufb" for v in cloud.labels.values())

    words = ["element", "property", "list", "vertex", "face", "double", "uchar", "int", "ascii", "binary_big_endian"]
    words += ["COUNT", "POINTS", "WIDTH", "DATA", "binary", "FIELDS", "4294967295", "-1", "nan", "1e400"]
    return Target(read, {}, seeds, words)


def _splat() -> Target:
    from perception.io.ply import map_ply, read_ply

    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    names += [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    from perception.io.ply import ply_bytes

    seed = ply_bytes({"vertex": {name: np.zeros(2, np.float32) for name in names}})

    def read(folder: Path, name: str) -> None:
        for element in read_ply(folder / "s.ply").values():
            assert len({len(column) for column in element.values()}) <= 1
        rows = map_ply(folder / "s.ply", "vertex")
        assert rows.nbytes <= (folder / "s.ply").stat().st_size
        rows.tobytes()

    return Target(read, {}, [("s.ply", same, seed)], ["element vertex", "property float", "property list uchar float"])


# ------------------------------------------------------------------ cameras and poses


def _colmap_text() -> dict[str, bytes]:
    images = "".join(f"{i} 1 0 0 0 {i}.5 0 1 1 {i}.png\n1 2 1 3 4 2 5 6 -1\n" for i in (1, 2))
    points = "".join(f"{i} {i} 2 3 10 20 30 0.5 1 {i - 1} 2 {i - 1}\n" for i in (1, 2))
    return {"cameras.txt": b"1 PINHOLE 8 6 7 7 4 3\n", "images.txt": images.encode(), "points3D.txt": points.encode()}


def _colmap_binary() -> dict[str, bytes]:
    camera = struct.pack("<QIiQQ4d", 1, 1, 1, 8, 6, 7, 7, 4, 3)
    image, point = struct.pack("<Q", 2), struct.pack("<Q", 2)
    for i in (1, 2):
        image += struct.pack("<I7dI", i, 1, 0, 0, 0, i, 0, 1, 1) + f"{i}.png\0".encode()
        image += struct.pack("<QddQddQddQ", 3, 1, 2, 1, 3, 4, 2, 5, 6, 2**64 - 1)
        point += struct.pack("<QdddBBBdQIIII", i, i, 2, 3, 1, 2, 3, 0.5, 2, 1, i - 1, 2, i - 1)
    return {"cameras.bin": camera, "images.bin": image, "points3D.bin": point}


def _without_photos() -> None:
    """Photos are not matched, which is no reading: random points take the place of those that a file lacks."""
    from perception.posed import triangulate

    def random(views: list[Any], store: Any, seed: int) -> tuple[Any, Any, dict[str, Any]]:
        return (*triangulate.random_cloud(views, seed), {"warnings": []})

    triangulate.triangulated_cloud = random
    triangulate.build_features = lambda *_, **__: SimpleNamespace(facts={"seconds": {}})  # type: ignore[assignment, return-value]
    triangulate.features_of = triangulate.tracks_of = lambda *_: SimpleNamespace(pairs=None)  # type: ignore[assignment]
    triangulate.checked_poses = lambda views, *_: (views, {"poses": {}, "notes": [], "warnings": []})
    triangulate.with_gains = lambda views, *_: (views, {})


def _png(width: int = 8) -> bytes:
    from PIL import Image

    out = io.BytesIO()
    Image.new("RGB", (width, 6)).save(out, "PNG")
    return out.getvalue()


def _colmap(binary: bool) -> Target:
    from perception.inputs.colmap import read_workspace
    from perception.sfm.options import ReadOptions

    _without_photos()
    old = _colmap_binary() if binary else _colmap_text()
    new = _with_rigs(old, binary)
    files = {f"old/sparse/0/{name}": content for name, content in old.items()}
    files |= {f"new/sparse/0/{name}": content for name, content in new.items()}
    photos = {f"{workspace}/images/{i}.png": _png() for i in (1, 2) for workspace in ("old", "new")}
    variants = [(name, same, content) for name, content in files.items()]

    def read(folder: Path, name: str) -> None:
        scene = read_workspace(folder / name[:3], ReadOptions(folder / "work"))
        assert scene.views and all(np.isfinite(view.camera_from_world).all() for view in scene.views)
        assert np.isfinite(scene.points).all()

    words = [
        "OPENCV",
        "SIMPLE_RADIAL",
        "FULL_OPENCV",
        "EQUIRECTANGULAR",
        "THIN_PRISM_FISHEYE",
        "1.png",
        "CAMERA",
        "nan",
    ]
    return Target(read, files | photos, variants, words)


def _with_rigs(model: dict[str, bytes], binary: bool) -> dict[str, bytes]:
    """The same model as pycolmap writes it today, with rigs and frames."""
    from perception.photos.lens import load_pycolmap

    with TemporaryDirectory() as source, TemporaryDirectory() as out:
        for name, content in model.items():
            Path(source, name).write_bytes(content)
        read = load_pycolmap().Reconstruction(source)
        (read.write_binary if binary else read.write_text)(out)
        return {file.name: file.read_bytes() for file in sorted(Path(out).iterdir())}


def _transforms() -> Target:
    from perception.inputs.transforms import read_frames, read_transforms
    from perception.sfm.options import ReadOptions

    _without_photos()
    frames = [
        {"file_path": f"{i}.png", "transform_matrix": [[1, 0, 0, i], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
        for i in (1, 2)
    ]
    small = [{"file_path": "1", "transform_matrix": frames[0]["transform_matrix"][:3], "k1": 0.1}]
    lens = {"w": 8, "h": 6, "fl_x": 7.5, "cx": 4, "cy": 3, "camera_model": "OPENCV", "ply_file_path": "a.ply"}
    angle = {"camera_angle_x": 0.8, "ply_file_path": "a.ply", "is_fisheye": True, "w": 8, "h": 6}
    seeds = [json.dumps({**lens, "frames": frames}), json.dumps({**angle, "frames": small})]
    files = {"1.png": _png(), "2.png": _png(), "a.ply": _vertices(face=False)}

    def read(folder: Path, name: str) -> None:
        file = folder / "transforms.json"
        try:
            read_frames(file)
        except InputError as error:
            _refuse_memory_errors(error)
        scene = read_transforms(file, ReadOptions(folder / "work"))
        assert all(np.isfinite(v.camera_from_world).all() and np.isfinite(v.K).all() for v in scene.views)

    words = [*lens, *angle, "frames", "file_path", "transform_matrix", "NaN", "Infinity", "null", "k1", "k4", "p1"]
    words += ["1e999", "\\u0000", "1" * 400, "PINHOLE", "OPENCV_FISHEYE", "[[[[", "../", "/"]
    return Target(read, files, [("transforms.json", same, s.encode()) for s in seeds], words)


def _camera() -> Target:
    import yaml

    from perception.photos.camera_file import read_camera

    def text(model: str, values: list[float]) -> bytes:
        data: dict[str, Any] = {"image_width": 640, "image_height": 480, "distortion_model": model}
        data["camera_matrix"] = {"rows": 3, "cols": 3, "data": [500.0, 0, 320, 0, 500, 240, 0, 0, 1]}
        data["distortion_coefficients"] = {"rows": 1, "cols": len(values), "data": values}
        return yaml.safe_dump(data, default_flow_style=None).encode()

    models = {"plumb_bob": [0.1, 0, 0, 0, 0.1], "rational_polynomial": [0.1] * 8, "equidistant": [0.1] * 4}

    def read(folder: Path, name: str) -> None:
        lens = read_camera(folder / "camera.yaml")
        assert lens.width > 0 and lens.height > 0 and np.isfinite(lens.params).all()

    words = [
        *models,
        "camera_matrix",
        "&a [*a]",
        "*a",
        "!!timestamp ",
        "!!int ",
        "!!float ",
        "!!bool ",
        "!!binary ",
        "<<:",
    ]
    words += ["2001-02-30", "0b_", "0x_", "1:60", ".nan", ".inf", "? ", "[[[[[", "{{{{", "---\n", "%YAML 1.1\n"]
    return Target(read, {}, [("camera.yaml", same, text(*item)) for item in models.items()], words)


def _config() -> Target:
    from perception.config import load_config

    seed = b'seed = 1\ndevice = "cpu"\n[train]\niterations = 10\ntime_limit = 3.5\n[losses]\nhalf_resolution = true\n'
    pairs = b"train.iterations=10\ntrain.time_limit=none\nlosses.margin=1e-3\ninstances.method=hdbscan\n"

    def read(folder: Path, name: str) -> None:
        json.dumps(load_config(folder / "c.toml").to_json())
        if name == "pairs":
            load_config(pairs=(folder / name).read_bytes().decode("utf-8", "replace").split("\n")[:9])

    words = [
        "train.",
        "losses",
        "true",
        "inf",
        "nan",
        "-1",
        "1e400",
        "photos",
        "held_out",
        "'''",
        '"""',
        "[[",
        "0x",
        "1979-05-27",
    ]
    return Target(read, {"c.toml": seed}, [("c.toml", same, seed), ("pairs", same, pairs[:-1])], words)


# ------------------------------------------------------------------ pictures


_PICTURE = 6144
"""MiB of address space: Pillow takes pictures of up to 179 million pixels, and asks for as much as a chunk's length
says, at most 4 GiB, before it reads what is there."""


_LARGEST = 1 << 20
"""Pixels from which Pillow warns, and refuses twice as many, while photos are fuzzed: large ones take seconds to decode
and reach the same code."""


def repaired_png(data: bytes) -> bytes:
    """The chunks' checksums made good, so that mutations reach what they hold."""
    out, at = bytearray(data[:8]), 8
    while at + 12 <= len(data):
        length = struct.unpack_from(">I", data, at)[0]
        if at + 12 + length > len(data):
            break
        body = data[at + 4 : at + 8 + length]
        out += data[at : at + 4] + body + struct.pack(">I", zlib.crc32(body))
        at += 12 + length
    return bytes(out + data[at:])


def _label_png() -> Target:
    from PIL import Image

    from perception.masks.label_files import load_labels, stored_key
    from perception.masks.label_folder import LabelFolder
    from perception.types import View

    labels = np.arange(48).reshape(6, 8)
    wide, palette = io.BytesIO(), io.BytesIO()
    Image.fromarray(labels.astype(np.uint16)).save(wide, "PNG")
    Image.fromarray(labels.astype(np.uint8)).convert("P").save(palette, "PNG")
    view = View("1.png", Path("1.png"), np.eye(3), 8, 6, np.eye(4))

    def read(folder: Path, name: str) -> None:
        stored_key(folder / "1.png.png")
        stored = load_labels(folder, view)
        assert stored.ndim == 2 and stored.dtype == np.int32
        image = LabelFolder(folder).label_image(view, np.zeros((6, 8, 3), np.uint8))
        assert image.shape == (6, 8) and image.dtype == np.int32

    good = {"1.png": wide.getvalue(), "1.png.png": wide.getvalue()}
    seeds = [
        (name, make, seed.getvalue()) for name in good for make in (same, repaired_png) for seed in (wide, palette)
    ]
    return Target(
        read,
        good,
        seeds,
        ["IHDR", "IDAT", "PLTE", "tEXt", "zTXt", "iTXt", "tRNS", "IEND", "iCCP", "eXIf", "acTL"],
        _PICTURE,
    )


def _photo() -> Target:
    from PIL import Image

    from perception.photos import decode as photos
    from perception.photos.decode import photo_size, read_photo, why_left_out

    exif = Image.Exif()
    exif[0x0112] = 6
    seeds = []
    for suffix, mode in (
        ("png", "RGBA"),
        ("png", "P"),
        ("png", "I;16"),
        ("jpg", "RGB"),
        ("bmp", "RGB"),
        ("webp", "RGB"),
    ):
        out = io.BytesIO()
        options = {"exif": exif} if suffix == "jpg" else {}
        Image.new(mode, (8, 6)).save(out, "JPEG" if suffix == "jpg" else suffix.upper(), **options)
        seeds.append((f"a.{suffix}", repaired_png if suffix == "png" else same, out.getvalue()))
    out = io.BytesIO()
    Image.new("RGB", (8, 6)).save(out, "TIFF")
    seeds.append(("a.tif", same, out.getvalue()))

    def read(folder: Path, name: str) -> None:
        file = folder / name
        with patch.object(photos, "MOST_DECODED", _LARGEST):
            why_left_out(file, strict=True)
            width, height = photo_size(file)
            photo = read_photo(file)
        assert photo.dtype == np.uint8 and photo.shape == (height, width, 3)

    return Target(
        read,
        {},
        seeds,
        ["IHDR", "IDAT", "PLTE", "Exif\0\0", "eXIf", "tRNS", "JFIF", "\xff\xd8", "VP8 ", "II*\0"],
        _PICTURE,
    )


# ------------------------------------------------------------------ the map


def _small_language() -> dict[str, np.ndarray]:
    from perception.language.description import InstanceDescription, to_arrays

    row = np.ones(4, np.float32)
    described = InstanceDescription(row, row[None], np.zeros((24, 4), np.float32), ["0.jpg"], [(0, 0, 9, 9)])
    return to_arrays([described] * 2, "words")


@cache
def _small_map() -> dict[str, bytes]:
    from perception.map.write import Map, write_map

    box = {"center": [0, 0, 0], "rotation": np.eye(3).tolist(), "extent": [1, 1, 1]}
    instances = [
        {"id": i, "label": None, "score": 0.5, "num_gaussians": 2, "centroid": [0, 0, 0], "obb": box} for i in range(4)
    ]
    instances[1]["parts"] = [{**instances.pop(), "parent": 1} for _ in range(2)]
    n = 4
    gmap = Map(
        *(np.zeros((n, k), np.float32) for k in (3, 4, 3)), np.zeros(n, np.float32), np.zeros((n, 4, 3), np.float32),
        np.zeros((n, 2), np.float32), np.array([0, 0, 1, -1], np.int32), np.ones(n, np.float32), instances,
        {"frame": "map", "metric": False, "source": "photos"}, views_at([np.eye(4)]),
        _small_language(), {"ids": np.array([2, 3, -1, -1], np.int32)},
    )  # fmt: skip
    with TemporaryDirectory() as folder:
        path = Path(folder, "a.gsmap")
        write_map(path, gmap)
        return {file.name: file.read_bytes() for file in sorted(path.iterdir())}


def map_store() -> Target:
    from perception.map.write import read_map, verify_map

    sealed = _small_map()
    info = json.loads(sealed["map.json"])
    loose = json.dumps({key: value for key, value in info.items() if key not in ("files", "sha256")}).encode()
    files = {f"sealed/{k}": v for k, v in sealed.items()} | {f"loose/{k}": v for k, v in sealed.items()}
    files["loose/map.json"] = loose
    variants: list[tuple[str, Callable[[bytes], bytes], bytes]] = [
        (f"loose/{name}", same, files[f"loose/{name}"]) for name in sealed
    ]
    variants += [("sealed/map.json", same, sealed["map.json"]), ("sealed/features.npy", same, sealed["features.npy"])]
    for name in ("language", "parts"):
        with np.load(io.BytesIO(files[f"loose/{name}.npz"])) as arrays:
            held = {key: arrays[key] for key in arrays.files}
        variants += [(f"loose/{name}.npz", member(key, held), npy(value)) for key, value in held.items()]

    def read(folder: Path, name: str) -> None:
        path = (folder / name).parent
        gmap = read_map(path)
        assert len(gmap.features) == len(gmap.instance_ids) == len(gmap.membership) == len(gmap)
        assert len(gmap.poses) == len(gmap.views) and len(gmap.index.ids) >= 0
        if "sealed" in name:
            verify_map(path)

    words = [
        "format_version",
        "files",
        "bytes",
        "sha256",
        "instances",
        "'descr'",
        "'shape'",
        "(9999999999,)",
        "<f8",
        "|O",
    ]
    words += ["fortran_order", "True", "centroid", "obb", "rotation", "label", "NaN", "1e999", "../", "[[[[[[[["]
    return Target(read, files, variants, words)


TARGETS: dict[str, Callable[[], Target]] = {
    "cloud": _cloud,
    "splat": _splat,
    "colmap-binary": lambda: _colmap(True),
    "colmap-text": lambda: _colmap(False),
    "transforms": _transforms,
    "camera": _camera,
    "config": _config,
    "label-png": _label_png,
    "photo": _photo,
    "map": map_store,
}
