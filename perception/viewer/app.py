"""The viewer's web page: viser's splat renderer and the controls of a `Session`."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import logging
import secrets
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from perception.colors import instance_palette
from perception.errors import InputError, missing_extra
from perception.map.history import is_removed
from perception.serve.listening import Guard, check_address, listen, url_host
from perception.types import OrientedBox
from perception.viewer.handshake import guarded_server
from perception.viewer.levels import MOST, Level, level
from perception.viewer.panel import Panel
from perception.viewer.picking import covariances
from perception.viewer.session import HIGHLIGHT, STATE_COLORS, Session

_log = logging.getLogger("perception.viewer")
WATCH = 1.0  # seconds between checks whether another program changed the map
GHOST_SIZE = 0.02  # side of a point of what stood elsewhere, where the map has size 10
EDGES = np.array([(i, i | 1 << a) for i in range(8) for a in range(3) if not i >> a & 1])  # of `OrientedBox.corners`


class Viewer:
    """A map in a page at http://host:port (port 0: any free one). `address`: its URL; `url`: the same with the access
    token; `stop` closes it.

    token: the access token; None generates one, which is refused where other machines can reach `host`. photos: a
    folder whose photos are shown too, beside those in the map's own.
    Raises InputError when `path` is no map, the port is in use, the token is missing, or viser is not installed.
    """

    def __init__(
        self,
        path: Path,
        host: str = "127.0.0.1",
        port: int = 8090,
        token: str | None = None,
        photos: Path | None = None,
    ):
        check_address(host, port, token)
        if importlib.util.find_spec("viser") is None:
            raise missing_extra("viser", "view")
        token = token or secrets.token_urlsafe(24)
        with contextlib.ExitStack() as undo:
            sock = undo.enter_context(listen(host, port))
            self.session = Session(path, photos)
            label = f"perception · {path.name}"
            self.server = guarded_server(Guard(host, token), sock, host=host, port=port, label=label, verbose=False)
            undo.pop_all()  # the server owns the socket from here on
        shown = "localhost" if host in ("127.0.0.1", "0.0.0.0", "::") else url_host(host)
        self.address = f"http://{shown}:{sock.getsockname()[1]}"
        self.url = f"{self.address}/?token={quote(token, safe='')}"
        self._one = threading.RLock()  # the actions of all browsers run one at a time
        self._overlays: list[Any] = []
        self._boxed = False
        self._frame_map()
        self.panel = Panel(self)  # before the Gaussians, which take their time on a slow connection
        self._splats = self.server.scene.add_gaussian_splats("/map/splats", *self._gaussians())
        self._stopped = threading.Event()
        self._problem = ""
        self.server.scene.on_click()(lambda event: self._clicked(event, add=False))
        self.server.scene.on_click(modifier="shift")(lambda event: self._clicked(event, add=True))
        threading.Thread(target=self._watch, daemon=True).start()

    def stop(self) -> None:
        """Closes the page and its port."""
        self._stopped.set()
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints there
            self.server.stop()

    def _frame_map(self) -> None:
        """Sets up direction, first camera and scale. The page uses half precision, so the map is scaled to size 10."""
        self._drawn = gmap = self.session.editor.original
        low, high = np.percentile(gmap.means, [5, 95], axis=0) if len(gmap) else (np.zeros(3), np.ones(3))
        self.scale = 10 / max(float(np.linalg.norm(high - low)), 1e-9)
        self._covariances = covariances(gmap) * np.float32(self.scale**2)
        self._level: Level | None = None
        if len(gmap) > MOST:
            ids = self.session.finest_ids()
            self._level = level(gmap.means * np.float32(self.scale), self._covariances, gmap.opacities, ids)
            self._covariances = self._level.covariances
        poses = gmap.poses
        if len(poses) == 0:
            return
        self.server.scene.set_up_direction(tuple(-poses[:, 1, :3].mean(axis=0)))
        pose = poses[len(poses) // 2]
        eye = -pose[:3, :3].T @ pose[:3, 3]
        depth = np.median((gmap.means @ pose[2, :3] + pose[2, 3]).clip(min=0)) if len(gmap) else 1.0
        camera = self.server.initial_camera
        camera.position = tuple(eye * self.scale)
        camera.look_at = tuple((eye + pose[2, :3] * max(float(depth), 1e-6)) * self.scale)

    def _gaussians(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Centres [N, 3], covariances [N, 3, 3], colours [N, 3] uint8 and opacities [N, 1] as the page shows them."""
        if self._level is not None:
            shown = self._level.colors(self.session.colors()), self._level.opacities(self.session.shown())[:, None]
            return self._level.means, self._covariances, *shown
        centers = (self._drawn.means * np.float32(self.scale)).astype(np.float32)
        return centers, self._covariances, self.session.colors(), self.session.opacities()[:, None]

    @property
    def detail(self) -> str:
        """How much of the map the page shows, as text; empty if all of it."""
        count = len(self._drawn)
        return "" if self._level is None else f"{len(self._level) / 1e6:.1f} of {count / 1e6:.1f} million Gaussians"

    def redraw(self) -> None:
        """Sends the Gaussians to every browser, in one message, and redraws the visible overlays."""
        with self._one:
            if self._drawn is not self.session.editor.original:
                self._frame_map()
            self._splats.set_gaussians(*self._gaussians())
            self._draw_overlays()

    def show_boxes(self, on: bool) -> None:
        """Shows or hides the instances' boxes and names."""
        with self._one:
            self._boxed = on
            self._draw_overlays()

    def _draw_overlays(self) -> None:
        """Draws anew the boxes and names of the instances that are lit, or of all, and the measured length."""
        for handle in self._overlays:
            handle.remove()
        self._overlays, scene, session = [], self.server.scene, self.session
        lit = session.lit()
        if len(ghosts := session.ghosts()):
            points, size = (ghosts * self.scale).astype(np.float32), GHOST_SIZE
            red = STATE_COLORS["removed"]
            cloud = scene.add_point_cloud("/map/ghosts", points, red, point_size=size, point_shape="circle")
            self._overlays.append(cloud)
        for entry in session.editor.instances if self._boxed else ():
            gone = is_removed(entry) and session.mode != "changes"
            if not entry.get("hidden") and not gone and (not lit or entry["id"] in lit):
                box, number = OrientedBox.from_json(entry["obb"]), entry["id"]
                segments = (box.corners[EDGES] * self.scale).astype(np.float32)
                style = {"thickness": 2, "thickness_units": "screen"}
                changed = session.mode == "changes" and entry.get("state") in STATE_COLORS
                name = session.name(entry) + (f", {entry['state']}" if changed else "")
                color, middle = tuple(instance_palette([number])[0].tolist()), np.array(entry["centroid"]) * self.scale
                self._overlays += [
                    scene.add_line_segments(f"/map/boxes/{number}", segments, color, **style),
                    scene.add_label(f"/map/names/{number}", name, position=tuple(middle)),
                ]
        if len(session.ends) == 2:
            ends = (np.array(session.ends) * self.scale).astype(np.float32)
            self._overlays += [
                scene.add_line_segments("/map/length/line", ends[None], tuple(HIGHLIGHT.tolist()), thickness=0.02),
                scene.add_label("/map/length/text", session.length, position=tuple(ends.mean(axis=0))),
            ]

    def _clicked(self, event: Any, add: bool) -> None:
        origin, direction = np.array(event.ray_origin) / self.scale, np.array(event.ray_direction)
        self.guarded(lambda: self.session.pick(origin, direction, add))

    def guarded(self, action: Callable[[], object], client: Any = None, edited: bool = False) -> None:
        """Runs the action of a control, then redraws everything. An InputError is shown in the page instead."""
        with self._one:
            try:
                action()
            except InputError as error:
                self.panel.notify(client, str(error))
                return
            if edited:
                self.session.edited()
            self.panel.refresh()
            self.redraw()

    def _watch(self) -> None:
        """Reopens a map that another program changed, as often as it changes: no error ends this. With unsaved edits
        here, the page offers to drop them."""
        while not self._stopped.wait(WATCH):
            with self._one:
                try:
                    problem = self._reopened()
                except InputError as error:  # missing; for an instant also between the two renames of a save
                    problem = str(error)
                except Exception as error:  # of any class: people edit instances.json by hand
                    problem = f"{self.session.editor.path}: cannot be shown ({type(error).__name__}: {error})"
                    if problem != self._problem:
                        _log.error("%s", problem, exc_info=error)
                with contextlib.suppress(Exception):  # a page that closes meanwhile
                    self.panel.renew.visible = bool(problem) and self.session.editor.dirty
                    if problem and problem != self._problem:
                        self.panel.notify(None, problem)
            self._problem = problem

    def _reopened(self) -> str:
        """Opens the map anew if another program changed it; returns why not, if there are unsaved edits."""
        editor = self.session.editor
        if editor.outdated and editor.dirty:
            return "the map was changed by another program; the corrections here cannot be saved into it"
        if editor.outdated:
            self.session.reopen()
            self.panel.notify(None, "the map was changed by another program; this is the new one")
            self.panel.refresh()
            self.redraw()
        return ""
