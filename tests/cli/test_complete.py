"""``complete``: what it must not destroy, folders of frames, depth of low resolution, video, warnings."""

import re
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from ditr_lite import files, pipeline
from ditr_lite.cli import complete, main
from ditr_lite.cli.video import Steady
from ditr_lite.config import StdConfig
from ditr_lite.data import load_sample

SHAPE = (64, 96)
QUICK = ["--steps", "1", "--samples", "1"]


def command(weights, **given):
    """Return a command line of `complete`."""
    pairs = [(f"--{name.replace('_', '-')}", str(value)) for name, value in given.items()]
    return ["complete", "--weights", str(weights), *QUICK, *(word for pair in pairs for word in pair)]


def refused(argv, capsys):
    """Run a command that must be refused, and return its one line."""
    assert main(argv) == 2
    said = capsys.readouterr()
    lines = said.err.strip().splitlines()
    assert len(lines) == 1 and not said.out, said
    return lines[0]


@pytest.mark.parametrize("target", ["out", "panel", "ply"])
@pytest.mark.parametrize("source", ["rgb", "depth", "region", "intrinsics"])
@pytest.mark.parametrize("disguise", ["same", "dots", "link", "hard link"])
def test_no_target_is_an_input(frame, weights, tmp_path, capsys, target, source, disguise):
    suffix = {"out": ".png", "panel": ".png", "ply": ".ply"}[target]
    inputs = {
        "rgb": frame / "a.png",
        "depth": frame / "b.png",
        "region": frame / "m.png",
        "intrinsics": frame / "K.txt",
    }
    taken = frame / f"taken{suffix}"
    shutil.copy(inputs[source], taken)
    inputs[source] = taken
    before = taken.read_bytes()
    other = tmp_path / f"other{suffix}"
    if disguise == "link":
        other.symlink_to(taken)
    elif disguise == "hard link":
        other.hardlink_to(taken)
    path = {"same": taken, "dots": frame / ".." / "in" / taken.name}.get(disguise, other)
    given = {**inputs, "out": tmp_path / "c.npy", "ply": tmp_path / "c.ply", target: path}
    assert f"--{target} and --{source} are the same file" in refused(command(weights, **given), capsys)
    assert taken.read_bytes() == before and not (tmp_path / "c.npy").exists()


def test_targets_differ_from_each_other(frame, weights, tmp_path, capsys):
    given = {"rgb": frame / "a.png", "depth": frame / "b.png", "out": tmp_path / "c.png", "panel": tmp_path / "c.png"}
    assert "--panel and --out are the same file" in refused(command(weights, **given), capsys)
    assert not (tmp_path / "c.png").exists()


def test_readings_in_tenths_of_a_millimetre_stay_exact(frame, weights, tmp_path):
    tenths = np.random.default_rng(0).integers(5000, 6000, SHAPE).astype(np.uint16)
    cv2.imwrite(str(frame / "b.png"), tenths)
    given = {"rgb": frame / "a.png", "depth": frame / "b.png", "region": frame / "m.png", "out": tmp_path / "c.png"}
    assert main(command(weights, **given, depth_scale=0.0001)) == 0
    out, keep = cv2.imread(str(tmp_path / "c.png"), -1), ~files.read_mask(frame / "m.png")
    assert np.array_equal(out[keep], tenths[keep])


def test_readings_outside_the_region_move_when_that_is_asked_for(frame, woken, tmp_path):
    cv2.imwrite(str(frame / "b.png"), np.random.default_rng(0).integers(500, 700, SHAPE).astype(np.uint16))
    given = {"rgb": frame / "a.png", "depth": frame / "b.png", "region": frame / "m.png"}
    assert main(command(woken, **given, out=tmp_path / "kept.npy")) == 0
    assert main([*command(woken, **given, out=tmp_path / "moved.npy"), "--adjust"]) == 0
    raw, region = files.read_depth(frame / "b.png"), files.read_mask(frame / "m.png")
    kept, moved = np.load(tmp_path / "kept.npy"), np.load(tmp_path / "moved.npy")
    outside = (raw > 0) & ~region
    assert np.array_equal(kept[outside], raw[outside]) and (moved != raw)[outside].mean() > 0.9
    assert np.array_equal(kept[~outside], moved[~outside])


