"""Rewrite the results section of the README from the committed result file, so that no number is typed by hand.

python tools/readme_results.py [--json ditr_lite/weights/results_test.json] [--readme README.md]
"""

import argparse
import json
from pathlib import Path

from ditr_lite.evaluation.results import is_current, outdated
from ditr_lite.evaluation.scoring import on_the_same_pixels
from ditr_lite.evaluation.statistics import bootstrap_mean, format_interval, interval, mean_known
from ditr_lite.files import written_whole
from ditr_lite.peers.compare import NO_GLASS
from ditr_lite.store import read_card
from ditr_lite.studies import denoisers, peer_tables

START, END = "<!-- results: tools/readme_results.py -->", "<!-- end of results -->"
OWN_FRAMES = (
    "; `score.py` stands for a file of your own that yields frames (`peers.compare.frames_of_file`), these real frames "
    "are not in the repository"
)
SOURCES = {  # frame -> where it is from, all under Apache-2.0
    "cleargrasp_d435": "Shreeyak/cleargrasp, 0688647, data/sample_dataset/real-val/d435",
    "gajdosech_d415": "gajdosech2/cleargrasp, 2f182e7",
    "exp-002": "gajdosech2/cleargrasp, 2f182e7",
    "arc_sr300": "andyzeng/arc-robot-vision, 33c02ba",
    "fernando_bottle": "Fernando94654/cleargrasp, 193af8b",
    "dsikar_d415": "dsikar/cleargrasp, 3d377b0, live_demo/viz/data/d415",
    "lingbot": "Robbyant/lingbot-depth, 47764da, examples",
    "promptda_arkit": "DepthAnything/PromptDA, b05523c",
}
SETS = ("optical", "optical_valid", "geometric", "outside", "whole")
COMPARED = {  # method -> what it does, in the table at the head
    "ditr": "this repository",
    "raw": "the sensor; holes take the nearest reading",
    "harmonic": "a smooth membrane over holes and region",
    "keep_and_fill": "readings kept inside the region, too; holes filled smoothly",
    "keep_and_fill_debiased": "the same, readings inside moved by their mean error in training scenes of table tops",
}
IN_BRIEF = ("optical", "geometric")
COSTLY = 1.15  # a disturbance may raise the error so far
ALL = "All methods and pixels"  # what is folded of a split
KEPT = ("rooms", "real", "denoiser", "bench", "robustness", "soak")  # results_*.json that have a paragraph


def brief(splits: dict[str, dict], frames: dict[str, dict]) -> str:
    """Return the table at the head: RMSE in the region and in the holes, on every kind of frame there is.

    Args:
        splits: title -> result of ``evaluate --json``.
        frames: name -> what ``tools/real_frames.py`` says of it.
    """
    scored = [row["rmse_m"] for row in frames.values() if row["rmse_m"]]
    reports = {title: result["summary"] for title, result in splits.items()}
    counts = {title.lower(): report["images"] for title, report in reports.items()}
    if scored:
        counts["real frames"] = len(scored)
    heads = [f"{title}, {key}" for title in counts for key in IN_BRIEF]
    lines = ["| RMSE, mm | " + " | ".join(heads) + " |", "|---|" + "---:|" * len(heads)]
    for name, says in COMPARED.items():
        cells = [brief_cell(report, name, key) for report in reports.values() for key in IN_BRIEF]
        if scored:
            means = [mean_known([row[name][key] for row in scored]) for key in IN_BRIEF]
            cells += ["–" if mean is None else f"{1000 * mean:.1f}" for mean in means]
        lines.append(f"| `{name}`: {says} | " + " | ".join(cells) + " |")
    missed = [
        f"{format_interval(report['stage_one']['miss_rate'], 100, '.0f')} % ({title.lower()})"
        for title, report in reports.items()
    ]
    lines += [
        "",
        f"Means over frames that nothing was trained on: {', '.join(f'{n} {title}' for title, n in counts.items())}. "
        "*optical*: inside glass and metal; *geometric*: holes elsewhere. All methods get the region that stage one "
        f"finds; of the true one it misses {' and '.join(missed)}. = marks what is not measurably different from DITR: "
        f"the 95 % interval of the paired difference holds 0{' (few real frames: left unmarked)' * bool(scored)}.",
    ]
    without = [row["claimed"] for name, row in frames.items() if NO_GLASS in name]
    if without:
        low, high = (f"{100 * share:.1f}" for share in (min(without), max(without)))
        lines[-1] += f" Of {len(without)} real frames without glass it claims {low} to {high} % of the picture."
    return "\n".join(lines)


