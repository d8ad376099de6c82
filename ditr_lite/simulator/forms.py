"""Shapes of the room scenes: vessels with an outline of their own, and what is in, on and around them.

A form is a dict: ``points`` (N, 2) radius and height in units of the vessel's height, from the centre of the foot
outwards and up; ``square`` the exponent of its cross section (2 is a circle, 6 nearly a square); ``ribs`` number and
depth of flutes; ``wall`` the thickness of its wall, 0 for a single sheet; ``segments`` those of a full turn. It is
centred on height 0.
"""

from typing import Any

import numpy as np

from .scenes import VESSELS, smoothed

SEGMENTS = 96, 48  # of a full turn: facets of about two pixels on a vessel that fills the picture, and on smaller ones
OUTLINES = VESSELS | {  # and shapes that look like what stands on real tables
    "straight_glass": [(0, 0), (0.27, 0), (0.28, 0.5), (0.29, 1)],
    "shot_glass": [(0, 0), (0.36, 0), (0.42, 0.5), (0.48, 1)],
    "beer_glass": [(0, 0), (0.17, 0), (0.19, 0.3), (0.24, 0.75), (0.22, 1)],
    "pet_bottle": [
        *((0, 0), (0.17, 0.0), (0.18, 0.05), (0.18, 0.3), (0.155, 0.4), (0.18, 0.5)),
        *((0.17, 0.7), (0.07, 0.9), (0.07, 1)),
    ],
    "dish": [(0, 0), (0.9, 0), (1.6, 0.4), (2.1, 1)],
    "flute": [(0, 0), (0.16, 0), (0.03, 0.04), (0.02, 0.33), (0.12, 0.5), (0.14, 0.75), (0.13, 1)],
    "carafe": [(0, 0), (0.34, 0), (0.36, 0.3), (0.14, 0.62), (0.14, 0.85), (0.22, 1)],
}
SLENDER = ("bottle", "pet_bottle", "flask", "carafe")  # have a neck that a cap closes


def vessel(rng: np.random.Generator, family: str, wall: float, close: bool = True) -> dict[str, Any]:
    """Draw a form of a family: widths 0.78 to 1.3 times its own, corners cut, a square or fluted body at times."""
    points = np.array(OUTLINES[family], dtype=float) - (0, 0.5)
    points[:, 0] *= rng.uniform(0.85, 1.2) * (1 + rng.uniform(-0.08, 0.08, len(points)))
    points = smoothed(points)
    if family == "pet_bottle" and rng.random() < 0.7:
        points = _waved(points, int(rng.integers(6, 14)), rng.uniform(0.01, 0.03))
    square = (
        float(rng.uniform(4, 9)) if family in ("bottle", "jar", "pet_bottle", "vase") and rng.random() < 0.25 else 2.0
    )
    fluted = family not in ("wine_glass", "flute") and rng.random() < 0.15
    ribs = (int(rng.integers(8, 25)), float(rng.uniform(0.01, 0.04))) if fluted else (0, 0.0)
    return {"points": points, "square": square, "ribs": ribs, "wall": wall, "segments": SEGMENTS[not close]}


def _waved(points: np.ndarray, waves: int, depth: float) -> np.ndarray:
    """Return an outline with rings pressed into it, as the bodies of thin plastic bottles have."""
    along = np.r_[0, np.cumsum(np.hypot(*np.diff(points, axis=0).T))]
    fine = np.linspace(0, along[-1], 90)
    radius, height = (np.interp(fine, along, points[:, k]) for k in (0, 1))
    body = (height > -0.47) & (height < 0.25)
    return np.stack([radius * (1 + depth * body * np.sin(2 * np.pi * waves * height)), height], axis=1)


def radius_at(form: dict[str, Any], height: np.ndarray) -> np.ndarray:
    """Return the outer radius of a form at heights in [-0.5, 0.5]."""
    points = form["points"]
    upright = np.maximum.accumulate(points[:, 1] + 1e-6 * np.arange(len(points)))
    return np.interp(height, upright, points[:, 0])


def liquid(form: dict[str, Any], level: float) -> dict[str, Any]:
    """Return what fills a vessel up to a share ``level`` of its height.

    A film of air lies between it and an upright wall. Where a thick wall bends in, at the foot above all, it reaches
    some way into the glass.
    """
    gap = form["wall"] + 0.012
    top = level - 0.5
    heights = np.linspace(-0.5 + gap, top, 24)
    radius = np.maximum(radius_at(form, heights) - gap, 0.004)
    points = np.concatenate([[(0, heights[0])], np.c_[radius, heights], [(0, top)]])
    return {**form, "points": points, "wall": 0.0}


