"""Camera paths, and their frames as images and as a video."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.images import write_pixels
from mitsuba_irrcache.view.camera import Camera
from mitsuba_irrcache.view.picture import Samples
from mitsuba_irrcache.view.session import Session
from mitsuba_irrcache.view.window import SAMPLES, View

#: Most frames of an animation.
MOST_FRAMES = 3000
#: Called with the number of frames that are done.
Progress = Callable[[int], None]


def turntable(camera: Camera, frames: int) -> list[Camera]:
    """Return cameras on a full circle about the target, around the upward axis."""
    up = np.array(camera.up) / np.linalg.norm(camera.up)
    target = np.array(camera.target)
    arm = np.array(camera.position) - target
    along = np.dot(arm, up) * up
    side, across = arm - along, np.cross(up, arm)
    angles = 2 * np.pi * np.arange(frames) / frames
    positions = target + along + np.outer(np.cos(angles), side) + np.outer(np.sin(angles), across)
    return [replace(camera, position=tuple(p.tolist())) for p in positions]


def along_path(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """Return cameras on a smooth path through the given ones, which are its ends and knots.

    Raises:
        IrrcacheError: there are fewer than two.
    """
    if len(cameras) < 2:
        raise IrrcacheError(f"the camera path has {len(cameras)} views; add at least two.")
    knots = np.array([[*c.position, *c.target, *c.up, c.fov] for c in cameras])
    at = np.linspace(0, len(knots) - 1, frames)
    numbers = _catmull_rom(knots, at)
    return [
        Camera(tuple(n[:3].tolist()), tuple(n[3:6].tolist()), tuple(n[6:9].tolist()), float(n[9]))
        for n in numbers
    ]


def _catmull_rom(knots: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Interpolate rows of ``knots`` at positions in [0, n - 1] by a Catmull-Rom spline."""
    ends = np.concatenate([2 * knots[:1] - knots[1:2], knots, 2 * knots[-1:] - knots[-2:-1]])
    first = np.minimum(at.astype(int), len(knots) - 2)
    t = (at - first)[:, None]
    p = [ends[first + k] for k in range(4)]
    return 0.5 * (
        2 * p[1]
        + (p[2] - p[0]) * t
        + (2 * p[0] - 5 * p[1] + 4 * p[2] - p[3]) * t**2
        + (3 * p[1] - p[0] - 3 * p[2] + p[3]) * t**3
    )


def write_frames(
    session: Session,
    view: View,
    cameras: Sequence[Camera],
    folder: Path,
    rate: float,
    progress: Progress,
) -> list[Path]:
    """Write ``0000.png`` ... to ``folder``, and ``video.mp4`` if imageio-ffmpeg is installed.

    The frames look like ``view``, with as many samples as an image at rest has; ``rate`` is in
    frames per second. The session goes on displaying images meanwhile.
    """
    if not 0 < len(cameras) <= MOST_FRAMES:
        raise IrrcacheError(f"{len(cameras)} frames were requested; give 1 to {MOST_FRAMES}.")
    folder.mkdir(parents=True, exist_ok=True)
    # Video codecs need even sizes.
    view = replace(view, size=tuple(max(n - n % 2, 2) for n in view.size))
    files = []
    with _video(folder / "video.mp4", view.size, rate) as send:
        for number, pixels in enumerate(_frames(session, view, cameras)):
            files.append(folder / f"{number:04}.png")
            write_pixels(files[-1], pixels)
            send(pixels)
            progress(number + 1)
    video = folder / "video.mp4"
    return [*files, video] if video.exists() else files


def _frames(session: Session, view: View, cameras: Sequence[Camera]) -> Iterator[np.ndarray]:
    """Yield the pixels of each frame; other views can be displayed between its samples."""
    look = view.look
    with session.reserved():
        for camera in cameras:

            def begin(camera: Camera = camera) -> Samples:
                seen = session.light.snapshot(look.layered, look.with_error)
                return Samples(seen, camera, view.size, slices=look.slices)

            samples = session.call(begin)
            while samples.count < SAMPLES:
                session.call(lambda samples=samples: samples.advance(SAMPLES))
            yield session.call(lambda s=samples, c=camera: s.picture(look, session.extent(c)))


@contextmanager
def _video(
    path: Path, size: tuple[int, int], rate: float
) -> Iterator[Callable[[np.ndarray], None]]:
    """Encode the frames that are sent as H.264, if imageio-ffmpeg is installed."""
    try:
        import imageio_ffmpeg
    except ImportError:
        yield lambda pixels: None
        return
    writer = imageio_ffmpeg.write_frames(str(path), size, fps=rate, macro_block_size=2, quality=8)
    writer.send(None)
    try:
        yield lambda pixels: writer.send(np.ascontiguousarray(pixels).tobytes())
    finally:
        writer.close()
