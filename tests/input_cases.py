"""Inputs as people have them, and what each must give: arrays, or the reason why not.

``python tests/input_cases.py`` makes them all, reads them, and prints counts; ``test_inputs.py`` does so one by one.
A case is container x type x unit x defect. All show one small frame: a slanted plane 0.5 to 0.7 m away, with holes.
"""

import io
import json
import re
import struct
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
from PIL import Image

from ditr_lite import files
from ditr_lite.camera import Camera

SIZE = (24, 32)
MM = np.tile(np.linspace(500, 700, SIZE[1]).round().astype(np.uint16), (SIZE[0], 1))
MM[4:7, 5:9] = 0
METRES = MM.astype(np.float32) / 1000
RNG = np.random.default_rng(0)
RGB = RNG.integers(0, 255, (*SIZE, 3), np.uint8)
REGION = np.zeros(SIZE, bool)
REGION[8:16, 10:20] = True
UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "tum": 1 / 5000, "quarter_mm": 0.00025, "tenth_mm": 0.0001}
CAMERA = Camera(30.0, 31.0, 15.5, 11.5, SIZE[1], SIZE[0])
K = np.array([[30, 0, 15.5], [0, 31, 11.5], [0, 0, 1]], float)


@dataclass(frozen=True)
class Case:
    """One input.

    Attributes:
        name: of the file that is made, and of the case.
        write: makes it at a path.
        read: reads it.
        expect: the array (or camera) that must come back, or a pattern that the reason of refusal must match.
        warns: a pattern that a warning must match; None where there must be none.
    """

    name: str
    write: Callable[[Path], None]
    read: Callable[[Path], object]
    expect: object
    warns: str | None = None

    def run(self, folder: Path) -> None:
        """Make the input, read it, and raise AssertionError where it gives anything but what is expected."""
        path = folder / self.name.partition("|")[2]
        path.parent.mkdir(parents=True, exist_ok=True)
        self.write(path)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                got = self.read(path)
            except ValueError as error:
                assert isinstance(self.expect, str), f"{self.name}: refused: {error}"
                assert re.search(self.expect, str(error)), f"{self.name}: another reason: {error}"
                assert "\n" not in str(error)
                assert path.name in str(error), f"{self.name}: the file is not named: {error}"
                return
        assert not isinstance(self.expect, str), f"{self.name}: accepted, expected {self.expect!r}"
        said = " ".join(str(w.message) for w in caught)
        assert re.search(self.warns, said) if self.warns else not said, f"{self.name}: warned {said!r}"
        if isinstance(self.expect, np.ndarray):
            assert got.dtype == self.expect.dtype and got.shape == self.expect.shape, f"{self.name}: {got.dtype}"
            near = 2e-3 if "f2" in self.name or "half" in self.name else 1e-4
            assert np.allclose(got, self.expect, atol=near), f"{self.name}: other values"
        else:
            assert got == self.expect, f"{self.name}: {got}"


# --- how files are made -----------------------------------------------------------------------------------------------


def npy(array):
    return lambda path: path.write_bytes(npy_bytes(array))


def npy_bytes(array):
    np.save(buffer := io.BytesIO(), array, allow_pickle=array.dtype == object)
    return buffer.getvalue()


def picture(array, suffix=".png"):
    return lambda path: path.write_bytes(cv2.imencode(suffix, array)[1].tobytes())


def pillow(image, kind="PNG", **options):
    def write(path):
        image.save(buffer := io.BytesIO(), kind, **options)
        path.write_bytes(buffer.getvalue())

    return write


def exr(**channels):
    def write(path):
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        named = {name.replace("__", "."): np.ascontiguousarray(c) for name, c in channels.items()}
        target = path.with_name("made.exr")
        OpenEXR.File(header, named).write(str(target))
        target.rename(path)

    return write


def raw(data):
    return lambda path: path.write_bytes(data)


def text(content):
    return lambda path: path.write_text(content)