def test_a_seed_paints_the_same_file_and_another_one_another(frame, woken, tmp_path):
    given = {"rgb": frame / "a.png", "depth": frame / "b.png", "region": frame / "m.png"}
    for name, number in (("one", 1), ("again", 1), ("other", 2)):
        assert main(command(woken, **given, out=tmp_path / f"{name}.npy", seed=number)) == 0
    one, again, other = ((tmp_path / f"{name}.npy").read_bytes() for name in ("one", "again", "other"))
    assert one == again != other


def test_a_picture_shows_the_error_to_expect_in_maps_of_the_width_asked_for(frame, woken, tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr("ditr_lite.viz.save_panel", lambda path, *maps, **how: shown.append((maps, how)))
    given = {"rgb": frame / "a.png", "depth": frame / "b.png", "region": frame / "m.png"}
    given |= {"out": tmp_path / "c.npy", "panel": tmp_path / "c.png", "samples": 3}
    assert main(command(woken, **given)) == main(command(woken, **given, panel_width=700)) == 0
    rgb, depth, region = files.read_rgb(frame / "a.png"), files.read_depth(frame / "b.png"), given["region"]
    out = pipeline.Ditr.from_pretrained(woken)(rgb, depth, files.read_mask(region), steps=1, samples=3)
    assert out.std.any()
    for maps, _ in shown:
        assert all(map(np.array_equal, maps, (rgb, depth, out.depth, out.region, out.std)))
    assert [how["width"] for _, how in shown] == [480, 700]


def test_depth_in_an_odd_unit_is_warned_of_once_and_completed(frame, weights, tmp_path, capsys):
    np.save(frame / "b.npy", np.full(SHAPE, 6.1))
    given = {"rgb": frame / "a.png", "depth": frame / "b.npy", "region": frame / "m.png", "out": tmp_path / "c.npy"}
    assert main(command(weights, **given)) == 0
    warned = capsys.readouterr().err.splitlines()
    assert len(warned) == 1 and "ditr_lite: warning: most depth readings are farther than 5 m" in warned[0]
    assert np.load(tmp_path / "c.npy")[0, 0] == np.float32(6.1)


def test_depth_of_lower_resolution_needs_its_argument_and_keeps_its_readings(frame, weights, tmp_path, capsys):
    small = np.random.default_rng(0).integers(500, 600, (16, 24)).astype(np.uint16)
    cv2.imwrite(str(frame / "b.png"), small)
    given = {"rgb": frame / "a.png", "depth": frame / "b.png", "region": frame / "m.png", "out": tmp_path / "c.npy"}
    assert "give --upsample-depth" in refused(command(weights, **given), capsys)
    assert main([*command(weights, **given), "--upsample-depth"]) == 0
    out, region = np.load(tmp_path / "c.npy"), files.read_mask(frame / "m.png")
    placed, free = out[2::4, 2::4], ~region[2::4, 2::4]
    assert np.array_equal(placed[free], small[free] / np.float32(1000)) and (out > 0).all()
    cv2.imwrite(str(frame / "b.png"), np.full((16, 16), 600, np.uint16))
    capsys.readouterr()
    assert "of like shape" in refused([*command(weights, **given), "--upsample-depth"], capsys)


@pytest.fixture
def folders(frame, tmp_path):
    """Three frames in folders as people have them: the second is damaged, hidden files lie about."""
    for kind, source, suffix in (("rgb", "a.png", ".png"), ("depth", "b.png", ".PNG"), ("region", "m.png", ".png")):
        (tmp_path / kind).mkdir()
        for k in range(3):
            shutil.copy(frame / source, tmp_path / kind / f"{k:03d}{suffix}")
        (tmp_path / kind / f"._000{suffix}").write_bytes(b"\x00\x05\x16\x07" + bytes(60))
        (tmp_path / kind / ".DS_Store").write_bytes(bytes(9))
    (tmp_path / "depth" / "001.PNG").write_bytes(b"\x89PNG damaged")
    (tmp_path / "depth" / "notes.md").write_text("not a frame")
    return {"rgb_dir": tmp_path / "rgb", "depth_dir": tmp_path / "depth", "out_dir": tmp_path / "out"}


def test_a_folder_goes_on_after_a_bad_frame_reports_it_and_resumes(frame, folders, weights, tmp_path, capsys):
    given = {**folders, "region_dir": tmp_path / "region", "panel_dir": tmp_path / "panels", "suffix": ".npy"}
    given |= {"ply_dir": tmp_path / "clouds", "intrinsics": frame / "K.txt"}
    assert main(command(weights, **given)) == 3
    said = capsys.readouterr()
    assert (
        "2 frames completed, 0 were there already, 1 failed" in said.out and "001.PNG failed: cannot read" in said.err
    )
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["000.npy", "002.npy"]
    assert sorted(p.name for p in (tmp_path / "panels").iterdir()) == ["000.png", "002.png"]
    assert sorted(p.name for p in (tmp_path / "clouds").iterdir()) == ["000.ply", "002.ply"]
    before = (tmp_path / "out" / "000.npy").stat().st_mtime_ns
    shutil.copy(tmp_path / "depth" / "000.PNG", tmp_path / "depth" / "001.PNG")
    assert main(command(weights, **given)) == 0
    assert "1 frames completed, 2 were there already, 0 failed" in capsys.readouterr().out
    assert (tmp_path / "out" / "000.npy").stat().st_mtime_ns == before


def test_patterns_pair_names_by_what_differs(folders, weights, tmp_path, capsys):
    mixed = tmp_path / "mixed"
    mixed.mkdir()
    for k in (7, 8, 12):
        shutil.copy(tmp_path / "rgb" / "000.png", mixed / f"color_{k:04d}.png")
        shutil.copy(tmp_path / "depth" / "000.PNG", mixed / f"depth_{k:04d}_raw.png")
    given = {"rgb_dir": mixed / "color_*.png", "depth_dir": mixed / "depth_*.png", "out_dir": tmp_path / "out"}
    assert main(command(weights, **given)) == 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [f"depth_{k:04d}_raw.png" for k in (7, 8, 12)]


def test_one_frame_in_folders_is_paired_whatever_its_files_are_called(frame, weights, tmp_path, capsys):
    for kind, source in (("rgb", "a.png"), ("depth", "b.png"), ("region", "m.png")):
        (tmp_path / kind).mkdir()
        shutil.copy(frame / source, tmp_path / kind / f"{kind}_0001.png")
    given = {f"{kind}_dir": tmp_path / kind for kind in ("rgb", "depth", "region", "out")}
    assert main(command(weights, **given)) == 0
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["depth_0001.png"]
    capsys.readouterr()
    shutil.copy(frame / "m.png", tmp_path / "region" / "region_0002.png")  # which is the frame's?
    assert "has no mask for depth_0001" in refused(command(weights, **given), capsys)
    shutil.copy(frame / "b.png", tmp_path / "depth" / "other.png")
    assert "has a depth map of its name" in refused(command(weights, **given), capsys)


@pytest.mark.parametrize(("wanted", "more"), [("panel_dir", {}), ("ply_dir", {"intrinsics": "K.txt"})])
def test_pictures_and_clouds_that_are_wanted_later_are_made_then(
    frame, folders, weights, tmp_path, capsys, wanted, more
):
    for kind, name in (("rgb", "001.png"), ("depth", "001.PNG")):  # the damaged frame
        (tmp_path / kind / name).unlink()
    assert main(command(weights, **folders)) == 0
    folders |= {wanted: tmp_path / "later", **{name: frame / file for name, file in more.items()}}
    assert main(command(weights, **folders)) == 0
    assert {path.stem for path in (tmp_path / "later").iterdir()} == {"000", "002"}
    capsys.readouterr()
    assert main(command(weights, **folders)) == 0
    assert "0 frames completed, 2 were there already" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"out_dir": None}, "--out-dir is missing"),
        ({"rgb": "a.png"}, "--rgb is of one frame"),
        ({"rgb_dir": "nowhere"}, "no folder .*nowhere; give one, or a pattern"),
        ({"out_dir": "depth", "suffix": ".PNG"}, "invalid choice"),
        ({"depth_dir": "rgb", "out_dir": "rgb"}, "the same file"),
    ],
)
def test_folders_that_cannot_be_completed(folders, weights, tmp_path, capsys, change, reason):
    given = {**folders, **{k: v and (v if k == "suffix" else tmp_path / v) for k, v in change.items()}}
    message = refused(command(weights, **{k: v for k, v in given.items() if v is not None}), capsys)
    assert re.search(reason, message), message


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        ({"suffix": ".npy"}, "--suffix is of --out-dir"),
        ({"panel_width": 200}, "--panel-width is of a picture: give --panel"),
        ({"intrinsics": "K.txt"}, "--intrinsics is of a point cloud: give --ply"),
        ({"ply": "c.ply"}, "--ply needs the camera: give --intrinsics"),
        ({"region": "m.png", "threshold": 0.9}, "--threshold is of stage one, which does not run where the region is"),
        ({"region": "m.png", "refine": "3,3,1"}, "--refine is of stage one"),
    ],
)
def test_an_argument_that_would_do_nothing_is_refused(frame, weights, tmp_path, capsys, more, reason):
    given = {"rgb": frame / "a.png", "depth": frame / "b.png", "out": tmp_path / "c.png", **more}
    assert reason in refused(command(weights, **given), capsys) and not (tmp_path / "c.png").exists()


