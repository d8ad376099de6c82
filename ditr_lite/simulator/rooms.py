"""Room scenes: things on bounded tables, floors, shelves, in bins and corners, in rooms that go on behind them.

The second kind of scene. A scene is drawn from one integer seed; ``rooms_train`` and ``rooms_val`` share shapes,
materials, surroundings and photographs, ``rooms`` has others. Lengths are metres; what things stand on is the plane
z = 0 of a right-handed world with z up, and the camera looks along +y.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..data import OPAQUE, REFLECTIVE, ROOM_SPLITS, TRANSPARENT
from . import forms, textures
from .render import vertices_of
from .scenes import Scene, Thing, look_at

PLACES = {"table": 0.42, "floor": 0.13, "corner": 0.15, "bin": 0.08, "shelf": 0.10, "landscape": 0.12}
EMPTY = {"landscape": 0.5}  # share of scenes without a transparent or reflective thing; elsewhere EMPTY_ELSEWHERE
EMPTY_ELSEWHERE = 0.07
TRANSPARENT_FAMILIES = (
    *("tumbler", "straight_glass", "shot_glass", "beer_glass", "bottle", "pet_bottle", "pet_bottle", "jar", "vase"),
    *("tumbler", "straight_glass", "bottle", "pet_bottle", "flute", "flute", "jar", "bowl", "dish"),
    *("pane", "sphere", "box", "hexagon", "cylinder", "plate"),
)
HELD_OUT_TRANSPARENT = (
    *("wine_glass", "goblet", "flask", "carafe", "wine_glass", "goblet", "carafe", "flask"),
    *("star", "flower", "ellipsoid", "pane", "plate"),
)
REFLECTIVE_FAMILIES = ("bowl", "dish", "tumbler", "jar", "sphere", "cylinder", "plate_mirror", "stand_mirror", "tool")
HELD_OUT_REFLECTIVE = ("goblet", "carafe", "ellipsoid", "cross", "round_mirror", "stand_mirror", "tool")
ROUND = {"sphere": forms.ball(), "ellipsoid": forms.ball(), "cylinder": forms.rod(), "round_mirror": forms.rod()}


@dataclass
class Framing:
    """How a scene is seen: ``size`` is a thing's typical height as a share of ``distance`` (m)."""

    place: str
    distance: float
    elevation: float  # radians above the horizon
    roll: float
    size: float
    close: bool
    held_out: bool
    empty: bool


@dataclass
class Support:
    """What things stand on: half extents of the usable area about ``centre`` (x, y), and the parts around it."""

    half: np.ndarray
    centre: np.ndarray
    floor: float  # height of the room's floor, at most 0
    parts: list[dict[str, Any]] = field(default_factory=list)
    back: float | None = None  # y of a wall that stands right behind


def room_scene(seed: int, split: str = "rooms_train") -> Scene:
    """Draw the room scene of one seed. The same seed and split give the same scene.

    Args:
        seed: any non-negative integer.
        split: ``rooms_train``, ``rooms_val`` or ``rooms``; only the last has the held-out shapes and surroundings.

    Raises:
        ValueError: for an unknown split.
    """
    if split not in ROOM_SPLITS:
        raise ValueError(f"unknown split {split!r}; choose one of {', '.join(ROOM_SPLITS)}")
    rng = np.random.default_rng([seed, 100 + ROOM_SPLITS.index(split)])
    view = _view(rng, held_out=split == "rooms")
    target = view.distance * np.array([*rng.uniform(-0.06, 0.06, 2), 0.0])
    target[2] = rng.uniform(0.1, 0.6) * view.size * view.distance
    eye = target + view.distance * np.array([0, -np.cos(view.elevation), np.sin(view.elevation)])
    support = SUPPORTS[view.place](rng, view)
    parts = support.parts + _room(rng, view, support)
    things = [thing for group in _place(rng, view, support) for thing in group]
    names = textures.HELD_OUT_SURROUNDINGS if view.held_out else textures.SURROUNDINGS
    level = float(np.exp(rng.uniform(np.log(0.3), np.log(1.2))))
    place = {"name": str(rng.choice(names)), "turn": float(rng.random()), "level": level}
    return Scene(
        seed=seed,
        things=things,
        table={},
        walls=[],
        camera_pose=look_at(eye, target, roll=view.roll),
        lights=_lights(rng, eye, support.floor),
        ambient=level,
        style={
            "place": view.place,
            "elevation_deg": float(np.rad2deg(view.elevation)),
            "roll_deg": float(np.rad2deg(view.roll)),
            "distance_m": float(view.distance),
            "size_share": float(view.size),
            "close": view.close,
            "empty": view.empty,
            "surrounding": place,
        },
        parts=parts,
        surrounding=place,
    )