def brief_cell(report: dict, name: str, key: str) -> str:
    """Return one RMSE of :func:`brief` in millimetres, marked where DITR's is not measurably another."""
    _, low, high = report["differences"].get(name, {}).get(key) or (None, 1, 1)
    return f"{1000 * report['methods'][name][key]['rmse']:.1f}" + " =" * (low <= 0 <= high)


def section(result: dict, title: str, file: str) -> str:
    """Return the Markdown of one test split: a table of RMSE, the paired differences, stage one.

    Args:
        result: of ``evaluate --json``.
        title: of the split.
        file: its name.
    """
    report = result["summary"]
    lines = [
        f"**{title}.** {report['images']} test scenes; shapes and materials of their glass and metal objects were "
        "held out, as far as the data card says. "
        "The region is the one that stage one *predicts*; every baseline is given that region and is composed as DITR "
        "is. RMSE in millimetres, mean over scenes.",
        "",
        *table(report),
    ]
    lines += [
        "",
        "*optical*: inside the true region; *optical_valid*: there, where the sensor read something; *geometric*: "
        "holes outside it; *outside*: all outside; *sensor*: the bare readings, scored only where there are any.",
        "",
        "DITR minus baseline, RMSE in millimetres, mean and 95 % interval of a bootstrap paired over scenes (below 0: "
        "DITR is better):",
        "",
        *minus(report["differences"], SETS[:3]),
    ]
    lines += [
        "",
        stage_one(result),
        "Readings outside the region come back " + ("bit for bit." if report["kept"] else "CHANGED, a defect."),
        "",
        f"Command: `{result['command']}`; the file with every scene's figures and the checksums of the weights is "
        f"`ditr_lite/weights/{file}`.",
    ]
    return "\n".join(lines)


def stage_one(result: dict) -> str:
    """Return what stage one finds; scenes without glass and metal apart, where an overlap is 0 or not defined.

    Args:
        result: of ``evaluate --json``.
    """
    one, frames = result["summary"]["stage_one"], result["stage_one"].values()
    iou = interval(bootstrap_mean, [f["iou"] for f in frames if f["miss_rate"] is not None])
    bare = [f["iou"] is not None for f in frames if f["miss_rate"] is None]  # whether it claims something there
    apart = f", in scenes with glass or metal; of the {len(bare)} without it claims something in {sum(bare)}"
    return (
        f"Stage one: intersection over union {format_interval(iou, 1, '.2f')} before refinement{apart * bool(bare)}. "
        f"After it, {format_interval(one['miss_rate'], 100, '.0f')} % of the region is missed; the area is "
        f"{format_interval(one['area_ratio'], 1, '.2f')} times that of the true mask refined alike."
    )


def table(report: dict, sets: tuple[str, ...] = SETS) -> list[str]:
    """Return the lines of a Markdown table of RMSE in millimetres, method x pixel set."""
    lines = ["| method | " + " | ".join(sets) + " |", "|---|" + "---:|" * len(sets)]
    for name, row in report["methods"].items():
        cells = [f"{1000 * row[k]['rmse']:.1f}" if row and row.get(k) else "–" for k in sets]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return lines


def minus(differences: dict, sets: tuple[str, ...]) -> list[str]:
    """Return the lines of a Markdown table of differences in millimetres with intervals, baseline x pixel set."""
    lines = ["| baseline | " + " | ".join(sets) + " |", "|---|" + "---:|" * len(sets)]
    for name, row in differences.items():
        same = {k: row[k] if on_the_same_pixels(name, k) else None for k in sets}
        lines.append(f"| {name} | " + " | ".join(format_interval(same[k], 1000, missing="–") for k in sets) + " |")
    return lines


