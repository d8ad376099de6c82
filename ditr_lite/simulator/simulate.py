"""Render scenes with Mitsuba 3 and turn them into samples: RGB, infrared pair, raw depth, the truth about each pixel.

Recipe after DREDS (Dai et al., 2022): path-traced infrared pair under a projected dot pattern, block matching,
reprojection into the RGB view. Mitsuba is an optional extra (``pip install .[simulate]``); nothing else in the package
needs it.
"""

import os
import shutil
import signal
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from itertools import islice
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from threading import Thread
from typing import Any

import cv2
import numpy as np
from tqdm.auto import tqdm

from ..camera import Camera, Stereo
from ..data import OPAQUE, ROOM_SPLITS, SPLITS, Sample, read_meta, save_sample
from ..loss_types import label
from . import cameras as sensors
from . import stereo as sensor
from .render import build_scene, mitsuba, render, render_clean, truth
from .rooms import room_scene
from .scenes import Scene, Thing, random_scene

SIZE = (192, 256)  # height, width of the RGB view
INFRARED_SIZE = (232, 360)  # wider than the RGB view, so that matching has room
RGB_PASSES, RGB_SAMPLES, INFRARED_SAMPLES = 4, 4, 5  # paths per pixel
ROOM_SIZE = (240, 320)  # the same of the room scenes
ROOM_WIDEST = 420  # pixels of an infrared view
ROOM_SAMPLES, ROOM_INFRARED_SAMPLES = 7, 3  # paths per pixel
ROOM_DEPTH, ROOM_INFRARED_DEPTH = 10, 6  # segments of a path

PATIENCE_S = 10.0  # that a worker is waited for which was told to end
LEFTOVER_S = 3600.0  # age from which a half-written scene is a leftover


def simulate(seed: int, split: str = "train", keep_infrared: bool = False, preset: str | None = None) -> Sample:
    """Render one scene and measure it with a random active-stereo sensor, or with one of four known ones.

    The random sensor of a table top (cameras, baseline, matcher, noise, dropouts) follows from the seed alone: train,
    val and test have the same one at the same seed. In rooms it differs.

    Args:
        seed: scene seed; the same seed, split and machine give the same bytes.
        split: table tops: ``train``, ``val``, or ``test``, which alone has held-out shapes and materials;
            rooms: ``rooms_train``, ``rooms_val``, or ``rooms``, likewise.
        keep_infrared: also return the infrared pair.
        preset: a name of ``sensors.PRESETS``; None draws a sensor at random.

    Returns:
        Sample: with region, instances, loss types, causes and both cameras.
    """
    if split in ROOM_SPLITS:
        return _simulate_room(seed, split, keep_infrared, preset)
    scene = random_scene(seed, split)
    rng = np.random.default_rng([seed, 7])  # of every split alike, which the shipped scenes depend on
    kind = None if preset is None else sensors.camera_preset(preset)
    camera, stereo = _rig(rng) if kind is None else sensors.rig(kind, SIZE)
    visible = build_scene(scene)
    rgb = photograph(visible, camera, scene.camera_pose, rng, seed)
    points, depth_gt, ids = truth(visible, camera, scene.camera_pose, seed)
    if kind is None:
        depth, dropped, seen, pair, how = _random_sensor(scene, points, camera, stereo, rng, seed, INFRARED_SAMPLES)
    else:
        depth, dropped, seen, pair = sensors.measure(kind, scene, points, camera, stereo, INFRARED_SAMPLES, seed)
        how = {"sensor": preset}
    frame = (rgb, depth, depth_gt, ids)
    return _sample(scene, split, frame, camera, stereo, dropped, seen, pair if keep_infrared else [None, None], how)


