"""What one window saves: views, animations, and where the files go."""

from __future__ import annotations

import io
import tempfile
import threading
import zipfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import viser

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.view.animation import MOST_FRAMES, along_path, turntable, write_frames
from mitsuba_irrcache.view.camera import Camera
from mitsuba_irrcache.view.editing import Editing
from mitsuba_irrcache.view.saving import checked_name, render_command, save_view
from mitsuba_irrcache.view.session import Session
from mitsuba_irrcache.view.window import View


class Cancelled(Exception):  # noqa: N818 (not an error: the user asked for it)
    """Raised to end an export."""


class ExportPanel:
    """Save the view that ``current_view`` returns, and animations that begin with it.

    Files are saved in ``folder``, or downloaded by the browser of the ``client`` if it is None.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        session: Session,
        folder: Path | None,
        editing: Editing,
        current_view: Callable[[], View | None],
    ) -> None:
        self._client, self._session, self._folder = client, session, folder
        self._current_view = current_view
        self._gone, self._cancelled = False, threading.Event()
        gui = client.gui
        with gui.add_folder("Save", order=6, expand_by_default=False):
            self._name = gui.add_text("name", "view")
            self._cache = gui.add_checkbox("with the cache", False)
            self._save = gui.add_button(
                "save view" if self._folder is not None else "download view",
                hint="PNG, EXR with layers, and a scene for irrcache render",
            )
            self._saved = gui.add_markdown("PNG, EXR with layers, Mitsuba scene")
        with gui.add_folder("Animation", order=7, expand_by_default=False):
            self._path: list[Camera] = []
            self._frames = gui.add_number("frames", 72, min=1, max=MOST_FRAMES, step=1)
            self._rate = gui.add_number("frames per second", 24, min=1, max=120, step=1)
            turn = gui.add_button("export turntable", hint="a full circle about the upward axis")
            self._knots = gui.add_markdown("")
            add = gui.add_button("add this view to the path", color="gray")
            clear = gui.add_button("clear the path", color="gray")
            export = gui.add_button("export path", hint="a smooth path through the views")
            self._cancel = gui.add_button("cancel", color="red", visible=False)
            self._exported = gui.add_markdown(_what_is_exported())
        turn.on_click(lambda _: editing.submit("turn", self._export_turntable))
        add.on_click(lambda _: editing.submit("add", self._add_knot))
        clear.on_click(lambda _: editing.submit("clear", self._clear_path))
        export.on_click(lambda _: editing.submit("path", self._export_path))
        self._cancel.on_click(lambda _: self._cancelled.set())
        self._save.on_click(lambda _: editing.submit("save", self._keep))

    def close(self) -> None:
        """Stop exports after the browser has disconnected."""
        self._gone = True

    def _keep(self) -> None:
        name = checked_name(self._name.value)
        view = self._current_view()
        if view is None:
            raise IrrcacheError("there is nothing to save before the first image.")
        self._saved.content = "saving ..."
        command = f"; the same image by\n```\n{render_command(name, view.look)}\n```"
        try:
            if self._folder is not None:
                self._folder.mkdir(exist_ok=True)
                files = save_view(self._session, view, self._folder, name, self._cache.value)
                self._saved.content = "saved " + ", ".join(f.name for f in files) + command
            else:
                self._download(view, name)
                self._saved.content = f"downloaded {name}.zip{command}"
        except Exception:
            self._saved.content = ""
            raise

    def _add_knot(self) -> None:
        view = self._current_view()
        if view is not None:
            self._path.append(view.camera)
            self._knots.content = f"views of the path: {len(self._path)}"

    def _clear_path(self) -> None:
        self._path.clear()
        self._knots.content = ""

    def _export_turntable(self) -> None:
        view = self._current_view()
        if view is not None:
            self._export("turntable", turntable(view.camera, int(self._frames.value)))

    def _export_path(self) -> None:
        self._export("path", along_path(self._path, int(self._frames.value)))

    def _export(self, name: str, cameras: list[Camera]) -> None:
        """Write the frames of an animation to the folder, or let the browser download them."""
        name = f"{checked_name(self._name.value)}-{name}"
        view = self._current_view()
        if view is None:
            return

        def report_progress(done: int) -> None:
            self._exported.content = f"frame {done} of {len(cameras)} ..."
            if self._gone:
                raise IrrcacheError("the window was closed during an export.")
            if self._cancelled.is_set():
                raise Cancelled

        self._cancelled.clear()
        self._cancel.visible = True
        try:
            self._write(name, view, cameras, report_progress)
        except Cancelled:
            written = "" if self._folder is None else f"; its frames are in {name}"
            self._exported.content = f"the export was cancelled{written}"
        except Exception:
            self._exported.content = ""
            raise
        finally:
            self._cancel.visible = False

    def _write(
        self, name: str, view: View, cameras: list[Camera], report_progress: Callable[[int], None]
    ) -> None:
        report_progress(0)
        rate = float(self._rate.value)
        if self._folder is not None:
            files = write_frames(
                self._session, view, cameras, self._folder / name, rate, report_progress
            )
            self._exported.content = f"saved {len(files)} files in {name}"
            return
        with tempfile.TemporaryDirectory() as folder:
            files = write_frames(self._session, view, cameras, Path(folder), rate, report_progress)
            self._offer(name, files)
        self._exported.content = f"downloaded {name}.zip"

    def _download(self, view: View, name: str) -> None:
        with tempfile.TemporaryDirectory() as folder:
            files = save_view(self._session, view, Path(folder), name, self._cache.value)
            self._offer(name, files)

    def _offer(self, name: str, files: list[Path]) -> None:
        """Let the browser download an archive."""
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            for file in files:
                archive.write(file, file.name)
        self._client.send_file_download(f"{name}.zip", packed.getvalue(), save_immediately=True)


def _what_is_exported() -> str:
    if find_spec("imageio_ffmpeg"):
        return "PNG frames, and a video (MP4)"
    return "PNG frames; a video, too, after `pip install imageio-ffmpeg`"
