import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ditr_lite import camera as cam
from ditr_lite.data import Camera

CAMERA = Camera(92.0, 88.0, 7.2, 5.9, 16, 12)
YAML = (
    "# Camera\ncamera_name: 'D435'\nxres: 16   # Image Width\nyres: 12\nfx: 92\nfy: 88\ncx: 7.2   # centre\ncy: 5.9\n"
)


@pytest.fixture
def depth():
    depth = np.random.default_rng(0).uniform(0.4, 0.9, (12, 16)).astype(np.float32)
    depth[2:4, 3:6] = 0
    return depth


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 15), st.integers(0, 11), st.floats(0.125, 60, width=32))
def test_projecting_a_point_gives_its_pixel_back(u, v, z):
    depth = np.zeros((12, 16), np.float32)
    depth[v, u] = z
    ((x, y, zz),) = cam.unproject(depth, CAMERA)
    assert zz == z
    assert np.isclose(x / z * CAMERA.fx + CAMERA.cx, u) and np.isclose(y / z * CAMERA.fy + CAMERA.cy, v)


def test_points_come_row_by_row_without_the_missing(depth):
    points = cam.unproject(depth, CAMERA)
    assert points.shape == ((depth > 0).sum(), 3) and points.dtype == np.float64
    np.testing.assert_array_equal(points[:, 2], depth[depth > 0])
    assert cam.unproject(np.zeros_like(depth), CAMERA).shape == (0, 3)


def test_unproject_refuses_another_size_and_other_units(depth):
    with pytest.raises(ValueError, match="use Camera.resized"):
        cam.unproject(depth[:6], CAMERA)
    with pytest.raises(ValueError, match="floating-point metres"):
        cam.unproject((depth * 1000).astype(np.uint16), CAMERA)


def test_point_cloud_on_disk_can_be_read_back_by_hand(tmp_path, depth):
    rgb = np.random.default_rng(1).integers(0, 256, (12, 16, 3), dtype=np.uint8)
    path = tmp_path / "cloud.ply"
    n = cam.write_ply(path, depth, rgb, CAMERA)
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert f"element vertex {n}" in lines and n == (depth > 0).sum()
    assert [line.split()[1:] for line in lines if line.startswith("property")] == [
        ["float", "x"],
        ["float", "y"],
        ["float", "z"],
        ["uchar", "red"],
        ["uchar", "green"],
        ["uchar", "blue"],
    ]
    assert len(body) == n * 15
    vertices = np.frombuffer(body, dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
    np.testing.assert_allclose(vertices["xyz"], cam.unproject(depth, CAMERA), rtol=1e-6)
    np.testing.assert_array_equal(vertices["rgb"], rgb[depth > 0])
    with pytest.raises(ValueError, match="uint8 like the depth map"):
        cam.write_ply(path, depth, rgb[:4], CAMERA)
    assert list(tmp_path.iterdir()) == [path]


def test_intrinsics_from_yaml_matrix_and_array(tmp_path):
    (tmp_path / "a.yaml").write_text(YAML)
    assert cam.read_intrinsics(tmp_path / "a.yaml") == CAMERA
    assert cam.read_intrinsics(tmp_path / "a.yaml", (12, 16)) == CAMERA
    matrix = np.array([[92, 0, 7.2], [0, 88, 5.9], [0, 0, 1]])
    np.savetxt(tmp_path / "spaces.txt", matrix)
    np.savetxt(tmp_path / "commas.txt", matrix, delimiter=",")
    np.save(tmp_path / "k.npy", matrix)
    for name in ("spaces.txt", "commas.txt", "k.npy"):
        assert cam.read_intrinsics(tmp_path / name, (12, 16)) == CAMERA


@pytest.mark.parametrize(
    ("name", "text", "size", "message"),
    [
        ("a.yaml", YAML, (720, 1280), "is for pictures of"),
        ("a.yaml", YAML.replace("fy: 88", ""), None, "lacks fy"),
        ("a.yaml", YAML.replace("fx: 92", "fx: 0"), None, "positive focal lengths"),
        ("k.txt", "92 0 7\n0 88 6\n0 0 1\n", None, r"pass size=\(height, width\)"),
        ("k.txt", "92 0 7\n0 88 6\n", (12, 16), "3x3 camera matrix"),
        ("k.txt", "92 0 7\n0 88 6\n0 0 7\n", (12, 16), "last row 0 0 1"),
        ("k.txt", "hello", (12, 16), "cannot read"),
        ("k.txt", "", (12, 16), "3x3 camera matrix: it holds no numbers"),
        ("k.txt", "# fx 0 cx\n\n", (12, 16), "it holds no numbers"),
        ("k.txt", "92 0 nan\n0 inf 6\n0 0 1\n", (12, 16), "finite numbers, got fy inf, cx nan"),
        ("a.yaml", YAML.replace("fx: 92", "fx: nan"), None, "finite numbers, got fx nan"),
        ("a.yaml", YAML.replace("xres: 16", "xres: inf"), None, "finite numbers, got xres inf"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_intrinsics_that_cannot_be_used(tmp_path, name, text, size, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=message):
        cam.read_intrinsics(tmp_path / name, size)


def test_absent_intrinsics(tmp_path):
    for name in ("a.yaml", "k.txt", "k.npy"):
        with pytest.raises(ValueError, match="no file"):
            cam.read_intrinsics(tmp_path / name, (12, 16))


def test_a_scene_twice_as_large_and_as_far_gives_the_same_picture(depth):
    once, twice = cam.unproject(depth, CAMERA), cam.unproject(2 * depth, CAMERA)
    assert np.allclose(twice, 2 * once)  # every point moved along its own line of sight ...
    pixels = [points[:, :2] / points[:, 2:] for points in (once, twice)]
    assert np.allclose(*pixels)  # ... so no pixel of a colour image tells the two apart
