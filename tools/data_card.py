"""Measure the rendered scenes and write their data card, data_samples/README.md, and its two contact sheets.

    python tools/data_card.py [--scenes outputs/scenes/train] [--rooms outputs/scenes/rooms_train] [--real DIR]

``--scenes`` and ``--rooms`` are folders of rendered training scenes, table tops and rooms, to hold against real
frames; where they are absent, the shipped samples of ``train`` and ``rooms_val`` stand in. ``--real`` is a folder of
ClearGrasp's real frames; without it the card has no such columns.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ditr_lite import baselines, viz
from ditr_lite.data import (
    OPAQUE,
    REFLECTIVE,
    ROOM_SPLITS,
    SAMPLES,
    SPLITS,
    TRANSPARENT,
    Sample,
    read_sample,
    sample_folders,
)
from ditr_lite.datasets import ClearGrasp
from ditr_lite.files import written_whole
from ditr_lite.loss_types import Cause, LossType
from ditr_lite.simulator import realism, rooms, simulate, textures
from ditr_lite.simulator.scenes import TEST_FAMILIES, TRAIN_FAMILIES

ROOT = Path(__file__).resolve().parents[1]
STRIDE = 8  # the contact sheet shows every eighth scene of the test split: taken blindly, never picked
SEEN = "Real frames were looked\nat while the simulators were designed, so lying inside is no independent check."
KINDS = {"opaque": OPAQUE, "transparent": TRANSPARENT, "reflective": REFLECTIVE}


def read_all(folder: Path) -> list[Sample]:
    """Return all samples of a folder, by name."""
    return [read_sample(path) for path in sample_folders(folder)]


def table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table; the first column is aligned left, all others right."""
    lines = [titles, ["---"] + ["---:"] * (len(titles) - 1), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def ranks(simulated: Sequence[Sample], real: Sequence[Sample]) -> list[tuple[str, str, float]]:
    """Return (statistic, frame, its :func:`rank` among the simulated frames) for all real frames."""
    rows = [realism.frame_statistics(s) for s in simulated]
    values = [(key, s.name, v) for s in real for key, v in realism.frame_statistics(s).items()]
    return [(key, name, rank([r[key] for r in rows], v)) for key, name, v in values]


def rank(values: Sequence[float], value: float) -> float:
    """Return the per cent of ``values`` below ``value``; equal ones count half, NaN not at all."""
    known = np.array(values)[~np.isnan(values)]
    return 100 * float(np.mean(known < value) + np.mean(known == value) / 2)


def realism_section(simulated: Sequence[Sample], real: Sequence[Sample], which: str) -> str:
    """Return the comparison with real frames and its verdict."""
    text = f"Percentiles over {len(simulated)} {which}"
    if not real:
        return f"{text}; no real frames were at hand.\n\n```\n{realism.compare_with_real(list(simulated), [])}\n```"
    text += f", and {len(real)} real frames of ClearGrasp\n(RealSense D435), which are not part of this repository:"
    placed = ranks(simulated, real)
    out = [(key, name, rank) for key, name, rank in placed if not 5 <= rank <= 95]
    verdict = f"**{len(placed) - len(out)} of {len(placed)}** real values lie inside the simulated 5 to 95 % spread."
    if out:
        listed = "; ".join(f"`{key}` of {name} at percentile {rank:.1f}" for key, name, rank in out)
        verdict += f"\nOutside: {listed}."
    return f"{text}\n\n```\n{realism.compare_with_real(list(simulated), list(real))}\n```\n\n{verdict}"


def few(real: Sequence[Sample]) -> str:
    """Return what so small a number of real frames cannot tell; nothing where there are none."""
    if not real:
        return ""
    frames = "frames are" if len(real) > 1 else "frame is"
    return f"{len(real)} real {frames} few, too few to tell how often each case occurs. {SEEN}"


def split_table(splits: dict[str, list[Sample]]) -> str:
    """Return the median of every statistic, the shares of loss and cause, split by split."""
    measured = {name: [realism.frame_statistics(s) for s in samples] for name, samples in splits.items()}
    rows = [["scenes", *(str(len(samples)) for samples in splits.values())]]
    for key in realism.STATISTICS:
        medians = (float(np.nanmedian([r[key] for r in stats])) for stats in measured.values())
        rows.append([f"median `{key}`", *(f"{m:.4f}" for m in medians)])
    rows.append(["`measure_bias`, m", *(f"{baselines.measure_bias(samples):.4f}" for samples in splits.values())])
    things = {name: [t["kind"] for s in samples for t in s.meta["things"]] for name, samples in splits.items()}
    for name, kind in KINDS.items():
        counts = (things[split].count(kind) / len(samples) for split, samples in splits.items())
        rows.append([f"{name} things a scene", *(f"{c:.2f}" for c in counts)])
    for codes, key in ((LossType, "loss"), (Cause, "cause")):
        for code in codes:
            shares = [100 * np.mean([getattr(s, key) == code for s in samples]) for samples in splits.values()]
            if any(shares):
                rows.append([f"{key} {int(code)}, `{code.name}`, % of pixels", *(f"{s:.2f}" for s in shares)])
    return table(["", *splits], rows)


def largest_difference(one: Sequence[Sample], other: Sequence[Sample]) -> str:
    """Return the statistic whose medians differ most between two splits, by their ratio, and the two medians.

    A statistic with a median of 0 or less has no ratio and is passed over.
    """
    a, b = ([realism.frame_statistics(s) for s in samples] for samples in (one, other))
    medians = {key: [float(np.nanmedian([r[key] for r in rows])) for rows in (a, b)] for key in realism.STATISTICS}
    medians = {key: pair for key, pair in medians.items() if min(pair) > 0}
    key = max(medians, key=lambda k: abs(np.log(medians[k][0] / medians[k][1])))
    return f"`{key}`, {medians[key][0]:.3f} against {medians[key][1]:.3f}"


def family_table() -> str:
    """Return which shapes each kind of thing may have, in training and in the test split."""
    rows = []
    for name, kind in KINDS.items():
        train, test = TRAIN_FAMILIES[kind], TEST_FAMILIES[kind]
        rows.append([name, ", ".join(train), "the same" if test == train else ", ".join(test)])
    return table(["things", "train and val", "test"], rows).replace("---:", "---")


def room_table() -> str:
    """Return which transparent and reflective shapes the rooms have, in training and in the test split, and in both."""
    families = {
        "transparent": (rooms.TRANSPARENT_FAMILIES, rooms.HELD_OUT_TRANSPARENT),
        "reflective": (rooms.REFLECTIVE_FAMILIES, rooms.HELD_OUT_REFLECTIVE),
    }
    rows = []
    for name, (train, test) in families.items():
        parts = (
            [f for f in train if f not in test],
            [f for f in test if f not in train],
            [f for f in train if f in test],
        )
        rows.append([name, *(", ".join(dict.fromkeys(part)) for part in parts)])
    return table(["things", "rooms_train and rooms_val alone", "rooms alone", "both"], rows).replace("---:", "---")


def contact_sheet(samples: Sequence[Sample], path: Path, shared: bool = True) -> None:
    """Draw every :data:`STRIDE`-th sample in full colour; ``shared`` gives all depths the same limits."""
    figure = viz.contact_sheet(samples[::STRIDE], columns=8, shared=shared)
    Figure.savefig(figure, path, dpi=130, pil_kwargs={"optimize": True})


def seeds(samples: Sequence[Sample]) -> str:
    """Return the first and the last seed, and which between them were passed over."""
    used = [s.meta["seed"] for s in samples]
    gone = sorted(set(range(used[0], used[-1] + 1)) - set(used))
    return f"{used[0]} to {used[-1]}" + (f" without {', '.join(map(str, gone))}" if gone else "")


def made_table(splits: dict[str, list[Sample]]) -> str:
    """Return how many scenes each split has, of which seeds, and how many are special."""
    rows = []
    for split, samples in splits.items():
        infrared = sum(s.ir_left is not None for s in samples)
        empty = sum(s.meta.get("empty", False) for s in samples)
        rows.append([split, str(len(samples)), seeds(samples), str(empty), str(infrared)])
    return table(["split", "scenes", "seeds", "meant to be without glass and metal", "with infrared pair"], rows)


def training_scenes(folders: Sequence[Path], stand_in: Sequence[Sample]) -> tuple[Sequence[Sample], str]:
    """Return the scenes of the folders and what to call them; the shipped ``stand_in`` where no folder has any."""
    found = [samples for samples in map(read_all, folders) if samples]
    origin = "rendered training" if found else f"shipped {stand_in[0].meta['split']}"
    groups = found or [stand_in]
    listed = "; ".join(f"{g[0].meta['seed']} to {g[-1].meta['seed']}" for g in groups)
    return [s for group in groups for s in group], f"{origin} scenes (seeds {listed})"


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    rendered = ROOT / "outputs" / "scenes"
    parser.add_argument("--scenes", type=Path, nargs="+", default=[rendered / "train"])
    parser.add_argument("--rooms", type=Path, nargs="+", default=[rendered / "rooms_train"])
    parser.add_argument("--real", type=Path)
    options = parser.parse_args(arguments)
    tops, room = (
        {s: read_all(SAMPLES / s) for s in names if (SAMPLES / s).is_dir()} for names in (SPLITS, ROOM_SPLITS)
    )
    wide, which = training_scenes(options.scenes, tops["train"])
    wide_rooms, which_rooms = training_scenes(options.rooms, room["rooms_val"])
    real = list(ClearGrasp(options.real)) if options.real else []
    contact_sheet(tops["test"], SAMPLES / "contact_sheet.png")
    contact_sheet(room["rooms"], SAMPLES / "contact_sheet_rooms.png", shared=False)
    columns = {"train, all rendered": wide} if "rendered" in which else {}
    room_columns = {"rooms_train, rendered": wide_rooms} if "rendered" in which_rooms else {}
    height, width = simulate.ROOM_SIZE
    card = TEXT.format(
        stride=STRIDE,
        made=made_table(tops | room),
        paths=simulate.ROOM_SAMPLES,
        infrared_paths=simulate.ROOM_INFRARED_SAMPLES,
        size=f"{width} x {height}",
        loss=", ".join(f"{int(c)} {c.name}" for c in LossType),
        cause=", ".join(f"{int(c)} {c.name}" for c in Cause),
        realism=realism_section(wide, real, which),
        room_realism=realism_section(wide_rooms, real, which_rooms),
        legend="\n".join(f"- `{key}`: {meaning}" for key, meaning in realism.STATISTICS.items()),
        few=few(real),
        splits=split_table(columns | tops),
        room_splits=split_table(room_columns | room),
        difference=largest_difference(tops["test"], wide),
        room_difference=largest_difference(room["rooms"], wide_rooms),
        families=family_table(),
        room_families=room_table(),
        photographs=", ".join(textures.PHOTOGRAPHS),
        held_out_photographs=", ".join(textures.HELD_OUT_PHOTOGRAPHS),
        places=len(textures.SURROUNDINGS),
        held_out_places=", ".join(textures.HELD_OUT_SURROUNDINGS),
    )
    with written_whole(SAMPLES / "README.md") as part:
        part.write_text(card, encoding="utf-8")
    size = sum(p.stat().st_size for p in SAMPLES.rglob("*") if p.is_file())
    bias = baselines.measure_bias(wide)
    print(f"{SAMPLES / 'README.md'}: {len(wide)} {which}; bias {bias:.4f} m; {size / 1e6:.1f} MB")
    return 0


TEXT = """# Rendered scenes: data card

Scenes with transparent and reflective objects, seen by a simulated active-stereo depth camera, with the truth about
every pixel: depth, object, material, what the sensor did there and why. There are two kinds, each with its own
simulator: **table tops** (splits `train`, `val`, `test`) and **rooms** (`rooms_train`, `rooms_val`, `rooms`). This card
and its tables are written by `python tools/data_card.py`.

![Table tops, by a fixed stride: colour with region outline, raw depth, truth](contact_sheet.png)

Every {stride}th scene of `test`: colour with the outline of the region, raw depth (grey is missing), truth.

![Rooms, by a fixed stride: colour with region outline, raw depth, truth](contact_sheet_rooms.png)

Every {stride}th scene of `rooms`, likewise; each with depth limits of its own, since one is a palm wide and another a
hall. Some have neither glass nor metal.

## What went in

- Table tops: nothing but seeds. No photograph, scan or other data set.
- Rooms: seeds and photographs. {places} panoramas of [environments](environments/README.md) (CC0), and four others for
  `rooms`, light the scenes, are mirrored in them, stand behind them and hang on their walls. Crops of photographs that
  come with scikit-image (CC0, public domain or without known copyright restrictions, as scikit-image says) are on
  some surfaces. Shapes, all other textures and the sensor follow from the seed.
- No frame of a real camera is part of either, and nothing was trained on one. But real frames outside this repository
  were looked at while the simulators and the system were designed: frames 80 and 123 of ClearGrasp (RealSense D435),
  frames of a RealSense D415 with bottles and glasses, one of a RealSense SR300 with wine glasses in a bin, one of a PET
  bottle (RealSense D4xx), and controls without glass or without truth. None of them is a blind test of anything here.
- Three of them (ClearGrasp 80 and 123, one D415 frame) taught that real glass is read more truthfully than rendered
  glass: a final step that had only seen rendered readings trusted none. So in 40 % of the windows of training the
  sensor reads parts of the glass as they are (`training.views.read_truly`). Its numbers were not fitted to them.
- They also had a say in stage one. On validation scenes its last training was better on table tops and no better in
  rooms, where it misses more and claims less by mistake; on real frames it claims less where there is no glass, and is
  shipped. The sizes at which it looks were chosen in the same way, among three that validation scenes rate alike.
  A further training of it, with truthful readings in 40 % of the frames, was rated alike by validation scenes, but
  claimed more in a real frame without glass, and was left out. The one with attention was taken because validation
  scenes rate it better in rooms, and alike on table tops; of its threshold, validation scenes prefer 0.4 to 0.5. On
  real frames both were looked at before they were taken: the mean error in the masks falls a little, more is claimed
  around the glasses of ClearGrasp 123, less in the frame without glass that was taken at night, a little in another.
- And in the final step: it stays as it was before the branches' last 1,500 and 2,500 steps. Trained once more, on what
  they paint now, it was rated alike by validation scenes and was worse on each of the three real frames. Trained with
  glass counting three times as much as what is opaque in a window, it was rated better in the regions of validation
  scenes, most with the true region given, and was worse in the masks of all three real frames.
- And in how a hole is given the level of its rim (`windows.level`). A reading counts where it is less than 1.4 times as
  far or as near as what is painted. Every such limit that was tried lowers the error in the holes of validation rooms
  clearly; on the three real frames with truth, lower ones lose what the levelling gains there, this one does not.
- And in how much wider than itself windows show a region (`windows.RIM`). On validation scenes two pixels lower the
  error inside glass and metal clearly, and three or five no further that could be told. Where the region is given, that
  costs nothing. Where stage one finds it, opaque things beside the glass pay, the more the wider: holes there become
  worse (`tools/swap_study.py`, *exact region*). On each of the three real frames, which were looked at before it was
  taken, the error in the masks falls.

## How they were made

### Table tops

`python -m ditr_lite simulate --out DIR` (`make samples`) renders them again: Mitsuba 3, `scalar_rgb`, path-traced RGB
(four passes of four paths a pixel, their median, then a camera's own denoising) and an infrared pair under a projected
dot pattern (five paths a pixel), semi-global block matching, dropouts, reprojection into the RGB view.
`scenes.py`, `render.py`, `stereo.py` and `simulate.py` in `ditr_lite/simulator` are the whole recipe. A scene follows
from split and seed alone. A seed is passed over when less than 0.5 % of its picture is transparent or
reflective, or when the sensor reads less than a quarter of the pixels.

Eight pictures were rendered with their two lamps in the other order, so that rendering them again leaves other noise
in `rgb.jpg` and nothing else: test_00007, 42, 64, 73, 108, 113, 120 and 132.

### Rooms

The same command renders them. A scene stands on a bounded table, on the floor, in a corner, in a bin, on a shelf, or
far away in a hall, 0.1 to 3 m from the camera, with a room behind it: walls, most of them 1.5 to 6 m behind,
furniture, posters. Vessels stand, lie or lean; some hold a liquid, some have a cap or a label. Mitsuba 3
traces {paths} paths a pixel, Intel Open Image Denoise cleans the picture, then come a lens's blur and a sensor's noise.
The infrared pair ({infrared_paths} paths a pixel) has a baseline and search range that suit the distance. Half of the
sensors also give stray readings, far too near or far too far. `rooms.py` and `forms.py` in `ditr_lite/simulator` draw
the scenes; `render.py`, `textures.py`, `stereo.py` and `simulate.py` do the rest.

Half of the far scenes and 7 % of the others are meant to show nothing transparent or reflective. A seed is passed over
when less than 0.2 % of the picture is, without being meant; when truth is known of less than 60 % of the pixels; when
nine tenths of them are nearer than 8 cm; or when the sensor reads less than a quarter.

### Both

{made}

Seeds are taken from 0 upwards. The same seed, on the same machine and the versions in `environment.txt`, gives the same
bytes. On another kind of processor single infrared paths may end elsewhere, and with them some raw readings.

More training scenes than fit here, and all of `rooms_train`, of which none is here:

    python -m ditr_lite simulate --split train --count 1500 --out outputs/scenes
    python -m ditr_lite simulate --split rooms_train --count 300 --out outputs/scenes

### What the shipped weights were trained on

| split | scenes | how to render them again |
|---|---:|---|
| train | 468 | `--split train --count 468` |
| train | 262 | `--split train --count 262 --first-seed 1000` |
| rooms_train | 600 | `--split rooms_train --count 600 --first-seed 5000` |
| rooms_train | 5 | `--split rooms_train --count 5 --first-seed 20000` |
| rooms_train | 159 | cannot be rendered again to the byte |

Stage one saw all of them; the final step 184 table tops and 109 rooms that the branches never saw, which saw the other
1,201; the autoencoder the first row. The boundary network saw 600 table tops of seeds 0 to 627. The last row (seeds 0
to 163) was made by an earlier state of `rooms.py` and `simulate.py`, with 5 paths a pixel instead of 7, smaller things,
and fewer vessels among them. The same seeds give other scenes now.

License: Creative Commons Attribution 4.0 International (CC BY 4.0), see `LICENSE-CC-BY-4.0`; the panoramas in
`environments` are in the public domain (CC0).

## Files

Beside the splits lie `sensors` (scenes of `test`, rendered anew for each preset of `simulate --sensor`), `peers` (what
other methods painted of a few test scenes, for notebook 08), and `environments` (the panoramas).

One folder a scene, `SPLIT/SPLIT_SEED/`; all maps are 256 x 192 pixels (rooms: {size}) in the view of the RGB camera.

| file | what it is |
|---|---|
| `rgb.jpg` | colour, 8 bit, sRGB |
| `depth.png` | raw sensor depth, 16 bit, millimetres, 0 = missing |
| `depth_gt.png` | depth of the first surface, glass included, 16 bit, millimetres, 0 = unknown |
| `material.png` | 0 opaque, 1 transparent, 2 reflective; the region is what is not 0 |
| `instances.png` | 0 table, walls, floor and furniture; k the k-th entry of `things` in `meta.json` |
| `loss.png` | {loss} |
| `cause.png` | {cause} |
| `ir_left.png`, `ir_right.png` | rectified infrared pair, 8 bit, 360 x 232, of some scenes only |
| `meta.json` | intrinsics of both cameras, baseline and pose (metres), seed, sensor settings, shapes, materials |

A reading is wrong when it is off by more than 10 mm and by more than 2 % of the true depth. Labels were taken from
the depths before these were rounded to millimetres. In Python: `dl.load_sample("test_00000")`, in metres.

## How they compare with a real camera

### Table tops

{realism}

### Rooms

{room_realism}

### What the statistics mean

{legend}

{few}

## The splits

Each statistic is taken frame by frame; the tables of shares count pixels.

{splits}

{room_splits}

In rooms, each part of a thing counts: a bottle, what is in it, its cap and its label are up to four. The bias inside is
larger there because what one sees through glass may be a wall metres behind.

## What the test splits hold out

### Table tops

Training and validation scenes share shapes and materials. In the test split no transparent or reflective thing has
a shape that they have; tables, walls, light, cameras and sensor settings are drawn alike, and opaque things but for
their size: all things of a test scene are sized from 0.05 to 0.14 of its distance, elsewhere from 0.035. Cameras and
sensor settings follow from the seed alone, so scenes of one seed share them in all three splits.

{families}

| material | train and val | test |
|---|---|---|
| glass: refractive index | 1.45 to 1.56 | 1.33 to 1.42 or 1.60 to 1.75 |
| glass: loss of colour by tint | up to 25 % | up to 45 % |
| metal | silver, aluminium, chromium | copper, gold |
| brushed metal: roughness | 0.05 to 0.20 | 0.20 to 0.30 |

So the colour of a mirror alone tells the test split from training, and its thin stems and star-shaped prisms are
finer than anything there. Of the statistics above, the median of test differs most from that of training in
{difference}.

The shipped weights were trained on `rooms_train`, too. It has none of the vessels that `test` holds out, but flutes,
which have stems, and discs of glass, which have the outline of the round mirrors.

### Rooms

Vessels of `rooms` have outlines that `rooms_train` does not have. Not all shapes are held out: panes and plates of
glass, mirrors that stand, and metal rods (tools) are in both, and flat mirrors of some outline, too. In `meta.json`
panes, plates and mirrors are called `plate_mirror` or `round_mirror` after their mesh, and a rod `cylinder`.

{room_families}

The flute, a tall glass on a stem, is in training alone, yet its stem is like that of the held-out wine glass. Opaque
things, drawn textures, tables, rooms, cameras and sensor settings are drawn alike; liquids have the same refractive
index.

| material | rooms_train and rooms_val | rooms |
|---|---|---|
| surroundings | {places} panoramas | {held_out_places} |
| photographs on surfaces | {photographs} | {held_out_photographs} |
| glass: refractive index | 1.45 to 1.56 | 1.36 to 1.43 or 1.57 to 1.70 |
| metal | silver, aluminium, chromium | silver, copper, gold |
| brushed metal: roughness | 0.05 to 0.18 | 0.15 to 0.25 |

Of the statistics above, the median of `rooms` differs most from that of training in
{room_difference}.

## Known limits

- The camera is ideal: no lens distortion, no rolling shutter, no motion blur, no chromatic error, no auto-exposure
  that fails; RGB and infrared are calibrated without error. Denoising leaves the pictures flatter than a real
  camera's.
- The sensor of the splits is one kind, active stereo. Time of flight and structured light fail differently; `sensors`
  shows two scenes under each. There is no temporal filter, no interference of a second projector, no sunlight.
- Light is traced in three colours: glass does not disperse it, and no caustic is sharp at this number of paths. In
  infrared each wall of glass passes a share that is drawn, not derived from the material.
- On table tops vessels are empty; in rooms a film of air lies between a liquid and an upright wall, while at the
  foot of a thick one it reaches a little into the glass. The inside of a solid stem glass comes a little out of its
  foot. No scratches, no dust, no fingerprints anywhere. Shapes are bodies of revolution, prisms, boxes and
  plates; no handles, no folds, no people, no clutter beyond a dozen things on a table top and some twenty in a room.
- Opaque surfaces of table tops carry procedural textures in colours more vivid than most rooms have. Rooms are
  built of boxes, and at {paths} paths a pixel the denoiser takes fine texture away, most in glass and mirrors.
- Outside glass and metal the sensor of the rooms is noisier than the two real frames that it was held against: more
  than a tenth of their pixels are wrong there, most often on walls beyond 2 m.
- A panorama has no depth: where a room ends in it, the truth is unknown (0), and nothing is scored.
- Things stand, lie or lean as they were put, without physics. Some things that lie rest on their bounding box:
  lying hexagons, stars, vases and wine glasses hover by up to 11 mm, most by 1 to 3. In half of the far scenes (places
  called landscape) there is nothing under the things: they hang in the air up to 1.2 m above the floor. So do a few
  things beside a table, counter or shelf that is seen from near.
- In the splits the colour camera stands between the two infrared ones, so that thin shadows fall on both sides of a
  thing. In real D400 cameras it stands beside them, and all shadow falls on one side, as under `sensors`.
- On table tops, at 256 x 192, a stem is two pixels wide, and so is the parallax shadow of a thing a few centimetres
  high. `PARALLAX` and `STEREO_OCCLUSION` forgive a pixel at either side and yield to `DROPOUT`, so they cover few
  pixels: geometric loss here is mostly dropouts and surfaces without a match. Real frames of 1280 x 720 show wider
  shadows.
- Thin glass is one sheet without a thickness; truth is its outer surface, and the inside of a bowl is not labelled
  apart.
"""


if __name__ == "__main__":
    sys.exit(main())