def real(result: dict) -> str:
    """Return the paragraph about real frames: errors where the truth is known, and what is claimed and moved."""
    frames = result["frames"]
    scored = {name: row["rmse_m"] for name, row in frames.items() if row["rmse_m"]}
    lines = [
        f"**Real frames, zero-shot.** {len(scored)} frames of RealSense cameras with truth and mask. Nothing was "
        "trained on them; they were looked at while the system was designed (see the data card). RMSE in millimetres, "
        "region found by stage one, for *ditr, true mask* the true one. So few frames prove little.",
        "",
        "| frame | method | " + " | ".join(SETS) + " |",
        "|---|---|" + "---:|" * len(SETS),
    ]
    for frame, methods in scored.items():
        for name, row in methods.items():
            cells = ["–" if row[key] is None else f"{1000 * row[key]:.1f}" for key in SETS]
            lines.append(f"| {frame} | {name} | " + " | ".join(cells) + " |")
    lines += [
        "",
        f"DITR minus baseline, RMSE in millimetres, {spread_over(len(scored))}:",
        "",
        *minus(result["differences"], SETS),
        "",
        "What stage one claims of each frame, masks drawn by hand included, and how many readings outside the true "
        "region, in per cent of them, moved by more than 2 cm. Where no mask is known, every reading counts; frames "
        "*without glass* should "
        "stay as they are.",
        "",
        "| frame | claimed, % | missed, % | area, times the true | moved, % |",
        "|---|---:|---:|---:|---:|",
    ]
    for frame, row in frames.items():
        missed = "–" if row["missed"] is None else f"{100 * row['missed']:.0f}"
        area = "–" if row["area"] is None else f"{row['area']:.2f}"
        name = frame.replace(NO_GLASS, "(without glass)")
        lines.append(f"| {name} | {100 * row['claimed']:.1f} | {missed} | {area} | {100 * row['moved']:.1f} |")
    known = dict.fromkeys(frame.removesuffix(f" {NO_GLASS}").split("/")[0] for frame in frames)
    sources = "; ".join(f"`{name}`: {SOURCES[name]}" for name in known if name in SOURCES)
    told = f" From GitHub (repository, commit, folder), all under Apache-2.0: {sources}." if sources else ""
    if sources and (others := [name for name in known if name not in SOURCES]):
        told += f" The reader's own: {', '.join(others)}."
    return "\n".join([*lines, "", f"Command: `{result['command']}`{OWN_FRAMES}.{told}"])


def spread_over(frames: int) -> str:
    """Say what stands in brackets: of three frames or fewer, resampling gives back their range and no 95 % interval."""
    if frames > 3:  # a resample is the smallest frame alone with a chance of 4**-4, below 2.5 %; of three, of 3**-3
        return "mean and 95 % interval of a bootstrap paired over these frames"
    return "mean and, in brackets, the smallest and the largest of these frames, which are too few for an interval"


def peers(result: dict) -> str:
    """Return the paragraph about learned peers at equal training time, the trained ablation and the oracles."""
    (scenes,) = {scene_count(part) for part in result["trained"].values()}
    minutes = peer_tables.minutes_each(result)
    spent = peer_tables.minutes_spent(result)
    height, width = result["settings"]["size"]
    lines = [
        f"**Learned peers at equal training time.** One small network for one idea of each compared system, trained "
        f"on the same {scenes:,} scenes for {minutes:g} min of processor time ({spent} measured), as were the "
        f"networks of *{peer_tables.EQUAL}*; all at a working size of {width} x {height} pixels, in the same windows, "
        "with the same pretrained colour. *+RR* has the paper's two branches and refined region, but our windows, "
        "evidence, encoder and single step; the last column holds it against each row; "
        f"*{peer_tables.EQUAL}* spends part of its time on our finer final step, whose trust in readings was chosen "
        "for cameras and not for rendered frames; "
        f"*{peer_tables.SHIPPED}* is the shipped system. RMSE in millimetres, "
        "composed with the region that stage one predicts. Stage one, the autoencoder and the encoder of colour are "
        "the shipped ones wherever they are used; their training is not counted.",
    ]
    for split, part in result["splits"].items():
        lines += ["", *peer_table(part, split)]
    if result.get("real"):
        lines += ["", "On real frames:", "", "```", peer_tables.format_real(result["real"]), "```"]
    if not is_current(result):
        lines += ["", "Shipped rows and regions are of earlier weights than those in the folder."]
    before = peer_tables.training_command(result)
    return "\n".join([*lines, "", f"Command: `{result['command']}`, after `{before}`{OWN_FRAMES}."])


