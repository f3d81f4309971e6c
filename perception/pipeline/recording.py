"""`--rrd`: a run as a Rerun recording: cameras with their photos, the Gaussians as they grow, instances and boxes."""

from __future__ import annotations

import contextlib
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.atomic import atomic_file
from perception.io.photos import load_photo
from perception.io.store import GaussianMap
from perception.pictures import instance_palette
from perception.types import View

PHOTO_SIDE = 320
"""Pixels of the longer side of recorded photos: enough to recognise what is meant."""
_SH_CONSTANT = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 √π)


class Recording:
    """Writes `path` aside while it grows; it appears under its name when the `with` block ends well.

    Entities: world/cameras/NAME (pinhole, photo), world/gaussians (splats, on the timeline "iteration"),
    world/instances (points by instance), world/boxes, figures/psnr and figures/gaussians.
    """

    def __init__(self, path: Path):
        self.path = Path(path)
        self._rr = _rerun()
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Recording:
        temporary = self._stack.enter_context(atomic_file(self.path))
        self._stream = self._rr.RecordingStream("perception")
        self._stream.save(temporary)
        self._stream.log("world", self._rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.flush()
        self._stream.disconnect()
        self._stack.__exit__(kind, error, trace)

    def cameras(self, views: list[View]) -> None:
        """Where the photos were taken, and the photos."""
        rr = self._rr
        for view in views:
            entity = f"world/cameras/{view.name}"
            rotation, translation = view.camera_from_world[:3, :3], view.camera_from_world[:3, 3]
            place = rr.Transform3D(mat3x3=rotation.T, translation=-rotation.T @ translation)
            self._stream.log(entity, place, static=True)
            scale = min(1.0, PHOTO_SIDE / max(view.width, view.height))
            size = [round(view.width * scale), round(view.height * scale)]
            K = view.K.copy()
            K[:2] *= np.array([[size[0] / view.width], [size[1] / view.height]])
            pinhole = rr.Pinhole(image_from_camera=K, resolution=size, camera_xyz=rr.ViewCoordinates.RDF)
            self._stream.log(entity, pinhole, static=True)
            with contextlib.suppress(InputError):  # a photo that has moved: its camera is drawn without it
                self._stream.log(entity, rr.Image(load_photo(view, PHOTO_SIDE)).compress(jpeg_quality=80), static=True)

    def gaussians(self, iteration: int, arrays: dict[str, np.ndarray], psnr: float | None = None) -> None:
        """The Gaussians at an iteration. arrays: means [N, 3], quats wxyz, log_scales, opacity_logits [N], sh."""
        rr = self._rr
        self._stream.set_time("iteration", sequence=iteration)
        opacity = 1 / (1 + np.exp(-arrays["opacity_logits"].reshape(-1, 1)))
        rgba = np.concatenate([0.5 + _SH_CONSTANT * arrays["sh"][:, 0], opacity], axis=1)
        splats = rr.GaussianSplats3D(
            arrays["means"],
            scales=np.exp(arrays["log_scales"]),
            quaternions=arrays["quats"][:, [1, 2, 3, 0]],  # Rerun's are xyzw
            colors=np.round(255 * rgba.clip(0, 1)).astype(np.uint8),
        )
        self._stream.log("world/gaussians", splats)
        self._stream.log("figures/gaussians", rr.Scalars(float(len(arrays["means"]))))
        if psnr is not None:
            self._stream.log("figures/psnr", rr.Scalars(psnr))

    def instances(self, gmap: GaussianMap) -> None:
        """The finished map: its Gaussians, the points of its instances in their colours, and their boxes."""
        rr = self._rr
        names = ("means", "quats", "log_scales", "opacity_logits", "sh")
        self.gaussians(
            int(gmap.info.get("training", {}).get("iterations", 0)), {name: getattr(gmap, name) for name in names}
        )
        rows = gmap.instance_ids >= 0
        points = rr.Points3D(gmap.means[rows], colors=instance_palette(gmap.instance_ids[rows]))
        self._stream.log("world/instances", points)
        if not gmap.instances:
            return
        boxes = [entry["obb"] for entry in gmap.instances]
        self._stream.log(
            "world/boxes",
            rr.Boxes3D(
                centers=[box["center"] for box in boxes],
                sizes=[box["extent"] for box in boxes],
                quaternions=[_xyzw(np.array(box["rotation"]).T) for box in boxes],
                labels=[entry.get("label") or f"{entry['id']} ({entry['score']:.2f})" for entry in gmap.instances],
                colors=instance_palette(np.array([entry["id"] for entry in gmap.instances])),
            ),
        )


def write_recording(path: Path, gmap: GaussianMap, views: list[View]) -> None:
    """A finished map as a Rerun recording."""
    with Recording(path) as recording:
        recording.cameras(views)
        recording.instances(gmap)


def _xyzw(rotation: np.ndarray) -> list[float]:
    from scipy.spatial.transform import Rotation

    return [float(x) for x in Rotation.from_matrix(rotation).as_quat()]


def _rerun() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise InputError('--rrd needs Rerun; run in the clone: pip install ".[rerun]"') from error
    return rerun
