import numpy as np
import pytest

from ditr_lite.data import OPAQUE, REFLECTIVE, TRANSPARENT
from ditr_lite.simulator.render import triangles
from ditr_lite.simulator.scenes import (
    PRISMS,
    TEST_FAMILIES,
    TRAIN_FAMILIES,
    VESSELS,
    cross_section,
    half_extent,
    look_at,
    profile,
    random_scene,
)

SEEDS = range(60)
FAMILIES = sorted({name for split in (TRAIN_FAMILIES, TEST_FAMILIES) for names in split.values() for name in names})


def vertices(thing):
    """Return the (N, 3) world vertices of a thing."""
    points, _, _ = triangles(thing.family, solid=False)
    return (points * thing.scale) @ thing.pose[:3, :3].T + thing.pose[:3, 3]


def things(split):
    return [thing for seed in SEEDS for thing in random_scene(seed, split).things]


def same(a, b):
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list):
        return len(a) == len(b) and all(map(same, a, b))
    return same(vars(a), vars(b)) if hasattr(a, "__dict__") else a == b


def test_a_seed_decides_the_scene_and_another_seed_or_split_another():
    assert same(random_scene(5, "train"), random_scene(5, "train"))
    assert not same(random_scene(5, "train"), random_scene(6, "train"))
    assert not same(random_scene(5, "train"), random_scene(5, "val"))


def test_unknown_split_is_refused():
    with pytest.raises(ValueError, match="unknown split 'holdout'; choose one of train, val, test"):
        random_scene(0, "holdout")


def test_held_out_families_share_nothing_with_training():
    for kind in (TRANSPARENT, REFLECTIVE):
        assert not set(TEST_FAMILIES[kind]) & set(TRAIN_FAMILIES[kind])
    lossy = {name for kind in (TRANSPARENT, REFLECTIVE) for name in TEST_FAMILIES[kind]}
    assert not lossy & {name for names in TRAIN_FAMILIES.values() for name in names}


@pytest.mark.parametrize("split", ["train", "val", "test"])
def test_families_and_materials_are_those_of_the_split(split):
    families = TEST_FAMILIES if split == "test" else TRAIN_FAMILIES
    for thing in things(split):
        assert thing.family in families[thing.kind]
        if thing.kind == TRANSPARENT:
            seen_in_training = 1.45 <= thing.material["ior"] <= 1.56
            assert seen_in_training == (split != "test")
        if thing.kind == REFLECTIVE:
            assert (thing.material["metal"] in ("Ag", "Al", "Cr")) == (split != "test")
            if thing.material["type"] == "brushed":
                assert (thing.material["roughness"] <= 0.2) == (split != "test")
        assert (thing.kind == OPAQUE) == (thing.material["type"] in ("matt", "plastic"))


@pytest.mark.parametrize("split", ["train", "test"])
def test_every_object_rests_on_the_table(split):
    for thing in things(split):
        lowest = vertices(thing)[:, 2].min()
        lying = abs(thing.pose[2, 2]) < 1e-9 and thing.family in (*VESSELS, *PRISMS)
        if lying:  # it rests on its bounding cylinder: nothing sinks in, a flat or rounded side hovers a little
            assert -1e-9 <= lowest <= 0.15 * half_extent(thing.family)[1] * thing.scale[1]
        else:
            assert abs(lowest) < 1e-9


def test_most_cameras_look_steeply_down_and_all_at_the_table():
    elevation = np.array([random_scene(seed).style["elevation_deg"] for seed in range(120)])
    assert 0.65 < (elevation >= 45).mean() < 0.85 and elevation.min() >= 22 and elevation.max() <= 80
    for seed in SEEDS:
        pose = random_scene(seed).camera_pose
        reach = -pose[2, 3] / pose[2, 2]  # along the optical axis down to z = 0
        where = pose[:3, 3] + reach * pose[:3, 2]
        assert reach > 0 and np.abs(where[:2]).max() < 0.25


def test_camera_axes_are_right_down_forward():
    pose = look_at(np.array([0, -1.0, 0.5]), np.zeros(3))
    right, down, forward = pose[:3, :3].T
    assert np.allclose(np.cross(right, down), forward) and np.isclose(np.linalg.det(pose[:3, :3]), 1)
    assert np.allclose(right, [1, 0, 0]) and down[2] < 0
    assert np.allclose(forward, np.array([0, 1, -0.5]) / np.hypot(1, 0.5))
    rolled = look_at(np.array([0, -1.0, 0.5]), np.zeros(3), roll=np.pi / 2)
    assert np.allclose(rolled[:3, 0], down) and np.allclose(rolled[:3, 2], forward)


@pytest.mark.parametrize("family", FAMILIES)
def test_half_extent_is_that_of_the_mesh(family):
    points, _, _ = triangles(family, solid=False)
    extent = half_extent(family)
    assert (np.abs(points) <= extent + 1e-9).all()  # the box holds the shape
    if family not in ("hexagon", "star"):  # no corner of theirs points along y
        # smoothing rounds a vessel's widest corner off; its foot and its rim stay
        assert np.allclose(np.abs(points).max(axis=0), extent, rtol=0.1 if family in VESSELS else 1e-9)
        assert np.isclose(np.abs(points[:, 2]).max(), extent[2])


@pytest.mark.parametrize("family", [*VESSELS, "sphere"])
def test_outline_starts_on_the_axis_and_never_crosses_it(family):
    points = profile(family)
    assert abs(points[0, 0]) < 1e-9 and (points[:, 0] >= -1e-9).all()
    assert np.isclose(points[0, 1], -points[-1, 1])  # centred on height 0


def test_cross_section_is_regular_or_a_star():
    assert np.allclose(np.linalg.norm(cross_section("hexagon"), axis=1), 1)
    star = np.linalg.norm(cross_section("star"), axis=1)
    assert len(star) == 10 and np.allclose(star[::2], 1) and np.allclose(star[1::2], 0.5)
    x, y = cross_section("cylinder").T
    assert np.isclose(0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1)), np.pi, rtol=0.01)  # positive: counter-clockwise