def peer_table(part: dict, split: str) -> list[str]:
    """Return the lines about one split: the table, what it says, ablation and oracles."""
    mean, ratio = part["mean"], part["ratio"]
    about = f"{split}, {part['frames']} scenes"
    lines = [
        f"| {about} | idea | optical | geometric | whole | optical, +RR over it |",
        "|---|---|---:|---:|---:|---:|",
    ]
    names = [peer_tables.SHIPPED, *peer_tables.with_seeds(mean, peer_tables.EQUAL, "+RR", *peer_tables.IDEAS)]
    for name in names:
        cells = [f"{1000 * mean[name][k][0]:.1f}" for k in peer_tables.SETS]
        cells.append(format_interval(ratio[name]["optical"], 1, ".2f"))
        lines.append(f"| {name} | {peer_tables.IDEAS.get(name, '')} | " + " | ".join(cells) + " |")
    lines += ["", peer_tables.ratio_verdict(part).replace("\n", ".\n") + ".", ""]
    for before, step in peer_tables.LADDER:
        changes = [
            format_interval([100 * (v - 1) for v in r[step]["optical"]], 1, "+.0f") for r in part["ablation"].values()
        ]
        if changes:
            lines.append(f"{step} after {before}, optical, per training seed: {' and '.join(changes)} %.")
    return [*lines, "", "```", peer_tables.format_oracles(part), "```"]


def costs(result: dict) -> str:
    """Return the paragraph about time and memory."""
    cost, takes = result["cost"], []
    for frame in cost["frames"]:
        (whole,) = (row for row in frame["stages"] if row["stage"] == "whole")
        height, width = frame["size"]
        takes.append(
            f"{width} x {height}: {whole['ms']:.0f} ms, {whole['gflops']:.0f} GFLOPs, peak memory "
            f"{whole['peak_mb']:.0f} MB"
        )
    ours, theirs = (cost["unets"][name]["ms_per_gflop"] for name in ("ours", "diffusers"))
    product = cost["machine"].get("product_ms")
    beside = f" A product of two float32 matrices 2048 x 2048 takes {product:.0f} ms there." if product else ""
    return (
        f"**What a frame costs**, on {cost['machine']['cores']} cores of one machine, median "
        f"of {cost['runs']} runs: {'; '.join(takes)}. Each window adds work, and how many there are depends on what "
        f"stage one finds. The denoiser takes {ours:.1f} ms a GFLOP, diffusers' U-Net of its size {theirs:.1f}."
        f"{beside} Other machines differ by factors: `python -m ditr_lite bench` measures yours."
    )


def disturbances(result: dict) -> str:
    """Return the table of what disturbances cost, a split after the other."""
    lines = [
        "**What disturbances cost**: optical RMSE of the disturbed over that of the undisturbed frame, on the same "
        "pixels (sparse readings: over linear interpolation between them), ratio of the means and 95 % interval, "
        f"paired over scenes; and of how many scenes the ratio, with the region found, is above {COSTLY} (sparse: "
        "above 1). Where a mean is far above 1 and few scenes are, those decide it.",
    ]
    for split, part in result["disturbances"].items():
        heads = "region found | region given | scenes above"
        lines += ["", f"| {split}, {len(part['frames'])} scenes | {heads} |", "|---|---:|---:|---:|"]
        for name, row in part["table"].items():
            key = "of_linear" if "of_linear" in row["found"] else "ratio"
            cells = [format_interval(row[region][key], 1, ".2f", "–") for region in ("found", "given")]
            lines.append(f"| {name} | " + " | ".join([*cells, scenes_above(part["rmse_m"][name]["found"])]) + " |")
    return "\n".join([*lines, "", f"Command: `{result['command']}`."])


def scenes_above(rows: dict) -> str:
    """Return of how many scenes a disturbance costs more than it should."""
    limit, key = (1, "linear_m") if "linear_m" in rows else (COSTLY, "undisturbed_m")
    pairs = [(a, b) for a, b in zip(rows["disturbed_m"], rows[key], strict=True) if a is not None and b is not None]
    return f"{sum(a > limit * b for a, b in pairs)} of {len(pairs)}"


