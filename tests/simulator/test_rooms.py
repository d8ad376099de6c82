from functools import cache

import numpy as np
import pytest

from ditr_lite.data import OPAQUE, REFLECTIVE, ROOM_SPLITS, TRANSPARENT
from ditr_lite.simulator import forms, rooms, textures
from ditr_lite.simulator.render import vertices_of
from ditr_lite.simulator.rooms import room_scene

SEEDS = range(80)


@cache
def scene_of(seed, split="rooms_train"):
    return room_scene(seed, split)


def scenes(split="rooms_train"):
    return [scene_of(seed, split) for seed in SEEDS]


def world(thing):
    return (vertices_of(thing)[0] * thing.scale) @ thing.pose[:3, :3].T + thing.pose[:3, 3]


def test_a_seed_and_a_split_decide_the_scene():
    first, again = room_scene(5), room_scene(5)
    assert first.style == again.style and len(first.things) == len(again.things)
    assert all(np.array_equal(world(a), world(b)) for a, b in zip(first.things, again.things, strict=True))
    poses = [room_scene(5, split).camera_pose for split in ROOM_SPLITS]
    assert not np.array_equal(poses[0], poses[1]) and not np.array_equal(poses[0], poses[2])


def test_unknown_split_is_refused():
    with pytest.raises(ValueError, match="unknown split 'test'"):
        room_scene(0, "test")


def test_the_test_rooms_share_no_shape_photograph_or_surrounding_with_training():
    seen = {}
    for split in ("rooms_train", "rooms"):
        families, pictures, places = set(), set(), set()
        for scene in scenes(split):
            places.add(scene.surrounding["name"])
            families |= {t.family for t in scene.things if t.kind != OPAQUE and "mirror" not in t.family}
            looks = [*scene.parts, *(t.material for t in scene.things if "texture" in t.material)]
            pictures |= {look["texture"] for look in looks} & {*textures.PHOTOGRAPHS, *textures.HELD_OUT_PHOTOGRAPHS}
            pictures |= {look["texture"] for look in looks if look["texture"].startswith("view:")}
        seen[split] = families, pictures, places
    families, pictures, places = (a & b for a, b in zip(*seen.values(), strict=True))
    assert families <= {"cylinder"} and not pictures and not places  # a metal rod is a rod


def test_about_an_eighth_of_the_scenes_is_empty_and_exactly_those_hold_nothing_lossy():
    drawn = [scene_of(seed) for seed in range(400)]
    assert 0.08 < np.mean([s.style["empty"] for s in drawn]) < 0.17
    for scene in drawn:
        lossy = [t for t in scene.things if t.kind in (TRANSPARENT, REFLECTIVE)]
        assert bool(lossy) != scene.style["empty"]


def test_distances_and_places_are_spread_as_said():
    styles = [scene_of(seed).style for seed in range(400)]
    distance = np.array([s["distance_m"] for s in styles])
    assert 0.1 <= distance.min() and distance.max() <= 3.0
    assert 0.4 < np.mean((distance > 0.3) & (distance < 1)) < 0.8
    assert {s["place"] for s in styles} == set(rooms.PLACES)
    assert 0.25 < np.mean([s["close"] for s in styles]) < 0.42


def test_nothing_stands_in_its_support_and_no_two_faces_coincide():
    for scene in scenes():
        for thing in scene.things:
            assert world(thing)[:, 2].min() >= 2e-4


def test_the_camera_is_above_the_floor_and_inside_no_box():
    for scene in scenes():
        eye = np.append(scene.camera_pose[:3, 3], 1)
        for part in scene.parts:
            local = np.linalg.inv(part["pose"]) @ eye if part["shape"] == "cube" else np.full(4, 9.0)
            assert np.abs(local[:3]).max() > 1
        floor = scene.parts[-1]["pose"][2, 3] if scene.parts[-1]["shape"] == "rectangle" else -9
        assert eye[2] > floor


@pytest.mark.parametrize("family", sorted(forms.OUTLINES))
def test_a_vessel_has_finite_faces_with_unit_normals_that_point_out(family):
    form = forms.vessel(np.random.default_rng(1), family, wall=0.02)
    vertices, faces, uv = forms.mesh(form)
    normals = forms.smooth_normals(vertices, faces, form["segments"])
    assert np.isfinite(vertices).all() and faces.max() < len(vertices) == len(uv)
    assert np.allclose(np.linalg.norm(normals, axis=1), 1)
    widest = np.argmax(np.hypot(*vertices[:, :2].T))
    assert normals[widest, :2] @ vertices[widest, :2] > 0


def test_a_liquid_touches_no_wall_and_a_sleeve_hugs_the_body():
    for family in ("tumbler", "bottle", "jar", "flute"):
        form = forms.vessel(np.random.default_rng(2), family, wall=0.03)
        inside = forms.liquid(form, 0.6)["points"][1:-1]
        assert (inside[:, 0] <= np.maximum(forms.radius_at(form, inside[:, 1]) - 0.03, 0.005)).all()
        sleeve = forms.sleeve(form, 0.2, 0.4)["points"]
        gap = sleeve[:, 0] - forms.radius_at(form, sleeve[:, 1])
        assert (gap > 0).all() and (gap < 0.02).all()


def test_a_surrounding_is_turned_scaled_and_without_peaks():
    still, turned = (textures.surrounding("esplanade", turn, 0.5) for turn in (0.0, 0.25))
    assert np.array_equal(np.roll(still, 128, axis=1), turned)
    assert still.max() < 0.5 * textures.PEAK * 5 and np.isfinite(still).all()
    with pytest.raises(ValueError, match="no surrounding 'attic'"):
        textures.panorama("attic")
