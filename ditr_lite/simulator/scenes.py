"""Random table-top scenes as plain data: what stands where, made of what, seen from where. No renderer is needed here.

A scene is drawn from one integer seed. Training and validation scenes share shape families and material ranges; the
test split draws every transparent or reflective object from families and ranges that training never saw.
Lengths are metres; the table is the plane z = 0 of a right-handed world with z up.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..data import OPAQUE, REFLECTIVE, SPLITS, TRANSPARENT

# Vessel outlines as (radius, height) points from the centre of the foot to the rim, in units of the vessel's height.
VESSELS = {
    "tumbler": [(0, 0), (0.30, 0), (0.33, 0.5), (0.37, 1)],
    "bottle": [(0, 0), (0.22, 0), (0.22, 0.55), (0.17, 0.68), (0.08, 0.78), (0.08, 1)],
    "bowl": [(0, 0), (0.45, 0), (0.85, 0.35), (1.05, 1)],
    "jar": [(0, 0), (0.42, 0.02), (0.46, 0.1), (0.46, 0.75), (0.36, 0.86), (0.36, 1)],
    "vase": [(0, 0), (0.20, 0), (0.30, 0.35), (0.14, 0.75), (0.20, 1)],
    "wine_glass": [(0, 0), (0.28, 0), (0.03, 0.06), (0.03, 0.4), (0.25, 0.6), (0.28, 0.8), (0.22, 1)],
    "flask": [(0, 0), (0.42, 0), (0.42, 0.08), (0.12, 0.66), (0.12, 1)],
    "goblet": [(0, 0), (0.30, 0.0), (0.08, 0.15), (0.10, 0.35), (0.40, 0.55), (0.44, 1)],
}
# Cross sections of solids pulled straight up: (corners, inner over outer radius; 1 is a regular polygon).
PRISMS = {
    "hexagon": (6, 1.0),
    "cylinder": (48, 1.0),
    "disc": (48, 1.0),
    "round_mirror": (48, 1.0),
    "cross": (4, 0.45),
    "star": (5, 0.5),
    "flower": (8, 0.75),
}
TRAIN_FAMILIES = {
    TRANSPARENT: ("tumbler", "bottle", "bowl", "jar", "vase", "sphere", "box", "hexagon", "cylinder"),
    REFLECTIVE: ("bowl", "jar", "tumbler", "sphere", "box", "cylinder", "plate_mirror"),
    OPAQUE: ("box", "sphere", "cylinder", "hexagon", "bowl", "tumbler", "slab", "disc"),
}
TEST_FAMILIES = {
    TRANSPARENT: ("wine_glass", "flask", "goblet", "star", "flower", "ellipsoid"),
    REFLECTIVE: ("flask", "goblet", "cross", "ellipsoid", "round_mirror"),
    OPAQUE: TRAIN_FAMILIES[OPAQUE],
}


@dataclass(frozen=True)
class Thing:
    """One object: ``family`` names its shape, ``scale`` (3,) stretches it, ``pose`` (4, 4) puts it on the table."""

    family: str
    kind: int  # OPAQUE, TRANSPARENT or REFLECTIVE
    scale: np.ndarray
    pose: np.ndarray
    material: dict[str, Any]
    form: dict[str, Any] | None = None  # a shape of its own, see forms.py; None is the family's


@dataclass(frozen=True)
class Scene:
    """Everything that the renderer needs; ``camera_pose`` (4, 4) takes RGB camera coordinates to the world."""

    seed: int
    things: list[Thing]
    table: dict[str, Any]
    walls: list[dict[str, Any]]
    camera_pose: np.ndarray
    lights: list[dict[str, Any]]
    ambient: float
    style: dict[str, Any] = field(default_factory=dict)
    parts: list[dict[str, Any]] | None = None  # of a room, see rooms.py: boxes and planes instead of table and walls
    surrounding: dict[str, Any] | None = None  # name, turn and level of a photographed panorama


def random_scene(seed: int, split: str = "train") -> Scene:
    """Draw the scene of one seed. The same seed and split give the same scene.

    Args:
        seed: any non-negative integer.
        split: ``train``, ``val`` or ``test``; only ``test`` uses the held-out families and materials,
            and only there nothing is smaller than 0.05 of the distance (elsewhere 0.035).

    Raises:
        ValueError: for an unknown split.
    """
    if split not in SPLITS:
        raise ValueError(f"unknown split {split!r}; choose one of {', '.join(SPLITS)}")
    rng = np.random.default_rng([seed, SPLITS.index(split)])
    families = TEST_FAMILIES if split == "test" else TRAIN_FAMILIES
    steep = rng.random() < 0.75  # looking down at small things on a table, as the real frames mostly do
    elevation = np.deg2rad(rng.uniform(45, 80) if steep else rng.uniform(22, 45))
    distance = rng.uniform(0.45, 0.85) if steep else rng.uniform(0.5, 1.0)
    target = np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(0, 0.04)])
    eye = target + distance * np.array([0, -np.cos(elevation), np.sin(elevation)])
    size = distance * rng.uniform(0.05 if split == "test" else 0.035, 0.14)  # real frames show small things too
    things = _place(rng, families, size, spread=distance * rng.uniform(0.26, 0.40), held_out=split == "test")
    return Scene(
        seed=seed,
        things=things,
        table=_opaque(rng, table=True),
        walls=_walls(rng, steep),
        camera_pose=look_at(eye, target, roll=rng.normal(0, 0.05)),
        lights=_lights(rng),
        ambient=float(rng.uniform(0.15, 0.7)),
        style={"elevation_deg": float(np.rad2deg(elevation)), "distance_m": float(distance)},
    )


def look_at(eye: np.ndarray, target: np.ndarray, roll: float = 0.0) -> np.ndarray:
    """Return (4, 4) world-from-camera for a camera with x right, y down, z forward that looks from eye to target."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([c * right + s * down, -s * right + c * down, forward], axis=1)
    pose[:3, 3] = eye
    return pose


