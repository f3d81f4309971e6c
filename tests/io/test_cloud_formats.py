"""Cloud files against plyfile-free oracles: bytes written by hand, and invariance under a round trip."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from perception.errors import InputError
from perception.evaluate.instances import run_instances
from perception.io.cloud import read_cloud, to_int32, write_cloud
from perception.io.ply import read_ply, write_ply
from perception.types import PointCloud


def sample(n: int = 57, *, faces: bool = True) -> PointCloud:
    rng = np.random.default_rng(3)
    cloud = PointCloud(rng.normal(size=(n, 3)).astype(np.float32))
    cloud.colors = rng.integers(0, 256, (n, 3)).astype(np.uint8)
    cloud.normals = rng.normal(size=(n, 3)).astype(np.float32)
    cloud.labels = {"instance_id": rng.integers(-1, 9, n).astype(np.int32)}
    if faces:
        cloud.faces = rng.integers(0, n, (21, 3)).astype(np.int32)
    return cloud


@pytest.mark.parametrize("suffix", ["ply", "pcd", "npz"])
def test_a_round_trip_keeps_points_and_order(tmp_path, suffix):
    cloud = sample()
    path = tmp_path / f"cloud.{suffix}"
    write_cloud(path, cloud)
    back = read_cloud(path)
    np.testing.assert_array_equal(back.points.astype(np.float32), cloud.points)
    np.testing.assert_array_equal(back.colors, cloud.colors)
    np.testing.assert_allclose(back.normals, cloud.normals, rtol=1e-7)
    np.testing.assert_array_equal(back.labels["instance_id"], cloud.labels["instance_id"])
    if suffix != "pcd":
        np.testing.assert_array_equal(back.faces, cloud.faces)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]  # nothing temporary is left


def test_written_ply_is_what_the_contract_says(tmp_path):
    cloud = sample(3, faces=False)
    cloud.normals = None
    write_cloud(tmp_path / "c.ply", cloud)
    data = (tmp_path / "c.ply").read_bytes()
    header, body = data.split(b"end_header\n")
    assert header.decode().splitlines() == [
        "ply",
        "format binary_little_endian 1.0",
        "element vertex 3",
        *[f"property float {a}" for a in "xyz"],
        *[f"property uchar {c}" for c in ("red", "green", "blue")],
        "property int instance_id",
    ]
    rows = [struct.unpack_from("<fffBBBi", body, 19 * i) for i in range(3)]
    assert len(body) == 3 * 19
    for i, row in enumerate(rows):
        assert row[:3] == tuple(cloud.points[i].tolist())
        assert row[3:6] == tuple(cloud.colors[i].tolist())
        assert row[6] == cloud.labels["instance_id"][i]


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_ply_of_both_byte_orders_with_mixed_faces(tmp_path, order):
    name = {"<": "little", ">": "big"}[order]
    header = (
        f"ply\nformat binary_{name}_endian 1.0\ncomment odd\nelement vertex 4\nproperty double x\n"
        "property double y\nproperty double z\nproperty ushort label\nelement face 2\n"
        "property list uchar int vertex_indices\nproperty uchar flag\n"
        "element edge 1\nproperty short a\nend_header\n"
    )
    body = b"".join(struct.pack(order + "dddH", i, 2 * i, -i, 60000 + i) for i in range(4))
    body += struct.pack(order + "BiiiB", 3, 0, 1, 2, 7) + struct.pack(order + "BiiiiB", 4, 0, 1, 2, 3, 8)
    body += struct.pack(order + "h", -5)
    (tmp_path / "m.ply").write_bytes(header.encode() + body)
    cloud = read_cloud(tmp_path / "m.ply")
    assert cloud.points.dtype == np.float64
    np.testing.assert_array_equal(cloud.points, [[i, 2 * i, -i] for i in range(4)])
    assert cloud.labels["label"].tolist() == [60000, 60001, 60002, 60003]
    assert cloud.faces.tolist() == [[0, 1, 2], [0, 1, 2], [0, 2, 3]]
    elements = read_ply(tmp_path / "m.ply")
    assert elements["edge"]["a"].tolist() == [-5]
    assert elements["face"]["flag"].tolist() == [7, 8]


def test_ascii_ply_equals_binary(tmp_path):
    rng = np.random.default_rng(0)
    vertex = {a: rng.normal(size=30) for a in "xyz"} | {"id": rng.integers(-9, 9, 30).astype(np.int32)}
    elements = {"vertex": vertex, "face": {"vertex_index": rng.integers(0, 30, (8, 3)).astype(np.int32)}}
    write_ply(tmp_path / "b.ply", elements)
    header = (tmp_path / "b.ply").read_bytes().split(b"end_header\n")[0].replace(b"binary_little_endian", b"ascii")
    rows = [" ".join(map(repr, row)) for row in zip(*(column.tolist() for column in vertex.values()), strict=True)]
    rows += [f"3 {a} {b} {c}" for a, b, c in elements["face"]["vertex_index"].tolist()]
    (tmp_path / "a.ply").write_bytes(header + b"end_header\n" + "\n".join(rows).encode() + b"\n")
    a, b = read_cloud(tmp_path / "a.ply"), read_cloud(tmp_path / "b.ply")
    np.testing.assert_array_equal(a.points, b.points)
    np.testing.assert_array_equal(a.faces, b.faces)
    np.testing.assert_array_equal(a.labels["id"], b.labels["id"])


def test_labels_stored_as_floats_are_whole_numbers_or_an_error_where_they_are_used(tmp_path):
    vertex = {a: np.zeros(3) for a in "xyz"} | {"scalar_instance_id": np.float32([4, -1, 70000])}
    write_ply(tmp_path / "a.ply", {"vertex": vertex})
    assert to_int32(read_cloud(tmp_path / "a.ply").labels["instance_id"], "x").tolist() == [4, -1, 70000]
    vertex["scalar_instance_id"] = np.float32([4, 0.5, 1])
    write_ply(tmp_path / "b.ply", {"vertex": vertex})
    with pytest.raises(InputError, match=r"b\.ply: property 'instance_id': value 0\.5 at index 1"):
        run_instances(tmp_path / "b.ply", tmp_path / "a.ply")


def test_nan_and_infinite_points_stay_in_place(tmp_path):
    points = np.array([[0, 0, 0], [np.nan, 1, 2], [np.inf, 0, 0], [4, 5, 6]], np.float32)
    for suffix in ("ply", "pcd", "npz"):
        write_cloud(tmp_path / f"n.{suffix}", PointCloud(points))
        np.testing.assert_array_equal(read_cloud(tmp_path / f"n.{suffix}").points, points)


def pcd(fields: str, size: str, kind: str, points: int, data: str) -> bytes:
    count = " ".join("1" for _ in fields.split())
    return (
        f"# .PCD\nVERSION .7\nFIELDS {fields}\nSIZE {size}\nTYPE {kind}\nCOUNT {count}\n"
        f"WIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {data}\n"
    ).encode()


def test_pcd_ascii_with_packed_colour(tmp_path):
    packed = struct.unpack("<f", struct.pack("<I", (200 << 16) | (100 << 8) | 7))[0]
    text = pcd("x y z rgb label", "4 4 4 4 4", "F F F F U", 2, "ascii")
    (tmp_path / "a.pcd").write_bytes(text + f"1 2 3 {packed:.9g} 5\n4 5 nan {packed:.9g} 6\n".encode())
    cloud = read_cloud(tmp_path / "a.pcd")
    np.testing.assert_array_equal(cloud.points, np.array([[1, 2, 3], [4, 5, np.nan]], np.float32))
    assert cloud.colors.tolist() == [[200, 100, 7]] * 2
    assert cloud.labels["label"].tolist() == [5, 6]


GOOD = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"


@pytest.mark.parametrize(
    ("name", "data", "word"),
    [
        ("a.ply", b"", "not a PLY"),
        ("a.ply", b"solid\n", "not a PLY"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex\n", "cannot be understood"),
        (
            "a.ply",
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty quad x\nend_header\n",
            "cannot be understood",
        ),
        ("a.ply", GOOD[:-3] + bytes(3000), "cannot be understood"),  # as a disk leaves it that lost power
        ("a.ply", b"ply\nformat ascii 1.0\n", "cut short"),
        ("a.ply", GOOD + b"end_header\n1 2\n", "cut short"),
        ("a.ply", GOOD + b"end_header\n1 two 3\n", "numbers are expected"),
        ("a.ply", GOOD + b"end_header\n1 2 3 4\n", "more numbers"),
        ("a.pcd", pcd("x y z", "4 4 4", "F F F", 1, "ascii") + b"1 2 3 4\n", "more numbers"),
        ("a.ply", GOOD.replace(b"ascii", b"binary_little_endian") + b"end_header\n\0\0", "0 complete rows"),
        ("a.ply", GOOD.replace(b"vertex 1", b"vertex 0") + b"end_header\n", "no points"),
        ("a.ply", GOOD.replace(b"float z", b"float w") + b"end_header\n1 2 3\n", "x, y and z"),
        (
            "a.ply",
            GOOD + b"element face 1\nproperty list uchar int vertex_indices\nend_header\n1 2 3\n3 0 0 9\n",
            "names vertex 9",
        ),
        ("a.pcd", b"VERSION .7\n", "no DATA"),
        ("a.pcd", pcd("x y z", "4 4 4", "F F F", 3, "binary") + b"123", "cut short"),
        ("a.pcd", pcd("x y z", "4 4 4", "F F F", 3, "zipped"), "zipped"),
        ("a.pcd", pcd("x y z", "4 4", "F F F", 3, "ascii"), "cannot be understood"),
        ("a.pcd", pcd("x y z", "4 4 4", "F F F", 1, "binary_compressed"), "cannot be understood"),
        ("a.pcd", pcd("x y z", "4 4 4", "F F F", 1, "binary_compressed") + b"\2\0\0\0\x0c\0\0\0\x20\0", "damaged"),
        ("a.pcd", pcd("x y z", "4 4 4", "F F F", 1, "binary_compressed") + b"\2\0\0\0\xff\0\0\0\0\0", "packed bytes"),
        (
            "a.pcd",
            pcd("x y z", "4 4 4", "F F F", 2, "ascii").replace(b"POINTS 2", b"POINTS 3") + b"1 2 3 " * 3,
            "2 and 3",
        ),
        ("a.npz", b"nonsense", "NPZ"),
        ("a.stl", b"", "unknown point cloud format"),
    ],
)
def test_bad_files_are_told_in_one_line(tmp_path, name, data, word):
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(InputError, match=word) as error:
        read_cloud(path)
    told = str(error.value)
    assert str(path) in told and "\n" not in told and len(told) < len(str(path)) + 600


def test_a_file_that_cannot_fit_is_refused_before_it_is_read(tmp_path, monkeypatch):
    write_cloud(tmp_path / "c.ply", sample(1000))
    monkeypatch.setattr("perception.machine.available_memory", lambda: 10_000)
    with pytest.raises(InputError, match=r"c\.ply: needs about .* GiB are free; split"):
        read_cloud(tmp_path / "c.ply")


def test_a_header_that_promises_too_much_is_cut_short_not_out_of_memory(tmp_path):
    head = GOOD.replace(b"ascii", b"binary_little_endian").replace(b"vertex 1", b"vertex 999999999999")
    (tmp_path / "c.ply").write_bytes(head + b"end_header\n" + bytes(24))
    with pytest.raises(InputError, match="2 complete rows, its header says 999999999999"):
        read_cloud(tmp_path / "c.ply")


def test_a_missing_file_and_a_folder_that_cannot_be_written(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_cloud(tmp_path / "none.ply")
    write_cloud(tmp_path / "new" / "c.ply", sample())  # as a page, pictures and a graph, which make their folders
    with pytest.raises(InputError, match="cannot be written"):
        write_cloud(tmp_path / "new" / "c.ply" / "c.ply", sample())
    with pytest.raises(InputError, match="cannot write the format"):
        write_cloud(tmp_path / "c.stl", sample())
