"""Clouds as other programs write them. The bytes are written here by `struct` and NumPy, or by Open3D."""

from __future__ import annotations

import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perception.errors import InputError
from perception.io.cloud import left_out, read_cloud, to_uint8, write_cloud
from perception.io.ply import Lists, read_ply
from perception.types import PointCloud

RNG = np.random.default_rng(5)
N = 40
XYZ, RGB = RNG.normal(size=(N, 3)).astype(np.float32), RNG.integers(0, 256, (N, 3)).astype(np.uint8)
NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float"}
NAMES |= {"f8": "double", "i8": "int64", "u8": "uint64"}


def ply(
    path: Path,
    columns: dict[str, np.ndarray],
    order: str = "<",
    eol: str = "\n",
    names: dict[str, str] = NAMES,
    before: str = "",
    after: str = "",
    tail: bytes = b"",
) -> Path:
    """before, after: header lines around the element; tail: bytes behind its rows."""
    rows = np.empty(N, np.dtype([(n, order + v.dtype.str[1:]) for n, v in columns.items()]))
    for name, values in columns.items():
        rows[name] = values
    lines = ["ply", f"format binary_{'little' if order == '<' else 'big'}_endian 1.0", before, f"element vertex {N}"]
    lines += [f"property {names[v.dtype.str[1:]]} {n}" for n, v in columns.items()] + [after, "end_header", ""]
    head = eol.join(line for line in lines[:-1] if line) + eol
    path.write_bytes(head.encode() + rows.tobytes() + tail)
    return path


def points() -> dict[str, np.ndarray]:
    return dict(zip("xyz", XYZ.T, strict=True)) | dict(zip(("red", "green", "blue"), RGB.T, strict=True))


STAMPS = np.arange(N, dtype=np.int64) + 1_700_000_000_000_000_000


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("scalar_label", np.where(np.arange(N) % 7, np.arange(N), np.nan).astype(np.float32)),
        ("scalar_dist_label", (np.arange(N) / 2).astype(np.float32)),
        ("gps_time", np.full(N, 4_000_000_000, np.uint32)),
        ("timestamp", STAMPS),
        ("hash", STAMPS.astype(np.uint64) * 10),
        ("weight", np.linspace(-1, 1, N)),
    ],
)
@pytest.mark.parametrize("order", ["<", ">"])
def test_a_column_of_any_type_is_kept_and_stops_nothing(
    name: str, values: np.ndarray, order: str, tmp_path: Path
) -> None:
    cloud = read_cloud(ply(tmp_path / "a.ply", points() | {name: values}, order))
    np.testing.assert_array_equal(cloud.points, XYZ)
    np.testing.assert_array_equal(cloud.colors, RGB)
    column = cloud.labels[name.removeprefix("scalar_")]
    np.testing.assert_array_equal(column, values)
    assert column.dtype == values.dtype and cloud.points.dtype == np.float32


def test_a_scalar_named_as_a_coordinate_does_not_move_the_points(tmp_path: Path) -> None:
    cloud = read_cloud(ply(tmp_path / "a.ply", points() | {"scalar_x": np.zeros(N, np.float32)}))
    write_cloud(tmp_path / "b.ply", cloud)
    np.testing.assert_array_equal(read_cloud(tmp_path / "b.ply").points, XYZ)


@pytest.mark.parametrize(
    "names",
    [
        {**NAMES, "i8": "long", "u1": "uint8", "f4": "float32"},
        {**NAMES, "i8": "int64_t", "u1": "uint8_t", "f4": "Float"},
    ],
)
def test_types_by_other_names(names: dict[str, str], tmp_path: Path) -> None:
    cloud = read_cloud(ply(tmp_path / "a.ply", points() | {"t": STAMPS}, names=names))
    np.testing.assert_array_equal(cloud.points, XYZ)
    np.testing.assert_array_equal(cloud.labels["t"], STAMPS)