def test_a_wrong_unit_is_named_as_it_is_typed(frame, weights, tmp_path, capsys):
    np.save(frame / "b.npy", np.full(SHAPE, 610.0))
    given = {"rgb": frame / "a.png", "depth": frame / "b.npy", "out": tmp_path / "c.npy"}
    assert refused(command(weights, **given), capsys).endswith("millimetres? pass --depth-scale 0.001")
    assert main([*command(weights, **given), "--depth-scale", "0.01"]) == 0
    warned = capsys.readouterr().err
    assert "is their unit right (--depth-scale)?" in warned and "depth_scale" not in warned


# --- video ------------------------------------------------------------------------------------------------------------


class Flickering:
    """A system whose claims and paintings flicker by themselves, as noise makes a real one."""

    claim_of = pipeline.Ditr.claim_of

    def __init__(self, ditr):
        self.ditr, self.config, self.rng = ditr, ditr.config, np.random.default_rng(0)

    def classify(self, rgb, depth):
        frame, classes = self.ditr.classify(rgb, depth)
        bright = frame.into(rgb.mean(axis=2).astype(np.float32)) > 150  # glass is what is bright
        glass = np.where(bright, 0.62, 0.38) + self.rng.normal(0, 0.06, bright.shape)
        return frame, np.stack([1 - glass, glass, 0 * glass]).astype(np.float32)

    def refine(self, mask, kernels):
        return mask

    def __call__(self, rgb, depth, region=None, **_):
        if region is None:
            found = self.claim(rgb, depth)
            region = found.frame.back(found.region)
        painted = np.where(rgb.mean(axis=2) > 150, 0.5, 0.7) + self.rng.normal(0, 0.02, depth.shape)
        painted = painted.astype(np.float32)
        zero = np.zeros(depth.shape, bool)
        depth = pipeline.compose(depth, painted, painted, region)
        return pipeline.Completion(depth, region, painted, zero, zero, zero, None, painted, painted, ())