def _simulate_room(seed: int, split: str, keep_infrared: bool, preset: str | None) -> Sample:
    """As :func:`simulate`, of a room scene: larger, by a sensor that suits its distance, with stray readings."""
    scene = room_scene(seed, split)
    rng = np.random.default_rng([seed, 11, ROOM_SPLITS.index(split)])
    if preset is None:
        height, width = ROOM_SIZE
        focal = width * np.exp(rng.uniform(np.log(0.72), np.log(1.2)))
        camera = Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    else:
        camera, stereo = sensors.rig(sensors.camera_preset(preset), ROOM_SIZE)
    visible = build_scene(scene)
    rgb = photograph_room(visible, camera, scene.camera_pose, rng, seed)
    points, depth_gt, ids = truth(visible, camera, scene.camera_pose, seed)
    if preset is None:
        stereo, disparities = _room_stereo(rng, camera, depth_gt)
        how = {"disparities": disparities, "far_m": float(np.exp(rng.uniform(np.log(3.0), np.log(10.0))))}
        exposure = {"white": float(rng.uniform(90, 98)), "gamma": float(rng.uniform(0.45, 0.9))}
        paths = {"paths": ROOM_INFRARED_SAMPLES, "depth": ROOM_INFRARED_DEPTH}
        measured = _random_sensor(
            scene, points, camera, stereo, rng, seed, exposure=exposure, slanted=True, **paths, **how
        )
        depth, dropped, seen, pair, settings = measured
        strays = sensor.random_strays(rng)
        depth = sensor.stray(depth, strays, rng)
        how |= {"exposure": exposure, **settings, "strays": vars(strays)}
    else:
        kind = sensors.camera_preset(preset)
        depth, dropped, seen, pair = sensors.measure(kind, scene, points, camera, stereo, ROOM_INFRARED_SAMPLES, seed)
        how = {"sensor": preset}
    frame = (rgb, depth, depth_gt, ids)
    return _sample(scene, split, frame, camera, stereo, dropped, seen, pair if keep_infrared else [None, None], how)


def _sample(
    scene: Scene,
    split: str,
    frame: tuple[np.ndarray, ...],
    camera: Camera,
    stereo: Stereo,
    dropped: np.ndarray,
    seen: sensors.Seen,
    pair: list[np.ndarray | None],
    how: dict[str, Any],
) -> Sample:
    """Put together what was rendered and measured; ``frame`` is RGB, raw depth, true depth and instance ids."""
    rgb, depth, depth_gt, ids = frame
    kinds = np.array([OPAQUE, *(thing.kind for thing in scene.things)], np.uint8)
    material = kinds[ids]
    loss = label(depth, depth_gt, material > OPAQUE)
    return Sample(
        name=f"{split}_{scene.seed:05d}",
        rgb=rgb,
        depth=depth,
        depth_gt=depth_gt,
        region=material > OPAQUE,
        camera=camera,
        material=material,
        instances=ids.astype(np.uint8),
        loss=loss,
        cause=sensor.causes(loss, material, dropped, *seen),
        ir_left=pair[0],
        ir_right=pair[1],
        stereo=stereo,
        meta={"seed": scene.seed, "split": split, **scene.style, **how, "things": _describe(scene.things)},
    )


def _random_sensor(
    scene: Scene,
    points: np.ndarray,
    camera: Camera,
    stereo: Stereo,
    rng: np.random.Generator,
    seed: int,
    paths: int,
    exposure: dict[str, float] | None = None,
    depth: int = 10,
    **limits: Any,
) -> tuple[np.ndarray, np.ndarray, sensors.Seen, list[np.ndarray | None], dict[str, Any]]:
    """Measure with a pattern, projector and matcher drawn from ``rng``; return as :func:`sensors.measure`, and how.

    ``paths`` is the renderer's number of paths per pixel, ``depth`` the longest path, ``exposure``
    are :func:`sensor.expose`'s settings, and ``limits`` :func:`sensor.raw_depth`'s.
    """
    left_pose = scene.camera_pose @ stereo.motion()
    right_pose = left_pose @ _shift(stereo.baseline_m)
    lit = build_scene(scene, left_pose @ _shift(stereo.baseline_m * rng.uniform(0.2, 0.8)), rng)
    matcher = sensor.random_matcher(rng) if scene.parts is None else sensor.random_room_matcher(rng)
    pair, seen = [], []
    for pose in (left_pose, right_pose):
        radiance = render(lit, stereo.camera, pose, paths, seed, depth).mean(axis=2)
        pair.append(sensor.expose(radiance, matcher, rng, **(exposure or {})))
        seen.append(sensor.visible_from(points, truth(lit, stereo.camera, pose, seed)[1], stereo.camera, pose))
    raw, dropped = sensor.raw_depth(*pair, stereo, camera, matcher, rng, **limits)
    return raw, dropped, seen, pair, {"matcher": vars(matcher)}


