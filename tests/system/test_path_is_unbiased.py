"""The solver ``path`` against an independent delta tracker.

The reference is written in NumPy: float64, its own trilinear interpolation, one global majorant,
analog collisions, binary transmittance towards the sun, and each colour channel traced separately.
Only the radiance of escaping rays comes from Mitsuba.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("rgb")

SHAPE = (5, 4, 7)
SUN_DIRECTION = np.array([0.4, -1.0, 0.55]) / np.linalg.norm([0.4, -1.0, 0.55])
SUN_IRRADIANCE = np.array([1.5, 1.2, 1.0])
PATHS = 2048
SAMPLES = 2048


class DeltaTracker:
    """Compute the fluence of analog paths in a grey medium that fills the transformed unit cube.

    Each channel of the emitters is computed separately.
    """

    def __init__(self, sigma_t, albedo, to_world, sky, sun: np.ndarray, seed: int) -> None:
        self.sigma_t, self.albedo = np.float64(sigma_t), np.float64(albedo)
        self.to_local = np.linalg.inv(to_world)
        self.sky, self.sun = sky, sun
        self.rng = np.random.default_rng(seed)

    def irradiance(self, positions: np.ndarray) -> np.ndarray:
        """Return the fluence of order 0, of order 1, and of all higher orders, (3, n, channel).

        One path is traced per position (n, 3).
        """
        result = np.zeros((3, len(positions), len(self.sun)))
        alive, where = np.arange(len(positions)), positions
        order = 0
        while alive.size:
            sunlit, _ = self._fly(where, np.broadcast_to(-SUN_DIRECTION, where.shape))
            direction = self.rng.normal(size=where.shape)
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
            escaped, where = self._fly(where, direction)
            light = escaped[:, None] * 4 * np.pi * self.sky(direction) + sunlit[:, None] * self.sun
            result[min(order, 2), alive] += light
            # Absorption is sampled, so every path has the weight 1.
            survives = ~escaped
            survives[survives] &= self.rng.random(survives.sum()) < self._lookup(
                self.albedo, where[survives]
            )
            alive, where = alive[survives], where[survives]
            order += 1
        return result

    def _fly(self, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whether each ray leaves the medium without a collision, and where it collides."""
        majorant = self.sigma_t.max()
        position, flying = origin.copy(), np.ones(len(origin), bool)
        escaped = np.zeros(len(origin), bool)
        while flying.any():
            i = np.flatnonzero(flying)
            step = self.rng.exponential(1 / majorant, i.size)
            position[i] += step[:, None] * direction[i]
            local = position[i] @ self.to_local[:3, :3].T + self.to_local[:3, 3]
            outside = ((local < 0) | (local > 1)).any(axis=1)
            escaped[i[outside]] = True
            chance = self._lookup(self.sigma_t, position[i]) / majorant
            collides = ~outside & (self.rng.random(i.size) < chance)
            flying[i[outside | collides]] = False
        return escaped, position

    def _lookup(self, values: np.ndarray, position: np.ndarray) -> np.ndarray:
        local = position @ self.to_local[:3, :3].T + self.to_local[:3, 3]
        nx, ny, _nz = counts = np.array(values.shape)[::-1]
        u = np.clip(local * counts - 0.5, 0, counts - 1)
        low = np.minimum(u.astype(int), counts - 2)
        x, y, z = (u - low).T
        base = (low[:, 2] * ny + low[:, 1]) * nx + low[:, 0]
        total = 0
        for k, j, i in np.ndindex(2, 2, 2):
            share = (x if i else 1 - x) * (y if j else 1 - y) * (z if k else 1 - z)
            total = total + share * values.ravel()[base + (k * ny + j) * nx + i]
        return total


def voxel_centers(cache) -> np.ndarray:
    """Return the world positions (n, 3) of the cached voxels."""
    nz, ny, nx = cache.grid.shape
    z, y, x = np.unravel_index(np.array(cache.active), (nz, ny, nx))
    local = (np.stack([x, y, z], axis=1) + 0.5) / [nx, ny, nz]
    return local @ cache.grid.to_world[:3, :3].T + cache.grid.to_world[:3, 3]


def sky_image() -> np.ndarray:
    """Return an environment that is ten times brighter on one side than on the other, (8, 16,
    3).
    """
    v, u = np.meshgrid(np.linspace(0, np.pi, 8), np.linspace(0, 2 * np.pi, 16), indexing="ij")
    brightness = 0.1 + 0.5 * (1 + np.sin(v) * np.cos(u - 1)) ** 2 / 2
    return np.float32(brightness[..., None] * [1.0, 0.7, 0.4])