def scene(left, rng):
    """Return a noisy frame: a bright box with its left edge at ``left`` before a dark wall."""
    rgb = np.full((*SHAPE, 3), 90.0)
    rgb[20:44, left : left + 24] = 210
    depth = np.full(SHAPE, 0.7) + rng.normal(0, 0.002, SHAPE)
    depth[20:44, left : left + 24] = 0
    return np.clip(rgb + rng.normal(0, 4, rgb.shape), 0, 255).astype(np.uint8), depth.astype(np.float32)


@pytest.fixture
def flickering(weights):
    return Flickering(pipeline.Ditr.from_pretrained(path=weights))


def unrest(outs):
    """Return the share of the region that comes and goes, and the mean change from frame to frame in metres."""
    regions, depths = np.stack([o.region for o in outs]), np.stack([o.depth for o in outs])
    always, ever = regions.all(0), regions.any(0)
    return 1 - always.sum() / ever.sum(), np.abs(np.diff(depths[:, ever], axis=0)).mean()


def test_a_still_scene_is_held_still(flickering):
    rng, steady = np.random.default_rng(1), Steady(flickering)
    frames = [scene(36, rng) for _ in range(30)]
    comes_and_goes, flicker = unrest([steady(*frame) for frame in frames][10:])
    assert comes_and_goes < 0.05 and flicker < 0.004
    alone = []
    for rgb, depth in frames[10:]:
        region = flickering.classify(rgb, depth)[1][1] > 0.5
        alone.append(flickering(rgb, depth, region))
    comes_and_goes, flicker = unrest(alone)  # what it would be without a memory
    assert comes_and_goes > 0.2 and flicker > 0.006


