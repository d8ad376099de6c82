import os
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from ditr_lite import files
from ditr_lite.camera import Camera, unproject

CAMERA = Camera(92.0, 88.0, 7.2, 5.9, 16, 12)
YAML = (
    "# Camera\ncamera_name: 'D435'\nxres: 16   # Image Width\nyres: 12\nfx: 92\nfy: 88\ncx: 7.2   # centre\ncy: 5.9\n"
)


def save_exr(path, **channels):
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels).write(str(path))
    return path


def save_image(path, array):
    path.write_bytes(cv2.imencode(path.suffix, array)[1].tobytes())
    return path


@pytest.fixture
def depth():
    depth = np.random.default_rng(0).integers(300, 2000, (12, 16)).astype(np.float32) / np.float32(1000)
    depth[2:4, 3:6] = 0
    return depth


# ---- point clouds and intrinsics


def test_point_cloud_on_disk_can_be_read_back_by_hand(tmp_path, depth):
    rgb = np.random.default_rng(1).integers(0, 256, (12, 16, 3), dtype=np.uint8)
    path = tmp_path / "cloud.ply"
    n = files.write_ply(path, depth, rgb, CAMERA)
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
    np.testing.assert_allclose(vertices["xyz"], unproject(depth, CAMERA), rtol=1e-6)
    np.testing.assert_array_equal(vertices["rgb"], rgb[depth > 0])
    with pytest.raises(ValueError, match="uint8 like the depth map"):
        files.write_ply(path, depth, rgb[:4], CAMERA)
    assert list(tmp_path.iterdir()) == [path]


def test_intrinsics_from_yaml_matrix_and_array(tmp_path):
    (tmp_path / "a.yaml").write_text(YAML)
    assert files.read_intrinsics(tmp_path / "a.yaml") == CAMERA
    assert files.read_intrinsics(tmp_path / "a.yaml", (12, 16)) == CAMERA
    matrix = np.array([[92, 0, 7.2], [0, 88, 5.9], [0, 0, 1]])
    np.savetxt(tmp_path / "spaces.txt", matrix)
    np.savetxt(tmp_path / "commas.txt", matrix, delimiter=",")
    np.save(tmp_path / "k.npy", matrix)
    for name in ("spaces.txt", "commas.txt", "k.npy"):
        assert files.read_intrinsics(tmp_path / name, (12, 16)) == CAMERA


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
        files.read_intrinsics(tmp_path / name, size)


def test_a_crop_far_from_the_middle_is_read_where_its_file_says_how_large_it_is(tmp_path):
    corner = Camera(92, 88, 64, 48, 128, 96).cropped(slice(0, 40), slice(70, 128))  # the centre lies outside it
    numbers = "".join(f"{name}: {getattr(corner, name)}\n" for name in ("fx", "fy", "cx", "cy", "width", "height"))
    (tmp_path / "crop.yaml").write_text(numbers)
    assert files.read_intrinsics(tmp_path / "crop.yaml", (40, 58)) == corner
    (tmp_path / "bare.yaml").write_text(numbers.split("width")[0])
    with pytest.raises(ValueError, match="let the file say"):
        files.read_intrinsics(tmp_path / "bare.yaml", (40, 58))


def test_absent_intrinsics(tmp_path):
    for name in ("a.yaml", "k.txt", "k.npy"):
        with pytest.raises(ValueError, match="no file"):
            files.read_intrinsics(tmp_path / name, (12, 16))


# ---- depth, colour, masks