def coloured_medium(scenes, coloured: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return extinction from 0.1 to 3 and albedo from 0.4 to 0.98, (z, y, x, channel).

    The optical depth is 2 to 5 across.
    """
    channels = 3 if coloured else 1
    sigma_t = scenes.texture((*SHAPE, channels), 0.1, 3.0, 1)
    albedo = scenes.texture((*SHAPE, channels), 0.4, 0.98, 2)
    return sigma_t, albedo


@pytest.fixture(scope="module")
def measured():
    """Cache reference samples across max_depth: coloured -> per-channel mean and error of
    orders.
    """
    return {}


def reference(store, coloured, sigma_t, albedo, to_world, positions, environment):
    """Return means and standard errors (3, n, channel) up to order 0, up to order 1, and of all."""
    if coloured not in store:
        parts = []
        for k, channels in enumerate([[0], [1], [2]] if coloured else [[0, 1, 2]]):

            def sky(direction, channels=channels):
                interaction = mi.SurfaceInteraction3f()
                interaction.wi = -mi.Vector3f(*np.float32(direction.T))
                return np.float64(environment.eval(interaction)).T[:, channels]

            light = sky, SUN_IRRADIANCE[channels]
            paths = DeltaTracker(sigma_t[..., k], albedo[..., k], to_world, *light, seed=10 + k)
            orders = paths.irradiance(np.repeat(positions, PATHS, axis=0))
            orders = np.cumsum(orders.reshape(3, len(positions), PATHS, -1), axis=0)
            parts.append([orders.mean(axis=2), orders.std(axis=2, ddof=1) / np.sqrt(PATHS)])
        store[coloured] = [np.concatenate(part, axis=-1) for part in zip(*parts, strict=True)]
    return store[coloured]


# Single scattering in colour is part of what has more orders, and of the first statistics in grey.
@pytest.mark.parametrize(
    ("coloured", "max_depth"),
    [
        *(pytest.param(False, depth, id=f"grey-{depth}") for depth in (2, 3, -1)),
        *(pytest.param(True, depth, id=f"rgb-{depth}") for depth in (3, -1)),
        pytest.param(True, 2, id="rgb-2", marks=pytest.mark.slow),
    ],
)
def test_voxel_irradiance_is_unbiased(scenes, measured, coloured, max_depth):
    """The fluence at every voxel (about 250) passes Z-tests for each colour channel.

    The seeds are fixed; there are 6 cases x 3 channels. Each statistic would fail by chance with
    probability below 1e-4 per channel: |mean of Z| sqrt(n) < 4, the variance of Z within 4
    deviations of 1, |Z| < 5.2 everywhere, and the pooled mean within 4 standard errors, which are
    about 0.2 %: a bias of 1 % of the fluence fails.
    """
    sigma_t, albedo = coloured_medium(scenes, coloured)
    to_world = scenes.placement((2.4, 1.4, 1.8), turn=35, mirror=True)
    medium = scenes.medium(sigma_t, albedo, to_world)
    integrator = {
        "type": "irrcache",
        "max_depth": max_depth,
        "resolution": 9,
        "cache_spp": SAMPLES,
        "cache_seed": 3,
    }
    sun = {
        "type": "directional",
        "direction": SUN_DIRECTION.tolist(),
        "irradiance": {"type": "rgb", "value": SUN_IRRADIANCE.tolist()},
    }
    sky = {"type": "envmap", "bitmap": mi.Bitmap(sky_image())}
    scene = scenes.load(
        integrator,
        scenes.boundary(medium, to_world),
        size=4,
        emitter=sky,
        sun=sun,
        default_solver="path",
    )
    scene.integrator().prepare(scene)
    cache = scene.integrator().cache
    positions = voxel_centers(cache)
    assert len(positions) > 200
    means, errors = reference(
        measured, coloured, sigma_t, albedo, to_world, positions, scene.environment()
    )
    order = {2: 0, 3: 1, -1: 2}[max_depth]
    index = np.array(cache.active)
    mine = np.array(cache.irradiance, dtype=np.float64).reshape(-1, 3)[index]
    my_error = np.array(cache.standard_error, dtype=np.float64).reshape(-1, 3)[index]
    n = len(positions)
    for c in range(3):
        theirs, their_error = means[order][:, c], errors[order][:, c]
        z = (mine[:, c] - theirs) / np.hypot(my_error[:, c], their_error)
        pooled = np.sqrt((my_error[:, c] ** 2 + their_error**2).sum()) / theirs.sum()
        difference = mine[:, c].sum() / theirs.sum() - 1
        assert pooled < 2.2e-3
        assert abs(difference) < 4 * pooled
        assert abs(z.mean()) * np.sqrt(n) < 4
        assert abs((z**2).mean() - 1) < 4 * np.sqrt(2 / n)
        assert np.abs(z).max() < 5.2