def test_a_change_of_exposure_is_no_motion(flickering):
    rng, steady = np.random.default_rng(1), Steady(flickering)
    for k in range(5):
        rgb, depth = scene(36, rng)
        same = steady._compare((rgb * (1 - 0.05 * k)).astype(np.uint8), depth)
        assert same.mean() > 0.95 or k == 0


def test_what_moves_is_not_smeared(flickering):
    rng, steady = np.random.default_rng(1), Steady(flickering)
    for k in range(12):
        left = 10 + 4 * max(0, k - 5)
        rgb, depth = scene(left, rng)
        out = steady(rgb, depth)
    inside = out.region[22:42, left + 2 : left + 22]
    trail = out.region[22:42, left - 10 : left - 3]
    assert inside.mean() > 0.7 and trail.mean() < 0.35
    assert abs(out.depth[22:42, left + 2 : left + 22][inside].mean() - 0.5) < 0.02


def test_readings_outside_the_region_are_kept_in_video(flickering):
    rng, steady = np.random.default_rng(1), Steady(flickering)
    for _ in range(5):
        rgb, depth = scene(36, rng)
        out = steady(rgb, depth)
        keep = (depth > 0) & ~out.region
        assert np.array_equal(out.depth[keep], depth[keep]) and (out.depth > 0).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0, 65.535])
def test_what_is_no_reading_is_painted_in_video_as_it_is_alone(flickering, bad):
    rng, steady = np.random.default_rng(1), Steady(flickering)
    for _ in range(2):
        rgb, depth = scene(36, rng)
        depth[50:60] = bad
        out = steady(rgb, depth)
        assert out.depth.min() > 0 and out.depth.max() < 1
    with pytest.raises(ValueError, match="divide millimetres by 1000"):
        steady(rgb, np.full(SHAPE, 700, np.uint16))


def test_a_still_frame_of_a_video_is_as_it_is_alone(weights):
    ditr = pipeline.Ditr.from_pretrained(path=weights)
    rgb, depth = scene(36, np.random.default_rng(1))
    threshold = float(np.median(ditr.claim(rgb, depth).probability))  # untrained, it is close to 2/3 everywhere
    refine = replace(ditr.config.refine, threshold=threshold, dilate=0)
    ditr.config = replace(ditr.config, refine=refine, std=StdConfig((0.02, 0.01), (1, 1), kept=0.005, missed=0.05))
    how = {"steps": 1, "samples": 2}
    alone, steady = ditr(rgb, depth, **how), Steady(ditr)
    assert (alone.classes > 0).any() and 0.05 < alone.region.mean() < 0.95
    for _ in range(3):
        out = steady(rgb, depth, **how)
        for name in ("depth", "region", "std", "probability", "classes", "boundary_da"):
            np.testing.assert_allclose(getattr(out, name), getattr(alone, name), rtol=1e-5, atol=1e-6, err_msg=name)
    given = Steady(ditr)(rgb, depth, alone.region, **how)
    assert given.classes is None and given.std[~alone.region].mean() < alone.std[~alone.region].mean()