def cut(write, share):
    """Leave the first ``share`` of a file."""

    def cut_write(path):
        write(path)
        data = path.read_bytes()
        path.write_bytes(data[: int(len(data) * share)])

    return cut_write


def flip(write, where):
    """Turn one byte, ``where`` of the file from its start."""

    def flip_write(path):
        write(path)
        data = bytearray(path.read_bytes())
        data[int(len(data) * where)] ^= 0xFF
        path.write_bytes(bytes(data))

    return flip_write


def depth_at(scale=None):
    return lambda path: files.read_depth(path, scale)


# --- the table --------------------------------------------------------------------------------------------------------


def depth_types():
    """Yield every container with every type it can hold, in every unit, with the scale that belongs to it."""
    for unit, scale in UNITS.items():
        values = MM.astype(np.float64) * (0.001 / scale)
        for kind in ("f2", "f4", "f8", ">f4", ">f8"):
            if values.max() < 60000 or kind != "f2":
                stored = values.astype(kind)
                yield Case(f"depth|{unit}_{kind.replace('>', 'be_')}.npy", npy(stored), depth_at(scale), METRES)
        yield Case(f"depth|{unit}.tif", picture(values.astype(np.float32), ".tif"), depth_at(scale), METRES)
        yield Case(f"depth|{unit}.EXR", exr(Z=values.astype(np.float32)), depth_at(scale), METRES)
        if scale <= 0.001:
            whole = values.round()
            for kind in ("u2", "i2", "i4", "u4", "i8", ">u2", ">i4"):
                stored = whole.astype(kind)
                yield Case(f"depth|{unit}_{kind.replace('>', 'be_')}.npy", npy(stored), depth_at(scale), METRES)
            yield Case(f"depth|{unit}.png", picture(whole.astype(np.uint16)), depth_at(scale), METRES)
            yield Case(f"depth|{unit}.TIFF", picture(whole.astype(np.uint16), ".tif"), depth_at(scale), METRES)


def depth_units():
    """Yield depth in a unit that nobody named."""
    floats = MM.astype(np.float32)
    yield Case("unit|m.npy", npy(METRES), depth_at(), METRES)
    yield Case("unit|mm.npy", npy(floats), depth_at(), r"millimetres\? pass depth_scale=0.001")
    yield Case("unit|mm.tif", picture(floats, ".tif"), depth_at(), r"millimetres\? pass depth_scale=0.001")
    yield Case("unit|mm.exr", exr(Z=floats), depth_at(), r"millimetres\? pass depth_scale=0.001")
    yield Case("unit|tenth.npy", npy(10 * floats), depth_at(), r"pass depth_scale=0.001|tenths")
    yield Case("unit|cm_far.npy", npy(floats / 5), depth_at(), r"centimetres\? pass depth_scale=0.01")
    yield Case("unit|dm.npy", npy(floats / 100), depth_at(), 10 * METRES, "farther than 5 m")
    yield Case("unit|km.npy", npy(METRES / 1000), depth_at(), r"kilometres\? pass depth_scale=1000")
    yield Case("unit|m_as_mm.npy", npy(METRES), depth_at(0.001), r"nearer than 1 cm.*pass depth_scale")
    yield Case("unit|near.npy", npy(METRES / 6), depth_at(), METRES / 6, "nearer than 0.15 m")
    blended = cv2.resize(cv2.resize(floats, (16, 12), interpolation=cv2.INTER_AREA), SIZE[::-1])
    yield Case("unit|blended_mm.npy", npy(blended), depth_at(), r"values up to 69\d.*depth_scale=0.001")
    few = floats.copy()
    few[:10] = 0.6
    yield Case("unit|mostly_mm.npy", npy(few), depth_at(), "most readings lie beyond 65 m")
    for scale in (0, -1, float("nan"), float("inf")):
        yield Case(f"unit|scale_{scale}.npy", npy(METRES), named(depth_at(scale)), "metres per unit")


