"""Registers a scan that lies in another frame, and perhaps another unit, to what a map's cameras see.

1. Rotations: the normals of scan and map, as distributions on the sphere, are compared under every rotation of a grid;
   the best are refined (Makadia et al. 2006, "Fully automatic registration of 3D point clouds").
2. Scale and shift: for each rotation and scale, the scan's voxels are correlated by FFT with a grid that is positive on
   the map's surface, negative in space that its cameras see through, and zero where they see nothing.
3. The best poses are refined by point-to-plane ICP and judged by the cameras: scan points on their depth speak for a
   pose, scan points in front of it against it. With colours, the best is refined on the rendered pictures.
4. It is accepted if few points speak against it, if it cannot slide, and if no other pose is nearly as good.

The search covers all poses, so of two that look alike both are found. Of descriptors of points (FPFH) 2 % matched right
on surfaces of trained maps, centimetres rough. Nothing is random, and no sum depends on the number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft
from scipy.ndimage import binary_dilation, map_coordinates

from perception.errors import InputError
from perception.export.align_steps import Images, Similarity, gray_images, jacobian, likely_rotations, robust_gain
from perception.export.depth_views import DepthView, centres, fused_surface, grid_cells, observe
from perception.export.neighbors import Neighbors, list_normals, neighbor_lists
from perception.geometry import sums_by, transform
from perception.types import PointCloud

SCALES = 2.0 ** np.arange(-2, 1.51, 1 / 9)  # scales to try around the ratio of the extents, 8 % apart
GRID = 28  # voxels of the correlation along the map's diagonal, divided by √3 in a cube
LARGEST_SCAN = 12  # times the map's diagonal: the correlation of a larger scan takes gigabytes
REFINED, JUDGED = 100, 16  # places that are refined with few points and views, and the best of them, refined with more
FINALISTS = 3  # places apart from each other that are refined with all points and colours
FEW_ROWS, ROWS, FINE_ROWS = 500, 1500, 20_000
"""Points of the scan in the steps: the first refinement, the second and judging, the last refinement."""
FEWEST, FEWEST_IN_VIEW = 30, 50  # points below which nothing is fitted or correlated: of all views, of one view
TOLERANCE = 1 / 60  # distance in extents of the map within which a scan point lies on the rendered surface
ELSEWHERE = 0.1  # root mean square distance in extents of the scan's points in one pose to those in another pose
LEAST_AGREEMENT, LEAST_COVER, MOST_RIVAL, LEAST_STIFFNESS, LEAST_LIKENESS = 0.95, 0.05, 0.85, 1e-3, 0.5
"""Bounds of the figures of an `Alignment` that is accepted."""
FACING = 0.7  # least cosine of the normals of points that are matched
LEAST_GAIN = 0.2  # views whose brightness goes less than this with the scan's are left out of a step


@dataclass(frozen=True)
class Alignment:
    """map_from_scan [4, 4]: a rotation times `scale`, and a translation.

    agreement: of the scan's points that some camera sees or sees through, the share on the rendered surface. overlap,
    cover: the shares of all scan points on the map's surface, and of that surface near the scan. rms: of the distances
    to the map's planes, weighted as ICP does, in map units. rival: the score of the next best pose over this one's.
    stiffness: the smallest eigenvalue of ICP's information matrix; 0 if the scan can slide or turn. likeness:
    correlation of the brightness of scan and map; None without colours.
    """

    map_from_scan: np.ndarray
    scale: float
    agreement: float
    overlap: float
    cover: float
    rms: float
    rival: float
    stiffness: float
    likeness: float | None = None

    @property
    def refusal(self) -> str | None:
        """Why the alignment must not be used; None when it may."""
        if self.agreement < LEAST_AGREEMENT or self.cover < LEAST_COVER:
            found = f"the best place has {self.agreement:.0%} of the points on surfaces that the map sees, and covers "
            needed = f"at least {LEAST_AGREEMENT:.0%} and {LEAST_COVER:.0%} are needed"
            return f"{found}{self.cover:.0%} of the map ({needed})"
        if self.likeness is not None and self.likeness < LEAST_LIKENESS:
            return f"at the best place, the colours of the scan and of the map do not go together ({self.likeness:.2f})"
        if self.stiffness < LEAST_STIFFNESS:
            return "the part that both see can slide or turn without a difference, as on one plane"
        if self.rival > MOST_RIVAL:
            return f"another place fits {self.rival:.0%} as well, as in a symmetric room"
        return None


def align(views: Sequence[DepthView], scan: PointCloud, similar: bool) -> Alignment:
    """The pose of `scan` in the map whose rendered depth is `views`; similar: with a scale, else rigid.
    The caller decides by `Alignment.refusal`. InputError if the map's views or the scan hold too little."""
    registration = Registration(views, scan, similar)
    poses = registration.refined(registration.candidates())
    if not poses:
        raise InputError("scan: no place in the map is found for it; it needs surfaces that the map shows")
    return registration.finished(poses)


