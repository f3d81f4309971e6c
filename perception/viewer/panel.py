"""The viewer's control panel: queries, display, selection, corrections, a known length."""

from __future__ import annotations

import string
from collections.abc import Callable
from typing import Any, Protocol

from perception.map.history import date_of, is_removed, last_seen, since, visits_of
from perception.query.hit import printed_texts
from perception.report.text import frame_lines
from perception.viewer.session import LEGEND, MODES, Session

_OF_ADDRESSES = {f"&#{ord(c)};" for c in ".:@"}


def escaped(text: str) -> str:
    """`text` as Markdown that shows exactly these characters: viser renders HTML in it, and names are untrusted.

    Every ASCII punctuation character becomes a character reference, which Markdown does not parse as syntax. An
    invisible element precedes the characters of web and mail addresses (. : @), else viser makes links of these.
    """
    shown = (f"&#{ord(c)};" if c in string.punctuation else c for c in " ".join(text.split()))
    return "".join(f"<wbr>{c}" if c in _OF_ADDRESSES else c for c in shown)


class Page(Protocol):
    """What the panel uses of the page (`app.Viewer`)."""

    server: Any
    session: Session

    @property
    def detail(self) -> str: ...

    def redraw(self) -> None: ...

    def show_boxes(self, on: bool) -> None: ...

    def guarded(self, action: Callable[[], object], client: Any = None, edited: bool = False) -> None: ...


