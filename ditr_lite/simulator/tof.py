"""The time-of-flight camera: it times light instead of matching pictures, so glass and corners fool it differently.

Light needs longer through glass (n times as long for the same way), so what stands behind a glass reads too far by
(n - 1) times the glass crossed. A pixel whose beam meets two surfaces reads between them. Light that comes back over a
second surface came a longer way, so corners read too far. And little light back is no reading at all. Everything is
computed from rendered truth; nothing is matched.

Paper: Sec. V-F names the L515 and shows no frame of it; the model is ours.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ..camera import Camera
from ..data import OPAQUE, TRANSPARENT
from .render import build_scene, mitsuba, render, truth
from .scenes import Scene

SHEET_M = 0.002  # glass in one wall that the scene keeps as a sheet without thickness
WALL_PASS = 0.92  # share of light left after a glass surface: twice the loss of clean glass (Fresnel head-on: 0.96)
EVENTS = 16  # surfaces followed along one ray
LOBE_DEG, LOBE_GAIN = 3.0, 40.0  # a glass surface met head-on throws light back into a narrow lobe
ALBEDO = 0.5  # of a typical surface; fixes the scale of the returned light


@dataclass(frozen=True)
class TimeOfFlight:
    """How such a camera reads. Amplitude 1 is what a white wall 1 m away returns."""

    noise_m: float = 0.0015  # standard deviation at amplitude 1; grows as the root of what is missing
    floor: float = 0.04  # amplitude below which there is no reading
    footprint: float = 0.6  # standard deviation of the beam, in pixels
    mixed_m: float = 0.012  # spread of the distances inside one beam that the camera notices ...
    noticed: float = 0.6  # ... and the share of such readings that it then drops


def mix(distance: np.ndarray, amplitude: np.ndarray, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the amplitude-weighted mean distance inside each beam, and the spread of distances there, both (h, w) m.

    Args:
        distance: (h, w) metres; where amplitude is 0 it plays no part.
        amplitude: (h, w) returned light, >= 0.
        sigma: standard deviation of the beam, in pixels.
    """
    weight, first, second = (
        cv2.GaussianBlur(a.astype(np.float64), (3, 3), sigma)
        for a in (amplitude, amplitude * distance, amplitude * distance**2)
    )
    weight = np.maximum(weight, 1e-12)
    mean = first / weight
    return mean, np.sqrt(np.maximum(second / weight - mean**2, 0))


def noise(amplitude: np.ndarray, settings: TimeOfFlight, rng: np.random.Generator) -> np.ndarray:
    """Return noise (h, w) in metres: its deviation grows as the root of what light is missing, down to the floor."""
    return settings.noise_m * rng.normal(size=amplitude.shape) / np.sqrt(np.maximum(amplitude, settings.floor))