def _view(rng, held_out: bool) -> Framing:
    place = str(rng.choice(list(PLACES), p=np.array(list(PLACES.values())) / sum(PLACES.values())))
    empty = rng.random() < EMPTY.get(place, EMPTY_ELSEWHERE)
    close = rng.random() < 0.38 and place != "landscape" and not empty
    low, high = ((0.3, 1.0), (0.1, 0.3), (1.0, 2.0))[rng.choice(3, p=[0.66, 0.14, 0.20])]
    if place == "landscape":
        low, high = 1.0, 3.0
    elif place == "floor":
        low = max(low, 0.3)
        high = max(high, 0.9)
    distance = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    degrees = {
        "table": rng.triangular(12, 38, 80),
        "floor": rng.triangular(15, 40, 85),
        "corner": rng.triangular(10, 25, 65),
        "bin": rng.uniform(45, 85),
        "shelf": rng.uniform(3, 28),
        "landscape": rng.uniform(3, 18),
    }[place]
    share = np.exp(rng.uniform(np.log(0.2), np.log(0.5)) if close else rng.uniform(np.log(0.06), np.log(0.25)))
    size = float(np.clip(share * distance, 0.012, 0.32)) / distance
    roll = rng.uniform(-np.pi, np.pi) if rng.random() < 0.15 else rng.normal(0, 0.06)
    return Framing(place, distance, float(np.deg2rad(degrees)), float(roll), size, bool(close), held_out, bool(empty))


# ----- what things stand on -------------------------------------------------------------------------------------


