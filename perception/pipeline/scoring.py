"""`perception eval masks`: evaluates the rendered instance masks of a map against ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from perception.evaluate.rendered import evaluate_rendered
from perception.io.store import read_map
from perception.pipeline.rendering import as_gaussians, map_views


def score_masks(map_path: Path, truth_dir: Path, all_views: bool = False) -> tuple[dict[str, Any], str]:
    """mIoU of the map's rendered masks in its held-out views; in all its views with all_views or if none was held out.

    truth_dir: one PNG per view, see `evaluate_rendered`. Returns (JSON-able result, table).
    """
    gmap = read_map(map_path)
    views = map_views(gmap, held_out=not all_views)
    result = evaluate_rendered(as_gaussians(gmap), gmap.instance_ids, views, truth_dir)
    lines = [f"{'truth':>6}{'map':>6}{'views':>7}{'mIoU':>8}{'pooled':>8}"]
    for row in result["instances"]:
        name = "-" if row["pred"] is None else row["pred"]
        lines.append(f"{row['gt']:>6}{name:>6}{row['views']:>7}{row['miou']:>8.3f}{row['pooled_iou']:>8.3f}")
    lines.append(f"mIoU {result['miou']:.4f} over {len(result['instances'])} instances in {result['views']} views")
    return result, "\n".join(lines)