def simulate_many(
    root: Path | str,
    split: str,
    count: int,
    first_seed: int = 0,
    workers: int = 1,
    infrared: int = 0,
    preset: str | None = None,
) -> list[Path]:
    """Render ``count`` scenes into ``root/split/``; scenes that are already there are kept, so a stopped run resumes.

    Scenes in which too little transparent or reflective is in view (below 0.5 % of the image; in rooms 0.2 %, unless
    they are meant to show none), in which the sensor reads less than a quarter of the pixels or, in rooms, in which
    truth is known of too few or nearly all is too near, are skipped by moving on to the next seed. Which those are
    depends on seeds and sensor alone, so the set is the same however it was made. It holds one sensor's scenes only.

    Args:
        root: output folder.
        split: as in :func:`simulate`.
        count: scenes wanted.
        first_seed: first seed to try.
        workers: processes; one per core is best.
        infrared: how many of the first seeds keep their infrared pair.
        preset: as in :func:`simulate`; each sensor needs a root of its own, for the scenes have the same names.

    Raises:
        ValueError: for an unknown split or sensor, a count below 1, or a folder that holds another sensor's scenes.
        ImportError: without Mitsuba.
    """
    if split not in SPLITS + ROOM_SPLITS or count < 1:
        raise ValueError(
            f"expected a split of {', '.join(SPLITS + ROOM_SPLITS)} and a count >= 1, got {split!r} and {count}"
        )
    if preset is not None:
        sensors.camera_preset(preset)
    folder = Path(root) / split
    _check_sensor(folder, preset)
    mitsuba()
    folder.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    _remove_leftovers(folder)
    seeds = iter(range(first_seed, first_seed + 10 * count + 10))
    done: list[Path] = []
    with _workers(workers) as pool, tqdm(total=count, desc=f"{split} scenes", unit="scene") as bar:
        while len(done) < count:
            batch = list(islice(seeds, count - len(done)))
            if not batch:
                raise ValueError(f"{len(done)} of {count} scenes were worth keeping: go on with another --first-seed")
            with _uninterrupted():
                jobs = [pool.submit(_write, folder, split, s, s - first_seed < infrared, preset) for s in batch]
            for job in as_completed(jobs):
                path = job.result()
                if path is not None:
                    done.append(path)
                    bar.update()
    return sorted(done)


@contextmanager
def _workers(count: int) -> Iterator[ProcessPoolExecutor]:
    """Yield a pool of processes that end with the block, at once when it ends by an error or an interruption."""
    others = set(active_children())
    pool = ProcessPoolExecutor(count, mp_context=get_context("spawn"), initializer=_begin)
    try:
        yield pool
    except BaseException:
        ours = set(active_children()) - others
        for process in ours:
            process.terminate()
        for process in ours:
            process.join(PATIENCE_S)
        pool.shutdown(cancel_futures=True)  # its thread has ended then: Python, ending beside it, would complain
        raise
    pool.shutdown()


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Hold Ctrl-C back while processes are started: they inherit that, so that it interrupts this process alone."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _remove_leftovers(folder: Path) -> None:
    """Remove what a writer that was killed has left half done, an hour ago or more."""
    for part in folder.glob(".*.part"):
        if time.time() - part.stat().st_mtime > LEFTOVER_S:
            shutil.rmtree(part, ignore_errors=True)


def _check_sensor(folder: Path, preset: str | None) -> None:
    """Raise ValueError where a finished scene was measured by another sensor: it would be taken for one of this set."""
    for path in sorted(folder.glob(f"{folder.name}_*[0-9]/meta.json")):
        stored = read_meta(path.parent)[2].get("sensor")  # absent: drawn at random
        if stored != preset:
            raise ValueError(
                f"{path.parent} was measured by {stored or 'a random sensor'}, not {preset or 'a random one'}: "
                "choose another root"
            )


def _write(folder: Path, split: str, seed: int, infrared: bool, preset: str | None) -> Path | None:
    path, skipped = folder / f"{split}_{seed:05d}", folder / f".skipped_{seed:05d}"
    if (path / "meta.json").is_file():
        return path
    if skipped.exists():
        return None
    sample = simulate(seed, split, infrared, preset)
    if not _worth_keeping(sample):
        skipped.touch()
        return None
    save_sample(sample, path)
    return path


def _worth_keeping(sample: Sample) -> bool:
    """Say whether a scene shows what it was made for; a room scene may be meant to show nothing lossy at all."""
    if sample.meta["split"] not in ROOM_SPLITS:
        return bool(sample.region.mean() >= 0.005 and (sample.depth > 0).mean() >= 0.25)
    shown = sample.meta["empty"] or sample.region.mean() >= 0.002
    known = (sample.depth_gt > 0).mean() >= 0.6 and np.percentile(sample.depth_gt, 90) > 0.08
    return bool(shown and known and (sample.depth > 0).mean() >= 0.25)