def box(low, high, look: dict[str, Any], turn: float = 0.0) -> dict[str, Any]:
    """Return a part: an upright box between two corners, turned about the world's z axis."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    pose = np.diag([*((high - low) / 2), 1.0])
    pose[:3, 3] = (low + high) / 2
    return {"shape": "cube", "pose": _turn(turn) @ pose, **look}


def _turn(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    pose = np.eye(4)
    pose[:2, :2] = [[c, -s], [s, c]]
    return pose


def _table(rng, view: Framing) -> Support:
    d = view.distance
    half = np.maximum(d * np.array([rng.uniform(0.3, 1.1), rng.uniform(0.25, 0.9)]), 0.5 * view.size * d + 0.02)
    centre = np.array([rng.uniform(-0.35, 0.35), rng.uniform(-0.1, 0.5)]) * half
    thick, floor = rng.uniform(0.015, 0.05), -rng.uniform(0.35, 1.0)
    turn = rng.normal(0, 0.25)
    look = surface(rng, view, "table")
    at = np.r_[centre, 0.0]
    parts = [box(at - np.r_[half, thick], at + np.r_[half, 0], look, turn)]
    if rng.random() < 0.7:
        wide = 0.02 + 0.03 * rng.random()
        legs = surface(rng, view, "furniture")
        for sx in (-1, 1):
            for sy in (-1, 1):
                foot = centre + (half - wide) * (sx, sy)
                parts.append(box([*(foot - wide), floor], [*(foot + wide), -thick - 0.001], legs, turn))
    return Support(0.92 * half, centre, floor, parts)


def _floor(rng, view: Framing) -> Support:
    wall = view.distance * rng.uniform(0.5, 2.5) if rng.random() < 0.5 else None
    return Support(np.full(2, 0.6 * view.distance), np.zeros(2), 0.0, back=wall)


def _corner(rng, view: Framing) -> Support:
    """A table or counter that reaches to a wall behind, and mostly to one at its side."""
    d = view.distance
    back = d * rng.uniform(0.12, 0.7)
    side = rng.choice([-1, 1]) if rng.random() < 0.7 else 0
    reach = d * rng.uniform(0.25, 0.6)
    turn = rng.uniform(0, 0.5) * (side or 1)
    front = d * rng.uniform(0.3, 1.2)
    low, high = np.array([-1.5, -front, -0.04]), np.array([1.5, back, 0.0])
    if side > 0:
        high[0] = reach
    elif side < 0:
        low[0] = -reach
    parts = [box(low, high, surface(rng, view, "table"), turn)]
    wall = surface(rng, view, "wall")
    tall = rng.uniform(1.0, 2.0) if rng.random() < 0.7 else d * rng.uniform(0.3, 0.8)
    parts.append(box([low[0] - 0.02, back + 0.001, -0.6], [high[0] + 0.02, back + 0.03, tall], wall, turn))
    if side:
        if rng.random() < 0.4:
            wall = surface(rng, view, "wall")
        x = np.sort([side * (reach + 0.001), side * (reach + 0.03)])
        parts.append(box([x[0], -front, -0.6], [x[1], back, tall], wall, turn))
    half = np.array([min(0.8 * reach, 0.5 * d), min(0.9 * back, 0.5 * d)])
    return Support(half, np.zeros(2), -rng.uniform(0.6, 0.95), parts, back)


def _bin(rng, view: Framing) -> Support:
    d = view.distance
    half = np.array([rng.uniform(0.25, 0.5), rng.uniform(0.2, 0.42)]) * d
    tall = np.clip(rng.uniform(0.4, 1.2) * view.size, 0.04, 0.22) * d
    thick = 0.006 * d + 0.002
    turn = rng.normal(0, 0.15)
    look = surface(rng, view, "bin")
    x, y = half
    parts = [box([-x, -y, -thick], [x, y, 0], look, turn)]
    for sign in (-1, 1):
        ends = np.sort([sign * (x + 0.0005), sign * (x + thick)])
        parts.append(box([ends[0], -y - thick, -thick], [ends[1], y + thick, tall], look, turn))
        ends = np.sort([sign * (y + 0.0005), sign * (y + thick)])
        parts.append(box([-x, ends[0], -thick], [x, ends[1], tall], look, turn))
    if rng.random() < 0.6:  # on a table
        wide = half + d * rng.uniform(0.1, 0.6, 2)
        under = np.r_[wide, 0.03 + thick + 0.001]
        parts.append(box(-under, [*wide, -thick - 0.001], surface(rng, view, "table"), turn + rng.normal(0, 0.1)))
    return Support(0.85 * half, np.zeros(2), -rng.uniform(0.3, 0.9), parts)


def _shelf(rng, view: Framing) -> Support:
    d = view.distance
    x, y = rng.uniform(0.35, 0.9) * d, rng.uniform(0.15, 0.35) * d
    gap = max(view.size * d * rng.uniform(1.5, 2.4), 0.3 * d)
    look = surface(rng, view, "furniture")
    back = look if rng.random() < 0.5 else surface(rng, view, "wall")
    thick = 0.02 * d + 0.005
    parts = [box([-x, y + 0.001, -1.5 * gap], [x, y + 0.01, 2 * gap], back)] if rng.random() < 0.8 else []
    for level in (-1, 0, 1, 2):
        parts.append(box([-x, -y, level * gap - thick], [x, y, level * gap], look))
    for sign in (-1, 1):
        ends = np.sort([sign * (x + 0.0005), sign * (x + thick)])
        parts.append(box([ends[0], -y, -1.5 * gap], [ends[1], y + 0.01, 2 * gap], look))
    for level in (-1, 1):
        parts += _books(rng, view, x, y, level * gap, gap - thick)
    turned = _turn(rng.normal(0, 0.25))
    parts = [{**part, "pose": turned @ part["pose"]} for part in parts]
    return Support(np.array([0.85 * x, 0.75 * y]), np.zeros(2), -max(rng.uniform(0.4, 1.2), 2 * gap), parts)


def _books(rng, view: Framing, x: float, y: float, base: float, room: float) -> list[dict[str, Any]]:
    parts, at = [], -x + 0.01
    while at < x - 0.1 * room and len(parts) < 14:
        wide = room * rng.uniform(0.08, 0.5)
        tall = room * rng.uniform(0.4, 0.9)
        deep = y * rng.uniform(0.2, 0.9)
        if rng.random() < 0.8:
            look = surface(rng, view, "goods")
            parts.append(box([at, -deep, base + 0.001], [min(at + wide, x - 0.002), y - 0.003, base + tall], look))
        at += wide + 0.004
    return parts


def _landscape(rng, view: Framing) -> Support:
    if rng.random() < 0.5:  # nothing near: a corridor, a hall, an office
        eye = rng.uniform(0.6, 1.6)
        half = np.array([0.5, 0.3]) * view.distance
        floor = -eye + view.distance * np.sin(view.elevation)
        # What stands there stands at height 0, so over a lower floor it floats: see the data card
        return Support(half, np.zeros(2), 0.0 if floor > -0.15 else floor)
    support = _table(rng, view)
    half, centre = support.half / 0.92, support.centre
    if rng.random() < 0.5:  # a cabinet
        low, high = [*(centre - half), support.floor], [*(centre + half), -0.03]
        support.parts = [
            box(low, high, surface(rng, view, "furniture")),
            box([*(centre - half), -0.029], [*(centre + half), 0.0], surface(rng, view, "table")),
        ]
    return support


SUPPORTS = {
    "table": _table,
    "floor": _floor,
    "corner": _corner,
    "bin": _bin,
    "shelf": _shelf,
    "landscape": _landscape,
}


# ----- the room behind ------------------------------------------------------------------------------------------


def _room(rng, view: Framing, support: Support) -> list[dict[str, Any]]:
    """Return floor, a wall behind (0.2 to 9 m), walls beside (0.8 to 4 m), a ceiling at times, and furniture."""
    floor = support.floor - 0.0015
    ground = np.diag([9.0, 9.0, 1.0, 1.0])
    ground[2, 3] = floor
    parts = [{"shape": "rectangle", "pose": ground, **surface(rng, view, "floor")}]
    corridor = view.place == "landscape" and rng.random() < 0.4
    back = float(np.exp(rng.uniform(np.log(1.5), np.log(6.0)))) * (1.5 if corridor else 1.0)
    if support.back is not None:
        back = max(support.back + 0.05, 0.2)
    walls = surface(rng, view, "wall")
    tall = floor + rng.uniform(2.2, 3.2)
    if rng.random() < 0.85:
        look = surface(rng, view, "view") if rng.random() < 0.2 else walls
        parts.append(box([-9, back, floor - 0.1], [9, back + 0.05, tall], look))
        for _ in range(rng.integers(0, 4)):
            parts.append(_fixture(rng, view, back, floor, tall))
    beside = []
    for sign in (-1, 1):
        if rng.random() < (0.95 if corridor else 0.45):
            at = rng.uniform(0.8, 1.4) if corridor else rng.uniform(1.3, 4.0)
            beside.append(at)
            x = np.sort([sign * at, sign * (at + 0.05)])
            parts.append(box([x[0], -4, floor - 0.1], [x[1], back - 0.001, tall], walls))
    if rng.random() < 0.08 or (corridor and rng.random() < 0.3):
        parts.append(box([-9, -2, tall + 0.001], [9, back, tall + 0.05], surface(rng, view, "ceiling")))
    clear = 0.35 * view.distance + 0.3  # of the support
    for _ in range(rng.integers(0, 7) if back > clear + 0.4 else 0):
        parts += _furniture(rng, view, clear, back, floor, min([3.0, *beside]))
    yaw = np.clip(rng.normal(0, 0.2), -0.4, 0.4) if view.place != "corner" else 0.0
    turned = _turn(yaw if support.floor < 0 or support.back is None else 0.3 * yaw)
    return [{**part, "pose": turned @ part["pose"]} for part in parts]


def _fixture(rng, view: Framing, back: float, floor: float, tall: float) -> dict[str, Any]:
    """Return a door, a window frame, a poster or a board on the wall behind."""
    wide = rng.uniform(0.2, 0.9)
    x = rng.uniform(-0.5, 0.5) * (back + 1)
    low = floor if rng.random() < 0.3 else floor + rng.uniform(0.4, 1.2)
    high = min(low + rng.uniform(0.4, 2.0), tall - 0.05)
    thick = rng.uniform(0.005, 0.04)
    look = surface(rng, view, "poster" if rng.random() < 0.6 else "furniture")
    return box([x - wide, back - thick, low], [x + wide, back - 0.002, max(high, low + 0.2)], look)


def _furniture(rng, view: Framing, clear: float, back: float, floor: float, side: float) -> list[dict[str, Any]]:
    """Return a cupboard, a chest, a carton or a table in the room behind."""
    wide, deep, tall = rng.uniform(0.15, 0.7), rng.uniform(0.1, 0.35), rng.uniform(0.2, 1.6)
    y = rng.uniform(clear + deep, max(back - deep - 0.01, clear + deep + 0.01))
    x = rng.uniform(-1, 1) * min(0.5 * (y + view.distance) + 0.3, max(side - wide, 0.1))
    look = surface(rng, view, "furniture" if rng.random() < 0.6 else "goods")
    turn = rng.normal(0, 0.1) if rng.random() < 0.7 else rng.uniform(-0.7, 0.7)
    place = np.eye(4)
    place[:2, 3] = x, y
    if rng.random() < 0.3:  # open below
        legs = surface(rng, view, "furniture")
        tall = min(tall, 0.8)
        parts = [box([-wide, -deep, floor + tall - 0.03], [wide, deep, floor + tall], look, turn)]
        for sx in (-1, 1):
            edge = np.sort([sx * (wide - 0.04), sx * (wide - 0.001)])
            parts.append(box([edge[0], -deep + 0.01, floor], [edge[1], deep - 0.01, floor + tall - 0.031], legs, turn))
    else:
        parts = [box([-wide, -deep, floor], [wide, deep, floor + tall], look, turn)]
    return [{**part, "pose": place @ part["pose"]} for part in parts]


def _lights(rng, eye: np.ndarray, floor: float) -> list[dict[str, Any]]:
    """Return one lamp, or none, well away from the camera's axis; the surroundings light the rest."""
    if rng.random() < 0.35:
        return []
    where = np.array([rng.uniform(-1.5, 1.5), rng.uniform(-1.5, 0.8), max(floor + rng.uniform(1.9, 2.2), eye[2] + 0.3)])
    warm = np.array([1, rng.uniform(0.75, 1.0), rng.uniform(0.5, 1.1)])
    return [{"at": where, "size": float(rng.uniform(0.1, 0.5)), "power": warm * rng.uniform(2, 9)}]


