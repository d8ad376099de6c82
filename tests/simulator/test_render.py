import builtins
from collections import Counter

import numpy as np
import pytest

from ditr_lite.camera import Camera
from ditr_lite.data import OPAQUE
from ditr_lite.simulator.render import build_scene, mitsuba, render, triangles, truth
from ditr_lite.simulator.scenes import PRISMS, VESSELS, Scene, Thing, look_at, random_scene

SOLIDS = [*VESSELS, *PRISMS, "sphere", "ellipsoid", "box", "slab", "plate_mirror"]
CAMERA = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
MATT = {"type": "matt", "texture": "noise", "texture_seed": 1, "roughness": 0.1, "infrared": 0.5}
MATT["colours"] = np.array([[0.2, 0.3, 0.4], [0.8, 0.7, 0.6]])


def oriented_edges(points, faces):
    """Count the directed edges of a mesh whose equal vertices are merged and whose empty faces are dropped."""
    _, index = np.unique(np.round(points, 9), axis=0, return_inverse=True)
    faces = index.reshape(-1)[faces]
    faces = faces[[len(set(face)) == 3 for face in faces.tolist()]]
    return Counter((a, b) for i, j, k in faces.tolist() for a, b in ((i, j), (j, k), (k, i)))


def volume(points, faces):
    a, b, c = (points[faces[:, i]] for i in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


@pytest.mark.parametrize("family", SOLIDS)
def test_a_solid_is_closed_and_its_normals_point_out(family):
    points, faces, uv = triangles(family, solid=True)
    assert points.shape[1] == 3 and uv.shape == (len(points), 2) and faces.min() >= 0 and faces.max() < len(points)
    edges = oriented_edges(points, faces)
    # each edge belongs to two faces that run along it in opposite directions
    assert set(edges.values()) == {1} and all((b, a) in edges for a, b in edges)
    assert volume(points, faces) > 0


@pytest.mark.parametrize("family", VESSELS)
def test_a_thin_vessel_is_open_at_the_rim_only(family):
    points, faces, _ = triangles(family, solid=False)
    edges = oriented_edges(points, faces)
    unique = np.unique(np.round(points, 9), axis=0)
    rim = [unique[list(edge), 2] for edge in edges if edge[::-1] not in edges]
    assert len(rim) == 64 and np.allclose(rim, points[:, 2].max())


def test_volumes_are_those_of_geometry():
    segment = 64 * np.sin(2 * np.pi / 64) / 2 / np.pi  # a 64-gon over its circle
    assert volume(*triangles("box", True)[:2]) == pytest.approx(8)
    assert volume(*triangles("sphere", True)[:2]) == pytest.approx(4 / 3 * np.pi * segment, rel=0.01)
    assert volume(*triangles("hexagon", True)[:2]) == pytest.approx(2 * 1.5 * np.sqrt(3))
    wall = volume(*triangles("tumbler", True)[:2])
    assert 0 < wall < 0.5 * np.pi * 0.34**2  # a wall, not a plug


def test_without_mitsuba_the_error_says_what_to_install(monkeypatch):
    real = builtins.__import__

    def absent(name, *args, **kwargs):
        if name.split(".")[0] == "mitsuba":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", absent)
    with pytest.raises(ImportError, match=r"pip install -e '\.\[simulate\]'"):
        mitsuba()
    from ditr_lite.simulator.simulate import simulate

    with pytest.raises(ImportError, match="Mitsuba 3, an optional extra"):
        simulate(0)


def staged(things=()):
    """Return a scene seen from half a metre, 60 degrees down."""
    pose = look_at(np.array([0, -0.25, 0.25 * np.sqrt(3)]), np.zeros(3))
    light = {"at": np.array([0.3, -0.5, 1.5]), "size": 0.3, "power": np.full(3, 6.0)}
    return Scene(0, list(things), MATT, [], pose, [light], 0.5)


@pytest.fixture(scope="module")
def box():
    """A red box, 8 cm a side, on the table under the optical axis."""
    pytest.importorskip("mitsuba")
    pose = np.eye(4)
    pose[2, 3] = 0.04
    red = {**MATT, "texture": "plain", "colours": np.array([[0.8, 0.05, 0.05]] * 2)}
    scene = staged([Thing("box", OPAQUE, np.full(3, 0.04), pose, red)])
    return scene, build_scene(scene)


def test_truth_is_the_first_surface_along_each_ray(box):
    scene, loaded = box
    points, depth, ids = truth(loaded, CAMERA, scene.camera_pose, seed=0)
    assert points.shape == (48, 64, 3) and depth.dtype == np.float32 and set(np.unique(ids)) == {0, 1}
    v, u = np.mgrid[:48, :64]
    ray = np.stack([(u - CAMERA.cx) / 60, (v - CAMERA.cy) / 60, np.ones(u.shape)], axis=-1)
    ray = ray @ scene.camera_pose[:3, :3].T
    assert np.allclose(points, scene.camera_pose[:3, 3] + ray * depth[..., None])
    table = -scene.camera_pose[2, 3] / ray[..., 2]  # where z = 0
    on_table = (ids == 0) & (np.abs(points[..., 2]) < 0.01)
    assert on_table.mean() > 0.5 and np.abs(depth - table)[on_table].max() < 5e-4
    top = (ids == 1) & (np.abs(points[..., 2] - 0.08) < 2e-3)
    assert top.sum() > 30
    assert np.abs(points[ids == 1]).max(axis=0) == pytest.approx([0.04, 0.04, 0.08], abs=0.006)


def test_picture_shows_the_box_where_the_truth_has_it(box):
    scene, loaded = box
    image = render(loaded, CAMERA, scene.camera_pose, samples=4, seed=0)
    _, _, ids = truth(loaded, CAMERA, scene.camera_pose, seed=0)
    redness = image[..., 0] / (image.sum(axis=2) + 1e-6)
    assert image.shape == (48, 64, 3) and np.isfinite(image).all() and (image >= 0).all()
    assert np.median(redness[ids == 1]) > 0.6 > 0.45 > np.median(redness[ids == 0])


def test_the_same_seed_renders_the_same_values(box):
    scene, loaded = box
    first, again, other = (render(loaded, CAMERA, scene.camera_pose, 2, seed) for seed in (3, 3, 4))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_any_seed_of_64_bits_renders(box):
    scene, loaded = box
    for seed in (2**32, 2**63 - 1):
        assert np.isfinite(render(loaded, CAMERA, scene.camera_pose, 1, seed)).all()
        assert np.isfinite(truth(loaded, CAMERA, scene.camera_pose, seed)[1]).all()


def test_any_number_of_threads_renders_the_same_values(box):
    drjit = pytest.importorskip("drjit")
    scene, loaded = box
    threads, images = drjit.thread_count(), []
    try:
        for count in (1, 2, 64):
            drjit.set_thread_count(count)
            images.append(render(loaded, CAMERA, scene.camera_pose, 1, seed=3))
    finally:
        drjit.set_thread_count(threads)
    assert all(np.array_equal(images[0], image) for image in images[1:])


def test_lamps_and_shapes_are_always_loaded_in_the_same_order():
    pytest.importorskip("mitsuba")
    scene = random_scene(4, "test")
    assert len(scene.lights) == 2  # whose order decides which one a random number picks
    orders = {tuple(shape.id() for shape in build_scene(scene).shapes()) for _ in range(6)}
    assert len(orders) == 1


def test_projected_dots_light_the_scene_in_infrared(box):
    scene, _ = box
    lit = build_scene(scene, scene.camera_pose, np.random.default_rng(0))
    grey = render(lit, CAMERA, scene.camera_pose, 4, 0).mean(axis=2)
    backwards = scene.camera_pose @ np.diag([1.0, -1, -1, 1])  # away from the scene
    dark = build_scene(scene, backwards, np.random.default_rng(0))
    plain = render(dark, CAMERA, scene.camera_pose, 4, 0).mean(axis=2)
    assert grey.std() / grey.mean() > 2 * plain.std() / plain.mean()
