"""`perception localise`: reads the photos, localises them, and prints or writes the poses."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from perception.errors import InputError
from perception.inputs.load import input_files
from perception.io.atomic import write_file
from perception.localise.localiser import Localised, Localiser, NotHere
from perception.localise.photos import new_photos, transforms_of
from perception.map.map import Map
from perception.map.outputs import refuse_inputs
from perception.photos.view_json import frame_facts
from perception.progress import Progress


def localise_photos(
    path: Path, sources: Sequence[Path], output: Path | None, photos: Path | None, camera: Path | None, show: Progress
) -> tuple[dict[str, Any], list[str]]:
    """The facts, and the lines that say them. output: a transforms.json with the poses that were found, in the map's
    frame; none is written without a pose. photos: a folder with the map's photos; camera: of the new ones."""
    if photos is not None and not photos.is_dir():
        raise InputError(f"{photos}: is no folder; give the one that holds the map's photos")
    gmap = Map.open(path)
    with TemporaryDirectory(prefix="perception-localise-") as folder:
        new = new_photos(sources, camera, Path(folder), show)
        listed = [file for source in sources if source.is_dir() for file in input_files(source)]
        refuse_inputs([output], [path, camera, *sources, *listed, *(photo.photo for photo in new)])
        localiser = Localiser(gmap, photos, show)
        answers = localiser.answers(new, Path(folder) / "still")
    facts = {"photos": [answer_json(answer) for answer in answers], "frame": gmap.frame, "metric": gmap.metric}
    facts |= {"map_id": gmap.map_id, "rendered": localiser.rendered}
    found = [answer for answer in answers if isinstance(answer, Localised)]
    if output is not None and found:
        head = {"map_id": gmap.map_id, "frame": gmap.frame, **frame_facts(gmap.info, gmap.views)}
        write_file(output, json.dumps(transforms_of(found, output, head), indent=1) + "\n")
    return facts, _lines(answers, gmap, localiser.rendered)


def answer_json(answer: Localised | NotHere) -> dict[str, Any]:
    """An answer as JSON: whether the photo is `localised`; its pose in the map's frame, or why there is none."""
    if isinstance(answer, NotHere):
        return {"name": answer.name, "localised": False, "why": answer.why}
    error, degrees = answer.standard_error
    return {
        "name": answer.name,
        "localised": True,
        "camera_from_map": answer.camera_from_map.tolist(),
        "position": answer.position.tolist(),
        "standard_error": {"position": error, "degrees": degrees},
        "inliers": answer.inliers,
        "rms_px": answer.rms_px,
        "lens": [answer.lens.model, list(answer.lens.params), answer.lens.width, answer.lens.height],
    }


def rendered_notice(gmap: Map, rendered: list[str]) -> str:
    """That the photos of the views `rendered` are not at hand."""
    many = f"{len(rendered)} of {len(gmap.views)} photos of the map"
    return f"{gmap.path}: {many} are not at hand; its own pictures are used"


def _lines(answers: Sequence[Localised | NotHere], gmap: Map, rendered: list[str]) -> list[str]:
    unit, lines = "m" if gmap.metric else "map units", []
    if rendered:
        lines.append(f"warning: {rendered_notice(gmap, rendered)} (--photos DIR gives their folder)")
    for answer in answers:
        if isinstance(answer, NotHere):
            lines.append(f"{answer.name}: {answer.why}")
            continue
        error, degrees = answer.standard_error
        at = " ".join(f"{x:.4g}" for x in answer.position)
        lines.append(f"{answer.name}: at {at} ±{error:.2g} {unit}, ±{degrees:.2g}°, {answer.inliers} features")
    here = sum(isinstance(answer, Localised) for answer in answers)
    return [*lines, f"{here} of {len(answers)} photos are in this map"]