# ----- what things are made of ----------------------------------------------------------------------------------

ROLES = {  # textures and their weights, chance of gloss, chance of a dark look
    "table": (
        {"plain": 3, "noise": 2, "planks": 5, "cloth": 2, "speckle": 1, "tiles": 1, "photo": 2, "wood": 1},
        0.4,
        0.2,
    ),
    "floor": ({"plain": 2, "planks": 4, "tiles": 3, "noise": 2, "cloth": 1, "photo": 1}, 0.4, 0.2),
    "wall": ({"plain": 6, "noise": 2, "planks": 2, "tiles": 1, "photo": 1}, 0.1, 0.1),
    "ceiling": ({"plain": 3, "tiles": 1}, 0.0, 0.0),
    "furniture": ({"plain": 4, "planks": 3, "noise": 1, "cloth": 1}, 0.3, 0.25),
    "goods": ({"packaging": 4, "plain": 2, "noise": 1}, 0.3, 0.15),
    "poster": ({"photo": 3, "packaging": 1, "view": 2, "print": 1}, 0.1, 0.0),
    "view": ({"view": 1}, 0.0, 0.0),
    "bin": ({"plain": 5, "noise": 1}, 0.4, 0.2),
    "thing": ({"plain": 5, "noise": 2, "packaging": 2, "stripes": 1, "print": 1, "speckle": 1, "photo": 1}, 0.45, 0.2),
    "carton": ({"packaging": 4, "print": 1, "photo": 1, "plain": 1}, 0.4, 0.1),
    "cloth": ({"cloth": 3, "noise": 2, "checker": 1, "stripes": 1}, 0.0, 0.15),
}