class Panel:
    """Builds viser's controls and updates their texts."""

    def __init__(self, viewer: Page):
        self.viewer = viewer
        self.session = viewer.session
        self.gui = viewer.server.gui
        self.gui.configure_theme(control_width="large", show_share_button=False)
        self._facts = self.gui.add_markdown("")
        self._build_ask()
        self._build_show()
        self._build_selection()
        self._build_history()
        self._build_measure()
        self.refresh()

    def _build_ask(self) -> None:
        with self.gui.add_form("Ask") as form:
            self._text = self.gui.add_text("prompt", "", hint='a thing, such as "red mug"; Enter asks')
            button = self.gui.add_button("Search")
        button.on_click(lambda _: form.submit())
        form.on_submit(lambda event: self.viewer.guarded(lambda: self.session.ask(self._text.value), event.client))
        self._answer = self.gui.add_markdown("")
        self._hits_folder = self.gui.add_folder("Hits", visible=False)
        self._hit_buttons: list[Any] = []

    def _build_show(self) -> None:
        with self.gui.add_folder("Show"):
            modes = MODES if self.session.editor.original.newest_visit else MODES[:-1]
            mode = self.gui.add_dropdown("colours", modes, initial_value=self.session.mode)
            legend = self.gui.add_markdown(f"*{LEGEND}*", visible=False)
            boxes = self.gui.add_checkbox("boxes and names", False)
            clear = self.gui.add_button("Clear selection")

        def choose(_: Any) -> None:
            self.session.mode, legend.visible = mode.value, mode.value == "changes"
            self.viewer.redraw()

        mode.on_update(choose)
        boxes.on_update(lambda _: self.viewer.show_boxes(boxes.value))
        clear.on_click(lambda event: self.viewer.guarded(self.session.clear, event.client))

    def _build_selection(self) -> None:
        editor, session = self.session.editor, self.session
        self._selection = self.gui.add_folder("Selected")
        with self._selection:
            self._facts_of_selected = self.gui.add_markdown("")
            self._photo: Any = None
            self._named: tuple[int, str | None] | None = None
            with self.gui.add_form(None) as form:
                self._name = self.gui.add_text("name", "", hint="Enter renames")
                rename = self.gui.add_button("Rename")
            rename.on_click(lambda _: form.submit())
            self._actions(
                "instance",
                {
                    "Hide": lambda: editor.hide(session.chosen()),
                    "Merge": lambda: session.select(editor.merge(session.selected)),
                    "Split": lambda: editor.split(session.chosen()),
                    "Remove": lambda: editor.remove(session.chosen()),
                },
            )

        def rename_it(event: Any) -> None:
            self.viewer.guarded(lambda: editor.rename(session.chosen(), self._name.value), event.client, edited=True)

        form.on_submit(rename_it)

    def _actions(self, label: str, actions: dict[str, Callable[[], object]]) -> None:
        """A row of buttons, each an edit."""
        row = self.gui.add_button_group(label, tuple(actions))
        row.on_click(lambda event: self.viewer.guarded(actions[row.value], event.client, edited=True))

    def _build_history(self) -> None:
        session, editor = self.session, self.session.editor
        with self.gui.add_folder("Corrections"):
            self._actions("history", {"Undo": editor.undo, "Redo": editor.redo})
            self._actions("map", {"Show hidden": session.show_all})
            save = self.gui.add_button("Save into the map")
            save.on_click(lambda event: self.viewer.guarded(editor.save, event.client, edited=True))
            why = "another program replaced the map"
            self.renew = self.gui.add_button("Drop them, open the new map", visible=False, hint=why)
            self.renew.on_click(lambda event: self.viewer.guarded(session.reopen, event.client, edited=True))
            self._history = self.gui.add_markdown("")

    def _build_measure(self) -> None:
        session, guarded = self.session, self.viewer.guarded
        with self.gui.add_folder("Measure", expand_by_default=False):
            start = self.gui.add_button("Two points", hint="then click both ends of a length on the map")
            self._measured = self.gui.add_markdown("")
            metres = self.gui.add_number("true length (m)", 0.0, min=0.0, step=0.001)
            scale = self.gui.add_button("Set scale", hint="writes the map in metres, by this length")
        start.on_click(lambda event: guarded(session.measure, event.client))
        scale.on_click(lambda event: guarded(lambda: session.set_scale(metres.value), event.client, edited=True))

    def notify(self, client: Any, text: str) -> None:
        """Shows a notification in one browser, or in all when `client` is None."""
        receivers = [client] if client is not None else list(self.viewer.server.get_clients().values())
        for receiver in receivers:
            receiver.add_notification("perception", text, auto_close_seconds=8, color="orange")

    def refresh(self) -> None:
        """Updates all texts of the panel from the session's state."""
        session, editor = self.session, self.session.editor
        unit = "m" if editor.original.metric else "map units"
        count = sum(not is_removed(entry) for entry in editor.instances)
        shown = f" (shown: {self.viewer.detail})" if self.viewer.detail else ""
        self._facts.content = f"**{len(editor.ids):,} Gaussians{shown} · instances: {count}**"
        self._refresh_answer()
        photo = None
        if not session.selected:
            self._facts_of_selected.content = "Click a thing; shift-click adds another."
        elif len(session.selected) > 1:
            names = [escaped(session.name(editor.entry(i))) for i in session.selected]
            self._facts_of_selected.content = f"{len(names)} selected: {', '.join(names)}"
        else:
            entry = editor.entry(session.selected[0])
            sides = " × ".join(f"{side:.2f}" for side in entry["obb"]["extent"])
            self._facts_of_selected.content = (
                f"**{escaped(session.name(entry))}** (id {entry['id']})  \nconfidence {entry['score']:.2f} · "
                f"{entry['num_gaussians']} Gaussians  \nbox {sides} {unit}"
                + (f"  \n{len(entry['parts'])} parts; Split takes it apart" if entry.get("parts") else "")
                + (f"  \n{self._history_of(entry)}" if entry.get("state") else "")
                + (f"  \nprinted: {escaped(', '.join(printed_texts(entry)[:5]))}" if entry.get("texts") else "")
            )
            named = (entry["id"], entry.get("label"))
            if named != self._named:  # else keep what a user is typing there
                self._named = named
                self._name.value = entry.get("label") or ""
            photo, why = session.crop(entry["id"])
            self._facts_of_selected.content += f"  \n{escaped(why)}" if why else ""
        self._show_photo(photo)
        wanted = f"click end {len(session.ends) + 1} of 2" if session.measuring else session.length
        lines = [wanted, *frame_lines(editor.original.info), *session.notes]
        self._measured.content = "  \n".join(escaped(line) for line in lines)
        last = editor.history[-3:]
        unsaved = "unsaved changes" if editor.dirty else "all saved"
        self._history.content = f"*{unsaved}*" + "".join(f"  \n{escaped(what)}" for what in reversed(last))

    def _history_of(self, entry: dict[str, Any]) -> str:
        """What the visits record of an instance."""
        gmap = self.session.editor.original
        visits, newest = visits_of(gmap.info, len(gmap.views)), gmap.newest_visit
        found, seen = date_of(visits, since(entry)), date_of(visits, last_seen(entry, newest))
        return f"{entry['state']}; {'gone' if is_removed(entry) else 'here'} since {found}, last seen {seen}"

    def _refresh_answer(self) -> None:
        session = self.session
        for button in self._hit_buttons:
            button.remove()
        self._hit_buttons = []
        self._hits_folder.visible = bool(session.hits)
        if not session.question:
            self._answer.content = ""
            return
        answer = f"{len(session.hits)} found" if session.hits else "**not present**"
        entries = [session.editor.entry(hit.instance_id) for hit in session.gone]
        gone = [f"  \n{escaped(session.name(entry))}: {self._history_of(entry)}" for entry in entries]
        self._answer.content = f'"{escaped(session.question)}": {answer}' + "".join(gone)
        with self._hits_folder:
            for rank, hit in enumerate(session.hits, start=1):
                name = session.name(session.editor.entry(hit.instance_id))
                name = name if hit.part is None else f"part of {name}"
                button = self.gui.add_button(f"{rank}. {name} · {hit.score:.2f}")
                button.on_click(lambda event, hit=hit: self.viewer.guarded(lambda: session.show_hit(hit), event.client))
                self._hit_buttons.append(button)

    def _show_photo(self, picture: Any) -> None:
        if self._photo is not None:
            self._photo.remove()
            self._photo = None
        if picture is not None:
            with self._selection:
                self._photo = self.gui.add_image(picture, label="best photo", order=0)