def profile(family: str) -> np.ndarray:
    """Return the (N, 2) outline (radius, height) of a vessel or a sphere, centred on height 0.

    A vessel's outline is smoothed by corner cutting, so that it bends like blown glass.
    """
    if family in ("sphere", "ellipsoid"):
        angle = np.linspace(-np.pi / 2, np.pi / 2, 25)
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return smoothed(np.array(VESSELS[family], dtype=float) - (0, 0.5))


def smoothed(points: np.ndarray) -> np.ndarray:
    """Return an outline (N, 2) with its corners cut twice: each by points at 1/4 and 3/4 of its edges (Chaikin)."""
    for _ in range(2):
        cut = np.stack([0.75 * points[:-1] + 0.25 * points[1:], 0.25 * points[:-1] + 0.75 * points[1:]], axis=1)
        points = np.concatenate([points[:1], cut.reshape(-1, 2), points[-1:]])
    return points


def cross_section(family: str) -> np.ndarray:
    """Return a prism's (N, 2) outline of unit outer radius, counter-clockwise."""
    corners, inner = PRISMS[family]
    count = corners if inner == 1 else 2 * corners
    radius = np.where(np.arange(count) % 2 == 0, 1.0, inner)
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def half_extent(family: str) -> np.ndarray:
    """Return (3,) half the bounding box of the unit shape; every unit shape is centred on the origin."""
    if family in VESSELS:
        radius = np.array(VESSELS[family])[:, 0].max()
        return np.array([radius, radius, 0.5])
    return np.ones(3)  # spheres, cubes, cylinders and prisms all fill the cube [-1, 1]^3


def _place(rng, families, size: float, spread: float, held_out: bool) -> list[Thing]:
    counts = {TRANSPARENT: rng.integers(1, 7), REFLECTIVE: rng.integers(0, 3), OPAQUE: rng.integers(1, 5)}
    kinds = [kind for kind, count in counts.items() for _ in range(count)]
    crowd = rng.uniform(0.55, 1.0)  # below 1 objects may touch and overlap in the picture
    things, taken = [], []
    for kind in kinds:
        family = str(rng.choice(families[kind]))
        scale = _scale(rng, family, size)
        rotation, height = _stand(rng, family, scale)
        radius = 0.8 * np.hypot(*(np.abs(rotation) @ (half_extent(family) * scale))[:2])
        for _ in range(30):
            spot = rng.uniform(-spread, spread, 2) * (1.25, 1.0)
            if all(np.hypot(*(spot - other)) > crowd * (radius + r) for other, r in taken):
                break
        else:
            continue  # the table is full
        taken.append((spot, radius))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, (*spot, height)
        things.append(Thing(family, kind, scale, pose, _material(rng, kind, family, held_out)))
    return things


def _scale(rng, family: str, size: float) -> np.ndarray:
    size = size * rng.uniform(0.65, 1.35)
    if family in VESSELS:
        height = size * (0.7 if family == "bowl" else 1.5)
        return np.array([1, 1, 1.0]) * height * rng.uniform(0.85, 1.15)
    if family in ("slab", "disc"):
        return np.array([size * rng.uniform(0.6, 1.2), size * rng.uniform(0.5, 1.0), rng.uniform(0.004, 0.02)])
    if family in ("plate_mirror", "round_mirror"):
        return np.array([size * rng.uniform(0.5, 0.9), size * rng.uniform(0.5, 0.9), rng.uniform(0.002, 0.006)])
    if family == "sphere":
        return np.full(3, size * rng.uniform(0.3, 0.6))
    return size * rng.uniform(0.3, 0.6, 3) * (1, 1, rng.uniform(0.3, 1.3))