def surface(rng, view: Framing, role: str) -> dict[str, Any]:
    """Draw the look of an opaque surface of one of ``ROLES``."""
    weights, gloss, dark = ROLES[role]
    kind = str(rng.choice(list(weights), p=np.array(list(weights.values())) / sum(weights.values())))
    if kind == "photo" and role in ("floor", "wall", "table"):
        kind = "immunohistochemistry" if view.held_out else str(rng.choice(textures.GROUNDS))
    if kind == "photo":
        kind = str(rng.choice(textures.HELD_OUT_PHOTOGRAPHS if view.held_out else textures.PHOTOGRAPHS))
    if kind == "view":
        names = textures.HELD_OUT_SURROUNDINGS if view.held_out else textures.SURROUNDINGS
        kind = f"view:{rng.choice(names)}"
    is_dark = rng.random() < dark
    large = {"floor": (6, 20), "wall": (3, 9), "ceiling": (6, 12), "table": (0.7, 2.5)}.get(role, (1, 1))
    whole = role in ("poster", "view")
    infrared = rng.uniform(0.02, 0.08) if is_dark else np.exp(rng.uniform(np.log(0.12), np.log(0.8)))
    return {
        "type": "plastic" if rng.random() < gloss else "matt",
        "texture": kind,
        "texture_seed": int(rng.integers(2**31)),
        "colours": colour_pair(rng, role, is_dark),
        "roughness": float(np.exp(rng.uniform(np.log(0.03), np.log(0.3)))),
        "infrared": float(infrared),
        "repeat": 1.0 if whole else float(np.exp(rng.uniform(*np.log(large)))),
    }


def colour_pair(rng, role: str, dark: bool) -> np.ndarray:
    """Return (2, 3) linear RGB, base and companion: white, grey, wooden or vivid as the role has them."""
    tones = {"wall": (0.7, 0.2, 0.1), "ceiling": (0.9, 0.1, 0.0), "furniture": (0.42, 0.43, 0.15)}
    tones |= {"table": (0.4, 0.4, 0.2), "floor": (0.45, 0.43, 0.12)}
    pale, wooden, vivid = tones.get(role, (0.3, 0.3, 0.4))
    mood = rng.choice(3, p=[pale, wooden, vivid])
    if mood == 0:
        base = rng.uniform(0.15, 0.85) * (1 + rng.normal(0, 0.04, 3))
    elif mood == 1:
        base = np.array([0.5, rng.uniform(0.22, 0.36), rng.uniform(0.08, 0.25)]) * np.exp(rng.uniform(-1.6, 0.4))
    else:
        hue = rng.random(3) ** 2
        base = (hue + rng.uniform(0.02, 0.3)) / (hue.max() + 0.1) * rng.uniform(0.1, 0.7)
    if dark:
        base = base / base.max() * rng.uniform(0.01, 0.06)
    base = np.clip(base, 0.01, 0.9)
    other = base * rng.uniform(0.45, 1.5) + rng.normal(0, 0.02 if role in ("floor", "wall", "table") else 0.1, 3)
    return np.stack([base, np.clip(other, 0.01, 0.9)])