def _begin() -> None:
    """Prepare a worker: it ends when its parent does, however that ended, and computes with one thread."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()
    cv2.setNumThreads(1)
    mi = mitsuba()
    import drjit as dr

    dr.set_thread_count(1)  # one process per core: threads inside would only compete
    assert mi.variant()


def _end_with_parent() -> None:
    parent_process().join()
    os._exit(1)


def _rig(rng: np.random.Generator) -> tuple[Camera, Stereo]:
    """Draw the two cameras: RGB, and an infrared pair 15 to 45 mm beside it with a baseline of 50 to 75 mm."""
    height, width = SIZE
    focal = rng.uniform(225, 275)
    camera = Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    height, width = INFRARED_SIZE
    focal *= rng.uniform(1.0, 1.15)
    infrared = Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    motion = np.eye(4)
    motion[:3, 3] = (-rng.uniform(0.015, 0.045), *rng.normal(0, 0.002, 2))
    return camera, Stereo(infrared, float(rng.uniform(0.05, 0.075)), tuple(map(tuple, motion.tolist())))


def _room_stereo(rng: np.random.Generator, camera: Camera, depth: np.ndarray) -> tuple[Stereo, int]:
    """Draw an infrared pair whose search range reaches what is nearest: a short baseline for a hand-held close-up.

    Args:
        rng: draws everything.
        camera: of the RGB view.
        depth: its true depth.

    Returns:
        Stereo: the pair; int: disparities to search, in pixels.
    """
    near = max(float(np.percentile(depth[depth > 0], 1)), 0.05) if (depth > 0).any() else 1.0
    focal = camera.fx * rng.uniform(1.0, 1.15)
    baseline = min(rng.uniform(0.05, 0.075), 80 * near / focal)
    offset = rng.uniform(0.015, 0.045) * min(1.0, near / 0.3)
    reach = focal * baseline / near
    half = focal * (camera.width / camera.fx / 2 + (offset + baseline) / near / 2)
    width = min(2 * round(half) + 16, ROOM_WIDEST)
    height = 2 * round(focal * camera.height / camera.fy / 2) + 16
    infrared = Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    motion = np.eye(4)
    motion[:3, 3] = (-offset, *rng.normal(0, 0.002 * min(1.0, near / 0.3), 2))
    disparities = int(np.clip(16 * np.ceil((1.15 * reach + 4) / 16), 32, 96))
    return Stereo(infrared, float(baseline), tuple(map(tuple, motion.tolist()))), disparities


def _shift(x: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


def photograph(loaded: Any, camera: Camera, pose: np.ndarray, rng: np.random.Generator, seed: int) -> np.ndarray:
    """Return the (H, W, 3) uint8 sRGB picture: exposure, white balance error, gamma, and no grain.

    Few paths leave bright and dark specks, and most in glass and metal: a network would learn the specks instead of the
    glass. The median of independent passes, then of neighbours, removes them; then comes the denoising that cameras do.
    """
    passes = [render(loaded, camera, pose, RGB_SAMPLES, RGB_PASSES * seed + k) for k in range(RGB_PASSES)]
    radiance = np.median(passes, axis=0)
    exposure = rng.uniform(0.45, 0.75) / max(float(np.percentile(radiance, 80)), 1e-6)
    balance = 1 + rng.normal(0, 0.05, 3)
    image = (np.clip(radiance * exposure * balance, 0, 1) ** (1 / 2.2) * 255).astype(np.uint8)
    smooth = cv2.medianBlur(image, 3)
    speck = np.abs(image.astype(int) - smooth).max(axis=2, keepdims=True) > 10
    return cv2.fastNlMeansDenoisingColored(np.where(speck, smooth, image), None, 4, 8, 5, 11)


def photograph_room(loaded: Any, camera: Camera, pose: np.ndarray, rng: np.random.Generator, seed: int) -> np.ndarray:
    """Return the (H, W, 3) uint8 sRGB picture as :func:`photograph` does, through a lens and with a sensor's noise."""
    radiance = render_clean(loaded, camera, pose, ROOM_SAMPLES, seed, ROOM_DEPTH)
    exposure = rng.uniform(0.35, 0.75) / max(float(np.percentile(radiance, 80)), 1e-6)
    balance = 1 + rng.normal(0, 0.06, 3)
    blur = rng.uniform(0.3, 0.7)
    light = cv2.GaussianBlur(np.clip(radiance * exposure * balance, 0, 1).astype(np.float32), (0, 0), blur)
    shown = light ** (1 / 2.2) * 255
    grain = cv2.GaussianBlur(rng.normal(0, 1, shown.shape).astype(np.float32), (0, 0), 0.6)
    return np.clip(np.rint(shown + rng.uniform(0, 3.0) * grain), 0, 255).astype(np.uint8)


def _describe(things: list[Thing]) -> list[dict[str, Any]]:
    """Return what a reader may want to know of each thing, in the order of the instance ids."""
    keep = ("type", "ior", "metal", "roughness")
    return [{"family": t.family, "kind": t.kind, **{k: t.material[k] for k in keep if k in t.material}} for t in things]