@pytest.mark.parametrize("suffix", [".png", ".npy", ".exr"])
def test_depth_survives_the_disk(tmp_path, depth, suffix):
    path = tmp_path / "déjà vu" / f"depth{suffix}"  # made on the way, and not ASCII
    files.write_depth(path, depth)
    again = files.read_depth(path)
    assert again.dtype == np.float32
    np.testing.assert_allclose(again, depth, atol=1e-6 if suffix == ".png" else 0)
    np.testing.assert_array_equal(again == 0, depth == 0)
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_depth_scale_applies_to_every_type(tmp_path):
    units = np.full((4, 5), 4000, np.uint16)
    png = save_image(tmp_path / "d.png", units)
    np.save(tmp_path / "int.npy", units)
    np.save(tmp_path / "float.npy", np.full((4, 5, 1), 1.25))
    np.save(tmp_path / "float32.npy", np.full((4, 5), 1.25, np.float32))
    assert files.read_depth(png)[0, 0] == 4.0
    assert files.read_depth(png, 0.00025)[0, 0] == 1.0
    assert files.read_depth(tmp_path / "int.npy", 0.00025)[0, 0] == 1.0
    assert files.read_depth(tmp_path / "float.npy")[0, 0] == 1.25
    for name in ("float.npy", "float32.npy"):
        assert files.read_depth(tmp_path / name, 0.5)[0, 0] == 0.625
    for scale in (0, -1, np.nan):
        with pytest.raises(ValueError, match="metres per unit"):
            files.read_depth(png, scale)


def test_bad_readings_become_missing(tmp_path):
    raw = np.array([[0.5, np.nan], [np.inf, -0.5]])
    np.save(tmp_path / "d.npy", raw)
    np.testing.assert_array_equal(files.read_depth(tmp_path / "d.npy"), np.array([[0.5, 0], [0, 0]], np.float32))
    save_exr(tmp_path / "d.exr", Z=raw.astype(np.float32))
    np.testing.assert_array_equal(files.read_depth(tmp_path / "d.exr"), np.array([[0.5, 0], [0, 0]], np.float32))


@pytest.mark.parametrize("scale", [0.0001, 0.00025, 0.001])
def test_65535_is_no_reading_whatever_the_unit(tmp_path, scale):
    units = np.array([[0, 65535, 4000], [65534, 1, 65535]], np.uint16)
    png = save_image(tmp_path / "d.png", units)
    np.save(tmp_path / "wide.npy", units.astype(np.int32))
    for path in (png, tmp_path / "wide.npy"):
        depth = files.read_depth(path, scale)
        assert not depth[units == 65535].any() and depth[0, 2] == np.float32(4000 * scale)
        assert (depth[1, 0] > 0) == (65534 * scale < 65)  # the number beside it is a distance like any other


def test_exr_channels(tmp_path):
    half = np.array([[0.5, np.nan, 0.25]], np.float16)
    grey = save_exr(tmp_path / "grey.exr", R=half, G=half, B=half)
    np.testing.assert_array_equal(files.read_depth(grey), [[0.5, 0, 0.25]])
    normals = save_exr(tmp_path / "normals.exr", R=half, G=half + np.float16(1), B=half)
    with pytest.raises(ValueError, match="normals picture, not depth"):
        files.read_depth(normals)
    other = save_exr(tmp_path / "other.exr", X=half, Y=half)
    with pytest.raises(ValueError, match="expected one channel, Z or R"):
        files.read_depth(other)


def test_unusable_depth_is_refused_with_the_reason(tmp_path):
    grey = np.full((4, 5), 9, np.uint8)
    cases = {
        "expected a 16-bit depth PNG": save_image(tmp_path / "eight.png", grey),
        "was the colour picture given": save_image(tmp_path / "rgb.png", np.dstack([grey] * 3)),
        "no valid depth": save_image(tmp_path / "empty.png", np.zeros((4, 5), np.uint16)),
        "no file": tmp_path / "absent.png",
        "not a plain .npy array": tmp_path / "objects.npy",
        "not an OpenEXR file": tmp_path / "text.exr",
        "expected a PNG, JPEG, TIFF .*, .npy .*or .exr file": tmp_path / "text.png",
        "should hold integers or floats": tmp_path / "text.npy",
    }
    np.save(tmp_path / "objects.npy", np.array([{}], dtype=object))
    np.save(tmp_path / "text.npy", np.array([["a"]]))
    (tmp_path / "text.exr").write_text("hello")
    (tmp_path / "text.png").write_text("hello")
    for message, path in cases.items():
        with pytest.raises(ValueError, match=message):
            files.read_depth(path)
    np.save(tmp_path / "mm.npy", np.full((4, 5), 612.0))
    with pytest.raises(ValueError, match=r"millimetres\? pass depth_scale=0.001"):
        files.read_depth(tmp_path / "mm.npy")
    assert not files.read_depth(cases["no valid depth"], allow_empty=True).any()


