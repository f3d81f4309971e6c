"""Things at rest before cameras, in Blender, for `blender_worlds`."""

# Runs in Blender's environment: nothing of this project may be imported here.
from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from blender_looks import pattern, printed
from mathutils import Matrix, Vector
from mathutils.bvhtree import BVHTree

SIZE, VIEWS, SAMPLES = (320, 240), (20, 26), 4
STUFF = ("floor", "wall", "ceiling", "table top")


class Scene:
    """Things at rest, each with its triangles in the world."""

    def __init__(self, seed: int, models: list[dict[str, Any]]) -> None:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self.rng = np.random.default_rng(seed)
        self.models = models
        self.things: list[dict[str, Any]] = []
        self.cameras: list[np.ndarray] = []

    # Things

    def box(self, size: Sequence[float], material: Any) -> Any:
        """A box whose bottom's centre is the origin; each side shows the whole picture of a print."""
        x, y, z = size[0] / 2, size[1] / 2, size[2]
        corners = [(i * x, j * y, k * z) for k in (0, 1) for j in (-1, 1) for i in (-1, 1)]
        faces = [(1, 0, 2, 3), (4, 5, 7, 6), (0, 1, 5, 4), (3, 2, 6, 7), (2, 0, 4, 6), (1, 3, 7, 5)]
        mesh = bpy.data.meshes.new("box")
        mesh.from_pydata(corners, [], faces)
        layer = mesh.uv_layers.new(name="UVMap")
        for k in range(24):
            layer.data[k].uv = ((0, 0), (1, 0), (1, 1), (0, 1))[k % 4]
        mesh.materials.append(material)
        return self._linked(mesh)

    def union(self, parts: list[tuple[Any, Sequence[float]]]) -> Any:
        """Boxes, each moved, as one object."""
        for part, offset in parts:
            part.location = offset
        bpy.context.view_layer.update()
        return self._joined([part for part, _ in parts])

    def model(self, entry: dict[str, Any], scale: float = 1.0) -> Any:
        before = set(bpy.data.objects)
        bpy.ops.wm.obj_import(filepath=str(entry["file"]), forward_axis="NEGATIVE_Z", up_axis="Y")
        new = [thing for thing in bpy.data.objects if thing not in before]
        thing = self._joined([part for part in new if part.type == "MESH"])
        turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # of its axes to ours
        points = _points(thing) @ (turn @ entry["turn"] @ turn.T).T
        low, high = points.min(axis=0), points.max(axis=0)
        points = (points - [*((low + high) / 2)[:2], low[2]]) * scale * entry["size"] / np.maximum(high - low, 1e-6)
        thing.data.vertices.foreach_set("co", points.astype(np.float32).ravel())
        for material in thing.data.materials:
            for node in material.node_tree.nodes if material is not None and material.use_nodes else ():
                if node.type == "BSDF_PRINCIPLED":
                    node.inputs["Metallic"].default_value *= 0.5
                    node.inputs["Emission Strength"].default_value = 0
                    rough = node.inputs["Roughness"]
                    rough.default_value = min(max(rough.default_value, 0.25), 0.85)
        return thing

    def of_size(self, least: float, most: float) -> dict[str, Any]:
        """A model by chance whose longest side is in that range, metres."""
        fit = [entry for entry in self.models if least <= entry["size"].max() <= most]
        return fit[self.rng.integers(len(fit))]

    def small(self, highest: float) -> tuple[Any, str]:
        """Something small, no higher than that: two in three are models, the others packages, books and blocks."""
        if self.rng.uniform() < 0.65:
            entry = self.of_size(0.03, 0.42)
            room = min(1.0, 0.95 * highest / max(entry["size"][2], 1e-3))
            if room > 0.5:
                return self.model(entry, room * self.rng.uniform(0.85, 1)), entry["name"]
        kinds = {"package": ([0.04, 0.03, 0.06], [0.16, 0.12, 0.26]), "book": ([0.12, 0.18, 0.01], [0.2, 0.28, 0.05])}
        kinds |= {"block": ([0.02, 0.02, 0.02], [0.1, 0.1, 0.1])}
        name = str(self.rng.choice(list(kinds), p=[0.5, 0.3, 0.2]))
        size = self.rng.uniform(*kinds[name])
        size[2] = min(size[2], 0.9 * highest)
        return self.box(size, pattern(self.rng) if name == "block" else printed(self.rng)), name

    def put(
        self, thing: Any, name: str, at: Sequence[float], yaw: float = 0.0, drop: float | None = None
    ) -> dict[str, Any]:
        """Turned about its vertical and moved to `at`; drop: height of its bottom to fall from until it touches."""
        points = _turned(_points(thing), yaw)
        thing.data.vertices.foreach_set("co", points.astype(np.float32).ravel())
        thing.data.update()
        bpy.context.view_layer.update()
        points, faces = _triangles(thing)
        points += [*at[:2], at[2] if drop is None else drop]
        tree = BVHTree.FromPolygons(points.tolist(), faces.tolist())
        fallen = 0.0 if drop is None else max(self._fall(points, tree) - 2e-4, 0.0)
        points[:, 2] -= fallen
        thing.location = (*at[:2], at[2] if drop is None else drop - fallen)
        made = {"name": name, "object": thing, "points": points, "faces": faces}
        made["tree"] = BVHTree.FromPolygons(points.tolist(), faces.tolist())
        made["low"], made["high"] = points.min(axis=0), points.max(axis=0)
        self.things.append(made)
        return made

    def _fall(self, points: np.ndarray, tree: BVHTree) -> float:
        """How far a thing falls until a vertex of it, or of what is below, touches."""
        low, high = points.min(axis=0), points.max(axis=0)
        far = float(low[2])  # the floor is at 0
        some = points[self.rng.permutation(len(points))[:1500]]
        for other in self.things:
            if (other["low"][:2] > high[:2]).any() or (other["high"][:2] < low[:2]).any() or other["low"][2] > low[2]:
                continue
            for point in some:
                hit = other["tree"].ray_cast(Vector(point), Vector((0, 0, -1)), far)
                far = far if hit[0] is None else min(far, hit[3])
            theirs = other["points"]
            inside = ((theirs[:, :2] > low[:2]) & (theirs[:, :2] < high[:2])).all(axis=1) & (theirs[:, 2] < high[2])
            for point in theirs[inside][:1500]:
                hit = tree.ray_cast(Vector(point), Vector((0, 0, 1)), far)
                far = far if hit[0] is None else min(far, hit[3])
        return far

    def scatter(self, count: int, low: Sequence[float], high: Sequence[float], z: float, gap: float) -> None:
        """Small things on the level z within a rectangle, side by side, many of them almost touching, some in rows of
        equal ones. gap: height above z that is free."""
        taken: list[tuple[np.ndarray, np.ndarray]] = []
        low, high = np.array(low), np.array(high)
        for _ in range(count):
            thing, name = self.small(gap)
            yaw = self.rng.choice([0.0, self.rng.uniform(0, 2 * math.pi)]) + self.rng.normal(0, 0.05)
            points = _turned(_points(thing), yaw)
            half, height = np.ptp(points[:, :2], axis=0) / 2, float(points[:, 2].max())
            copies = int(self.rng.integers(2, 6)) if self.rng.uniform() < 0.2 else 1
            for copy in range(copies):
                spot = self._spot(half, low, high, taken, beside=copy > 0)
                if spot is None:
                    break
                taken.append((spot - half, spot + half))
                one = self._linked(thing.data.copy())
                self.put(one, name, [*spot, z], yaw, drop=z + max(0.98 * gap - height, 0.0))
            bpy.data.objects.remove(thing)

    def _spot(self, half: np.ndarray, low: np.ndarray, high: np.ndarray, taken: list[Any], beside: bool) -> Any:
        """A free place for a box of that half size; half of them almost touch one that is taken, `beside` the last."""
        for _ in range(60):
            if (2 * half > high - low).any():
                return None
            spot = self.rng.uniform(low + half, high - half)
            if taken and (beside or self.rng.uniform() < 0.5):
                a, b = taken[-1 if beside else self.rng.integers(len(taken))]
                axis, side = self.rng.integers(2), self.rng.choice([-1, 1])
                spot = (a + b) / 2 + self.rng.normal(0, 0.01, 2)
                spot[axis] += side * ((b - a)[axis] / 2 + half[axis] + self.rng.exponential(0.004))
            if (spot - half < low).any() or (spot + half > high).any():
                continue
            if not any((spot - half < b - 1e-4).all() and (spot + half > a + 1e-4).all() for a, b in taken):
                return spot
        return None

    # Cameras

    def around(
        self, centre: Sequence[float], distance: tuple[float, float], height: tuple[float, float], front: bool = False
    ) -> None:
        turn = self.rng.uniform(0, 2 * math.pi)
        for k in range(VIEWS[0]):
            for _ in range(100):
                angle = turn + 2 * math.pi * (k + self.rng.uniform(-0.4, 0.4)) / VIEWS[0]
                if front:
                    angle = -math.pi / 2 + math.radians(self.rng.uniform(-55, 55))
                away = self.rng.uniform(*distance)
                beside = [away * math.cos(angle), away * math.sin(angle), self.rng.uniform(*height)]
                eye = np.add(centre, beside)
                if eye[2] > 0.15 and self.look(eye, np.array(centre) + self.rng.normal(0, [0.12, 0.12, 0.08]), 0.2):
                    break

    def look(self, eye: np.ndarray, aim: np.ndarray, free: float) -> bool:
        """Adds a camera unless it is in a thing, or sees nothing but one."""
        where, ahead = Vector(eye), (Vector(aim) - Vector(eye)).normalized()
        for thing in self.things:
            near = thing["tree"].find_nearest(where, 0.12)
            if near[0] is not None or thing["tree"].ray_cast(where, ahead, free)[0] is not None:
                return False
        roll = math.radians(self.rng.normal(0, 2))
        matrix = Matrix.Translation(where) @ ahead.to_track_quat("-Z", "Y").to_matrix().to_4x4()
        self.cameras.append(np.array(matrix @ Matrix.Rotation(roll, 4, "Z")))
        return True

    # Pictures and truth

    def render(self, folder: Path) -> None:
        scene = bpy.context.scene
        scene.render.engine = "CYCLES"
        cycles = scene.cycles
        cycles.device, cycles.samples, cycles.use_denoising = "CPU", SAMPLES, True
        cycles.denoiser, cycles.denoising_quality, cycles.denoising_prefilter = "OPENIMAGEDENOISE", "BALANCED", "FAST"
        cycles.max_bounces, cycles.diffuse_bounces, cycles.glossy_bounces, cycles.sample_clamp_indirect = 4, 3, 3, 4.0
        cycles.caustics_reflective = cycles.caustics_refractive = False
        scene.render.threads_mode, scene.render.threads, scene.render.use_persistent_data = "FIXED", 1, True
        scene.render.resolution_x, scene.render.resolution_y = SIZE
        scene.render.image_settings.file_format = "PNG"
        scene.view_settings.view_transform = "AgX"
        scene.view_settings.look = "AgX - Medium High Contrast"
        world = scene.world = bpy.data.worlds.new("world")
        world.use_nodes = True
        world.node_tree.nodes["Background"].inputs[0].default_value = (1, 0.97, 0.93, 1)
        world.node_tree.nodes["Background"].inputs[1].default_value = 0.2
        warm = self.rng.uniform(0.75, 1)
        for _ in range(self.rng.integers(1, 4)):
            light = bpy.data.lights.new("area", "AREA")
            light.size, light.energy = float(self.rng.uniform(0.2, 1.2)), float(self.rng.uniform(40, 110))
            light.color = (1, 0.5 + warm / 2, warm)
            lamp = bpy.data.objects.new("area", light)
            bpy.context.collection.objects.link(lamp)
            lamp.location = (*self.rng.uniform(-1.2, 1.2, 2), 2.5)
            lamp.visible_camera = False
        focal = SIZE[0] * self.rng.uniform(0.75, 1.1)
        camera = bpy.data.cameras.new("camera")
        camera.sensor_width, camera.clip_start = 36.0, 0.01
        camera.lens = focal * 36 / SIZE[0]
        scene.camera = bpy.data.objects.new("camera", camera)
        bpy.context.collection.objects.link(scene.camera)
        for k, pose in enumerate(self.cameras):
            scene.camera.matrix_world = Matrix(pose)
            cycles.seed = k
            scene.render.filepath = str(folder / "images" / f"{k:04d}.png")
            bpy.ops.render.render(write_still=True)
        counts = np.cumsum([0, *(len(thing["points"]) for thing in self.things)])
        faces = [thing["faces"] + start for thing, start in zip(self.things, counts[:-1], strict=True)]
        ids = np.repeat(np.arange(1, len(self.things) + 1), [len(thing["faces"]) for thing in self.things])
        points = np.concatenate([thing["points"] for thing in self.things]).astype(np.float32)
        np.savez_compressed(
            folder / "surface.npz", points=points, faces=np.concatenate(faces), ids=ids.astype(np.uint16)
        )
        instances = [
            {"id": k + 1, "name": thing["name"], "is_stuff": thing["name"].startswith(STUFF)}
            for k, thing in enumerate(self.things)
        ]
        about = {
            "focal": focal,
            "size": SIZE,
            "poses": [pose.tolist() for pose in self.cameras],
            "instances": instances,
        }
        (folder / "cameras.json").write_text(json.dumps(about), encoding="utf-8")

    @staticmethod
    def _linked(mesh: Any) -> Any:
        thing = bpy.data.objects.new(mesh.name, mesh)
        bpy.context.collection.objects.link(thing)
        return thing

    @staticmethod
    def _joined(parts: list[Any]) -> Any:
        bpy.ops.object.select_all(action="DESELECT")
        for part in parts:
            part.select_set(True)
        bpy.context.view_layer.objects.active = parts[0]
        if len(parts) > 1:
            bpy.ops.object.join()
        bpy.ops.object.transform_apply(location=True, rotation=True, scale=True)
        return bpy.context.view_layer.objects.active


def _points(thing: Any) -> np.ndarray:
    points = np.empty(len(thing.data.vertices) * 3, np.float32)
    thing.data.vertices.foreach_get("co", points)
    return points.reshape(-1, 3).astype(np.float64)


def _turned(points: np.ndarray, yaw: float) -> np.ndarray:
    c, s = math.cos(yaw), math.sin(yaw)
    return points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def _triangles(thing: Any) -> tuple[np.ndarray, np.ndarray]:
    mesh = thing.data
    mesh.calc_loop_triangles()
    faces = np.empty(len(mesh.loop_triangles) * 3, np.int32)
    mesh.loop_triangles.foreach_get("vertices", faces)
    return _points(thing), faces.reshape(-1, 3)
