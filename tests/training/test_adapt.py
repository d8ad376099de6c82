"""Fine-tuning: it keeps what helps, says when nothing does, and never writes over what it started from."""

import shutil

import numpy as np
import pytest
import torch
from made_scenes import make_scenes

from ditr_lite.config import override, preset
from ditr_lite.store import WEIGHTS, load_part, read_card, read_config, save_part, sha256
from ditr_lite.training import adapt as module
from ditr_lite.training.adapt import adapt, check_out, errors_of, hold_out, mixed, split_held_out
from ditr_lite.training.loop import Recipe
from ditr_lite.training.parts import PARTS, train_on
from ditr_lite.training.recipes import RECIPES as FROM_SCRATCH

TINY = preset("tiny")
SIZE = (64, 96)
SHORT = Recipe(steps=2, batch=2, lr=1e-3, warmup=1)


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    """A tiny system after two steps."""
    home = tmp_path_factory.mktemp("start")
    for part in PARTS:
        train_on(part, TINY, [make_scenes(3, SIZE)], None, home / "weights", home / "work", SHORT)
    return home / "weights"


def own(count=9, seed=5):
    return make_scenes(count, SIZE, seed)


def go(part, start, folder, recipe, held_out=None, config=TINY):
    pool = mixed([own()], [make_scenes(3, SIZE)], 0.5)
    return adapt(part, config, pool, held_out or own(6, 7), start, folder / "out", folder / "work", recipe)


def test_what_helps_is_kept_and_judged_by_frames_that_chose_nothing(start, tmp_path):
    before = {path.name: sha256(path) for path in start.glob("*.safetensors")}
    recipe = Recipe(steps=60, batch=4, lr=5e-3, warmup=1, decay=0.8, ramp=False, patience=3, law="constant")
    notes = go("region", start, tmp_path, recipe)
    judged = notes["judged"]
    assert judged["kept"] == "fine-tuned" and np.mean(judged["after"]) < np.mean(judged["before"])
    assert len(judged["before"]) == 4 and notes["curve"][0]["step"] == 0 and notes["best_step"] > 0
    assert {path.name: sha256(path) for path in start.glob("*.safetensors")} == before
    card = read_card(tmp_path / "out")["parts"]
    assert set(card) == set(PARTS) and card["region"]["start_sha256"] == read_card(start)["parts"]["region"]["sha256"]
    old, new = (load_part("region", folder) for folder in (start, tmp_path / "out"))
    assert any(not torch.equal(old[key], new[key]) for key in old)


def test_other_frames_judge_than_those_that_say_when_to_stop(start, tmp_path, monkeypatch):
    held_out, asked = own(7, 7), []
    chooses, judges = split_held_out(held_out, "region")

    def errors_of(*_):
        return lambda scenes: asked.append(scenes.depth.tobytes()) or np.zeros(len(scenes))

    monkeypatch.setattr(module, "errors_of", errors_of)
    go("region", start, tmp_path, SHORT, held_out)
    every_one, first, *between, last = asked
    assert every_one == held_out.depth.tobytes()
    assert first == last == judges.depth.tobytes() and set(between) == {chooses.depth.tobytes()}


def test_frames_that_ask_nothing_neither_choose_nor_judge(start, tmp_path):
    held_out = own(6, 7)
    held_out.material[[0, 3]] = 0  # both would choose
    notes = go("optical", start, tmp_path / "a", SHORT, held_out)
    assert len(notes["judged"]["before"]) == 2 and np.isfinite(notes["judged"]["before"]).all()
    assert np.isfinite([row["held_out"] for row in notes["curve"]]).all()
    held_out.material[1:3] = 0
    with pytest.raises(ValueError, match="3 held-out frames or more that concern 'optical', got 2 of 6"):
        go("optical", start, tmp_path / "b", SHORT, held_out)


@pytest.mark.parametrize("part", ["optical", "detail"])
def test_what_does_not_help_leaves_the_start(start, tmp_path, part, monkeypatch):
    monkeypatch.setattr(module, "model_errors", lambda model, errors, scenes: np.full(len(scenes), 0.5))  # no gain
    notes = go(part, start, tmp_path, SHORT)
    assert notes["judged"]["kept"] == "start"
    for key, value in load_part(part, start).items():
        assert torch.equal(value, load_part(part, tmp_path / "out")[key])


def test_the_card_counts_frames_of_like_names(start, tmp_path):
    pool = mixed([own(4), own(4)], [make_scenes(3, SIZE)], 0.5)
    notes = adapt("region", TINY, pool, own(6, 7), start, tmp_path / "out", tmp_path / "work", SHORT)
    assert notes["scenes"] == {"made_0 to made_2": 3, "made_0 to made_3": 8}


def test_the_weights_to_start_from_and_the_packages_own_are_never_replaced(start, tmp_path):
    for out, whose in ((start, "the weights to start from"), (WEIGHTS, "the package's own weights")):
        with pytest.raises(ValueError, match=f"holds {whose}, which fine-tuning never replaces: give --out"):
            check_out(out, start)
    with pytest.raises(ValueError, match="cannot fine-tune 'autoencoder': choose one of region"):
        go("autoencoder", start, tmp_path, SHORT)
    with pytest.raises(ValueError, match="3 held-out frames or more that concern 'region', got 2 of 2"):
        go("region", start, tmp_path, SHORT, own(2))
    assert not (tmp_path / "out").exists()