def test_what_another_branch_painted_counts_no_more(flickering):
    (rgb, depth), steady = scene(36, np.random.default_rng(1)), Steady(flickering)
    depth[:] = 0.7
    depth[:, 36:60] = 0
    everywhere = np.ones(SHAPE, bool)
    painted = []
    for k in range(9):
        out = steady(rgb, depth, everywhere if k < 6 else ~everywhere)
        painted.append(out.optical)
    np.testing.assert_allclose(out.depth[:, 36:60], np.mean(painted[6:], axis=0)[:, 36:60], rtol=1e-5)


def other_scene():
    """Return a frame that looks like :func:`scene` nowhere, neither in colour nor in depth."""
    rgb, depth = scene(10, np.random.default_rng(2))
    return 255 - rgb, np.where(depth > 0, depth + np.float32(0.3), 0)


def refuse(*_):
    raise OSError("no memory left")


@pytest.mark.parametrize("fails", ["before it is claimed", "after it is claimed"])
def test_a_frame_that_fails_is_not_remembered(weights, monkeypatch, fails):
    ditr, how = pipeline.Ditr.from_pretrained(path=weights), {"steps": 1, "samples": 1}
    steady, there = Steady(ditr), other_scene()
    for _ in range(3):
        steady(*scene(36, np.random.default_rng(1)), **how)
    with monkeypatch.context() as broken, pytest.raises((ValueError, OSError)):
        if fails == "after it is claimed":
            broken.setattr(pipeline.Ditr, "inpaint", refuse)
        steady(*there, **how | ({"steps": 0} if fails == "before it is claimed" else {}))
    alone, out = ditr(*there, **how), steady(*there, **how)
    for name in ("depth", "probability"):
        np.testing.assert_allclose(getattr(out, name), getattr(alone, name), rtol=1e-5, atol=1e-6, err_msg=name)


def test_what_was_claimed_before_a_region_was_given_counts_no_more(flickering, monkeypatch):
    said, real = [], flickering.classify

    def classify(*frame):
        said.append(real(*frame))
        return said[-1]

    monkeypatch.setattr(flickering, "classify", classify)
    steady, there = Steady(flickering), other_scene()
    for _ in range(3):
        steady(*scene(36, np.random.default_rng(1)))
    for _ in range(3):
        steady(*there, np.ones(SHAPE, bool))
    steady(*there)
    assert np.array_equal(steady.classes, said[-1][1])
    assert np.array_equal(steady.claimed, 1 - steady.classes[0] > flickering.config.refine.threshold)
    steady(*there)
    np.testing.assert_allclose(steady.classes, (said[-2][1] + said[-1][1]) / 2, atol=1e-6)


def test_readings_alone_show_that_something_moved_and_single_ones_do_not(flickering):
    rng, steady = np.random.default_rng(1), Steady(flickering)
    grey, depth = np.full((*SHAPE, 3), 128, np.uint8), np.full(SHAPE, 0.7, np.float32)
    steady._compare(grey, depth)
    assert steady._compare(grey, np.where(rng.random(SHAPE) < 0.05, 1.4, depth).astype(np.float32)).all()
    nearer = depth.copy()
    nearer[:, 48:] = 0.6
    same = steady._compare(grey, nearer)
    assert same[:, :40].all() and not same[:, 52:].any()


def test_a_reading_is_remembered_while_it_is_missing(flickering):
    steady, grey = Steady(flickering), np.full((*SHAPE, 3), 128, np.uint8)
    depth = np.full(SHAPE, 0.7, np.float32)
    blind, farther = depth.copy(), depth.copy()
    blind[:, 48:], farther[:, 48:] = 0, 0.9
    for seen in (depth, blind):
        steady._compare(grey, seen)
    assert not steady._compare(grey, farther)[:, 52:].any()