def multipath(points: np.ndarray, normals: np.ndarray, camera: Camera, albedo: float = ALBEDO) -> np.ndarray:
    """Return how much too far each pixel reads because light also arrives over a second surface, (h, w) metres.

    One bounce: lamp, patch Q, patch P, camera. The lamp stands at the camera, so a patch that fills the solid angle dw
    of the camera receives dw of light whatever its distance and slant; it passes on albedo cos cos / (pi |PQ|^2) of it.
    The detour is (|Q| + |QP| - |P|) / 2, and the reading is the mean of the ways, weighted by their light.

    Args:
        points: (h, w, 3) metres, in the camera's own frame.
        normals: (h, w, 3) unit, towards the camera; 0 where there is no surface.
        camera: of that size.
        albedo: share of light that surfaces throw back.
    """
    coarse, step = 4, 8
    at_p, at_q = (np.s_[k // 2 :: k, k // 2 :: k] for k in (coarse, step))  # the middles of patches
    p, n = points[at_p].reshape(-1, 3), normals[at_p].reshape(-1, 3)
    q, m = points[at_q].reshape(-1, 3), normals[at_q].reshape(-1, 3)
    ray = q / np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-9)
    solid = step**2 / (camera.fx * camera.fy) * ray[:, 2] ** 3  # of one patch, seen by the camera
    between = q[None] - p[:, None]  # (P, Q, 3)
    apart = np.linalg.norm(between, axis=2)
    facing_p = np.maximum((between * n[:, None]).sum(2), 0) / np.maximum(apart, 1e-9)
    facing_q = np.maximum(-(between * m[None]).sum(2), 0) / np.maximum(apart, 1e-9)
    far_p, far_q = np.linalg.norm(p, axis=1), np.linalg.norm(q, axis=1)
    direct = np.maximum(-(p * n).sum(1) / np.maximum(far_p, 1e-9), 0.05) / np.maximum(far_p, 1e-3) ** 2
    share = albedo * solid * facing_p * facing_q / (np.pi * np.maximum(apart, 0.02) ** 2) / direct[:, None]
    detour = np.maximum(far_q[None] + apart - far_p[:, None], 0) / 2
    bias = (share * detour).sum(1) / (1 + share.sum(1))
    small = bias.reshape(points[at_p].shape[:2]).astype(np.float32)
    rows, columns = ((np.arange(count, dtype=np.float32) - coarse // 2) / coarse for count in points.shape[:2])
    where = np.meshgrid(columns, rows)  # of every pixel in ``small``; resizing would shift what a middle was asked for
    return cv2.remap(small, *where, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def surface_normals(points: np.ndarray) -> np.ndarray:
    """Return (h, w, 3) unit normals, towards the camera at the origin, from the points' neighbours, at jumps too."""
    across, down = np.gradient(points, axis=1), np.gradient(points, axis=0)
    normal = np.cross(across, down)
    length = np.linalg.norm(normal, axis=2, keepdims=True)
    normal = np.where(length > 0, normal / np.maximum(length, 1e-12), 0)
    return np.where((normal * points).sum(2, keepdims=True) > 0, -normal, normal)


def follow(loaded: Any, scene: Scene, origin: np.ndarray, direction: np.ndarray) -> tuple[float, float, int, float]:
    """Follow one ray straight through glass and off mirrors to the first surface that throws light back.

    Args:
        loaded: the Mitsuba scene.
        scene: what it was made from.
        origin: (3,) world.
        direction: (3,) unit.

    Returns:
        the way in metres and the delay in glass in metres, both to that surface (0, 0 where there is none); the number
        of glass surfaces crossed; the cosine at the first surface.
    """
    mi = mitsuba()
    way, late, walls, inside, first = 0.0, 0.0, 0, 1.0, 0.0
    for event in range(EVENTS):
        hit = loaded.ray_intersect(mi.Ray3f(origin.tolist(), direction.tolist()))
        if not hit.is_valid():
            return 0.0, 0.0, walls, first
        step, normal = float(hit.t), np.array(hit.n)
        cosine = float(normal @ direction)
        first = abs(cosine) if event == 0 else first
        way, late = way + step, late + (inside - 1) * step
        name = hit.shape.id()
        material = scene.things[int(name.split("_")[1]) - 1].material if name.startswith("thing_") else {"type": ""}
        origin = origin + step * direction
        if material["type"] == "thin_glass":
            late += (material["ior"] - 1) * SHEET_M / max(abs(cosine), 0.2)
            walls += 2
        elif material["type"] == "glass":
            inside, walls = (material["ior"] if cosine < 0 else 1.0), walls + 1
        elif material["type"] == "mirror":
            direction = direction - 2 * cosine * normal
        else:
            return way, late, walls, first
        origin = origin + 1e-5 * direction
    return 0.0, 0.0, walls, first


def measure_flight(
    scene: Scene, camera: Camera, pose: np.ndarray, settings: TimeOfFlight, paths: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what the camera reads, in its own view.

    Args:
        scene: what it looks at.
        camera: its intrinsics.
        pose: (4, 4) world from camera.
        settings: how it reads.
        paths: of the renderer, per pixel.
        seed: of renderer and noise.

    Returns:
        (h, w) float32 metres along z, 0 = missing; (h, w) bool, readings that the camera notices to be mixed and drops;
        (h, w) float32 true z.
    """
    rng = np.random.default_rng([seed, 11])
    lit = build_scene(scene, pose, rng, slide=np.ones((8, 8)))  # a lamp beside the lens instead of dots
    points, depth, ids = truth(lit, camera, pose, seed)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    seen = depth > 0
    way = np.linalg.norm(local, axis=2) * seen
    normals = surface_normals(local) * seen[..., None]
    cosine = np.maximum(-(normals * local).sum(2) / np.maximum(way, 1e-6), 0.05)
    kinds = np.array([OPAQUE, *(thing.kind for thing in scene.things)], np.uint8)[ids]
    shiny = np.isin(ids, [i + 1 for i, t in enumerate(scene.things) if t.material["type"] == "mirror"])

    radiance = render(lit, camera, pose, paths, seed).mean(axis=2)
    matt = seen & (kinds == OPAQUE)
    scale = float(np.median((radiance * way**2 / cosine)[matt])) / ALBEDO if matt.any() else 1.0
    amplitude = np.where(seen, radiance / max(scale, 1e-9), 0)
    distance = way + multipath(local, normals, camera) * seen
    for v, u in np.argwhere(seen & ((kinds == TRANSPARENT) | shiny)):
        ray = (points[v, u] - pose[:3, 3]) / way[v, u]
        back, late, walls, head_on = follow(lit, scene, pose[:3, 3], ray)
        through = ALBEDO * WALL_PASS ** (2 * walls) / max(back, 1e-3) ** 2 if back else 0.0
        lobe = np.exp(-0.5 * (np.rad2deg(np.arccos(min(head_on, 1.0))) / LOBE_DEG) ** 2)
        front = 0.0 if shiny[v, u] else (1 - WALL_PASS) / 2 * LOBE_GAIN * lobe / way[v, u] ** 2
        amplitude[v, u] = through + front
        if amplitude[v, u] > 0:
            distance[v, u] = (through * (back + late) + front * way[v, u]) / amplitude[v, u]

    reading, spread = mix(distance, amplitude, settings.footprint)
    reading += noise(amplitude, settings, rng)
    kept = seen & (amplitude >= settings.floor)
    z = np.where(kept, reading * depth / np.maximum(way, 1e-6), 0).astype(np.float32)
    dropped = kept & (spread > settings.mixed_m) & (rng.random(way.shape) < settings.noticed)
    return z, dropped, depth
