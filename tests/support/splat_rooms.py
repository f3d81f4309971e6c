"""A furnished room as a finished splat, with known up, free space and floaters: discs on every surface."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from perception.io.ply import write_ply

SIDES = np.array([4.0, 3.0, 2.4])
TABLE = (np.array([1.4, 1.0, 0.0]), np.array([2.6, 2.0, 0.7]))
BOXES = [
    (np.array([1.5, 1.1, 0.7]), np.array([1.9, 1.5, 1.1])),
    (np.array([2.1, 1.45, 0.7]), np.array([2.5, 1.9, 1.0])),
]
SPACING = 0.06


def square(low: np.ndarray, high: np.ndarray, axis: int, at: float) -> tuple[np.ndarray, np.ndarray]:
    """Points [P, 3] SPACING apart on a rectangle across `axis`, and the axis of each [P]."""
    a, b = (i for i in range(3) if i != axis)
    u, v = (np.arange(low[i] + SPACING / 2, high[i], SPACING) for i in (a, b))
    points = np.empty((len(u) * len(v), 3))
    points[:, a], points[:, b] = (x.ravel() for x in np.meshgrid(u, v, indexing="ij"))
    points[:, axis] = at
    return points, np.full(len(points), axis)


def room_columns(
    turn: np.ndarray | None = None, floaters: int = 0, ceiling: bool = False, seed: int = 0
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Properties of 3DGS, and the thing of each Gaussian: 0 room, 1 table, 2 … boxes, −1 a floater. turn [3, 3]:
    file_from_room, of which z is up."""
    rng = np.random.default_rng(seed)
    parts = [square(np.zeros(3), SIDES, 2, 0.0)]
    parts += [square(np.zeros(3), SIDES, axis, at) for axis in (0, 1) for at in (0.0, SIDES[axis])]
    parts += [square(np.zeros(3), SIDES, 2, SIDES[2])] if ceiling else []
    owner = [np.zeros(sum(len(points) for points, _ in parts), int)]
    for number, (low, high) in enumerate([TABLE, *BOXES], start=1):
        faces = [square(low, high, 2, high[2])]
        faces += [square(low, high, axis, at) for axis in (0, 1) for at in (low[axis], high[axis])]
        parts += faces
        owner.append(np.full(sum(len(points) for points, _ in faces), number))
    means, axis = (np.concatenate(each) for each in zip(*parts, strict=True))
    means = np.concatenate([means, rng.uniform(0.3, 0.7, (floaters, 3)) * SIDES + [0, 0, 0.5]])
    axis = np.concatenate([axis, np.zeros(floaters, int)])
    thing = np.concatenate([*owner, np.full(floaters, -1)])
    palette = np.array([[0.75, 0.7, 0.65], [0.45, 0.25, 0.1], [0.8, 0.1, 0.1], [0.1, 0.2, 0.8], [0.2, 0.2, 0.2]])
    color = palette[thing] + rng.normal(0, 0.02, (len(means), 3))
    scales = np.full((len(means), 3), np.log(0.75 * SPACING))
    scales[np.arange(len(means)), axis] = np.log(0.004)
    turn = np.eye(3) if turn is None else turn
    from scipy.spatial.transform import Rotation

    quat = Rotation.from_matrix(turn).as_quat()[[3, 0, 1, 2]]
    columns = dict(zip("xyz", (means @ turn.T).T, strict=True)) | {f"n{i}": np.zeros(len(means)) for i in "xyz"}
    columns |= {f"f_dc_{i}": (color[:, i] - 0.5) / 0.28209479 for i in range(3)}
    columns |= {"opacity": np.full(len(means), 4.0)} | {f"scale_{i}": scales[:, i] for i in range(3)}
    columns |= {f"rot_{i}": np.full(len(means), 2 * quat[i]) for i in range(4)}  # of any length
    return {name: np.ascontiguousarray(values, np.float32) for name, values in columns.items()}, thing


def write_room(path: Path, columns: dict[str, np.ndarray]) -> Path:
    """The columns as a PLY."""
    write_ply(path, {"vertex": columns})
    return path
