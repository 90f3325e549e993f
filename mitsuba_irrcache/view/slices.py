"""Slices of a volume's values as opaque planes in the image, at their places in the medium."""

from __future__ import annotations

from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.render.camera import ClosedFormCameraRays, RayResult
from mitsuba_irrcache.volumes.data import VolumeData

#: Position of a plane that no ray reaches.
NOWHERE = 1e30


def slice_index(share: float, count: int) -> int:
    """Return the number of the slice at a share of the way along an axis with ``count`` of them."""
    return round(share * (count - 1))


def slice_values(
    volume: VolumeData, axis: int, share: float, limits: tuple[float, float]
) -> np.ndarray:
    """Return a slice in grey levels in [0, 1], float32, black and white at the ``limits``.

    ``axis`` is 0, 1 or 2 for x, y or z. Rows are along the last of the other axes, columns along
    the first.
    """
    number, (low, high) = 2 - axis, limits
    found = volume.values.take(slice_index(share, volume.values.shape[number]), axis=number)
    grey = (np.asarray(found, dtype=np.float32) - low) / max(high - low, 1e-30)
    return np.clip(grey, 0, 1).astype(np.float32)


class Slices:
    """Planes across x, y and z at ``shares`` of the volume's sides, None for no plane.

    ``limits`` are the values that are black and white.
    """

    def __init__(
        self,
        volume: VolumeData,
        shares: tuple[float | None, float | None, float | None],
        limits: tuple[float, float],
    ) -> None:
        self._to_local = np.linalg.inv(volume.to_world)
        self._places, self._images = [], []
        for axis, share in enumerate(shares):
            count, image = volume.size[axis], np.zeros((1, 1), np.float32)
            if share is not None:
                image = slice_values(volume, axis, share, limits)
            place = NOWHERE if share is None else (slice_index(share, count) + 0.5) / count
            self._places.append(place)
            self._images.append(image)

    @cached_property
    def _textures(self) -> list[mi.Texture2f]:
        # Three of them, whichever are shown, so that one kernel serves all.
        wrap = dr.WrapMode.Clamp
        tensors = [mi.TensorXf(image[..., None]) for image in self._images]
        return [mi.Texture2f(tensor, use_accel=False, wrap_mode=wrap) for tensor in tensors]

    def intersect(self, ray: mi.Ray3f) -> tuple[mi.Float, mi.Float]:
        """Return the distance of the first plane along ``ray``, infinite for none, and its grey
        level, as it is displayed.
        """
        origin, direction = self._local(ray.o, 1.0), self._local(ray.d, 0.0)
        distance, grey = mi.Float(dr.inf), mi.Float(0)
        for axis, texture in enumerate(self._textures):
            place = dr.opaque(mi.Float, self._places[axis])
            t = (place - origin[axis]) / direction[axis]
            u, v = (
                dr.fma(t, direction[other], origin[other]) for other in range(3) if other != axis
            )
            hit = (t > 0) & (t < distance) & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
            (found,) = texture.eval(mi.Point2f(u, v), hit)
            distance, grey = dr.select(hit, t, distance), dr.select(hit, found, grey)
        return distance, grey

    def _local(self, vector: mi.Vector3f, w: float) -> list[mi.Float]:
        """Transform a point (``w`` = 1) or a direction (0) to the unit cube of the volume."""
        rows = self._to_local[:3]
        return [
            sum(dr.opaque(mi.Float, float(row[k])) * vector[k] for k in range(3))
            + dr.opaque(mi.Float, float(w * row[3]))
            for row in rows
        ]


class SlicedCameraRays(ClosedFormCameraRays):
    """Camera rays that end at slices."""

    def __init__(self, whole: ClosedFormCameraRays, slices: Slices) -> None:
        """Copy the camera rays without slices."""
        vars(self).update(vars(whole))
        self._slices = slices
        #: of the rays that are being traced
        self._end = mi.Float(dr.inf)
        #: what the slices add to the display, through the medium in front of them
        self.shown = mi.Color3f(0)

    def sample(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        medium: mi.Medium | None,
        active: mi.Bool,
    ) -> RayResult:
        """Compute the radiance in front of the slices, and `shown`."""
        self._end, grey = self._slices.intersect(ray)
        result, ends = super().sample(scene, sampler, ray, medium, active), self._end < dr.inf
        curved = dr.select(grey <= 0.04045, grey / 12.92, ((grey + 0.055) / 1.055) ** 2.4)
        through = result.transmittance
        through = mi.Color3f(through.x) if mi.is_monochromatic else mi.Color3f(through)
        self.shown = dr.select(ends, through * curved, 0)
        result.alpha = dr.select(ends, 1, result.alpha)
        if self.shows_emitters:
            result.background -= dr.select(ends, result.transmittance, 0)  # see `background`
        return result

    def background(
        self, scene: mi.Scene, ray: mi.Ray3f, medium: mi.Medium | None, active: mi.Bool
    ) -> tuple[bool, mi.Spectrum, mi.Float, mi.Float]:
        """Return what is behind the medium, 1 where a ray ends before: no ray march may end early
        because nothing is there.
        """
        visible, radiance, through, straight = super().background(scene, ray, medium, active)
        ends = self._end < dr.inf
        radiance, through = dr.select(ends, 1, radiance), dr.select(ends, 1, through)
        return visible, radiance, through, dr.select(ends, 0, straight)

    def blur(
        self, ray: mi.Ray3f, *transmittances: mi.Spectrum, u: mi.Point2f, active: mi.Bool
    ) -> list[tuple[mi.Vector3f, mi.Float]]:
        """Return the directions as `ClosedFormCameraRays.blur`, without weight for rays that end
        at slices.
        """
        return super().blur(ray, *transmittances, u=u, active=active & (self._end == dr.inf))

    def span(self, ray: mi.Ray3f, medium: mi.Medium | None) -> tuple[mi.Bool, mi.Float, mi.Float]:
        """Return whether rays intersect the medium before they end, and where."""
        hit, near, far = super().span(ray, medium)
        far = dr.minimum(far, self._end)
        return hit & (near < far), near, far
