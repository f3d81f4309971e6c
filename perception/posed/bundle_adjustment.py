"""Bundle adjustment of posed views with depth: robust Gauss-Newton on poses and points, the given poses as priors.

Triggs et al. 2000, "Bundle adjustment: a modern synthesis": Levenberg-Marquardt, points eliminated (section 6.1); the
reduced system is solved by preconditioned conjugate gradients (Agarwal et al. 2010). All sums have a fixed order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from perception.geometry import sums_by
from perception.sfm.tracks import Tracks

ROUNDS, STEPS, GAIN = 4, 12, 1e-3
"""Most steps of a round; it ends when a step lowers the cost by less than GAIN. Each round estimates the noise anew."""
CAUCHY = 3.0
"""Scale of the loss in standard errors of the noise."""
LEAST_PIXELS, LEAST_DEPTH = 0.1, 1e-3
"""Smallest standard error of features in pixels, and of measured depth relative to it."""
LOOSE = 3.0
"""The priors on the given poses are this much wider than those on the drift between consecutive views."""
NEAR = 1e-9


@dataclass(frozen=True)
class Poses:
    """rotation [N, 3, 3] camera_from_world, center [N, 3] in the world: x_camera = rotation (x − center)."""

    rotation: np.ndarray
    center: np.ndarray

    def at(self, number: int) -> Poses:
        """One of them."""
        return Poses(self.rotation[number : number + 1], self.center[number : number + 1])

    def turned(self, delta: np.ndarray) -> Poses:
        """Each camera turned by delta[:, :3] (rotation vector, world axes, radians) and moved by delta[:, 3:]."""
        return Poses(self.rotation @ Rotation.from_rotvec(-delta[:, :3]).as_matrix(), self.center + delta[:, 3:])

    def matrices(self) -> np.ndarray:
        """camera_from_world [N, 4, 4]."""
        result = np.tile(np.eye(4), (len(self.center), 1, 1))
        result[:, :3, :3] = self.rotation
        result[:, :3, 3] = -np.einsum("nij,nj->ni", self.rotation, self.center)
        return result

    def since(self, given: Poses) -> np.ndarray:
        """delta [N, 6] with given.turned(delta) equal to this."""
        turned = np.einsum("nji,njk->nik", self.rotation, given.rotation)
        return np.concatenate([Rotation.from_matrix(turned).as_rotvec(), self.center - given.center], axis=1)


def starting_points(tracks: Tracks, poses: Poses) -> np.ndarray:
    """Points [P, 3]: the least-squares intersection of the rays, each ended at its measured depth if there is one."""
    rays = np.concatenate([tracks.rays, np.ones((len(tracks.rays), 1))], axis=1)
    world = np.einsum("oji,oj->oi", poses.rotation[tracks.view], rays)
    origin = poses.center.mean(axis=0)  # the world's may be far away
    ends = (poses.center - origin)[tracks.view] + world * tracks.depth[:, None]
    along = world / np.linalg.norm(world, axis=1, keepdims=True)
    across = np.eye(3) - along[:, :, None] * along[:, None, :]
    # Σ A_o (x − e_o) = 0, where A_o is the projection across the ray, or with depth nearly the identity.
    weight = np.where(tracks.depth[:, None, None] > 0, np.eye(3), across)
    system = sums_by(tracks.point, weight, tracks.size)
    right = sums_by(tracks.point, np.einsum("oij,oj->oi", weight, ends), tracks.size)
    system += 1e-9 * np.trace(system, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    return np.asarray(np.linalg.solve(system, right[..., None])[..., 0] + origin)


def residuals(tracks: Tracks, poses: Poses, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """pixel errors [O, 2], relative errors of depth [O] (0 without depth), points in camera axes [O, 3]."""
    x = np.einsum("oij,oj->oi", poses.rotation[tracks.view], points[tracks.point] - poses.center[tracks.view])
    z = np.where(x[:, 2] > NEAR, x[:, 2], np.inf)
    error = tracks.focal[:, None] * (x[:, :2] / z[:, None] - tracks.rays)
    known = tracks.depth > 0
    return error, np.where(known, x[:, 2] / np.where(known, tracks.depth, 1.0) - 1.0, 0.0), x


def adjust(
    tracks: Tracks, given: Poses, poses: Poses, prior: tuple[float, float], held: np.ndarray | None = None
) -> Adjusted:
    """`poses` adjusted, together with the points of the tracks. given: the poses that the priors pull to.
    prior: standard errors of a given pose relative to that of the next view: angle in radians, centre in scene units.
    The priors keep the world frame, and hold views that have no features. held [N]: mask of poses that stay as given.
    """
    points, priors = starting_points(tracks, poses), _priors(len(given.center), prior)
    held = np.zeros(len(given.center), bool) if held is None else held
    for _ in range(ROUNDS):
        error, depth, _ = residuals(tracks, poses, points)
        known = np.abs(depth[tracks.depth > 0])
        # Standard errors from the medians of normal residuals in 2D (1.18 σ) and 1D (0.67 σ).
        sigma = max(float(np.median(np.hypot(*error.T))) / 1.1774, LEAST_PIXELS)
        depth_sigma = max(float(np.median(known)) / 0.6745 if len(known) else 0.0, LEAST_DEPTH)
        problem = _Problem(tracks, given, *priors, sigma, depth_sigma, held)
        damping, cost = 1e-4, _cost(problem, poses, points)
        for _ in range(STEPS):
            delta, shift = _step(problem, poses, points, damping)
            moved, shifted = poses.turned(delta), points + shift
            now = _cost(problem, moved, shifted)
            if not now < cost:
                damping *= 10
                continue
            poses, points, damping, gain, cost = moved, shifted, max(damping / 10, 1e-9), 1 - now / cost, now
            if gain < GAIN:
                break
    return Adjusted(poses, points, problem)


@dataclass(frozen=True)
class _Problem:
    """prior_rows, prior_weights: see `_priors`. sigma: standard error of features in pixels; depth_sigma: of measured
    depth relative to it. held [N]: mask of poses that are not adjusted."""

    tracks: Tracks
    given: Poses
    prior_rows: Any
    prior_weights: np.ndarray
    sigma: float
    depth_sigma: float
    held: np.ndarray

    @property
    def free(self) -> np.ndarray:
        """The rows of the poses that are adjusted among the [6N] of all."""
        return np.flatnonzero(np.repeat(~self.held, 6))


@dataclass(frozen=True)
class Adjusted:
    """What `adjust` found: poses, and points [P, 3]."""

    poses: Poses
    points: np.ndarray
    _problem: _Problem

    def covariances(self, lens: np.ndarray) -> np.ndarray:
        """[K, 6, 6] of the K poses that are not held, each as `Poses.turned` takes its change; of points as well as
        poses: the blocks of the inverse of the reduced normal matrix (Triggs et al. 2000, section 6.1).
        lens [K, 2]: standard errors of the focal length, relative to it, and of the principal point in pixels, before
        features tell more of them; 0 where they are known. What they add is of each pose with the others held."""
        free = self._problem.free
        count, (reduced, _, V_inverse, _, _) = len(free) // 6, _normal(self._problem, self.poses, self.points, 0.0)
        inverse = np.linalg.inv(reduced[free][:, free].toarray()).reshape(count, 6, count, 6)
        found = np.asarray(inverse[np.arange(count), :, np.arange(count)])
        unknown = np.flatnonzero(lens.all(axis=1))
        if len(unknown):
            moved, schur, _ = self._by_lens(V_inverse, unknown, lens[unknown])
            found[unknown] += moved @ np.linalg.solve(schur, np.swapaxes(moved, 1, 2))
        return found

    def lens_steps(self, lens: np.ndarray, changed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What a step of Gauss-Newton adds, as features tell: [K, 3] to the logarithm of each focal length and to the
        principal point, [K, 6] to the pose, as `Poses.turned` takes it. lens: as of `covariances`, of the lenses before
        they were `changed` [K, 3]; no step is longer."""
        steps, turns, unknown = np.zeros((len(lens), 3)), np.zeros((len(lens), 6)), np.flatnonzero(lens.all(axis=1))
        V_inverse = _normal(self._problem, self.poses, self.points, 0.0)[2]
        moved, schur, right = self._by_lens(V_inverse, unknown, lens[unknown])
        errors = lens[unknown][:, [0, 1, 1]]
        some = np.linalg.solve(schur, (right - changed[unknown] / errors**2)[..., None])[..., 0]
        some /= np.maximum(1.0, np.abs(some / errors).max(axis=1, keepdims=True))
        steps[unknown], turns[unknown] = some, -np.einsum("lpk,lk->lp", moved, some)
        return steps, turns

    def _by_lens(
        self, V_inverse: np.ndarray, numbers: np.ndarray, lens: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the lenses of L poses, with points and poses eliminated: how each parameter moves the pose [L, 6, 3], the
        normal matrix [L, 3, 3] and the right side [L, 3]."""
        problem, tracks = self._problem, self._problem.tracks
        views = np.flatnonzero(~problem.held)[numbers]
        rows = np.isin(tracks.view, views)
        residual, J_pose, J_point = (part[rows] for part in _linearised(problem, self.poses, self.points))
        J = np.concatenate([J_pose, _lens_jacobian(problem, self.poses, self.points)[rows]], axis=2)
        W, view, count = np.einsum("orv,orw->ovw", J, J_point), tracks.view[rows], len(self.poses.center)
        each = np.einsum("orv,orw->ovw", J, J) - W @ V_inverse[tracks.point[rows]] @ np.swapaxes(W, 1, 2)
        S = sums_by(view, each, count)[views]
        g = -sums_by(view, np.einsum("orv,or->ov", J, residual), count)[views]
        A, B, C = S[:, :6, :6], S[:, :6, 6:], S[:, 6:, 6:]
        C = C + np.eye(3) / np.square(lens[:, [0, 1, 1]])[:, None]
        moved = np.linalg.solve(A, B)
        return moved, C - np.swapaxes(B, 1, 2) @ moved, g[:, 6:] - np.einsum("lpk,lp->lk", moved, g[:, :6])


def _normalised(problem: _Problem, poses: Poses, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """residuals over their standard errors: pixels [O, 2], depths [O]; points in camera axes [O, 3]."""
    error, depth, x = residuals(problem.tracks, poses, points)
    return error / problem.sigma, depth / problem.depth_sigma, x


def _cost(problem: _Problem, poses: Poses, points: np.ndarray) -> float:
    """Σ s² log(1 + |r|²/s²) of pixels and of depths + Σ |priors|²."""
    error, depth, _ = _normalised(problem, poses, points)
    robust = CAUCHY**2 * (np.log1p((error**2).sum(1) / CAUCHY**2).sum() + np.log1p(depth**2 / CAUCHY**2).sum())
    deviations = problem.prior_rows @ poses.since(problem.given).ravel()
    return float(robust + (problem.prior_weights * deviations**2).sum())


def _priors(count: int, prior: tuple[float, float]) -> tuple[Any, np.ndarray]:
    """A sparse [6 (2N − 1), 6N]: times the deviations of N poses from the given ones, it is these deviations and their
    differences between consecutive views; the weights of its rows."""
    from scipy.sparse import diags, identity, kron, vstack

    steps = diags([-np.ones(max(count - 1, 1)), np.ones(max(count - 1, 1))], [0, 1], shape=(count - 1, count))
    inverse = np.repeat(1 / np.square(prior), 3)
    weights = np.concatenate([np.tile(inverse / LOOSE**2, count), np.tile(inverse, count - 1)])
    return kron(vstack([identity(count), steps]), identity(6)).tocsr(), weights


def _step(problem: _Problem, poses: Poses, points: np.ndarray, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """One damped step: delta [N, 6] of the poses, shift [P, 3] of the points."""
    reduced, right, V_inverse, g_point, W = _normal(problem, poses, points, damping)
    reduced.setdiag(reduced.diagonal() * (1 + damping))
    delta, free = np.zeros(len(right)), problem.free
    delta[free] = _solved(reduced[free][:, free], right[free])  # priors tie held poses to the others
    shift = np.einsum("pij,pj->pi", V_inverse, g_point - (W.T @ delta).reshape(-1, 3))
    return delta.reshape(-1, 6), shift


def _normal(problem: _Problem, poses: Poses, points: np.ndarray, damping: float) -> tuple[Any, ...]:
    """The normal equations with the points eliminated: matrix [6N, 6N] sparse, right side [6N]; for the points: inverse
    of their blocks [P, 3, 3], right side [P, 3], coupling [6N, 3P]."""
    from scipy.sparse import bsr_matrix, diags

    tracks, count, size = problem.tracks, len(poses.center), problem.tracks.size
    residual, J_pose, J_point = _linearised(problem, poses, points)
    U = sums_by(tracks.view, np.einsum("orv,orw->ovw", J_pose, J_pose), count)
    V = sums_by(tracks.point, np.einsum("orv,orw->ovw", J_point, J_point), size)
    g_pose = -sums_by(tracks.view, np.einsum("orv,or->ov", J_pose, residual), count)
    g_point = -sums_by(tracks.point, np.einsum("orv,or->ov", J_point, residual), size)
    V += np.eye(3) * (damping * np.einsum("pii->pi", V)[:, None, :] + 1e-12)
    V_inverse = np.linalg.inv(V)
    order = np.argsort(tracks.view, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(tracks.view, minlength=count))])
    W = bsr_matrix(
        (np.einsum("orv,orw->ovw", J_pose, J_point)[order], tracks.point[order], starts), shape=(6 * count, 3 * size)
    )
    eliminate = W @ bsr_matrix((V_inverse, np.arange(size), np.arange(size + 1)), shape=(3 * size, 3 * size))
    A, weight = problem.prior_rows, problem.prior_weights
    prior_g = -(A.T @ (weight * (A @ poses.since(problem.given).ravel())))
    U = bsr_matrix((U, np.arange(count), np.arange(count + 1)), shape=(6 * count, 6 * count))
    reduced = (U + A.T @ diags(weight) @ A - eliminate @ W.T).tocsr()
    return reduced, g_pose.ravel() + prior_g - eliminate @ g_point.ravel(), V_inverse, g_point, W


def _linearised(problem: _Problem, poses: Poses, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """residuals [O, 3] (pixels x and y, depth) and Jacobians by pose [O, 3, 6] and point [O, 3, 3], Cauchy-weighted."""
    tracks, sigma = problem.tracks, problem.sigma
    error, depth, x = _normalised(problem, poses, points)
    front = x[:, 2] > NEAR
    z = np.where(front, x[:, 2], 1.0)
    slope = np.zeros((len(z), 3, 3))
    slope[:, 0, 0] = slope[:, 1, 1] = tracks.focal / (sigma * z)
    slope[:, :2, 2] = -tracks.focal[:, None] / sigma * x[:, :2] / z[:, None] ** 2
    known = tracks.depth > 0
    slope[:, 2, 2] = np.where(known, 1 / (problem.depth_sigma * np.where(known, tracks.depth, 1)), 0)
    root = _roots(error, depth, front)
    J_point = root[..., None] * (slope @ poses.rotation[tracks.view])
    arm = points[tracks.point] - poses.center[tracks.view]
    # x_camera = R Exp(θ)ᵀ (p − c − δ):  ∂/∂θ = R [p − c]×,  ∂/∂δ = −R.
    J_pose = np.concatenate([np.cross(J_point, arm[:, None]), -J_point], axis=2)
    J_pose[problem.held[tracks.view]] = 0
    residual = np.concatenate([np.where(front[:, None], error, 0.0), depth[:, None]], axis=1)
    return root * residual, J_pose, J_point


def _roots(error: np.ndarray, depth: np.ndarray, front: np.ndarray) -> np.ndarray:
    """Roots [O, 3] of the weights of the loss, 0 behind the camera."""
    weight = np.repeat(1 / (1 + (error**2).sum(1) / CAUCHY**2), 2).reshape(-1, 2)
    weight = np.concatenate([weight, 1 / (1 + depth[:, None] ** 2 / CAUCHY**2)], axis=1)
    return np.sqrt(np.where(front[:, None], weight, 0.0))


def _lens_jacobian(problem: _Problem, poses: Poses, points: np.ndarray) -> np.ndarray:
    """Jacobian [O, 3, 3] of the weighted residuals by the logarithm of the focal length and the principal point."""
    error, depth, x = _normalised(problem, poses, points)
    front = x[:, 2] > NEAR
    J = np.zeros((len(x), 3, 3))
    J[:, :2, 0] = problem.tracks.focal[:, None] * x[:, :2] / np.where(front, x[:, 2], 1.0)[:, None]
    J[:, 0, 1] = J[:, 1, 2] = 1
    return _roots(error, depth, front)[..., None] * J / problem.sigma


def _solved(A: Any, b: np.ndarray) -> np.ndarray:
    """x of A x = b, A [6N, 6N] sparse, symmetric and positive, preconditioned by its diagonal blocks [6, 6]."""
    from scipy.sparse import bsr_matrix
    from scipy.sparse.linalg import cg

    blocks = np.stack([A[i : i + 6, i : i + 6].toarray() for i in range(0, len(b), 6)])
    inverse = bsr_matrix((np.linalg.inv(blocks), np.arange(len(blocks)), np.arange(len(blocks) + 1)), shape=A.shape)
    return np.asarray(cg(A, b, rtol=1e-6, M=inverse, maxiter=10 * len(b))[0])