def named(read):
    """Let errors that are of no file pass the check for its name."""

    def call(path):
        try:
            return read(path)
        except ValueError as error:
            raise ValueError(f"{error} ({path.name})") from None

    return call


def depth_containers():
    """Yield other ways to hold the same depth."""
    three = np.dstack([MM] * 3)
    four = np.dstack([three, np.full_like(MM, 65535)])
    for name, write in {
        "hw1.npy": npy(METRES[..., None]),
        "three.png": picture(three),
        "four.png": picture(four),
        "D.PNG": picture(MM),
        "no_suffix": picture(MM),
        "wrong_suffix.jpg": picture(MM),
        "npy_as.png": npy(METRES),
        "zlib.tif": pillow(Image.fromarray(MM), "TIFF", compression="tiff_adobe_deflate"),
        "be.pgm": raw(b"P5\n32 24\n65535\n" + MM.astype(">u2").tobytes()),
        "kinect.pgm": raw(b"P5\n32 24\n2047\n" + MM.astype(">u2").tobytes()),
        "y.exr": exr(Y=METRES),
        "r.exr": exr(R=METRES),
        "rgb.exr": exr(R=METRES, G=METRES, B=METRES),
        "blender.exr": exr(ViewLayer__Depth__Z=METRES, ViewLayer__Combined__R=METRES, ViewLayer__Combined__G=METRES),
        "rgbz.exr": exr(R=METRES * 0.3, G=METRES * 0.2, B=METRES * 0.1, Z=METRES),
        "half.exr": exr(Z=METRES.astype(np.float16)),
        "ros.png": raw(struct.pack("<iff", 0, 0, 0) + cv2.imencode(".png", MM)[1].tobytes()),
        "nan.npy": npy(np.where(MM > 0, METRES, np.nan)),
        "inf.npy": npy(np.where(MM > 0, METRES, np.inf)),
        "negative.npy": npy(np.where(MM > 0, METRES, -1)),
        "minus_one.npy": npy(np.where(MM > 0, MM, -1).astype(np.int32)),
        "code.png": picture(np.where(MM > 0, MM, 65535).astype(np.uint16)),
        "comment.png": pillow(Image.fromarray(MM), icc_profile=b"odd profile that libpng complains of"),
    }.items():
        yield Case(f"container|{name}", write, depth_at(), METRES)
    inverse = np.where(MM > 0, 1000 / np.maximum(METRES, 0.1) + 5, 0).round().astype(np.uint16)
    header = struct.pack("<iff", 0, 1000, 5)
    quantised = np.where(MM > 0, 1000 / np.maximum(inverse.astype(np.float64) - 5, 1), 0).astype(np.float32)
    data = header + cv2.imencode(".png", inverse)[1].tobytes()
    yield Case("container|ros_inverse.png", raw(data), depth_at(), quantised)