def test_video_repaints_readings_where_it_may(flickering):
    steady = Steady(flickering)
    for adjust in (False, True):
        rgb, depth = scene(36, np.random.default_rng(1))
        out = steady(rgb, depth, adjust=adjust)
        outside = (depth > 0) & ~out.region
        assert (out.depth == depth)[outside].all() != adjust
    assert np.array_equal(out.depth, steady.painted)


def test_a_video_may_change_its_size(flickering):
    steady, (rgb, depth) = Steady(flickering), scene(36, np.random.default_rng(1))
    for step in (1, 2, 1):
        frame = rgb[::step, ::step].copy(), depth[::step, ::step].copy()
        out = steady(*frame)
        assert np.array_equal(steady.painted, np.where(out.region, out.optical, out.geometric))
        assert not steady.same.any() and out.depth.shape == frame[1].shape


def test_a_video_is_claimed_by_the_threshold_that_is_given(weights):
    ditr, frame = pipeline.Ditr.from_pretrained(path=weights), scene(36, np.random.default_rng(1))
    probability, shares = ditr.find_region(*frame)[0], []
    for share in (0.2, 0.8):
        threshold = float(np.quantile(probability, share))
        region = Steady(ditr)(*frame, steps=1, samples=1, threshold=threshold).region
        assert np.array_equal(region, ditr.find_region(*frame, threshold)[1])
        shares.append(region.mean())
    assert shares[0] > shares[1] + 0.1


@pytest.mark.parametrize(
    ("names", "order"),
    [(["f10", "f2", "f1"], ["f1", "f2", "f10"]), (["0010", "0002"], ["0002", "0010"]), (["b1", "a2"], ["a2", "b1"])],
)
def test_frames_of_a_video_come_as_people_count(frame, weights, tmp_path, monkeypatch, names, order):
    for kind, source in (("rgb", "a.png"), ("depth", "b.png")):
        (tmp_path / kind).mkdir()
        for name in names:
            shutil.copy(frame / source, tmp_path / kind / f"{name}.png")
    seen, write = [], complete.write_job
    monkeypatch.setattr(complete, "write_job", lambda job, *rest: seen.append(job.out.stem) or write(job, *rest))
    folders = {f"{kind}_dir": tmp_path / kind for kind in ("rgb", "depth", "out")}
    assert main([*command(weights, **folders), "--video"]) == 0
    assert seen == order


def test_video_goes_through_the_frames_in_order(folders, weights, tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["complete", "--help"])
    assert "left out, but not with --video" in " ".join(capsys.readouterr().out.split())
    shutil.copy(tmp_path / "depth" / "000.PNG", tmp_path / "depth" / "001.PNG")
    assert main([*command(weights, **folders), "--video"]) == 0
    assert len(list((tmp_path / "out").iterdir())) == 3
    capsys.readouterr()
    given = {"rgb": tmp_path / "rgb/000.png", "depth": tmp_path / "depth/000.PNG", "out": tmp_path / "c.png"}
    assert "--video needs frames" in refused([*command(weights, **given), "--video"], capsys)


def test_disparity_in_a_folder_of_frames_is_warned_of_once(weights, tmp_path, capsys):
    scene = load_sample("val_00000")
    inverse = np.where(scene.depth > 0, 0.3 / np.maximum(scene.depth, 0.1), 0).astype(np.float32)
    for k in range(2):
        files.write_picture(tmp_path / "rgb" / f"{k}.png", scene.rgb[..., ::-1])
        files.write_depth(tmp_path / "depth" / f"{k}.npy", inverse)
    folders = {name: tmp_path / name.partition("_")[0] for name in ("rgb_dir", "depth_dir", "out_dir")}
    assert main(command(weights, **folders)) == 0
    said = capsys.readouterr().err
    assert said.count("looks like disparity") == 1 and said.count("looks like BGR") == 1