def cap(form: dict[str, Any], height: float) -> dict[str, Any]:
    """Return a closure over the mouth: ``height`` as a share of the vessel's."""
    low, high = 0.5 - height, 0.512
    radius = radius_at(form, np.array([0.5]))[0] * 1.12 + 0.004
    points = np.array([(radius, low), (radius, high), (0, high)])
    return turned(points)


def turned(points: np.ndarray) -> dict[str, Any]:
    """Return the plain round form of an outline."""
    return {"points": points, "square": 2.0, "ribs": (0, 0.0), "wall": 0.0, "segments": SEGMENTS[1]}


def sleeve(form: dict[str, Any], low: float, high: float) -> dict[str, Any]:
    """Return a sleeve that hugs the body between two shares of its height."""
    heights = np.linspace(low, high, 12) - 0.5
    return {**form, "points": np.c_[radius_at(form, heights) * 1.012 + 0.002, heights], "wall": 0.0}


def half_size(form: dict[str, Any]) -> np.ndarray:
    """Return (3,) half the bounding box."""
    radius = form["points"][:, 0].max() * (1 + form["ribs"][1])
    return np.array([radius, radius, np.abs(form["points"][:, 1]).max()])


def ball() -> dict[str, Any]:
    """Return a sphere of radius 1."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 33)
    return {**turned(np.stack([np.cos(angle), np.sin(angle)], axis=1)), "segments": SEGMENTS[0]}


def rod() -> dict[str, Any]:
    """Return a cylinder of radius 1 from -1 to 1."""
    return {**turned(np.array([(0, -1), (1, -1), (1, 1), (0, 1)], dtype=float)), "segments": SEGMENTS[0]}


def _creased(points: np.ndarray) -> np.ndarray:
    """Return an outline with its sharp corners doubled, so that shading does not round them off."""
    step = np.diff(points, axis=0)
    direction = np.arctan2(step[:, 1], step[:, 0])
    bend = np.abs((np.diff(direction) + np.pi) % (2 * np.pi) - np.pi)
    return np.repeat(points, np.r_[1, 1 + (bend > np.deg2rad(40)), 1].astype(int), axis=0)


def smooth_normals(vertices: np.ndarray, faces: np.ndarray, segments: int) -> np.ndarray:
    """Return (N, 3) unit normals of a turned mesh, averaged over the faces at each vertex and over its seam."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(total, faces[:, k], across)
    rings = total.reshape(-1, segments + 1, 3)
    rings[:, 0] = rings[:, -1] = rings[:, 0] + rings[:, -1]
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.maximum(length, 1e-20), (0.0, 0.0, 1.0))


def mesh(form: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices (N, 3), faces (M, 3) and texture coordinates (N, 2) of a form, normals pointing out."""
    points = form["points"]
    if form["wall"]:
        points = walled(points, form["wall"])
    points = _creased(points)
    count = form["segments"]
    angle = np.linspace(0, 2 * np.pi, count + 1)
    power = form["square"]
    around = (np.abs(np.cos(angle)) ** power + np.abs(np.sin(angle)) ** power) ** (-1 / power)
    around = (
        around / around.max() * (1.1 if power > 2 else 1.0) * (1 + form["ribs"][1] * np.cos(form["ribs"][0] * angle))
    )
    return lathe(points, around)


def walled(points: np.ndarray, wall: float) -> np.ndarray:
    """Return the outline (2 N, 2) of a vessel with an inside: the outer one (N, 2), moved inwards and up by ``wall``.

    An upright wall is that thick. On the slope of a stem glass's foot the inside comes out of the body, by less than
    ``wall``.
    """
    inner = np.c_[np.maximum(points[:, 0] - wall, 0), np.minimum(points[:, 1] + wall, points[-1, 1])]
    return np.concatenate([points, inner[::-1]])


def lathe(points: np.ndarray, around: np.ndarray, repeats: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Turn an outline about the z axis.

    Args:
        points: (N, 2) radius and height.
        around: (K + 1,) what the radius is multiplied by at equal angles of a full turn, the first and the last alike.
        repeats: how many pairs of textures lie around it.

    Returns:
        vertices (N (K + 1), 3), faces (2 (N - 1) K, 3), texture coordinates (N (K + 1), 2).
    """
    count = len(around) - 1
    angle = np.linspace(0, 2 * np.pi, count + 1)
    radius, height = points[:, :1] * around, points[:, 1:]
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), height + 0 * angle], axis=-1)
    along = np.linspace(0, 1, len(points))[:, None] + 0 * angle
    uv = np.stack([repeats * angle / np.pi + 0 * along, along], axis=-1)
    rows, columns = np.mgrid[: len(points) - 1, :count]
    a = rows * (count + 1) + columns
    b, c, d = a + 1, a + count + 2, a + count + 1
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return vertices.reshape(-1, 3), faces, uv.reshape(-1, 2)