def _stand(rng, family: str, scale: np.ndarray) -> tuple[np.ndarray, float]:
    """Return a rotation and the height of the centre that leaves the object resting on the table."""
    turn = rng.uniform(0, 2 * np.pi)
    yaw = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    lying = rng.random() < (0.6 if family in VESSELS and family != "bowl" else 0.2)
    tilt = np.pi / 2 if lying else 0.0
    if "mirror" in family:
        tilt = rng.uniform(0, 0.35) if rng.random() < 0.6 else rng.uniform(1.1, 1.45)  # flat, or leaning upright
    pitch = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    rotation = yaw @ pitch
    return rotation, float((np.abs(rotation) @ (half_extent(family) * scale))[2])


def _material(rng, kind: int, family: str, held_out: bool) -> dict[str, Any]:
    if kind == OPAQUE:
        return _opaque(rng)
    if kind == TRANSPARENT:
        ior = rng.choice([rng.uniform(1.33, 1.42), rng.uniform(1.6, 1.75)]) if held_out else rng.uniform(1.45, 1.56)
        hollow = family in VESSELS or (family in ("cylinder", "box") and rng.random() < 0.4)
        tint = 1 - rng.uniform(0, 0.45 if held_out else 0.25) * rng.random(3)
        thin = hollow and rng.random() < 0.75
        # The pattern crosses at least two walls on its way in and out: clear film to frosted or coated plastic.
        kept = float(rng.uniform(0.35, 0.98))
        return {"type": "thin_glass" if thin else "glass", "ior": float(ior), "tint": tint, "infrared": kept}
    metals = ("Cu", "Au") if held_out else ("Ag", "Al", "Cr")
    smooth = rng.random() < 0.6 or "mirror" in family
    rough = rng.uniform(0.2, 0.3) if held_out else rng.uniform(0.05, 0.2)
    return {"type": "mirror" if smooth else "brushed", "metal": str(rng.choice(metals)), "roughness": float(rough)}


def _opaque(rng, table: bool = False) -> dict[str, Any]:
    kinds = ("plain", "noise", "stripes", "checker", "wood", "speckle", "print")
    weights = np.array([0.2, 0.25, 0.07, 0.06, 0.2, 0.12, 0.1] if table else [0.35, 0.2, 0.1, 0.05, 0.1, 0.1, 0.1])
    return {
        "type": "plastic" if rng.random() < (0.15 if table else 0.25) else "matt",
        "texture": str(rng.choice(kinds, p=weights / weights.sum())),
        "texture_seed": int(rng.integers(2**31)),
        "colours": _colours(rng),
        "roughness": float(rng.uniform(0.05, 0.3)),
        "infrared": float(np.exp(rng.uniform(np.log(0.06), np.log(0.8)))),  # black rubber to white paper
    }


def _colours(rng) -> np.ndarray:
    """Return (2, 3) linear RGB: a base colour and a companion, from greyish to vivid, dark to bright."""
    base = rng.beta(1.2, 1.2, 3) * rng.uniform(0.2, 0.95)
    base = base.mean() + (base - base.mean()) * rng.uniform(0.1, 1.2)
    other = np.clip(base * rng.uniform(0.4, 1.8) + rng.normal(0, 0.08, 3), 0.02, 0.95)
    return np.stack([np.clip(base, 0.02, 0.95), other])


def _walls(rng, steep: bool) -> list[dict[str, Any]]:
    walls = []
    if rng.random() < (0.5 if steep else 0.9):  # behind
        walls.append({"y": float(rng.uniform(0.3, 0.9)), "turn": float(rng.normal(0, 0.3)), **_opaque(rng)})
    if rng.random() < 0.25:  # at one side
        side = rng.choice([-1, 1])
        walls.append({"y": float(rng.uniform(0.3, 0.6)), "turn": float(side * rng.uniform(1.2, 1.7)), **_opaque(rng)})
    return walls


def _lights(rng) -> list[dict[str, Any]]:
    lights = []
    for _ in range(rng.integers(1, 3)):
        where = np.array([rng.uniform(-1.2, 1.2), rng.uniform(-1.2, 0.8), rng.uniform(1.2, 2.0)])
        warm = np.array([1, rng.uniform(0.8, 1.0), rng.uniform(0.6, 1.1)])
        lights.append({"at": where, "size": float(rng.uniform(0.1, 0.4)), "power": warm * rng.uniform(2, 9)})
    return lights