@pytest.mark.parametrize("eol", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_line_ends_comments_and_a_byte_order_mark(eol: str, mark: bytes, tmp_path: Path) -> None:
    """A row that begins with the byte of a line end is no part of the header."""
    xyz = XYZ.copy()
    xyz[0, 0] = np.frombuffer(b"\n\r\nA", np.float32)[0]
    before = f"comment end_header of caf\u00e9{eol}obj_info num_cols 512"
    path = ply(tmp_path / "a.ply", dict(zip("xyz", xyz.T, strict=True)), eol=eol, before=before)
    path.write_bytes(mark + path.read_bytes())
    np.testing.assert_array_equal(read_cloud(path).points, xyz)


def test_elements_without_properties_and_repeated_names(tmp_path: Path) -> None:
    path = ply(
        tmp_path / "a.ply", points() | {"q": np.full(N, 7, np.int32)}, before="element camera 3", after="element x 2"
    )
    path.write_bytes(path.read_bytes().replace(b"property int q", b"property int x"))
    np.testing.assert_array_equal(read_cloud(path).points, XYZ)
    assert list(read_ply(path)["vertex"]) == ["x", "y", "z", "red", "green", "blue"]  # in the order of the file
    with pytest.raises(InputError, match="expected x, y and z"):
        path.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 2\nend_header\n")
        read_cloud(path)


@pytest.mark.parametrize("order", ["<", ">", ""])
def test_lists_of_different_lengths(order: str, tmp_path: Path) -> None:
    """Of vertices, as OpenMVS writes them, and of faces: triangles, quads, points and lines, as fans."""
    rows = [RNG.integers(0, 99, RNG.integers(0, 5)).tolist() for _ in range(N)]
    faces = [RNG.integers(0, N, k).tolist() for k in (3, 4, 3, 2, 0, 5, 3, 6)]
    kind = {"<": "binary_little_endian", ">": "binary_big_endian", "": "ascii"}[order]
    head = f"ply\nformat {kind} 1.0\nelement vertex {N}\n" + "".join(f"property float {a}\n" for a in "xyz")
    head += "property list uchar uint view_indices\nproperty list ushort float view_weights\nproperty short after\n"
    head += f"element face {len(faces)}\nproperty list int uint vertex_indices\nproperty uchar flag\nend_header\n"
    if order:
        body = b"".join(
            struct.pack(f"{order}fffB{len(r)}IH{len(r)}fh", *XYZ[i], len(r), *r, len(r), *r, i)
            for i, r in enumerate(rows)
        )
        body += b"".join(struct.pack(f"{order}i{len(f)}IB", len(f), *f, 7) for f in faces)
    else:
        lines = [[*map(repr, XYZ[i].tolist()), len(r), *r, len(r), *r, i] for i, r in enumerate(rows)]
        body = "\n".join(" ".join(map(str, line)) for line in [*lines, *([len(f), *f, 7] for f in faces)]).encode()
    (tmp_path / "a.ply").write_bytes(head.encode() + body)
    elements = read_ply(tmp_path / "a.ply")
    for name in ("view_indices", "view_weights"):
        lists = elements["vertex"][name]
        assert isinstance(lists, Lists) and lists.counts.tolist() == [len(r) for r in rows]
        assert lists.values.tolist() == [v for r in rows for v in r]
    assert elements["face"]["flag"].tolist() == [7] * len(faces)
    cloud = read_cloud(tmp_path / "a.ply")
    assert list(elements["vertex"]) == [*"xyz", "view_indices", "view_weights", "after"]
    np.testing.assert_array_equal(cloud.points, XYZ)
    assert cloud.labels["after"].tolist() == list(range(N)) and set(cloud.labels) == {"after"}
    assert cloud.faces.tolist() == [[f[0], f[i], f[i + 1]] for f in faces for i in range(1, len(f) - 1)]
    (tmp_path / "a.ply").write_bytes((head.encode() + body)[: -1 if order else -2])
    with pytest.raises(InputError, match="cut short"):
        read_cloud(tmp_path / "a.ply")


def test_more_rows_of_lists_than_are_gathered_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("ply._PIECE", "cloud._SOME"):
        monkeypatch.setattr(f"perception.io.{name}", 3)
    test_lists_of_different_lengths("<", tmp_path)


def test_polygons_of_one_length_become_fans(tmp_path: Path) -> None:
    faces = RNG.integers(0, N, (6, 5))
    tail = b"".join(struct.pack("<B5i", 5, *f) for f in faces.tolist())
    after = "element face 6\nproperty list uchar int vertex_index"
    cloud = read_cloud(ply(tmp_path / "a.ply", points(), after=after, tail=tail))
    assert cloud.faces.tolist() == [[f[0], f[i], f[i + 1]] for f in faces.tolist() for i in (1, 2, 3)]


@pytest.mark.parametrize("corner", [N, -1, 2**32 + 5, float("nan")])
def test_a_face_of_a_vertex_that_is_not_there(corner: float, tmp_path: Path) -> None:
    kind, code = ("double", "d") if isinstance(corner, float) else ("int64", "q")
    after = f"element face 1\nproperty list uchar {kind} vertex_index"
    ply(tmp_path / "a.ply", points(), after=after, tail=struct.pack(f"<B3{code}", 3, 0, 1, corner))
    np.savez(tmp_path / "a.npz", points=XYZ, faces=np.array([[0, 1, corner]]))
    for name in ("a.ply", "a.npz"):
        with pytest.raises(InputError, match=f"names vertex {corner}, but there are {N}"):
            read_cloud(tmp_path / name)


@pytest.mark.parametrize("word", ["nan", "-nan(ind)", "1.#QNAN0", "-1.#IND00", "1.#INF"])
def test_numbers_that_are_not_finite_in_a_text(word: str, tmp_path: Path) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    (tmp_path / "a.ply").write_text(f"{head}property int64 t\nend_header\n1 2 3 1700000000\n4 {word} 6 7\n")
    cloud = read_cloud(tmp_path / "a.ply")
    assert np.isfinite(cloud.points).tolist() == [[True] * 3, [True, False, True]]
    assert cloud.labels["t"].tolist() == [1_700_000_000, 7]


def test_words_in_a_text_are_told_by_an_older_numpy_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before 2.4 it warned of a word and returned the numbers before it."""

    def older(source: Any, kind: type, sep: str) -> np.ndarray:
        text = source if isinstance(source, bytes) else source.read()
        try:
            return np.array(text.split(), kind)
        except ValueError:
            warnings.warn("unmatched data", DeprecationWarning, stacklevel=2)
            return np.arange(3.0)

    for name in ("fromfile", "fromstring"):
        monkeypatch.setattr(np, name, older)
    test_numbers_that_are_not_finite_in_a_text("-1.#IND00", tmp_path)
    with pytest.raises(InputError, match="text where numbers are expected"):
        test_numbers_that_are_not_finite_in_a_text("six", tmp_path)


LEVELS = np.linspace(0, 1, 3 * N).reshape(N, 3)


@pytest.mark.parametrize(
    ("stored", "scale"),
    [
        (LEVELS.astype(np.float32), 255),
        (np.where(LEVELS > 0.99, 1.5, LEVELS), 255),  # lights brighter than white
        ((LEVELS * 255).round(), 1),
        (LEVELS * 255, 1),
        (LEVELS * 65535, 1 / 257),
        ((LEVELS * 65535).astype(np.uint16), 1 / 257),
        ((LEVELS * 255).astype(np.uint16), 1),
        ((LEVELS * 255).astype(np.int32), 1),
        ((LEVELS * 255).astype(np.uint8).view(np.int8), None),
        (np.where(LEVELS > 0.99, np.nan, LEVELS), 255),
    ],
)
def test_colours_of_any_type_and_range(stored: np.ndarray, scale: float | None) -> None:
    exact = stored.view(np.uint8) if scale is None else np.clip(np.round(np.nan_to_num(stored) * scale), 0, 255)
    np.testing.assert_array_equal(to_uint8(stored), exact)


def pcd(fields: str, sizes: str, types: str, counts: str | None, extra: str, data: str) -> bytes:
    lines = ["# .PCD v0.7", "VERSION 0.7", f"FIELDS {fields}", f"SIZE {sizes}", f"TYPE {types}"]
    lines += [f"COUNT {counts}"] if counts else []
    return ("\n".join([*lines, extra, "VIEWPOINT 0 0 0 1 0 0 0", f"DATA {data}"]) + "\n").encode()


SHAPE = f"WIDTH {N}\nHEIGHT 1\nPOINTS {N}"


@pytest.mark.parametrize(
    ("fields", "sizes", "types", "counts", "gap"),
    [
        ("x y z _ t", "4 4 4 1 8", "F F F U U", "1 1 1 0 1", 0),
        ("x y z _ t", "4 4 4 1 8", "F F F U U", "1 1 1 4 1", 4),
        ("x y z _ t _", "4 4 4 1 8 1", "F F F U U U", "1 1 1 3 1 0", 3),
        ("x y z t", "4 4 4 8", "f f f u", None, 0),
    ],
)
def test_pcd_with_padding_and_stamps(
    fields: str, sizes: str, types: str, counts: str | None, gap: int, tmp_path: Path
) -> None:
    rows = np.zeros(N, np.dtype([("xyz", "<f4", 3), ("gap", "u1", gap), ("t", "<u8")]))
    rows["xyz"], rows["t"], rows["gap"] = XYZ, STAMPS, 9
    for extra in (SHAPE, f"WIDTH {N // 4}\nHEIGHT 4", f"POINTS {N}", f"WIDTH 3\nHEIGHT 3\nPOINTS {N}"):
        (tmp_path / "a.pcd").write_bytes(pcd(fields, sizes, types, counts, extra, "binary") + rows.tobytes())
        cloud = read_cloud(tmp_path / "a.pcd")
        np.testing.assert_array_equal(cloud.points, XYZ)
        assert set(cloud.labels) == {"t"} and np.array_equal(cloud.labels["t"], STAMPS)


def test_pcd_that_open3d_packs(tmp_path: Path) -> None:
    """Its order is by column; repeated coordinates make its code repeat bytes, near and far."""
    o3d = pytest.importorskip("open3d")
    xyz = np.concatenate([np.repeat(XYZ, 30, axis=0), np.zeros((500, 3), np.float32), XYZ])
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(xyz))
    cloud.point.colors = o3d.core.Tensor(np.tile(RGB, (len(xyz) // N + 1, 1))[: len(xyz)])
    cloud.point.intensity = o3d.core.Tensor(np.arange(len(xyz), dtype=np.float32).reshape(-1, 1))
    for compressed in (True, False):
        assert o3d.t.io.write_point_cloud(str(tmp_path / "a.pcd"), cloud, compressed=compressed)
        kind = b"DATA binary_compressed" if compressed else b"DATA binary\n"
        assert kind in (tmp_path / "a.pcd").read_bytes()
        back = read_cloud(tmp_path / "a.pcd")
        np.testing.assert_array_equal(back.points, xyz)
        np.testing.assert_array_equal(back.colors, cloud.point.colors.numpy())
        np.testing.assert_array_equal(back.labels["intensity"], np.arange(len(xyz)))


def test_npz_with_columns_of_any_type(tmp_path: Path) -> None:
    more = {"stamp": STAMPS, "valid": np.arange(N) % 2 == 0, "half": np.arange(N, dtype=np.float16)}
    np.savez(tmp_path / "a.npz", points=XYZ.astype(">f8"), name=np.array("scan"), **more)
    cloud = read_cloud(tmp_path / "a.npz")
    assert cloud.points.dtype == np.float64 and np.array_equal(cloud.points, XYZ)
    assert all(np.array_equal(cloud.labels[name], values) for name, values in more.items())


def test_coordinates_in_whole_numbers_keep_their_digits(tmp_path: Path) -> None:
    columns = {a: np.arange(N, dtype=np.int32) + 2**26 + 1 for a in "xyz"}
    assert read_cloud(ply(tmp_path / "a.ply", columns)).points[:, 0].tolist() == columns["x"].tolist()


@pytest.mark.parametrize("suffix", ["ply", "pcd", "npz"])
def test_columns_are_written_in_a_type_that_the_format_has(suffix: str, tmp_path: Path) -> None:
    exact = {
        "small": np.arange(N, dtype=np.int64),
        "large": np.arange(N, dtype=np.uint64) + 2**40,
        "valid": np.arange(N) % 2 == 0,
        "half": np.arange(N, dtype=np.float16),
        "extended": np.arange(N).astype(np.longdouble),
        "u": np.full(N, 2**32 - 1, np.uint32),
        "d": np.linspace(0, 1, N),
    }
    lost: dict[str, np.ndarray] = {"stamp": STAMPS, "two words": np.zeros(N), "red": np.zeros(N, np.uint8)}
    if suffix == "npz":
        lost = {name: np.zeros(N) for name in ("points", "colors", "file")}
    given = PointCloud(XYZ.astype(np.longdouble), labels=exact | lost)
    assert left_out(tmp_path / f"a.{suffix}", given) == list(lost)
    write_cloud(tmp_path / f"a.{suffix}", given)
    cloud = read_cloud(tmp_path / f"a.{suffix}")
    assert np.array_equal(cloud.points, XYZ)
    assert cloud.labels.keys() == exact.keys() and cloud.colors is None
    assert all(np.array_equal(cloud.labels[name], values) for name, values in exact.items())


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["binary", "mixed", "lists", "text"])
def test_reading_takes_three_times_the_file(kind: str, tmp_path: Path) -> None:
    """A million points, in a process of its own; what is allocated besides the file does not grow with it."""
    import subprocess
    import sys

    tool = Path(__file__).parents[2] / "tools"
    run = subprocess.run(
        [sys.executable, str(tool), "speed.readers", "--points", "1000000", "--formats", kind],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert float(run.stdout.partition(" times the file")[0].split()[-1]) <= 3, run.stdout


def test_names_in_capitals(tmp_path: Path) -> None:
    """As PDAL names colours beside x, and others all of them; one of three alone is a column."""
    names, wide = ("X", "Y", "Z", "Red", "Green", "Blue", "Intensity", "B"), RGB.astype(np.float64) * 257
    values = [*XYZ.T.astype(np.float64), *wide.T, np.arange(N) * 1.0, np.arange(N) * 1.0]
    cloud = read_cloud(ply(tmp_path / "a.ply", dict(zip(names, values, strict=True))))
    np.testing.assert_array_equal(cloud.points, XYZ)
    np.testing.assert_array_equal(cloud.colors, RGB)
    assert list(cloud.labels) == ["Intensity", "B"]


@pytest.mark.parametrize("kind", ["F", "U"])
def test_packed_colours_as_whole_numbers_in_a_text(kind: str, tmp_path: Path) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (20, 3))
    rgb[0] = 0
    head = "FIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F " + kind + "\nWIDTH 20\nHEIGHT 1\nPOINTS 20\nDATA ascii\n"
    rows = [f"0 0 {i} {(r << 16) | (g << 8) | b}" for i, (r, g, b) in enumerate(rgb.tolist())]
    (tmp_path / "a.pcd").write_text(head + "\n".join(rows) + "\n")
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.pcd").colors, rgb)