def glass(rng, hollow: bool, held_out: bool) -> dict[str, Any]:
    """Draw clear, tinted or vividly coloured glass or plastic; ``infrared`` is the share that one wall lets through."""
    ior = rng.choice([rng.uniform(1.36, 1.43), rng.uniform(1.57, 1.7)]) if held_out else rng.uniform(1.45, 1.56)
    tint = 1 - rng.uniform(0, 0.12) * rng.random(3)
    if rng.random() < 0.15:
        tint = np.array([(0.75, 0.45, 0.15), (0.35, 0.7, 0.4), (0.4, 0.6, 0.85), (0.8, 0.8, 0.8)][rng.integers(4)])
        tint = tint ** rng.uniform(0.5, 1.2)
    thin = hollow and rng.random() < 0.5
    kept = float(rng.uniform(0.45, 0.98))
    look = {"type": "thin_glass" if thin else "glass", "ior": float(ior), "tint": tint, "infrared": kept}
    # A matcher reads through clear solid glass, too; the renderer's shadow rays cannot, unless it is taken for thin.
    return {**look, "seen_through": bool(thin or rng.random() < 0.7)}


def metal(rng, smooth: bool, held_out: bool) -> dict[str, Any]:
    """Draw a mirror or a brushed metal."""
    name = str(rng.choice(("Cu", "Au", "Ag") if held_out else ("Ag", "Al", "Cr")))
    rough = rng.uniform(0.15, 0.25) if held_out else rng.uniform(0.05, 0.18)
    return {"type": "mirror" if smooth else "brushed", "metal": name, "roughness": float(rough)}


# ----- the things -----------------------------------------------------------------------------------------------

Group = list[Thing]  # a vessel with what is in and on it


def _place(rng, view: Framing, support: Support) -> list[Group]:
    """Put groups of things beside each other; those that matter come first and nearest to the middle."""
    size = view.size * view.distance
    lossy = [] if view.empty else _wanted(rng, view)
    clutter = int(rng.integers(1, 5)) if view.close else int(rng.integers(2, 13))
    makers = [(kind, size) for kind in lossy] + [(OPAQUE, size * rng.uniform(0.6, 1.4)) for _ in range(clutter)]
    spread = np.minimum(support.half, view.distance * rng.uniform(0.2, 0.42))
    crowd = rng.uniform(0.5, 1.0)
    lift = float(np.clip(0.001 * view.distance, 0.0003, 0.001))
    groups, taken = [], []
    for i, (kind, large) in enumerate(makers):
        group, rotation, wide = _group(rng, view, kind, large)
        low = _lowest(group, rotation)
        radius = 0.8 * wide
        for tries in range(30):
            near = min(1.0, 0.1 + tries / 15) if view.close and i < len(lossy) else 1.0
            spot = support.centre * (not view.close) + near * rng.uniform(-1, 1, 2) * spread
            if all(np.hypot(*(spot - other)) > crowd * (radius + r) for other, r, _ in taken):
                break
        else:
            if kind == OPAQUE:
                continue
        top = 0.0
        if kind != OPAQUE and rng.random() < 0.12 and not view.close:  # on top of something flat
            height = large * rng.uniform(0.1, 0.5)
            groups.append([_stand(rng, view, spot, height, 0.9 * wide, lift)])
            top = height + lift
        taken.append((spot, radius, top))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, (*spot, top + lift - low)
        groups.append([Thing(t.family, t.kind, t.scale, pose @ t.pose, t.material, t.form) for t in group])
    return groups


def _wanted(rng, view: Framing) -> list[int]:
    """Return the kinds of the transparent and reflective things of a scene."""
    clear = int(rng.integers(1, 3)) if view.close else int(rng.integers(1, 7))
    shiny = int(rng.choice([0, 1, 2], p=[0.62, 0.25, 0.13]))
    if rng.random() < 0.08:
        clear, shiny = 0, max(shiny, 1)
    return [TRANSPARENT] * clear + [REFLECTIVE] * (min(shiny, 1) if view.close else shiny)


def _lowest(group: Group, rotation: np.ndarray) -> float:
    """Return the least height of a turned group, so that it can be put on its support exactly."""
    lows = []
    for thing in group:
        vertices = (vertices_of(thing)[0] * thing.scale) @ thing.pose[:3, :3].T + thing.pose[:3, 3]
        lows.append((vertices @ rotation.T)[:, 2].min())
    return float(min(lows))


def _stand(rng, view: Framing, spot: np.ndarray, height: float, half: float, lift: float) -> Thing:
    pose = _turn(rng.uniform(0, np.pi))
    pose[:3, 3] = (*spot, height / 2 + lift)
    return Thing("box", OPAQUE, np.array([half, half, height / 2]), pose, surface(rng, view, "carton"))