@pytest.mark.parametrize("suffix", files.DEPTH)
def test_a_file_cut_short_is_refused(tmp_path, depth, suffix):
    path = tmp_path / f"d{suffix}"
    files.write_depth(path, depth)
    whole = path.read_bytes()
    for size in (0, len(whole) // 2):
        path.write_bytes(whole[:size])
        with pytest.raises(ValueError, match="cannot read"):
            files.read_depth(path)


def test_every_flipped_bit_of_a_png_is_noticed(tmp_path, depth):
    path = tmp_path / "d.png"
    files.write_depth(path, depth)
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    for place in range(len(files.PNG_MAGIC), len(whole)):
        flipped = bytearray(whole)
        flipped[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        with pytest.raises(ValueError, match="cannot read|claims"):  # so many pixels, or another kind of them
            files.read_depth(path)


@pytest.mark.parametrize("share", [0.5, 0.9, 0.99])
def test_a_jpeg_without_its_end_is_refused(tmp_path, share):
    smooth = np.tile(np.linspace(0, 200, 64).astype(np.uint8)[:, None, None], (1, 80, 3))
    path = save_image(tmp_path / "a.jpg", smooth)
    whole = path.read_bytes()
    assert files.read_rgb(path).shape == (64, 80, 3)
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ValueError, match="cannot read"):
        files.read_rgb(path)


def test_a_jpeg_may_hold_a_smaller_one_with_an_end_of_its_own(tmp_path):
    grey = np.full((64, 80, 3), 90, np.uint8)
    path, small = save_image(tmp_path / "a.jpg", grey), cv2.imencode(".jpg", grey[:8, :8])[1].tobytes()
    whole = path.read_bytes()
    remark = b"\xff\xfe" + (2 + len(small)).to_bytes(2, "big") + small
    path.write_bytes(whole[:2] + remark + whole[2:])  # behind the two bytes that begin every JPEG
    np.testing.assert_array_equal(files.read_rgb(path), grey)


def test_rgb_comes_red_first_and_only_as_rgb(tmp_path):
    rgb = np.zeros((4, 5, 3), np.uint8)
    rgb[..., 0] = 200
    path = save_image(tmp_path / "a.png", rgb[..., ::-1])
    np.testing.assert_array_equal(files.read_rgb(path), rgb)
    np.save(tmp_path / "a.npy", rgb)
    np.testing.assert_array_equal(files.read_rgb(tmp_path / "a.npy"), rgb)
    bad = {
        "grey picture": save_image(tmp_path / "grey.png", rgb[..., 0]),
        "RGBA": save_image(tmp_path / "rgba.png", np.dstack([rgb, rgb[..., :1]])),
        "uint16": save_image(tmp_path / "deep.png", rgb.astype(np.uint16)),
    }
    for message, path in bad.items():
        with pytest.raises(ValueError, match=message):
            files.read_rgb(path)


def test_masks(tmp_path):
    soft = np.array([[0, 99, 100, 255]], np.uint8)
    np.testing.assert_array_equal(files.read_mask(save_image(tmp_path / "a.png", soft)), [[False, False, True, True]])
    binary = np.array([[0, 1, 1, 0]], np.uint8)
    np.testing.assert_array_equal(files.read_mask(save_image(tmp_path / "b.png", binary)), binary > 0)
    three = np.dstack([soft] * 3)
    np.testing.assert_array_equal(files.read_mask(save_image(tmp_path / "c.png", three)), soft >= 100)
    np.save(tmp_path / "d.npy", binary > 0)
    np.testing.assert_array_equal(files.read_mask(tmp_path / "d.npy"), binary > 0)
    with pytest.raises(ValueError, match="largest value is 7"):
        files.read_mask(save_image(tmp_path / "ids.png", soft // 99 * 7 % 8))
    three[0, 0] = (9, 0, 0)
    with pytest.raises(ValueError, match="one channel of whole numbers"):
        files.read_mask(save_image(tmp_path / "colour.png", three))


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.full((2, 2), np.nan), "NaN"),
        (np.full((2, 2), -1.0), "negative"),
        (np.ones((2, 2), np.uint16), "floating-point metres"),
        (np.ones((2, 2, 1)), "floating-point metres"),
        (np.full((2, 2), 70.0), "ends at 65.5"),
    ],
)
def test_what_is_not_depth_is_not_written(tmp_path, array, message):
    with pytest.raises(ValueError, match=message):
        files.write_depth(tmp_path / "d.png", array)
    assert not list(tmp_path.iterdir())