class Registration:
    """The state of one alignment. Both clouds are moved to their medians; lengths are in map units."""

    def __init__(self, views: Sequence[DepthView], scan: PointCloud, similar: bool):
        points, self.normals = fused_surface(views)
        rows = np.flatnonzero(np.isfinite(scan.points).all(axis=1))
        if min(len(points), len(rows)) < 100:
            raise InputError(f"scan: {len(rows)} finite points, {len(points)} of the map are seen; 100 are needed")
        raw = scan.points[rows].astype(np.float64)
        self.middle, self.scan_middle = np.median(points, axis=0), np.median(raw, axis=0)
        self.points, raw, self.similar = points - self.middle, raw - self.scan_middle, similar
        self.extent, scan_extent = _extent(self.points), _extent(raw)
        if not scan_extent > 0:
            raise InputError("scan: its points lie in one place; nothing can be aligned")
        if not similar and scan_extent > LARGEST_SCAN * self.extent:
            ratio = f"it is {scan_extent / self.extent:.0f} times as large as the map, whose unit is the metre"
            raise InputError(f"scan: {ratio}; give it in metres, or cut it to what the map shows")
        near = np.linalg.norm(raw, axis=1) <= scan_extent  # stray points would widen the grid of the correlation
        raw, rows = raw[near], rows[near]
        unit = self.extent / scan_extent if similar else 1.0
        self.scales = unit * SCALES if similar else np.ones(1)
        self.tolerance = TOLERANCE * self.extent
        shift = transform(np.eye(3), self.middle)
        self.views = [replace(view, camera_from_world=view.camera_from_world @ shift) for view in views]
        self.tree = Neighbors(self.points)
        colors = None if scan.colors is None else scan.colors[rows]
        self.scan, self.brightness = _thinned(raw, colors, self.extent / unit / 150)
        self.scan_normals = list_normals(self.scan, neighbor_lists(self.scan, 24)).astype(np.float64)
        self.scan_tree = Neighbors(self.scan)
        self.rows = np.arange(0, len(self.scan), max(len(self.scan) // ROWS, 1))

    def candidates(self) -> list[Similarity]:
        """Places by the correlation, best first: the best two shifts of each rotation and scale. Score: Σ of the grid
        over the N cells that the scan occupies, over √N; the sum alone grows with the scale."""
        step = self.extent / GRID
        low = self.points.min(axis=0) - 2 * step
        grid = self._evidence(low, step)
        spectra: dict[tuple[int, ...], np.ndarray] = {}  # of the grid, by padded shape
        rows = self.scan[:: max(len(self.scan) // FINE_ROWS, 1)]
        found: list[Similarity] = []
        for rotation in likely_rotations(self.scan_normals, self.normals):
            turned = rows @ rotation.T
            for scale in self.scales:
                points = np.asfortranarray(turned * scale)
                first = points.min(axis=0)
                cells = ((points - first) / step).astype(np.int64)
                shape = tuple(4 * (-int(n) // -4) for n in np.array(grid.shape) + cells.max(axis=0) + 1)
                if shape not in spectra:
                    spectra[shape] = fft.rfftn(grid, shape)
                held = np.zeros(shape, np.float32)
                held[tuple(cells.T)] = 1
                scores = fft.irfftn(spectra[shape] * np.conj(fft.rfftn(held)), shape) / np.sqrt(held.sum())
                for _ in range(2):
                    best = np.array(np.unravel_index(int(np.argmax(scores)), shape))
                    value = float(scores[tuple(best)])
                    around = [(best[axis] + np.arange(-2, 3)) % shape[axis] for axis in range(3)]
                    scores[np.ix_(*around)] = -np.inf
                    offset = np.where(best >= grid.shape, best - shape, best)  # shifts are circular
                    found.append(Similarity(scale * rotation, low + offset * step - first, value))
        return sorted(found, key=lambda pose: -pose.score)

    def _evidence(self, low: np.ndarray, step: float) -> np.ndarray:
        """[X, Y, Z] float32: 1 in cells with surface, 0.5 beside them, −1 in free space, 0 unknown."""
        shape = np.ceil((self.points.max(axis=0) + 2 * step - low) / step).astype(int).tolist()
        on, free, _ = observe(centres(low, shape, step), self.views, step)
        grid = np.where((free >= 2) & (free > on), -1.0, 0.0).reshape(shape)
        held = np.zeros(shape, bool)
        held[tuple(np.floor((self.points - low) / step).astype(int).T)] = True
        grid[binary_dilation(held)] = 0.5
        grid[held] = 1.0
        return grid.astype(np.float32)

    def refined(self, candidates: Sequence[Similarity]) -> list[Similarity]:
        """Up to JUDGED distinct poses after ICP, best first by `judged`."""
        w, poses = self.tolerance, self._distinct(candidates, 0.04, REFINED)
        for views, few, widths in (
            (self.views[::4], self.rows[:: max(len(self.rows) // FEW_ROWS, 1)], [4 * w] * 4 + [2 * w] * 4),
            (self.views, self.rows, [2 * w] * 4 + [w] * 4),
        ):
            poses = [self._icp(pose, few, widths)[0] for pose in poses]
            poses = [replace(pose, score=self.judged(pose, views)[0]) for pose in poses]
            poses = self._distinct(sorted(poses, key=lambda pose: -pose.score), 0.02, JUDGED)
        return poses

    def _distinct(self, poses: Sequence[Similarity], distance: float, most: int) -> list[Similarity]:
        """The first `most` poses that are at least `distance` extents apart."""
        some = self.scan[self.rows[:: max(len(self.rows) // 50, 1)]]
        kept, moved = [], np.empty((0, *some.shape))
        for pose in poses:
            there = pose(some)
            if (((moved - there) ** 2).sum(axis=2).mean(axis=1) > (distance * self.extent) ** 2).all():
                kept.append(pose)
                moved = np.concatenate([moved, there[None]])
                if len(kept) == most:
                    break
        return kept

    def finished(self, poses: Sequence[Similarity]) -> Alignment:
        """The best of the first poses that lie apart, refined with all points and colours, and its figures."""
        w, fine = self.tolerance, np.arange(0, len(self.scan), max(len(self.scan) // FINE_ROWS, 1))
        tried = []
        for pose in self._distinct(poses, ELSEWHERE, FINALISTS):
            refined, rms, information = self._icp(pose, fine, [w] * 3 + [w / 2] * 6 + [w / 4] * 12)
            refined = self._photometric(refined, fine)
            tried.append((self.judged(refined), refined, rms, information))
        tried.sort(key=lambda row: -row[0][0])
        (score, agreement, overlap, cover), best, rms, information = tried[0]
        others = (figures[0] for figures, other, *_ in tried[1:] if self.apart(other, best) > ELSEWHERE * self.extent)
        rival = max(others, default=0.0) / max(score, 1e-9)
        matrix = transform(best.linear, best.shift + self.middle - best.linear @ self.scan_middle)
        stiffness = float(np.linalg.eigvalsh(information)[0])
        light = self.brightness
        likeness = None if light is None else self._alike(best(self.scan[self.rows]), light[self.rows], self.views)
        return Alignment(matrix, best.scale, agreement, overlap, cover, rms, rival, stiffness, likeness)

    def judged(self, pose: Similarity, views: Sequence[DepthView] | None = None) -> tuple[float, float, float, float]:
        """(score, agreement, overlap, cover) of a pose; the score is (2 agreement − 1) cover, with colours times
        the squared correlation (at least 0.1) of the scan's brightness with the rendered one."""
        moved = pose(self.scan[self.rows])
        on, free, _ = observe(moved, views or self.views, self.tolerance)
        good, bad = (on > 0) & (2 * on >= free), (free >= 2) & (2 * on < free)
        agreement = float(good.sum() / max(good.sum() + bad.sum(), 1))
        chosen = slice(None, None, max(len(self.points) // ROWS, 1))
        back = (self.points[chosen] - pose.shift) @ np.linalg.inv(pose.linear).T
        index, distance = self.scan_tree.query(back, 1, self.tolerance / pose.scale)
        turned = self.normals[chosen] @ pose.linear / pose.scale
        facing = np.einsum("ij,ij->i", turned, self.scan_normals[index[:, 0]])
        near = (index[:, 0] >= 0) & (np.abs(facing) > FACING)
        depth = np.where(near, distance[:, 0] * pose.scale / self.tolerance, 1.0)
        score = max(2 * agreement - 1, 0.0) * float((1 - depth**2).mean())
        if self.brightness is not None:
            score *= max(0.1, self._alike(moved, self.brightness[self.rows], views or self.views)) ** 2
        return score, agreement, float(good.mean()), float(near.mean())

    def apart(self, a: Similarity, b: Similarity) -> float:
        """Root mean square distance of the scan's points in two poses."""
        some = self.scan[self.rows[:: max(len(self.rows) // 100, 1)]]
        return float(np.sqrt(((a(some) - b(some)) ** 2).sum(axis=1).mean()))

    def _alike(self, moved: np.ndarray, brightness: np.ndarray, views: Sequence[DepthView]) -> float:
        """Correlation, at least 0, of the scan's brightness with its mean over the views that see a point."""
        total, count = np.zeros((2, len(moved)))
        for view in views:
            rows, u, v, _ = view.seen(moved, self.tolerance)
            total[rows] += view.brightness[v.astype(np.int64), u.astype(np.int64)]
            count[rows] += 1
        seen = count > 0
        if seen.sum() < FEWEST:
            return 0.0
        a, b = total[seen] / count[seen], brightness[seen]
        a, b = a - a.mean(), b - b.mean()
        return max(0.0, float((a * b).sum() / max(np.sqrt((a * a).sum() * (b * b).sum()), 1e-12)))

    def _icp(self, pose: Similarity, rows: np.ndarray, widths: Sequence[float]) -> tuple[Similarity, float, np.ndarray]:
        """The pose after a step for each width, the weighted rms before the last, and its information matrix over Σ w.
        Each step lowers Σ w r², r = n·(s R p + t − q), w = (1 − r²/width²)² for |r| < width, else 0 (Tukey), of the
        points p and the map's points q nearest to them, with normals n."""
        rms, information = np.inf, np.zeros((7, 7))
        for width in widths:
            index, _ = self.tree.query(pose(self.scan[rows]), 1, 3 * width)
            near = np.flatnonzero(index[:, 0] >= 0)
            if len(near) < FEWEST:
                break
            own, at = rows[near], index[near, 0]
            moved, facing = pose(self.scan[own]), self.normals[at]
            r = np.einsum("ij,ij->i", facing, moved - self.points[at])
            turned = np.einsum("nj,ij->ni", self.scan_normals[own], pose.linear / pose.scale)
            alike = np.abs(np.einsum("ij,ij->i", facing, turned)) > FACING
            w = np.maximum(1 - (r / width) ** 2, 0) ** 2 * alike
            total = max(float(w.sum()), 1e-12)
            middle = np.einsum("i,ij->j", w, moved) / total
            J = jacobian(moved, facing, middle, self.extent, self.similar)
            information = np.einsum("i,ij,ik->jk", w, J, J) / total
            b = np.einsum("i,ij,i->j", w, J, r) / total
            delta = -np.linalg.solve(information + 1e-6 * np.eye(len(information)), b)
            pose = pose.stepped(delta, middle, self.extent)
            rms = float(np.sqrt(np.einsum("i,i,i->", w, r, r) / total))
        return pose, rms, information

    def _photometric(self, pose: Similarity, rows: np.ndarray) -> Similarity:
        """The pose refined on the pictures; unchanged without colours, or if that leads away."""
        if self.brightness is None:
            return pose
        found, chosen = pose, self.views[:: max(len(self.views) // 24, 1)]
        for blur in (8.0, 8.0, 4.0, 2.0, 1.0):
            images = gray_images(chosen, blur)
            for _ in range(5):
                found = self._photometric_step(found, self.scan[rows], self.brightness[rows], images)
        # With the fewer points of `judged`, noise turned down refinements from 1.2 to 0.3 cm.
        before, after = (self._alike(p(self.scan[rows]), self.brightness[rows], self.views) for p in (pose, found))
        return found if after > before and self.apart(found, pose) < 2 * self.tolerance else pose

    def _photometric_step(self, pose: Similarity, points: np.ndarray, light: np.ndarray, images: Images) -> Similarity:
        """A step that lowers Σ w (a_v I_v(π_v(s R p + t)) + b_v − g_p)² over views v and the points p on their depth.
        points [P, 3] of brightness g = light [P]; I_v: rendered brightness; a_v, b_v: gain and offset of each view; w:
        Tukey's weights by the spread of the view's residuals."""
        moved = pose(points)
        middle, size = moved.mean(axis=0), 7 if self.similar else 6
        A, b = np.zeros((size, size)), np.zeros(size)
        for view, *layers in images:
            rows, u, v, own = view.seen(moved, self.tolerance)
            if len(rows) < FEWEST_IN_VIEW:
                continue
            I, Iu, Iv = (map_coordinates(layer, [v - 0.5, u - 0.5], order=1, mode="nearest") for layer in layers)
            gain, r, w = robust_gain(I.astype(np.float64), light[rows])
            if gain < LEAST_GAIN:
                continue
            x, y, z = own.T
            fx, fy = view.K[0, 0], view.K[1, 1]
            slopes = np.stack([Iu * fx / z, Iv * fy / z, -(Iu * fx * x + Iv * fy * y) / z**2], axis=1)
            slopes = gain * np.einsum("nj,ji->ni", slopes, view.camera_from_world[:3, :3])
            J = jacobian(moved[rows], slopes, middle, self.extent, self.similar)
            A += np.einsum("i,ij,ik->jk", w, J, J)
            b += np.einsum("i,ij,i->j", w, J, r)
        if not np.trace(A) > 0:
            return pose
        return pose.stepped(-np.linalg.solve(A + 1e-6 * np.trace(A) * np.eye(size), b), middle, self.extent)


def _extent(points: np.ndarray) -> float:
    low, high = np.percentile(points, [1, 99], axis=0)
    return float(np.linalg.norm(high - low))


def _thinned(points: np.ndarray, colors: np.ndarray | None, width: float) -> tuple[np.ndarray, np.ndarray | None]:
    """Mean point, and mean brightness in [0, 1] if there are colours, of each cell of a grid."""
    cell, count = grid_cells(points, width)
    mean = sums_by(cell, points, len(count)) / count[:, None]
    if colors is None or colors.min() == colors.max():
        return mean, None
    return mean, np.bincount(cell, colors.mean(axis=1) / 255) / count
