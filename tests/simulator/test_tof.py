"""Time of flight: what light does on its way, checked against paths that can be computed by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ditr_lite.camera import Camera
from ditr_lite.data import OPAQUE, REFLECTIVE, TRANSPARENT
from ditr_lite.simulator import tof
from ditr_lite.simulator.scenes import Scene, Thing, look_at

MATT = {"type": "matt", "texture": "noise", "texture_seed": 1, "roughness": 0.1, "infrared": 0.6}
MATT["colours"] = np.array([[0.3, 0.3, 0.3], [0.7, 0.7, 0.7]])
CAMERA = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
DOWN = look_at(np.array([0.0, -1e-3, 0.6]), np.zeros(3))


def plate(kind, material, height=0.2, thick=0.02, half=0.06):
    """Return a level plate whose upper side is ``height`` above the table."""
    pose = np.eye(4)
    pose[2, 3] = height - thick / 2
    return Thing("slab", kind, np.array([half, half, thick / 2]), pose, material)


def scene_of(*things):
    return Scene(0, list(things), MATT, [], DOWN, [], 0.5)


def follow(scene, direction=(0.0, 0.0, -1.0)):
    pytest.importorskip("mitsuba")
    loaded = tof.build_scene(scene, DOWN, np.random.default_rng(0), slide=np.ones((8, 8)))
    direction = np.array(direction) / np.linalg.norm(direction)
    return tof.follow(loaded, scene, np.array([0.0, 0.0, 0.6]), direction)


def test_solid_glass_delays_by_its_index_less_one_times_its_thickness():
    glass = {"type": "glass", "ior": 1.5, "tint": np.ones(3)}
    way, late, walls, head_on = follow(scene_of(plate(TRANSPARENT, glass)))
    assert way == pytest.approx(0.6, abs=1e-4) and walls == 2 and head_on == pytest.approx(1, abs=1e-4)
    assert late == pytest.approx(0.5 * 0.02, abs=1e-5)
    slanted = follow(scene_of(plate(TRANSPARENT, glass)), (0.1, 0, -1))
    assert slanted[1] == pytest.approx(late * np.hypot(0.1, 1), rel=1e-3)  # a slanted way through is longer


def test_a_thin_sheet_counts_as_two_millimetres():
    sheet = {"type": "thin_glass", "ior": 1.4, "tint": np.ones(3)}
    way, late, walls, _ = follow(scene_of(plate(TRANSPARENT, sheet)))
    assert way == pytest.approx(0.6, abs=1e-4)
    assert late == pytest.approx(walls / 2 * 0.4 * tof.SHEET_M, rel=1e-3) and walls == 4  # a box of two sheets


def test_a_mirror_reads_what_it_shows_and_nothing_where_it_shows_the_sky():
    mirror = {"type": "mirror", "metal": "Ag"}
    assert follow(scene_of(plate(REFLECTIVE, mirror)))[0] == 0  # straight back up: no surface
    wall = {**MATT, "y": 0.3, "turn": 0.0}
    tilted = plate(REFLECTIVE, mirror, height=0.05)
    c = np.sqrt(0.5)
    tilted.pose[:3, :3] = np.array([[1, 0, 0], [0, c, -c], [0, c, c]])  # throws the ray sideways, towards -y
    scene = Scene(0, [tilted], MATT, [{**wall, "y": -0.3}], DOWN, [], 0.5)
    way, late, walls, _ = follow(scene)
    down = 0.6 - way + 0.3  # the way is down to the mirror, then sideways to the wall
    assert way > 0.6 and late == 0 and walls == 0 and 0 < down < 0.1


def test_an_opaque_surface_ends_the_way():
    way, late, walls, _ = follow(scene_of(plate(OPAQUE, MATT)))
    assert (way, late, walls) == (pytest.approx(0.4, abs=1e-4), 0, 0)


def test_a_pixel_over_an_edge_reads_between_by_amplitude():
    distance = np.full((9, 9), 1.0)
    distance[:, 5:] = 2.0
    mean, spread = tof.mix(distance, np.ones((9, 9)), 0.6)
    assert 1 < mean[4, 4] < 1.5 < mean[4, 5] < 2 and spread[4, 4] > 0.1
    assert np.allclose(mean[:, :4], 1) and np.allclose(spread[:, :4], 0, atol=1e-6)
    bright = np.where(distance == 2, 9.0, 1.0)
    assert tof.mix(distance, bright, 0.6)[0][4, 4] > mean[4, 4]  # the brighter surface draws the reading
    blind = np.where(distance == 2, 0.0, 1.0)
    assert np.allclose(tof.mix(distance, blind, 0.6)[0][:, :5], 1)


@pytest.mark.parametrize(("amplitude", "deviation"), [(1.0, 0.002), (0.25, 0.004), (4.0, 0.001), (0.01, 0.004)])
def test_noise_grows_as_the_root_of_missing_light_down_to_the_floor(amplitude, deviation):
    dim = tof.TimeOfFlight(noise_m=0.002, floor=0.25)
    drawn = tof.noise(np.full((200, 200), amplitude), dim, np.random.default_rng(0))
    assert drawn.std() == pytest.approx(deviation, rel=0.02) and abs(drawn.mean()) < 0.02 * deviation


def wall_at(z, slope=0.0):
    """Return points and normals of a wall z = z0 + slope x, in the camera's frame."""
    v, u = np.mgrid[:48, :64]
    ray = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], -1)
    points = ray * (z / (1 - slope * ray[..., 0]))[..., None]
    return points, tof.surface_normals(points)