def test_an_unknown_suffix_is_refused(tmp_path):
    with pytest.raises(ValueError, match="choose .png, .tif, .tiff, .npy, .exr"):
        files.write_depth(tmp_path / "d.jpg", np.ones((2, 2)))


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path):
    path = tmp_path / "out.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), files.written_whole(path) as part:
        part.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
    with files.written_whole(path) as part:
        part.write_text("new")
        assert path.read_text() == "old" and part.suffix == ".txt"
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]


# --- whole or not at all ----------------------------------------------------------------------------------------------


def test_two_writers_of_one_folder_leave_one_whole(tmp_path):
    folder = tmp_path / "scene"

    def write(mark):
        for _ in range(10):
            with files.folder_written_whole(folder) as part:
                for name in "abc":
                    (part / name).write_text(mark)

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(write, "wxyz"))
    assert len({path.read_text() for path in folder.iterdir()}) == 1 and len(list(folder.iterdir())) == 3
    assert list(tmp_path.iterdir()) == [folder]


def test_the_old_folder_is_not_put_in_the_way_of_another_writer(tmp_path, monkeypatch):
    folder, locked = tmp_path / "scene", files.locked
    folder.mkdir()

    @contextmanager
    def then_another_begins(path):
        with locked(path):
            yield
        folder.rename(tmp_path / "theirs")  # it holds the lock now, and will put its own there

    monkeypatch.setattr(files, "locked", then_another_begins)
    with files.folder_written_whole(folder) as part:
        (part / "a").write_text("new")
    assert list(tmp_path.iterdir()) == [tmp_path / "theirs"] and (tmp_path / "theirs" / "a").read_text() == "new"


def test_an_interrupted_folder_leaves_the_old_one(tmp_path):
    folder = tmp_path / "scene"
    with files.folder_written_whole(folder) as part:
        (part / "a").write_text("old")
    with pytest.raises(KeyboardInterrupt), files.folder_written_whole(folder) as part:
        (part / "a").write_text("new")
        raise KeyboardInterrupt
    assert (folder / "a").read_text() == "old" and list(tmp_path.iterdir()) == [folder]


def test_a_folder_is_not_lost_between_two_renames(tmp_path, monkeypatch):
    folder = tmp_path / "scene"
    with files.folder_written_whole(folder) as part:
        (part / "a").write_text("old")
    rename = Path.rename

    def interrupted(self, target):
        if self.name.endswith(".part") and not self.name.endswith(".old.part"):
            raise KeyboardInterrupt
        return rename(self, target)

    with pytest.raises(KeyboardInterrupt), files.folder_written_whole(folder) as part:
        monkeypatch.setattr(Path, "rename", interrupted)
    assert (folder / "a").read_text() == "old" and list(tmp_path.iterdir()) == [folder]


def test_a_lock_is_held_by_one_and_taken_over_when_it_was_left_behind(tmp_path, monkeypatch):
    target, lock = tmp_path / "card.json", tmp_path / ".card.json.lock"
    with files.locked(target):
        assert lock.is_file()
        monkeypatch.setattr(files, "LOCK_S", 0.05)
        lock.touch()
        os.utime(lock, (time.time() + 99, time.time() + 99))  # its holder is at work
        with pytest.raises(ValueError, match="another process is writing"), files.locked(target):
            pass
        os.utime(lock, (1, 1))
        with files.locked(target):
            assert lock.is_file()
    assert not lock.exists()