def damaged_depth():
    """Yield depth that cannot be used."""
    whole = {".png": picture(MM), ".tif": picture(MM, ".tif"), ".npy": npy(METRES), ".exr": exr(Z=METRES)}
    for suffix, write in whole.items():
        for share in (0, 0.1, 0.3, 0.6, 0.9):
            yield Case(f"damaged|cut{share}{suffix}", cut(write, share), depth_at(), "cannot read")
    for where in (0.3, 0.5, 0.7):
        yield Case(f"damaged|flip{where}.png", flip(picture(MM), where), depth_at(), "cannot read")
    np.savez(archive := io.BytesIO(), depth=MM)
    huge = b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (1000000, 1000000), }"
    png = bytearray(cv2.imencode(".png", MM)[1].tobytes())
    png[16:24] = struct.pack(">II", 60000, 60000)
    pages = [Image.fromarray(MM)] * 2
    swapped = np.random.default_rng(1).integers(500, 560, SIZE).astype(np.uint16)
    for name, write, reason in (
        ("npz.npy", raw(archive.getvalue()), "not a plain .npy array"),
        ("terabytes.npy", raw(huge.ljust(128) + b"\n"), "not a plain .npy array"),
        ("terabytes.png", raw(bytes(png)), "cannot read|claims"),
        ("pickled.npy", npy(np.array([{"depth": 1}], dtype=object)), "not a plain .npy array"),
        ("header.npy", raw(b"\x93NUMPY\x01\x00\x10\x00{'descr': oops}\n"), "not a plain .npy array"),
        ("version.npy", raw(b"\x93NUMPY\x09\x00\x10\x00{}"), "not a plain .npy array"),
        ("empty.png", raw(b""), "cannot read"),
        ("text.png", text("hello"), "cannot read"),
        ("text.exr", text("hello"), "not an OpenEXR file"),
        ("zeros.png", raw(bytes(2000)), "cannot read"),
        ("zero_size.npy", npy(np.zeros((0, 0))), "no pixel"),
        ("zero_wide.npy", npy(np.zeros((4, 0))), "no pixel"),
        ("chw.npy", npy(METRES[None, ...].repeat(2, 0)), "one depth channel"),
        ("line.npy", npy(METRES[0]), "one depth channel"),
        ("one_number.npy", npy(np.float32(0.6)), "one depth channel"),
        ("complex.npy", npy(METRES.astype(complex)), "integers or floats"),
        ("words.npy", npy(np.array([["a"]])), "integers or floats"),
        ("eight.png", picture((MM // 4).astype(np.uint8)), "8 bits a pixel"),
        ("bool.npy", npy(MM > 0), "8 bits a pixel"),
        ("colour.png", picture(RGB), "was the colour picture given"),
        ("normals.exr", exr(R=METRES, G=METRES + 1, B=METRES), "R, G, B that differ"),
        ("xy.exr", exr(A=METRES, X=METRES), "expected one channel, Z or R"),
        ("double.tif", picture(METRES.astype(np.float64), ".tif"), "expected .* TIFF .of integers or float32"),
        ("all_zero.png", picture(0 * MM), "no valid depth"),
        ("all_nan.npy", npy(np.full(SIZE, np.nan)), "no valid depth"),
        ("all_code.png", picture(np.full_like(MM, 65535)), "no valid depth"),
        ("swapped.png", picture(swapped.byteswap()), "two bytes swapped"),
        ("swapped.npy", npy(swapped.byteswap()), "two bytes swapped"),
        ("swapped.tif", picture(swapped.byteswap(), ".tif"), "two bytes swapped"),
        ("pages.tif", pillow(pages[0], "TIFF", save_all=True, append_images=pages[1:]), "holds 2 pictures"),
        ("gif.png", pillow(Image.fromarray((MM // 4).astype(np.uint8)), "GIF"), "cannot read"),
        ("._mac.png", raw(b"\x00\x05\x16\x07\x00\x02\x00\x00Mac OS X        " + bytes(60)), "cannot read"),
        ("turned.png", pillow(Image.fromarray(MM), exif=orientation(6)), "EXIF orientation 6"),
    ):
        yield Case(f"damaged|{name}", write, depth_at(), reason)
    yield Case("damaged|absent.png", lambda path: None, depth_at(), "no file")


def orientation(value):
    """Return EXIF data that says how to turn a picture."""
    exif = Image.Exif()
    exif[files.ORIENTATION] = value
    return exif


def masks():
    """Yield masks in every way in which tools write them."""
    m = REGION.astype(np.uint8)
    red, black, inverted = [0, 0, 0, 128, 0, 0], [0, 0, 0, 255, 255, 255], [255, 255, 255, 0, 0, 0]

    def palette(indices, colours):
        image = Image.fromarray(indices)
        image.putpalette(colours + [0] * (768 - len(colours)))
        return image

    soft = np.where(
        cv2.erode(255 * m, np.ones((3, 3))) > 0, 255, cv2.blur(255 * m, (3, 3))
    )  # in the region at least 100
    soft = np.where(m > 0, np.maximum(soft, 128), np.minimum(soft, 64)).astype(np.uint8)
    opaque, full = np.full_like(m, 255), np.full((*SIZE, 3), 255, np.uint8)
    for name, write in {
        "grey255.png": picture(255 * m),
        "grey01.png": picture(m),
        "u16.png": picture(m.astype(np.uint16) * 65535),
        "u16_one.png": picture(m.astype(np.uint16)),
        "soft.png": picture(soft),
        "three.png": picture(np.dstack([255 * m] * 3)),
        "bit.png": pillow(Image.fromarray(255 * m).convert("1")),
        "palette.png": pillow(palette(m, red)),
        "palette_bw.png": pillow(palette(m, black)),
        "palette_wb.png": pillow(palette(1 - m, inverted)),
        "la.png": pillow(Image.merge("LA", (Image.fromarray(255 * m), Image.fromarray(opaque)))),
        "la_alpha.png": pillow(Image.merge("LA", (Image.fromarray(opaque), Image.fromarray(255 * m)))),
        "rgba.png": picture(np.dstack([255 * m] * 3 + [opaque])),
        "cutout.png": picture(np.dstack([full, 255 * m])),
        "mask.tif": picture(255 * m, ".tif"),
        "MASK.BMP": picture(255 * m, ".bmp"),
        "bool.npy": npy(REGION),
        "int.npy": npy(m.astype(np.int64)),
        "float.npy": npy(m.astype(np.float32)),
        "hw1.npy": npy(REGION[..., None]),
    }.items():
        yield Case(f"mask|{name}", write, files.read_mask, REGION)
    for name, write, reason in (
        ("classes.png", picture(2 * m), "largest value is 2"),
        ("classes_palette.png", pillow(palette(2 * m, [*red, 0, 128, 0])), "largest value is 2"),
        ("ids.png", picture(7 * m), "largest value is 7"),
        ("many_ids.png", picture(np.maximum(120 * m, 10 * np.roll(m, 9, 0))), "areas of other values"),
        ("ignore.png", picture(np.maximum(255 * m, np.roll(m, 9, 0))), "areas of other values"),
        ("wide.npy", npy(300 * m.astype(np.int32)), "largest value is 300"),
        ("negative.npy", npy(-m.astype(np.int8)), "smallest value is -1"),
        ("zero_size.npy", npy(np.zeros((0, 5), bool)), "no pixel"),
        ("half.npy", npy(0.5 * m), "whole numbers"),
        ("nan.npy", npy(np.where(REGION, np.nan, 0)), "whole numbers"),
        ("colour.png", picture(RGB), "one channel of whole numbers"),
        ("cut.png", cut(picture(255 * m), 0.5), "cannot read"),
        ("absent.png", lambda path: None, "no file"),
    ):
        yield Case(f"bad mask|{name}", write, files.read_mask, reason)


def colours():
    """Yield colour pictures."""
    image = Image.fromarray(RGB)
    bgr = np.ascontiguousarray(RGB[..., ::-1])
    for name, write in {
        "a.png": picture(bgr),
        "A.PNG": picture(bgr),
        "a.bmp": picture(bgr, ".bmp"),
        "a.tif": pillow(image, "TIFF"),
        "a.webp": pillow(image, "WEBP", lossless=True),
        "a.ppm": picture(bgr, ".ppm"),
        "a.npy": npy(RGB),
        "exif1.png": pillow(image, exif=orientation(1)),
    }.items():
        yield Case(f"colour|{name}", write, files.read_rgb, RGB)
    turns = {2: 0, 3: 3, 4: 1, 5: 5, 6: 2, 7: 6, 8: 4}  # the transposition that stores what the tag will undo
    for value, turn in turns.items():
        stored = image.transpose(Image.Transpose(turn))
        for kind in ("PNG", "TIFF"):
            write = pillow(stored, kind, exif=orientation(value))
            name = f"colour|exif{value}.{kind.lower()}"
            yield Case(name, write, files.read_rgb, RGB, f"EXIF orientation {value}")
    smooth = np.dstack([np.tile(np.arange(32, dtype=np.uint8) * 7, (24, 1))] * 3)
    jpeg = picture(smooth, ".jpg")
    for share in (0.3, 0.6, 0.9, 0.98):
        yield Case(f"bad colour|cut{share}.jpg", cut(jpeg, share), files.read_rgb, "cannot read")
        yield Case(f"bad colour|cut{share}.png", cut(picture(RGB), share), files.read_rgb, "cannot read")
    for name, write, reason in (
        ("grey.png", picture(RGB[..., 0]), "grey picture"),
        ("rgba.png", picture(np.dstack([RGB, RGB[..., 0]])), "four channels"),
        ("deep.png", picture(RGB.astype(np.uint16) * 257), "uint16"),
        ("float.npy", npy(RGB / 255.0), "float64"),
        ("chw.npy", npy(RGB.transpose(2, 0, 1)), "uint8"),
        ("depth.png", picture(MM), "was a depth map"),
        ("zero.npy", npy(np.zeros((0, 0, 3), np.uint8)), "no pixel"),
        ("cmyk.jpg", pillow(image.convert("CMYK"), "JPEG"), "colours as CMYK: save it as RGB"),
        ("ycbcr.tif", pillow(image.convert("YCbCr"), "TIFF"), "colours as YCbCr: save it as RGB"),
        ("lab.tif", pillow(image.convert("LAB"), "TIFF"), "colours as LAB: save it as RGB"),
        ("photo.heic", raw(b"\x00\x00\x00\x18ftypheic" + bytes(500)), "cannot read"),
        ("absent.jpg", lambda path: None, "no file"),
    ):
        yield Case(f"bad colour|{name}", write, files.read_rgb, reason)


ROS = """image_width: 32
image_height: 24
camera_name: head
camera_matrix:
  rows: 3
  cols: 3
  data: [30.0, 0.0, 15.5, 0.0, 31.0, 11.5, 0.0, 0.0, 1.0]
distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}
"""
ROS_2 = "header:\n  frame_id: c\nheight: 24\nwidth: 32\nk:\n" + "".join(f"- {number}\n" for number in K.ravel())
ROS_ECHO = """height: 24
width: 32
distortion_model: "plumb_bob"
K: [30.0, 0.0, 15.5, 0.0, 31.0, 11.5, 0.0, 0.0, 1.0]
P: [30.0, 0.0, 15.5, 0.0, 0.0, 31.0, 11.5, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
roi:
  x_offset: 0
  y_offset: 0
  height: 0
  width: 0
  do_rectify: False
---
"""  # of `rostopic echo camera_info`
NAMED = {"fx": 30.0, "fy": 31.0, "cx": 15.5, "cy": 11.5}
LINES = "".join(f"{key}: {value}\n" for key, value in NAMED.items())


def cameras():
    """Yield camera files."""

    def at(size=SIZE):
        return lambda path: files.read_intrinsics(path, size)

    rows = "30 0 15.5\n0 31 11.5\n0 0 1\n"
    realsense = {"width": 32, "height": 24, "ppx": 15.5, "ppy": 11.5, "fx": 30.0, "fy": 31.0, "model": "none"}
    open3d = {"width": 32, "height": 24, "intrinsic_matrix": [30.0, 0, 0, 0, 31.0, 0, 15.5, 11.5, 1]}
    for name, content in {
        "K.txt": rows,
        "K.csv": rows.replace(" ", ","),
        "a.yaml": LINES,
        "sized.yaml": LINES + "width: 32\nheight: 24\n",
        "xres.yml": LINES + "xres: 32\nyres: 24\n",
        "ros.yaml": ROS,
        "ros2.yaml": ROS_2,
        "ros2_echo.yaml": ROS_2 + ROS_ECHO[ROS_ECHO.index("binning") :],
        "ros1_echo.yaml": ROS_ECHO,
        "ros1_echo_twice.yaml": 2 * ROS_ECHO,
        "ros1.yaml": "height: 24\nwidth: 32\nK: [30.0, 0.0, 15.5, 0.0, 31.0, 11.5, 0.0, 0.0, 1.0]\n",
        "realsense.json": json.dumps(realsense),
        "realsense.txt": "Width: 32\nHeight: 24\nPPX: 15.5\nPPY: 11.5\nFx: 30\nFy: 31\n",
        "open3d.json": json.dumps(open3d),
        "nested.json": json.dumps({"color": realsense}),
        "k.json": json.dumps({"K": K.tolist()}),
    }.items():
        yield Case(f"camera|{name}", text(content), at(), CAMERA)
        if "width" in content.lower() or "xres" in content:
            yield Case(f"camera|alone_{name}", text(content), at(None), CAMERA)
            yield Case(f"camera|other_size_{name}", text(content), at((240, 320)), "is for pictures of")
    yield Case("camera|K.npy", npy(K), at(), CAMERA)
    normalised = K / np.array([[32], [24], [1]])
    half, twice = K / np.array([[2], [2], [1]]), K * np.array([[2], [2], [1]])
    for name, write, reason in (
        ("normalised.npy", npy(normalised), "normalised"),
        ("half.npy", npy(half), "another size"),
        ("twice.npy", npy(twice), "another size"),
        ("millimetres.npy", npy(np.array([[1.9, 0, 15.5], [0, 1.9, 11.5], [0, 0, 1]])), "no camera of"),
        ("stretched.npy", npy(np.array([[30, 0, 15.5], [0, 90, 11.5], [0, 0, 1]])), "no camera of"),
        ("transposed.npy", npy(K.T), "last row 0 0 1"),
        ("four.npy", npy(np.eye(4)), "3x3 camera matrix"),
        ("words.npy", npy(np.array([["a"] * 3] * 3)), "3x3 camera matrix"),
        ("bytes.yaml", raw(b"fx: \xff\xfe\n"), "UTF-8"),
        ("list.json", text("[1, 2]"), "cannot read|lacks"),
        ("broken.json", text('{"fx": '), "as JSON"),
        ("deep.json", text('{"a": ' * 3000 + "1" + "}" * 3000), "JSON|lacks"),
        ("two.json", text(json.dumps({"left": realsense, "right": realsense})), "2 cameras"),
        ("two.yaml", text("color:\n" + LINES + "depth:\n" + LINES.replace("30", "25")), "several cameras"),
        ("two_ros.yaml", text(ROS_ECHO + ROS_ECHO.replace("30", "25")), "several cameras"),
        ("odd.json", text(json.dumps({"K": "thirty", "fx": None})), "lacks"),
        ("odd_matrix.json", text(json.dumps({"K": [["a"] * 3] * 3})), "should hold numbers"),
        ("few.yaml", text("K: [30, 0, 15.5]\n"), "3x3 camera matrix|lacks"),
        ("empty.yaml", text(""), "holds no numbers|lacks"),
        ("no_size.json", text(json.dumps(realsense | {"width": 0})), "size"),
    ):
        yield Case(f"bad camera|{name}", write, at(), reason)


def table() -> list[Case]:
    """Return all cases."""
    makers = (depth_types, depth_units, depth_containers, damaged_depth, masks, colours, cameras)
    return [case for maker in makers for case in maker()]


def main() -> int:
    """Run all cases and print how many of each kind gave what they should."""
    wrong, right = Counter(), Counter()
    for case in table():
        kind = case.name.partition("|")[0]
        with tempfile.TemporaryDirectory() as folder:
            try:
                case.run(Path(folder))
                right[kind] += 1
            except Exception as error:
                wrong[kind] += 1
                print(f"{case.name}: {type(error).__name__}: {str(error)[:300]}")
    for kind in right | wrong:
        print(f"{kind:12} {right[kind]:4} right {wrong[kind]:4} wrong")
    print(f"{'all':12} {right.total():4} right {wrong.total():4} wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
