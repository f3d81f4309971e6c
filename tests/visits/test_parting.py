"""Instances of which a part went, in photos rendered from what truly stands there: the exact truth tells the parts."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from perception.boxes import instance_entry
from perception.config import load_config
from perception.gaussians.model import Gaussians, isotropic
from perception.gaussians.views import TrainingView, expected_depth, render
from perception.map.map import Map
from perception.pipeline.optimise import Photos
from perception.visits.parted import parted
from perception.visits.visit import Visit
from support.aimed import look_at

K, SIDE = torch.tensor([[130.0, 0, 64], [0, 130, 64], [0, 0, 1]]), 128


def box(low: tuple[float, ...], high: tuple[float, ...], seed: int, count: int = 1500) -> Gaussians:
    """The sides of a box in patches of their own colours, of small balls."""
    rng, generator = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    points, side = rng.uniform(low, high, (count, 3)), rng.integers(0, 6, count)
    points[np.arange(count), side // 2] = np.array([low, high])[side % 2, side // 2]
    patch = np.floor((points - low) / 0.05 + 0.5).astype(int) @ np.array([1, 7, 49]) % 64
    return isotropic(
        points, torch.full((count,), -4.4), torch.rand(64, 3, generator=generator)[patch], 0.95, 2, generator
    )


CARTON, CAN = box((-0.12, -0.06, 0), (0, 0.06, 0.25), 1), box((0, -0.06, 0), (0.12, 0.06, 0.2), 2)
"""They touch, and are one instance."""
FLOOR = box((-0.6, -0.6, -0.02), (0.6, 0.6, 0), 3, 9000)
BOTH = 7


def visit_of(now: list[Gaussians]) -> Visit:
    """Photos from all sides of what stands `now`, with exact depth and masks of the things, beside a map of the carton
    and the can on the floor."""
    before, views, stereo = Gaussians.concatenate([CARTON, CAN, FLOOR]), [], []
    ids = np.repeat(np.array([BOTH, BOTH, -1], np.int32), [len(CARTON), len(CAN), len(FLOOR)])
    truth = Gaussians.concatenate([*now, FLOOR])
    for angle in np.arange(8) * np.pi / 4:
        eye = np.array([0.8 * np.cos(angle), 0.8 * np.sin(angle), 0.6])
        camera = torch.from_numpy(look_at(eye, np.array([0, 0, 0.1]), np.array([0, 0, 1.0])).astype(np.float32))
        out = render(truth, camera, K, SIDE, SIDE, harmonics=True)
        labels = np.zeros((SIDE, SIDE), np.uint16)
        for number, thing in enumerate(now, 1):
            alone = expected_depth(render(thing, camera, K, SIDE, SIDE)).numpy()
            front = (alone > 0) & (alone < 1.02 * expected_depth(out).numpy())
            labels[front] = number
        photo = (out.colors[0].clamp(0, 1) * 255).to(torch.uint8)
        views.append(TrainingView("a", photo, torch.from_numpy(labels.astype(np.int32)), K, camera))
        depth = expected_depth(out).numpy()
        stereo.append(SimpleNamespace(depth=depth, confirmed=depth > 0))
    arrays: dict[str, Any] = {name: tensor.numpy() for name, tensor in before.named().items()}
    own = ids == BOTH
    entry = instance_entry(BOTH, arrays["means"][own].astype(np.float64), np.ones(own.sum()), 0.9, 8, "breakfast")
    sure = np.ones(len(ids), np.float32)
    gmap = Map(**arrays, instance_ids=ids, membership=sure, instances=[entry])
    run = SimpleNamespace(config=load_config())
    known: dict[str, Any] = dict.fromkeys(("number", "whole", "near", "masks", "mark", "left_out", "beside", "earlier"))
    known |= {"light": np.ones(3), "grey": False, "stereo": stereo, "photos": Photos([], [], views, []), "run": run}
    return Visit(gmap=gmap, rows=np.arange(len(before)), gaussians=before, **known)


def test_what_went_of_two_things_in_one_instance_is_one_of_its_own() -> None:
    gmap = parted(visit_of([CARTON])).gmap
    assert [entry["id"] for entry in gmap.instances] == [7, 8]
    assert [entry["label"] for entry in gmap.instances] == ["breakfast", None]
    outside = np.abs(gmap.means[:, 0]) > 0.02  # the sides that touch are seen in no photo
    for thing, own in enumerate((7, 8)):
        rows = np.arange(len(outside)) // len(CARTON) == thing
        assert (gmap.instance_ids[rows & outside] == own).mean() > 0.9
    assert (gmap.instance_ids[-len(FLOOR) :] == -1).all()


@pytest.mark.parametrize("now", [[CARTON, CAN], [], [CARTON, box((0, -0.06, 0), (0.12, 0.06, 0.2), 9)]])
def test_what_stays_or_goes_as_a_whole_or_has_another_colour_is_not_split(now: list[Gaussians]) -> None:
    visit = visit_of(now)
    assert parted(visit) is visit
