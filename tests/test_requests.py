"""What callers hand to the system: numbers, arrays of any kind, and parts of their own."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ditr_lite import diffusion
from ditr_lite.config import RefineConfig, override, preset
from ditr_lite.pipeline import Ditr, build
from ditr_lite.units import MAX_SEED, check_inputs, check_unit, clean_depth, upsample_sparse

TINY = preset("tiny")
SIZE = (48, 64)
RNG = np.random.default_rng(0)
RGB = RNG.integers(0, 255, (*SIZE, 3), np.uint8)
DEPTH = np.tile(np.linspace(0.5, 0.7, SIZE[1], dtype=np.float32), (SIZE[0], 1))
DEPTH[5:9, 5:20] = 0
REGION = np.zeros(SIZE, bool)
REGION[20:30, 20:40] = True


@pytest.fixture(scope="module")
def parts():
    torch.manual_seed(0)
    return build(TINY)


@pytest.fixture(scope="module")
def ditr(parts):
    return Ditr(parts, TINY)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"samples": 2.5}, "samples: expected a whole number, got 2.5"),
        ({"samples": "2"}, "samples: expected a whole number"),
        ({"samples": True}, "samples: expected a whole number"),
        ({"samples": 100_000}, "samples: expected at most 256"),
        ({"samples": -1}, "samples: expected at least 1"),
        ({"steps": 1.0}, "steps: expected a whole number"),
        ({"steps": 0}, "steps: expected at least 1"),
        ({"steps": 1001}, "steps: expected at most 1000"),
        ({"seed": -1}, "seed: expected at least 0"),
        ({"seed": 2**63}, "seed: expected at most"),
        ({"seed": 0.5}, "seed: expected a whole number"),
        ({"threshold": 1.5}, "threshold: expected a probability"),
        ({"threshold": float("nan")}, "threshold: expected a probability"),
        ({"depth": 1000 * DEPTH}, r"depth: most readings lie beyond 65 m.*millimetres\? multiply it by 0.001"),
        ({"depth": DEPTH / 1000}, r"depth: most readings lie nearer than 1 cm.*kilometres\?"),
        ({"depth": DEPTH.astype(object)}, "depth: expected"),
        ({"depth": [[1.0, 2.0], [3.0]]}, "depth: expected"),
        ({"rgb": None}, "rgb: expected"),
        ({"rgb": RGB[:0], "depth": DEPTH[:0], "region": REGION[:0]}, "depth: expected at least one pixel"),
        ({"rgb": DEPTH, "depth": RGB}, "rgb: expected"),
    ],
)
def test_odd_requests_are_refused_before_anything_runs(ditr, monkeypatch, change, message):
    monkeypatch.setattr(ditr, "inpaint", None)
    with pytest.raises(ValueError, match=message):
        ditr(**{"rgb": RGB, "depth": DEPTH, "region": REGION} | change)


def test_whole_numbers_of_numpy_are_whole_numbers(ditr):
    plain = ditr(RGB, DEPTH, REGION, steps=1, samples=1, seed=3)
    numpy = ditr(RGB, DEPTH, REGION, steps=np.int32(1), samples=np.uint8(1), seed=np.int64(3))
    assert np.array_equal(plain.depth, numpy.depth)
    ditr(RGB, DEPTH, REGION, steps=1, samples=1, seed=MAX_SEED)


def test_masked_pixels_are_missing():
    masked = np.ma.masked_array(DEPTH, DEPTH > 0.6)
    _, depth, _ = check_inputs(RGB, masked, REGION, 1)
    assert np.array_equal(depth > 0, (DEPTH > 0) & (DEPTH <= 0.6))
    assert not clean_depth(np.ma.masked_all((2, 3))).any()
    _, _, region = check_inputs(RGB, DEPTH, np.ma.masked_array(np.ones(SIZE, bool), ~REGION), 1)
    assert np.array_equal(region, REGION)


@pytest.mark.parametrize(("factor", "warned"), [(1.0, ""), (0.2, "nearer than 0.15"), (20.0, "farther than 5 m")])
def test_an_unusual_distance_is_warned_of(factor, warned, recwarn):
    check_unit("depth", factor * DEPTH)
    assert [warned in str(w.message) for w in recwarn] == [True] * bool(warned)


def test_a_device_that_is_not_there_is_refused(parts):
    for device in ("cuda:7", "nonsense", "meta:x"):
        if device.startswith("cuda") and torch.cuda.device_count() > 7:
            continue
        with pytest.raises(ValueError, match="cannot be used here") as refusal:
            Ditr(parts, TINY, device=device)
        assert "\n" not in str(refusal.value)


# --- parts of one's own -----------------------------------------------------------------------------------------------


def test_a_boundary_of_ones_own_guides_the_system(parts):
    seen = []

    def mine(image):
        seen.append((image.shape, image.dtype))
        found = np.zeros(image.shape[:2], bool)
        found[::4] = True
        return found

    out = Ditr(parts, TINY, boundary=mine)(RGB, DEPTH, REGION, samples=1)
    assert out.boundary_rgb.any() and {dtype for _, dtype in seen} == {np.dtype(np.uint8), np.dtype(np.float32)}


@pytest.mark.parametrize("wrong", [lambda x: x, lambda x: np.zeros((3, 3), bool), lambda x: None])
def test_a_boundary_of_another_shape_or_type_is_refused(parts, wrong):
    with pytest.raises(ValueError, match="boundary: expected .* bool of a picture"):
        Ditr(parts, TINY, boundary=wrong)(RGB, DEPTH, REGION, samples=1)


def test_kernels_bring_no_threshold_or_looks_with_them(parts):
    ditr = Ditr(parts, TINY)
    own = TINY.refine
    ditr(RGB, DEPTH, samples=1, refine=replace(own, median=0))  # the system's own
    ditr(RGB, DEPTH, samples=1, refine=RefineConfig(0, 0, 0))  # the defaults, which nobody asked for
    for name, value in {"threshold": 0.9, "temperature": 50.0, "looks": (2.0,)}.items():
        with pytest.raises(ValueError, match=f"its {name} .* would do nothing"):
            ditr(RGB, DEPTH, samples=1, refine=replace(own, **{name: value}))


def test_the_sampler_adds_the_noise_of_its_setting(parts):
    drawn = []
    for eta in (0, 0, 1):
        ditr = Ditr(parts, override(TINY, **{"sampler.eta": eta}))
        how = {"generator": torch.Generator().manual_seed(0), "x_T": torch.ones(2, 1, 4, 4)}
        drawn.append(ditr.sampler(lambda x, t: 0.5 * x, (2, 1, 4, 4), ditr.schedule, 3, "x0", **how))
    assert torch.equal(drawn[0], drawn[1]) and not torch.equal(drawn[0], drawn[2])
    with pytest.raises(ValueError, match="sampler.eta: expected a number from 0 to 1, got 2"):
        override(TINY, **{"sampler.eta": 2})


def test_a_sampler_of_ones_own_is_asked_for_every_latent(parts):
    asked = []

    def mine(predict, shape, schedule, steps, prediction, generator=None, x_T=None):
        asked.append(tuple(shape))
        return diffusion.sample(predict, shape, schedule, steps, prediction, generator=generator, x_T=x_T)

    own = Ditr(parts, TINY, sampler=mine)(RGB, DEPTH, REGION, samples=1)
    assert np.array_equal(own.depth, Ditr(parts, TINY)(RGB, DEPTH, REGION, samples=1).depth) and len(asked) == 2


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda predict, shape, *_, **__: torch.zeros(shape)[..., :-1], "sampler: expected a tensor"),
        (lambda predict, shape, *_, **__: np.zeros(shape), "sampler: expected a tensor .* got ndarray"),
        (lambda predict, shape, *_, **__: torch.full(shape, torch.nan), "NaN or infinity"),
    ],
)
def test_a_sampler_that_returns_something_else_is_refused(parts, wrong, message):
    with pytest.raises(ValueError, match=message):
        Ditr(parts, TINY, sampler=wrong)(RGB, DEPTH, REGION, samples=1)


# --- promises ---------------------------------------------------------------------------------------------------------

ODD = st.sampled_from([0.0, -1.0, np.nan, np.inf, -np.inf, 100.0, 1e-4]) | st.floats(0.25, 4.0, width=32)


@settings(max_examples=15, deadline=None)
@given(data=st.data(), height=st.integers(1, 70), width=st.integers(1, 70), adjust=st.booleans())
def test_readings_come_back_bit_for_bit_and_the_rest_is_filled(ditr, data, height, width, adjust):
    kind = data.draw(st.sampled_from([np.float16, np.float32, np.float64]))
    few = data.draw(arrays(np.float64, (min(height, 4), min(width, 4)), elements=ODD))
    tiles = (-(-height // few.shape[0]), -(-width // few.shape[1]))
    depth = np.tile(few, tiles)[:height, :width].astype(kind)
    region = data.draw(arrays(bool, (height, width)) | st.just(np.zeros((height, width), bool)) | st.none())
    rgb = np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8)
    given = [None if array is None else array.copy() for array in (rgb, depth, region)]
    try:
        clean = check_inputs(rgb, depth, region, 1)[1]
    except ValueError:
        return  # nothing to complete from
    out = ditr(rgb, depth, region, steps=1, samples=1, adjust=adjust)
    keep = (clean > 0) & ~out.region
    assert out.depth.shape == (height, width) and out.depth.dtype == np.float32
    assert np.isfinite(out.depth).all() and (out.depth > 0).all()
    assert region is None or np.array_equal(out.region, given[2])
    assert adjust or np.array_equal(out.depth[keep].view(np.uint32), clean[keep].view(np.uint32))
    assert np.array_equal(rgb, given[0]) and np.array_equal(depth, given[1], equal_nan=True)
    assert region is None or np.array_equal(region, given[2])


@settings(deadline=None)
@given(h=st.integers(1, 30), w=st.integers(1, 30), zoom=st.integers(1, 9))
def test_upsampled_depth_holds_every_reading_once_and_nothing_else(h, w, zoom):
    depth = np.arange(1, 1 + h * w, dtype=np.float32).reshape(h, w)
    large = upsample_sparse(depth, (h * zoom, w * zoom))
    assert np.array_equal(large[large > 0], depth.ravel()) and large.shape == (h * zoom, w * zoom)


@pytest.mark.parametrize("kind", [torch.int64, torch.float64])
def test_a_sampler_of_another_type_is_refused_or_converted(parts, kind):
    own = Ditr(parts, TINY, sampler=lambda predict, shape, *a, **k: torch.zeros(shape, dtype=kind))
    if kind == torch.int64:
        with pytest.raises(ValueError, match="sampler: expected latents of floating-point numbers"):
            own(RGB, DEPTH, REGION, samples=1)
    else:
        assert np.isfinite(own(RGB, DEPTH, REGION, samples=1).depth).all()


@pytest.mark.parametrize(
    "returned, told",
    [
        (lambda like: like.new_zeros(1, 3, *like.shape[2:]), "expected a dictionary with float logits .* got Tensor"),
        (lambda like: {"logits": like.new_zeros(1, 2, *like.shape[2:])}, r"got logits \(1, 2, "),
        (lambda like: {"logits": like.new_zeros(3, *like.shape[2:])}, r"got logits \(3, "),
        (lambda like: {"logits": like.new_full((1, 3, *like.shape[2:]), float("nan"))}, "the logits hold NaN"),
        (lambda like: {}, "got dict"),
    ],
)
def test_a_stage_one_of_ones_own_that_returns_something_else_is_told(returned, told):
    ditr = Ditr(build(TINY), TINY)

    class Mine(torch.nn.Module):
        def forward(self, rgb, depth_n, valid):
            return returned(depth_n)

    ditr.parts["region"] = Mine()
    with pytest.raises(ValueError, match=f"stage one: .*{told}"):
        ditr(RGB, DEPTH)


def test_a_denoiser_of_ones_own_is_asked_for_both_of_its_calls():
    ditr = Ditr(build(TINY), TINY)
    ditr.parts["optical"] = torch.nn.Identity()
    with pytest.raises(ValueError, match="the optical denoiser should have two calls.*Identity lacks one"):
        ditr(RGB, DEPTH, region=DEPTH > 0)
    with pytest.raises(ValueError, match="sampler: expected a call like diffusion.sample, got 'ddim'"):
        Ditr(build(TINY), TINY, sampler="ddim")
