"""Training views from posed photos and label images, decoded once at training size."""

from __future__ import annotations

from bisect import bisect
from dataclasses import replace
from itertools import compress
from pathlib import Path, PurePosixPath

import numpy as np
import torch

from perception.config import PhotoConfig
from perception.errors import InputError
from perception.gaussians.views import TrainingView
from perception.io.documents import text_of
from perception.io.memory import Keep
from perception.masks.label_files import load_labels
from perception.photos.decode import load_photo, scaled_K
from perception.photos.depth import load_depth, without_edges
from perception.photos.ignore_masks import load_weight
from perception.photos.named_files import folded
from perception.progress import Progress
from perception.types import Scene, View


def split_scene(scene: Scene, options: PhotoConfig) -> tuple[Scene, list[View], list[View]]:
    """(the scene with its views sorted by name, training views, held-out views as exposed as their neighbours).

    Held out are the views that the file `options.held_out` names, or those that the input sets apart, or every
    `options.holdout`-th: none with a holdout of 1 or 0, or of fewer than 4 views. InputError for a file that cannot be
    read or leaves no view to train on; names in it of no view are a warning in the scene's report.
    """
    views, listed, every = scene.views, options.held_out, options.holdout
    if listed is not None:
        names = held_out_names(Path(listed))
        own = [{folded(view.name), folded(PurePosixPath(view.name).stem)} for view in views]
        held = [bool(names & either) for either in own]
        if all(held):
            raise InputError(f"{listed}: names all {len(views)} photos; some must be left to train on")
        if strange := sorted(names.difference(*own)):
            found = f"{len(strange)} of {len(names)} names are of no posed photo, such as {strange[0]}"
            warnings = [*scene.report.get("warnings", []), f"{listed}: {found}; expected names such as {views[0].name}"]
            scene = replace(scene, report={**scene.report, "warnings": warnings})
    elif every > 1 and 0 < sum(view.held_out for view in views) < len(views):
        held = [view.held_out for view in views]
    else:
        held = [every > 1 and len(views) >= 4 and index % every == 0 for index in range(len(views))]
    training = list(compress(views, [not is_held for is_held in held]))
    held_out = exposed_as_neighbours(list(compress(views, held)), training)
    return replace(scene, views=sorted([*training, *held_out], key=lambda view: view.name)), training, held_out


def held_out_names(listed: Path) -> set[str]:
    """The names that a file lists, in small letters. InputError when it cannot be read."""
    try:
        return {folded(line.strip()) for line in text_of(listed.read_bytes()).splitlines() if line.strip()}
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{listed}: cannot be read; expected a text file of photo names, one a line") from error


def exposed_as_neighbours(held_out: list[View], training: list[View]) -> list[View]:
    """Held-out views, each with the geometric mean of the gains of the training views before and after it by name.

    Their own gains come from the photos that they are to be compared with.
    """
    names = [view.name for view in training]
    exposed = []
    for view in held_out:
        after = bisect(names, view.name)
        near = [other.gain for other in training[max(after - 1, 0) : after + 1] if other.gain is not None]
        gain = None if view.gain is None or not near else tuple(np.exp(np.log(near).mean(axis=0)).tolist())
        exposed.append(replace(view, gain=gain))
    return exposed


def training_view(view: View, max_side: int) -> TrainingView:
    """Decodes one photo, its mask of pixels to ignore, and its depth image without ignored pixels."""
    photo = load_photo(view, max_side)
    height, width = photo.shape[:2]
    weight = load_weight(view, width, height)
    depth = None
    if view.depth is not None:
        depth = without_edges(load_depth(view, width, height)) * (1 if weight is None else weight > 0)
    return TrainingView(
        view.name,
        torch.from_numpy(photo),
        None,
        torch.from_numpy(scaled_K(view, width, height).astype(np.float32)),
        torch.from_numpy(view.camera_from_world.astype(np.float32)),
        weight=None if weight is None else torch.from_numpy(weight),
        depth=None if depth is None else torch.from_numpy(depth),
        gain=None if view.gain is None else torch.tensor(view.gain),
    )


def with_labels(decoded: TrainingView, view: View, folder: Path) -> TrainingView:
    """The decoded photo with its label image from `folder`, in the smallest type; ignored pixels are unlabelled."""
    labels = load_labels(folder, view)
    most = int(labels.max(initial=0))
    labels = labels.astype(np.uint8 if most < 256 else np.int16 if most < 1 << 15 else np.int32)
    if decoded.weight is not None:
        labels[decoded.weight.numpy() == 0] = 0
    return replace(decoded, labels=torch.from_numpy(decoded.keep(labels)))


def load_all(views: list[View], max_side: int, progress: Progress, keep: Keep = np.asarray) -> list[TrainingView]:
    """Decodes all `views`; `keep` takes 3 bytes per pixel, and 4 more with depth."""
    loaded = []
    for done, view in enumerate(views, start=1):
        loaded.append(replace(training_view(view, max_side), keep=keep).stored())
        progress.update("photos", done, len(views))
    return loaded