@settings(max_examples=10, deadline=None)
@given(z=st.floats(0.3, 3), slope=st.floats(-0.8, 0.8))
def test_one_plane_sees_itself_not_and_has_unit_normals(z, slope):
    points, normals = wall_at(z, slope)
    assert np.allclose(np.linalg.norm(normals, axis=2), 1) and ((normals * points).sum(2) < 0).all()
    assert np.abs(tof.multipath(points, normals, CAMERA)).max() < 1e-4


def corner():
    """Return points and normals of two walls that meet in an edge pointing away from the camera."""
    left, right = wall_at(0.6, 0.9), wall_at(0.6, -0.9)
    inner = left[0][..., 2] < right[0][..., 2]  # the nearer of both
    return tuple(np.where(inner[..., None], a, b) for a, b in zip(left, right, strict=True))


def test_a_corner_reads_too_far_most_at_its_edge():
    points, normals = corner()
    bias = tof.multipath(points, normals, CAMERA)
    assert bias.min() >= 0 and 0.001 < bias[24].max() < 0.05
    assert bias[24, 22:30].mean() > 1.4 * bias[24, :6].mean()
    assert np.allclose(tof.multipath(points, normals, CAMERA, albedo=0.0), 0)  # black walls throw nothing back


def test_the_light_of_a_second_surface_is_put_where_it_was_asked_for():
    points, normals = corner()
    bias = tof.multipath(points, normals, CAMERA)
    assert np.abs(bias - bias[:, ::-1]).mean() < 0.1 * bias.mean()  # the corner is symmetric, and so is what it reads


def test_a_matt_table_is_read_as_it_is_and_dim_light_is_not_read():
    pytest.importorskip("mitsuba")
    quiet = tof.TimeOfFlight(noise_m=0.0)
    z, dropped, truth = tof.measure_flight(scene_of(), CAMERA, DOWN, quiet, 4, 0)
    assert (z > 0).mean() > 0.95 and np.median(np.abs(z - truth)) < 0.001 and not dropped.any()
    assert not tof.measure_flight(scene_of(), CAMERA, DOWN, tof.TimeOfFlight(floor=1e3), 4, 0)[0].any()
    again = tof.measure_flight(scene_of(), CAMERA, DOWN, quiet, 4, 0)
    assert np.array_equal(z, again[0])


def test_glass_over_a_table_reads_the_table_and_the_delay():
    pytest.importorskip("mitsuba")
    glass = {"type": "glass", "ior": 1.5, "tint": np.ones(3), "infrared": 1.0}
    tilted = plate(TRANSPARENT, glass, height=0.25)
    tilted.pose[:3, :3] = np.array([[1, 0, 0], [0, 0.966, -0.259], [0, 0.259, 0.966]])  # no glint from the lamp
    z, _, truth = tof.measure_flight(scene_of(tilted), CAMERA, DOWN, tof.TimeOfFlight(noise_m=0.0), 4, 0)
    middle = np.s_[21:27, 28:36]
    assert (truth[middle] < 0.45).all() and np.median(z[middle]) == pytest.approx(0.61, abs=0.004)