def _group(rng, view: Framing, kind: int, size: float) -> tuple[Group, np.ndarray, float]:
    """Return the parts of one object in its own frame, how it is turned, and its radius on the table."""
    size = size * rng.uniform(0.7, 1.3)
    if kind == OPAQUE:
        return _distractor(rng, view, size)
    names = {
        TRANSPARENT: (TRANSPARENT_FAMILIES, HELD_OUT_TRANSPARENT),
        REFLECTIVE: (REFLECTIVE_FAMILIES, HELD_OUT_REFLECTIVE),
    }
    family = str(rng.choice(names[kind][view.held_out]))
    if family in forms.OUTLINES:
        return _vessel(rng, view, kind, family, size)
    turn, tilt = rng.uniform(0, 2 * np.pi), 0.0
    if family in ("pane", "plate", "plate_mirror", "round_mirror", "stand_mirror"):
        scale = size * np.array([rng.uniform(0.4, 0.9), rng.uniform(0.4, 0.9), 0.0])
        scale[2] = rng.uniform(0.001, 0.003) * max(1, view.distance)
        if view.close:
            scale *= 0.6  # else it would be all that one sees
        if family in ("pane", "stand_mirror"):  # upright or leaning, facing the camera more or less
            turn, tilt = rng.normal(0, 0.5), np.pi / 2 - rng.uniform(0, 0.4) * rng.integers(0, 2)
        shape = "round_mirror" if family in ("plate", "round_mirror") and rng.random() < 0.6 else "plate_mirror"
    elif family == "tool":
        shape, scale = "cylinder", size * np.array([0.05, 0.05, rng.uniform(0.4, 0.8)])
        tilt = np.pi / 2
    else:
        shape = family
        scale = np.full(3, size * rng.uniform(0.3, 0.5)) if family == "sphere" else size * rng.uniform(0.25, 0.5, 3)
        tilt = np.pi / 2 if rng.random() < 0.25 else 0.0
    if kind == TRANSPARENT:
        material = glass(rng, False, view.held_out)
    else:
        material = metal(rng, "mirror" in family or rng.random() < 0.5, view.held_out)
    thing = Thing(shape, kind, scale, np.eye(4), material, ROUND.get(shape))
    rotation = _rotation(turn, tilt)
    return [thing], rotation, float(np.hypot(*(np.abs(rotation) @ scale)[:2]))


def _rotation(turn: float, tilt: float) -> np.ndarray:
    c, s = np.cos(tilt), np.sin(tilt)
    return _turn(turn)[:3, :3] @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def _vessel(rng, view: Framing, kind: int, family: str, size: float) -> tuple[Group, np.ndarray, float]:
    """A glass, bottle, bowl or the like: standing, lying or upside down; full, capped or labelled at times."""
    material = glass(rng, True, view.held_out) if kind == TRANSPARENT else metal(rng, rng.random() < 0.5, view.held_out)
    solid = material["type"] == "glass"
    form = forms.vessel(rng, family, float(rng.uniform(0.015, 0.05)) if solid else 0.0, view.close)
    low = family in ("bowl", "dish")
    height = size * {"bowl": 0.6, "dish": 0.25}.get(family, 1.0)
    scale = np.full(3, height)
    group = [Thing(family, kind, scale, np.eye(4), material, form)]
    posture = rng.choice(
        ["standing", "lying", "over", "leaning"], p=[0.95, 0, 0.05, 0] if low else [0.62, 0.24, 0.06, 0.08]
    )
    tilt = {"standing": 0.0, "lying": np.pi / 2, "over": np.pi, "leaning": rng.uniform(0.15, 1.2)}[posture]

    def add(shape: dict[str, Any], what: int, look: dict[str, Any]) -> None:
        group.append(Thing(family, what, scale, np.eye(4), look, shape))

    if kind == TRANSPARENT and posture == "standing" and rng.random() < 0.28:
        level = rng.uniform(0.5, 0.8) if family in ("wine_glass", "flute", "goblet") else rng.uniform(0.15, 0.8)
        add(forms.liquid(form, level), *_drink(rng))
    if kind == TRANSPARENT and family in forms.SLENDER:
        if rng.random() < 0.5:
            add(forms.cap(form, rng.uniform(0.06, 0.11)), OPAQUE, surface(rng, view, "bin"))
        if rng.random() < 0.35:
            start = rng.uniform(0.1, 0.3)
            add(forms.sleeve(form, start, start + rng.uniform(0.12, 0.3)), OPAQUE, surface(rng, view, "carton"))
    rotation = _rotation(rng.uniform(0, 2 * np.pi), tilt)
    return group, rotation, float(np.hypot(*(np.abs(rotation) @ (forms.half_size(form) * scale))[:2]))


def _drink(rng) -> tuple[int, dict[str, Any]]:
    """Return the kind and material of a liquid: water, juice or tea; or milk and coffee, which are opaque."""
    if rng.random() < 0.2:
        base = np.array([(0.85, 0.82, 0.75), (0.05, 0.02, 0.01), (0.7, 0.35, 0.05)][rng.integers(3)])
        look = {"type": "plastic", "texture": "plain", "texture_seed": 0, "colours": np.stack([base, base])}
        return OPAQUE, {**look, "roughness": 0.05, "infrared": float(rng.uniform(0.1, 0.7)), "repeat": 1.0}
    tint = np.ones(3)
    if rng.random() < 0.6:
        tint = np.array(
            [(0.9, 0.5, 0.1), (0.7, 0.1, 0.08), (0.5, 0.85, 0.4), (0.85, 0.7, 0.3), (0.3, 0.12, 0.05)][rng.integers(5)]
        )
    look = {"type": "glass", "ior": 1.33, "tint": tint, "infrared": float(rng.uniform(0.5, 0.95))}
    return TRANSPARENT, {**look, "seen_through": bool(rng.random() < 0.5)}


