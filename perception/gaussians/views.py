"""Training photos as tensors, and renders of the Gaussians from their cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from perception.gaussians.model import Gaussians
from perception.geometry import far_from_most
from perception.io.memory import Keep
from perception.rasterizer.rasterize import rasterizer_for
from perception.rasterizer.types import Forward, Settings

BEST_PSNR = 100.0  # PSNR in dB of two equal images, as in `evaluate.images`: finite, so that means and JSON stay valid


@dataclass(frozen=True)
class TrainingView:
    """One photo as used in training. photo [H, W, 3] uint8; labels [H, W] integers (0 = unlabelled) or None;
    K [3, 3] and camera_from_world [4, 4] float32; eps2d: see `rasterize`; weight [H, W] float32: 0 = pixel is ignored,
    None = all pixels count; depth [H, W] float32, what a sensor measured along the optical axis without its edges
    (`photos.depth.without_edges`), in scene units, 0 = none; or None; gain [3] float32: colours of the photo over those
    of the scene, None = 1. keep: where `stored` puts the images."""

    name: str
    photo: torch.Tensor
    labels: torch.Tensor | None
    K: torch.Tensor
    camera_from_world: torch.Tensor
    eps2d: float = 0.3
    weight: torch.Tensor | None = None
    depth: torch.Tensor | None = None
    gain: torch.Tensor | None = None
    keep: Keep = np.asarray

    @property
    def labelled(self) -> bool:
        """Whether any pixel has a label."""
        return self.labels is not None and bool((self.labels > 0).any())

    @property
    def camera(self) -> tuple[np.ndarray, np.ndarray]:
        """K [3, 3] and camera_from_world [4, 4], float64."""
        return self.K.double().numpy(), self.camera_from_world.double().numpy()

    def seen(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The rows [M] of points [P, 3] that lie before the camera and in the picture, and their pixels (row, column)
        [2, M] int64; depth z [P] of all along the axis. Rounded alike with any number of threads."""
        K, pose = self.camera
        x, y, z = (points[:, 0] * a + points[:, 1] * b + points[:, 2] * c + t for a, b, c, t in pose[:3].tolist())
        depth, (height, width) = np.where(z > 0, z, 1), self.photo.shape[:2]
        column, row = K[0, 0] * x / depth + K[0, 2], K[1, 1] * y / depth + K[1, 2]
        inside = np.flatnonzero((z > 0) & (column >= 0) & (row >= 0) & (column < width) & (row < height))
        return inside, np.stack([row[inside], column[inside]]).astype(np.int64), z

    def stored(self) -> TrainingView:
        """The view with its images where `keep` puts them."""
        images = {name: getattr(self, name) for name in ("photo", "labels", "weight", "depth")}
        kept = {name: torch.from_numpy(self.keep(image.numpy())) for name, image in images.items() if image is not None}
        return replace(self, **kept)  # type: ignore[arg-type]

    def to(self, device: torch.device) -> TrainingView:
        """The view on `device`, but for the labels, which `losses.assign_labels` reads once."""
        names = ("photo", "K", "camera_from_world", "weight", "depth", "gain")
        tensors: dict[str, Any] = {name: getattr(self, name) for name in names}
        return replace(self, **{name: tensor.to(device) for name, tensor in tensors.items() if tensor is not None})

    def halved(self) -> TrainingView:
        """The same view at half the resolution: photo averaged 2 × 2, labels taken at every other pixel. A pixel is
        ignored if one of the four is. Depth is averaged over the measured pixels of 2 × 2: it has no edges, so pixels
        of two surfaces are never averaged.
        """
        K, (height, width), eps2d = half_camera(self.K, self.photo.shape, self.eps2d)
        # In numpy: torch's aligned temporary arrays do not fit where they were freed, which took 6 MB a view.
        rows = self.photo.numpy()[: 2 * height, : 2 * width].astype(np.uint16).reshape(height, 2, 2 * width, 3)
        total = rows[:, 0] + rows[:, 1]
        photo = torch.from_numpy(((total[:, 0::2] + total[:, 1::2] + 2) // 4).astype(np.uint8))
        labels = self.labels
        if labels is not None:
            labels = torch.from_numpy(labels.numpy()[: 2 * height : 2, : 2 * width : 2].copy())

        def four(image: torch.Tensor) -> np.ndarray:
            return image.numpy()[: 2 * height, : 2 * width].reshape(height, 2, width, 2)

        depth = self.depth
        if depth is not None:
            measured = (four(depth) > 0).sum(axis=(1, 3), dtype=np.float32)
            depth = torch.from_numpy(four(depth).sum(axis=(1, 3)) / np.maximum(measured, 1))
        weight = None if self.weight is None else torch.from_numpy(four(self.weight).min(axis=(1, 3)))
        return replace(self, photo=photo, labels=labels, K=K, eps2d=eps2d, weight=weight, depth=depth)

    def exposed(self, image: torch.Tensor) -> torch.Tensor:
        """`image` [H, W, 3] of the scene as this photo is exposed."""
        return image if self.gain is None else image * self.gain


def half_camera(K: torch.Tensor, shape: Sequence[int], eps2d: float) -> tuple[torch.Tensor, tuple[int, int], float]:
    """K [3, 3], (height, width) and eps2d at half the resolution; shape: (height, width, …).

    Averaging 2 × 2 pixels adds a blur of (2² − 1) / 12 px² at full resolution, so eps2d is changed. With an unchanged
    eps2d Gaussians become too thin for full resolution (−0.33 dB on tabletop_a at half length).
    """
    return K * torch.tensor([[0.5], [0.5], [1.0]]), (shape[0] // 2, shape[1] // 2), (eps2d + 0.25) / 4


def target_photo(view: TrainingView, image: torch.Tensor) -> torch.Tensor:
    """The photo to compare `image` [H, W, 3] with; ignored pixels are the image's own, also for windows around them."""
    if view.weight is None:
        return view.photo
    photo = view.photo.to(image.dtype) / 255
    return torch.where(view.weight[..., None] > 0, photo, image.detach())


def unprojected(K: np.ndarray, pose: np.ndarray, x: np.ndarray, y: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """World points [..., 3] of pixels x, y [...] at `depth` [...] along the axis; K [3, 3], pose camera_from_world."""
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x, np.float64)], axis=-1)
    # Explicit sums: the rounding of a matrix product can depend on the number of threads.
    return np.asarray(((rays * depth[..., None] - pose[:3, 3])[..., None] * pose[:3, :3]).sum(axis=-2))


def scene_extent(views: list[TrainingView]) -> float:
    """1.1 × the largest distance of a camera from the mean camera centre (Kerbl et al. 2023), at least 1e-3.
    Cameras `far_from_most` do not count."""
    poses = torch.stack([view.camera_from_world for view in views])
    centres = -torch.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    centres = centres[torch.from_numpy(~far_from_most(centres.double().numpy()))]
    return max(1.1 * float((centres - centres.mean(dim=0)).norm(dim=1).max()), 1e-3)


def render(
    gaussians: Gaussians,
    camera_from_world: torch.Tensor,
    K: torch.Tensor,
    width: int,
    height: int,
    *,
    features: torch.Tensor | None = None,
    harmonics: bool = False,
    depth: bool = True,
    eps2d: float = 0.3,
) -> Forward:
    """Renders one view (C = 1) where the Gaussians are, without gradients. First arguments, features and harmonics: see
    `Gaussians.inputs`; depth and eps2d: see `rasterize`."""
    degree = gaussians.sh_degree if harmonics else -1
    settings = Settings(width, height, sh_degree=degree, eps2d=eps2d, variance=False, depth=depth)
    inputs = gaussians.inputs(camera_from_world, K, features, harmonics=harmonics)
    return rasterizer_for(gaussians.means.device).rasterize_forward(inputs, settings)


@torch.no_grad()
def render_view(gaussians: Gaussians, view: TrainingView) -> torch.Tensor:
    """The Gaussians rendered and exposed as the view, [H, W, 3] float32 in [0, 1] on the CPU, black background."""
    return view.exposed(_render(gaussians, view).colors[0].cpu()).clamp(0, 1)


@torch.no_grad()
def visible_in(gaussians: Gaussians, view: TrainingView) -> torch.Tensor:
    """[N] bool: whether each Gaussian contributes to some pixel of the view."""
    return _render(gaussians, view).visible[0].bool()


def _render(gaussians: Gaussians, view: TrainingView) -> Forward:
    height, width = view.photo.shape[:2]
    return render(
        gaussians, view.camera_from_world, view.K, width, height, harmonics=True, depth=False, eps2d=view.eps2d
    )


@torch.no_grad()
def rgb_image(
    gaussians: Gaussians, camera_from_world: torch.Tensor, K: torch.Tensor, width: int, height: int
) -> np.ndarray:
    """The Gaussians' picture [H, W, 3] uint8."""
    out = render(gaussians, camera_from_world, K, width, height, harmonics=True, depth=False)
    return (out.colors[0].clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy()


@torch.no_grad()
def depth_image(
    gaussians: Gaussians, camera_from_world: torch.Tensor, K: torch.Tensor, width: int, height: int
) -> torch.Tensor:
    """Expected depth [H, W] on the CPU along the optical axis where the map is more than half opaque, 0 elsewhere."""
    return expected_depth(render(gaussians, camera_from_world, K, width, height))


def expected_depth(out: Forward, all_views: bool = False) -> torch.Tensor:
    """`depth_image` of what `render` returned; all_views: of all cameras [C, H, W]."""
    assert out.depths is not None  # for the type checker
    alpha, depths = (out.alphas, out.depths) if all_views else (out.alphas[0], out.depths[0])
    return torch.where(alpha > 0.5, depths / alpha.clamp(min=1e-6), torch.zeros_like(alpha)).cpu()


def surface_depth(gaussians: Gaussians, view: TrainingView) -> np.ndarray:
    """Depth [H, W] float32 along the optical axis of `view`, 0 = no surface: what a sensor measured, and rendered where
    nothing was."""
    rendered = depth_image(gaussians, view.camera_from_world, view.K, *view.photo.shape[1::-1])
    return (rendered if view.depth is None else torch.where(view.depth > 0, view.depth, rendered)).numpy()


def psnr(image: torch.Tensor, photo: torch.Tensor, weight: torch.Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB of image [H, W, 3] in [0, 1] against photo uint8, where weight [H, W] > 0."""
    # In numpy: the order of torch's sum depends on the number of threads, and growth decisions depend on the result.
    squares = np.square(image.detach().numpy() - photo.numpy() / np.float64(255))
    error = float(squares.mean() if weight is None else squares[weight.numpy() > 0].mean())
    return BEST_PSNR if error == 0 else min(BEST_PSNR, -10 * float(np.log10(error)))