def test_of_many_who_take_over_a_lock_one_holds_it_at_a_time(tmp_path, monkeypatch):
    target, lock = tmp_path / "card.json", tmp_path / ".card.json.lock"
    lock.touch()
    os.utime(lock, (1, 1))  # left behind
    within = []

    def write(_):
        with files.locked(target):
            within.append("in")
            time.sleep(0.01)
            within.append("out")

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write, range(16)))
    assert within == ["in", "out"] * 16 and not list(tmp_path.iterdir())


def test_a_stale_lock_is_looked_at_again_when_ones_turn_comes(tmp_path):
    lock, turn = tmp_path / ".card.json.lock", tmp_path / ".card.json.lock.old"
    lock.write_text("made by another in between")
    files._remove_left_behind(lock)
    assert lock.exists()
    os.utime(lock, (1, 1))
    turn.touch()  # another is at it
    files._remove_left_behind(lock)
    assert lock.exists()
    turn.unlink()
    files._remove_left_behind(lock)
    assert not list(tmp_path.iterdir())


def test_a_lock_that_another_took_over_is_left_to_it(tmp_path):
    target, lock = tmp_path / "card.json", tmp_path / ".card.json.lock"
    with files.locked(target):
        lock.write_text("another's")
    assert lock.read_text() == "another's"


def test_threads_that_read_pictures_leave_the_streams_as_they_were(tmp_path, capfd):
    Image.fromarray(np.zeros((64, 64, 3), np.uint8)).save(tmp_path / "a.png")
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda _: files.read_rgb(tmp_path / "a.png"), range(200)))
    print("heard")
    os.write(2, b"heard")
    assert capfd.readouterr() == ("heard\n", "heard")


def test_no_reading_becomes_the_number_that_means_none(tmp_path):
    scale = 0.00025
    with pytest.raises(ValueError, match="use .npy"):
        files.write_depth(tmp_path / "a.png", np.full((2, 2), 65534.6 * scale, np.float32), scale)
    files.write_depth(tmp_path / "a.png", np.full((2, 2), 65534 * scale, np.float32), scale)
    assert files.read_depth_and_unit(tmp_path / "a.png", scale)[0].min() > 16


@pytest.mark.parametrize("scale", [0.0001, 0.00025, 0.0002, 0.001, 0.002])
def test_readings_leave_as_a_png_in_the_unit_in_which_they_came(tmp_path, scale):
    units = (
        np.random.default_rng(0).integers(1, int(5.0 / scale) if scale > 1e-4 else 60000, (40, 50)).astype(np.uint16)
    )
    came = save_image(tmp_path / "in.png", units)
    files.write_depth(tmp_path / "out.png", *files.read_depth_and_unit(came, scale))
    np.testing.assert_array_equal(files.read_array(tmp_path / "out.png"), units)


def test_libraries_print_nothing_of_their_own(tmp_path, capfd):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"Z": np.ones((40, 40), np.float32)}).write(str(tmp_path / "d.exr"))
    capfd.readouterr()
    for name, whole in {
        "d.png": cv2.imencode(".png", np.ones((40, 40), np.uint16))[1].tobytes(),
        "d.tif": cv2.imencode(".tif", np.ones((40, 40), np.uint16))[1].tobytes(),
        "d.jpg": cv2.imencode(".jpg", np.ones((40, 40, 3), np.uint8))[1].tobytes(),
        "d.exr": (tmp_path / "d.exr").read_bytes(),
    }.items():
        for share in (0.3, 0.6, 0.9):
            (tmp_path / name).write_bytes(whole[: int(len(whole) * share)])
            with pytest.raises(ValueError):
                files.read_array(tmp_path / name)
    assert capfd.readouterr() == ("", "")