def _distractor(rng, view: Framing, size: float) -> tuple[Group, np.ndarray, float]:
    """An opaque thing: carton, can, book, phone or screen, cloth, tool, bowl, mug, ball, block."""
    family = str(
        rng.choice(["carton", "can", "book", "phone", "cloth", "tool", "pot", "mug", "ball", "block", "block"])
    )
    turn, tilt = rng.uniform(0, 2 * np.pi), 0.0
    look, shape, form = surface(rng, view, "thing"), "box", None
    match family:
        case "carton":
            scale, look = size * rng.uniform(0.2, 0.7, 3), surface(rng, view, "carton")
        case "can":
            return _can(rng, view, size)
        case "book":
            scale = size * np.array([rng.uniform(0.4, 0.8), rng.uniform(0.3, 0.6), rng.uniform(0.02, 0.12)])
            look = surface(rng, view, "carton")
        case "phone":  # or a screen: black, glossy, and no reading
            scale = size * np.array([rng.uniform(0.3, 1.0), rng.uniform(0.3, 0.7), 0.03])
            look |= {"type": "plastic", "texture": "plain", "roughness": float(rng.uniform(0.02, 0.06))}
            look |= {"colours": np.full((2, 3), rng.uniform(0.01, 0.03)), "infrared": float(rng.uniform(0.01, 0.05))}
            if rng.random() < 0.5:
                turn, tilt = rng.normal(0, 0.5), np.pi / 2 - rng.uniform(0, 0.3)
        case "cloth":
            scale = size * np.array([rng.uniform(0.5, 1.2), rng.uniform(0.4, 1.0), rng.uniform(0.01, 0.04)])
            look = surface(rng, view, "cloth")
        case "tool":
            shape = str(rng.choice(["cylinder", "box"]))
            scale, tilt = (
                size * np.array([rng.uniform(0.03, 0.09), rng.uniform(0.03, 0.09), rng.uniform(0.4, 1.0)]),
                np.pi / 2,
            )
        case "pot" | "mug":
            form = forms.vessel(rng, str(rng.choice(["bowl", "tumbler", "jar", "vase", "dish"])), 0.0, view.close)
            scale = np.full(3, size * rng.uniform(0.4, 0.9))
        case "ball":
            shape, scale = "sphere", np.full(3, size * rng.uniform(0.2, 0.5))
        case _:
            shape = str(rng.choice(["box", "cylinder", "hexagon"]))
            scale = size * rng.uniform(0.2, 0.6, 3)
            tilt = np.pi / 2 if rng.random() < 0.3 else 0.0
    rotation = _rotation(turn, tilt)
    half = scale if form is None else forms.half_size(form) * scale
    thing = Thing(shape, OPAQUE, scale, np.eye(4), look, form or ROUND.get(shape))
    return [thing], rotation, float(np.hypot(*(np.abs(rotation) @ half)[:2]))


def _can(rng, view: Framing, size: float) -> tuple[Group, np.ndarray, float]:
    """A tin can: a printed sleeve between two metal-grey rims; opaque, since its readings are good."""
    radius = rng.uniform(0.22, 0.42)
    rim = 0.5 - rng.uniform(0.01, 0.05)
    points = np.array(
        [(0, -0.5), (0.94 * radius, -0.5), (radius, -rim), (radius, rim), (0.94 * radius, 0.5), (0, 0.48)]
    )
    body = forms.turned(points)
    grey = {"type": "plastic", "texture": "plain", "texture_seed": 0, "colours": np.full((2, 3), rng.uniform(0.3, 0.6))}
    grey |= {"roughness": float(rng.uniform(0.05, 0.2)), "infrared": float(rng.uniform(0.3, 0.6)), "repeat": 1.0}
    scale = np.full(3, size * rng.uniform(0.5, 1.0))
    look = {**surface(rng, view, "carton"), "type": "plastic"}
    sleeve = forms.sleeve(body, 0.5 - rim + 0.01, 0.5 + rim - 0.01)
    group = [Thing("can", OPAQUE, scale, np.eye(4), grey, body), Thing("can", OPAQUE, scale, np.eye(4), look, sleeve)]
    rotation = _rotation(rng.uniform(0, 2 * np.pi), np.pi / 2 if rng.random() < 0.25 else 0.0)
    return group, rotation, float(np.hypot(*(np.abs(rotation) @ np.array([radius, radius, 0.5]) * scale[0])[:2]))