def test_frames_that_choose_frames_that_judge_and_frames_to_learn_from_are_apart():
    scenes = own(7)
    chooses, judges = split_held_out(scenes, "region")
    (learns,), (held_out,) = hold_out([scenes])
    for one, other in ((chooses, judges), (learns, held_out)):
        assert sorted([*one.names, *other.names]) == sorted(scenes.names)
    assert np.array_equal(judges.depth[0], scenes.depth[1])


def test_a_group_of_one_frame_is_held_out_or_learnt_from():
    learns, held_out = hold_out([own(1), own(1), own(5)])
    assert [len(g) for g in learns] == [1, 3] and [len(g) for g in held_out] == [1, 2]


def test_a_false_claim_where_there_is_no_glass_counts_against_fine_tuning(monkeypatch):
    nothing = np.zeros((4, 4), bool)
    claims = [(nothing, nothing), (~nothing, nothing), (~nothing, ~nothing)]
    monkeypatch.setattr(module, "claims_in_order", lambda *_: iter(claims))
    assert module.region_errors(None, TINY, None).tolist() == [0, 1, 0]


def test_a_share_of_the_draws_are_scenes_of_the_first_training():
    pool = mixed([own(4), own(12)], [own(3)], 0.2)
    assert pool.shares == pytest.approx([0.2, 0.6, 0.2]) and len(mixed([own(4)], [own(3)], 0.0).groups) == 1
    with pytest.raises(ValueError, match="from 0 to below 1"):
        mixed([own()], [own()], 1.0)


@pytest.mark.parametrize("part", list(module.RECIPES))
def test_errors_have_a_place_for_every_frame(start, part):
    from ditr_lite.pipeline import build

    parts = build(TINY).eval()
    for name in PARTS:
        parts[name].load_state_dict(load_part(name, start))
    scenes = own(3)
    scenes.material[1] = 0
    scenes.depth[0, -9:, -9:] = 0  # a hole outside the region
    found = module.model_errors(parts[part], errors_of(part, parts, TINY, "none"), scenes)
    assert found.shape == (3,) and (part != "optical" or np.isnan(found[1])) and np.isfinite(found[0])


def test_a_stopped_fine_tuning_goes_on(start, tmp_path):
    once = go("region", start, tmp_path / "a", SHORT)
    shutil.copytree(tmp_path / "a" / "work", tmp_path / "b" / "work")
    again = go("region", start, tmp_path / "b", SHORT)
    assert once["judged"] == again["judged"] and once["curve"] == again["curve"]


def test_a_stopped_fine_tuning_with_other_settings_goes_on(start, tmp_path, monkeypatch):
    config = override(TINY, evidence=False)
    with monkeypatch.context() as stopped, pytest.raises(KeyboardInterrupt):
        stopped.setattr(module, "save_part", pull_the_plug)
        go("optical", start, tmp_path, SHORT, config=config)
    notes = go("optical", start, tmp_path, SHORT, config=config)
    assert notes["judged"]["before"] and read_config(tmp_path / "out") == config


def pull_the_plug(*_):
    raise KeyboardInterrupt


def test_a_checkpoint_of_other_settings_is_not_taken(start, tmp_path):
    go("optical", start, tmp_path, SHORT)
    shutil.rmtree(tmp_path / "out")
    with pytest.raises(ValueError, match="belongs to another run, of other settings"):
        go("optical", start, tmp_path, SHORT, config=override(TINY, evidence=False))


def test_a_checkpoint_of_another_start_or_of_other_held_out_frames_is_not_taken(start, tmp_path):
    go("region", start, tmp_path, SHORT)
    with pytest.raises(ValueError, match="belongs to another run, of other settings"):
        go("region", start, tmp_path, SHORT, own(6, 8))
    other = shutil.copytree(start, tmp_path / "other")
    state = load_part("region", other)
    first = next(name for name, value in state.items() if value.is_floating_point())
    save_part("region", state | {first: state[first] + 1}, TINY, other, {})
    with pytest.raises(ValueError, match="belongs to another run, of other settings"):
        go("region", other, tmp_path, SHORT)


@pytest.mark.parametrize("part", list(module.RECIPES))
def test_fine_tuning_is_slow_begins_with_the_start_and_stops_early(part):
    recipe, afresh = module.RECIPES[part], FROM_SCRATCH[part]
    assert recipe.lr < afresh.lr and recipe.steps < afresh.steps
    assert not recipe.ramp and 0 < recipe.patience < recipe.steps / module.EVERY and recipe.law == "constant"


def test_the_final_step_does_not_go_on_above_another_branch(start, tmp_path):
    go("detail", start, tmp_path, SHORT)
    other = load_part("optical", start)
    save_part("optical", other | {"out.bias": other["out.bias"] + 1}, TINY, tmp_path / "out", {})
    with pytest.raises(ValueError, match="belongs to another run, of other settings"):
        go("detail", start, tmp_path, SHORT)