def soak(result: dict) -> str:
    """Return the table of what was tried to break the system."""
    lines = ["**What it was put through**, and how often what happened was right:", ""]
    lines += ["| check | right | measured |", "|---|---:|---|"]
    for check in result["checks"]:
        lines.append(f"| {check['check']} | {check['right']} of {check['tried']} | {check['measured']} |")
    return "\n".join([*lines, "", f"Command: `{result['command']}`. `make soak` writes to `outputs/soak.json`."])


def scene_count(part: dict) -> int:
    """Return how many scenes a part was trained on: its card says it in one number or in one a group of scenes."""
    scenes = part["scenes"]
    return sum(scenes.values()) if isinstance(scenes, dict) else scenes


def training(card: dict) -> str:
    """Return the table of how the shipped networks were trained."""
    lines = [
        "**How the shipped networks were trained**, by the card of the weights:",
        "",
        "| network | scenes | steps | minutes |",
        "|---|---:|---:|---:|",
    ]
    for name, part in card["parts"].items():
        nets = [part] if "steps" in part else [value for value in part.values() if isinstance(value, dict)]
        nets = [net for net in nets if "steps" in net]
        if not nets:  # taken over as it is
            continue
        steps, minutes = sum(net["steps"] for net in nets), sum(net["seconds"] for net in nets) / 60
        lines.append(f"| {name} | {scene_count(part):,} | {steps:,} | {minutes:.0f} |")
    return "\n".join(lines)


def variants(result: dict) -> str:
    """Return the table of variants of the denoiser."""
    lines = [
        f"**What makes the optical denoiser better.** Variants of its small version, trained alike for "
        f"{result['minutes']:g} min of processor time on {result['scenes']:,} scenes, and scored in windows of the "
        "validation scenes, without the finer final step; in brackets 95 % intervals, paired over scenes."
        + earlier(result),
        "",
        "```",
        denoisers.format_denoisers(result),
        "```",
        "",
        f"Command: `{result['command']}`.",
    ]
    return "\n".join(lines)


def earlier(result: dict) -> str:
    """Return a sentence that names the parts of which results were made with earlier weights; empty without any."""
    old = outdated(result)
    return f" Made with earlier weights of {' and '.join(old)}." if old else ""


def folded(text: str, summary: str) -> str:
    """Leave the first paragraph of a long section in sight, and fold the rest under ``summary``."""
    first, rest = text.split("\n\n", maxsplit=1)
    return f"{first}\n\n<details><summary>{summary}</summary>\n\n{rest}\n\n</details>"


def read(path: Path) -> dict | None:
    """Return what a results file holds; None where there is none."""
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None


def main() -> None:
    """Rewrite the README in place."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, default=Path("ditr_lite/weights/results_test.json"))
    parser.add_argument("--readme", type=Path, default=Path("README.md"))
    args = parser.parse_args()
    text = args.readme.read_text(encoding="utf-8")
    before, rest = text.split(START)
    after = rest.split(END)[1]
    kept = {name: read(args.json.with_name(f"results_{name}.json")) for name in KEPT}
    splits = {"Table tops": read(args.json)} | ({"Rooms": kept["rooms"]} if kept["rooms"] else {})
    frames = kept["real"]["frames"] if kept["real"] else {}
    made = [brief(splits, frames)]
    made.append(folded(section(splits["Table tops"], "Table tops (split test)", args.json.name), ALL))
    if kept["rooms"]:
        made.append(folded(section(kept["rooms"], "Rooms (split rooms)", "results_rooms.json"), ALL))
    if kept["real"]:
        made.append(folded(real(kept["real"]), "All frames"))
    if peer_tables.RESULTS.is_file():
        made.append(folded(peers(peer_tables.load_results()), "Tables of the peers, and oracles"))
    if kept["denoiser"]:
        made.append(folded(variants(kept["denoiser"]), "Table of the variants"))
    if kept["bench"]:
        made.append(costs(kept["bench"]))
    if kept["robustness"] and kept["robustness"].get("disturbances"):
        made.append(folded(disturbances(kept["robustness"]), "Both splits"))
    if kept["soak"]:
        made.append(folded(soak(kept["soak"]), "Table of the checks"))
    made = "\n\n".join([*made, training(read_card())])
    with written_whole(args.readme) as part:
        part.write_text(f"{before}{START}\n{made}\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
