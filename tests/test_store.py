import hashlib
import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch
from torch import nn

from ditr_lite import pipeline, store
from ditr_lite.config import StdConfig, override, preset
from ditr_lite.store import CARD, load_part, load_parts, read_card, save_part, sha256, write_tensors

TINY = preset("tiny")
STATE = {"weight": torch.tensor([[1.0, 0.1], [-2.5, 1e-4]]), "count": torch.tensor([7, 2**40])}


def test_weights_come_back_as_float32_rounded_to_half_and_whole_numbers_exactly(tmp_path):
    path = save_part("region", STATE, TINY, tmp_path, {"steps": 3})
    back = load_part("region", tmp_path)
    assert back["weight"].dtype == torch.float32 and torch.equal(back["weight"], STATE["weight"].half().float())
    assert torch.equal(back["count"], STATE["count"])
    assert path.stat().st_size < 400 and not list(tmp_path.glob("*.part*"))


def test_card_names_the_bytes_and_keeps_the_other_parts(tmp_path):
    paths = [save_part(name, STATE, TINY, tmp_path, {"steps": k}) for k, name in enumerate(("region", "detail"))]
    card = read_card(tmp_path)
    assert {k: v["steps"] for k, v in card["parts"].items()} == {"region": 0, "detail": 1}
    for path in paths:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        assert card["parts"][path.stem]["sha256"] == digest == sha256(path)
    (tmp_path / "empty").touch()
    assert sha256(tmp_path / "empty") == "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"


def test_configuration_travels_with_the_weights(tmp_path):
    config = override(TINY, **{"detail.width": 0, "sampler.steps": 9})
    for name in ("region", "autoencoder", "optical", "geometric"):
        save_part(name, STATE, config, tmp_path, {})
    loaded, states = load_parts(tmp_path)
    assert loaded == config and sorted(states) == ["autoencoder", "geometric", "optical", "region"]


def test_a_part_trained_anew_leaves_what_calibration_entered(tmp_path):
    calibrated = replace(TINY, std=StdConfig(kept=0.02), refine=replace(TINY.refine, temperature=1.5))
    save_part("region", STATE, calibrated, tmp_path, {})
    save_part("detail", STATE, replace(TINY, size=(96, 96)), tmp_path, {})
    assert store.read_config(tmp_path) == replace(calibrated, size=(96, 96))


def test_a_system_with_a_pretrained_encoder_loads_it_too(tmp_path):
    config = preset("lite")
    for name in ("region", "autoencoder", "optical", "geometric", "detail", "encoder"):
        save_part(name, STATE, config, tmp_path, {})
    assert sorted(load_parts(tmp_path)[1]) == ["autoencoder", "detail", "encoder", "geometric", "optical", "region"]


def test_a_part_is_copied_with_its_entry_and_only_where_it_is_missing(tmp_path):
    save_part("encoder", STATE, preset("lite"), tmp_path / "a", {"source": "elsewhere"})
    save_part("region", STATE, TINY, tmp_path / "b", {})
    store.copy_part("encoder", tmp_path / "a", tmp_path / "b")
    card = read_card(tmp_path / "b")
    assert card["parts"]["encoder"]["source"] == "elsewhere" and card["config"]["name"] == "tiny"
    assert torch.equal(load_part("encoder", tmp_path / "b")["count"], STATE["count"])
    save_part("encoder", {"other": torch.ones(1)}, TINY, tmp_path / "a", {})
    store.copy_part("encoder", tmp_path / "a", tmp_path / "b")  # it is there already
    assert "count" in load_part("encoder", tmp_path / "b")


def test_a_file_without_an_entry_in_the_card_does_not_count_as_a_copy(tmp_path):
    save_part("encoder", STATE, preset("lite"), tmp_path / "a", {})
    save_part("region", STATE, TINY, tmp_path / "b", {})
    (tmp_path / "b" / "encoder.safetensors").write_bytes(b"what a killed writer left")
    store.copy_part("encoder", tmp_path / "a", tmp_path / "b")
    assert torch.equal(load_part("encoder", tmp_path / "b")["count"], STATE["count"])


def test_a_folder_without_a_card_gets_the_settings_that_are_asked_for(tmp_path):
    save_part("encoder", STATE, preset("lite"), tmp_path / "a", {})
    store.copy_part("encoder", tmp_path / "a", tmp_path / "b", TINY)
    assert store.read_config(tmp_path / "b") == TINY
    store.copy_part("encoder", tmp_path / "a", tmp_path / "c")
    assert store.read_config(tmp_path / "c") == preset("lite")


def test_damaged_or_replaced_weights_are_refused(tmp_path):
    path = save_part("region", STATE, TINY, tmp_path, {})
    whole = path.read_bytes()
    path.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(ValueError, match="does not match its checksum"):
        load_part("region", tmp_path)
    path.write_bytes(b"not safetensors")
    card = read_card(tmp_path)
    card["parts"]["region"]["sha256"] = sha256(path)
    (tmp_path / CARD).write_text(json.dumps(card))
    with pytest.raises(ValueError, match="cannot be read as safetensors"):
        load_part("region", tmp_path)
    path.unlink()
    with pytest.raises(ValueError, match="no weights called 'region'"):
        load_part("region", tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "no weights in"),
        ("{", "is damaged"),
        ("\xff", "is damaged"),
        ("[]", "is damaged"),
        ("{}", "lacks config"),
    ],
)
def test_a_folder_without_a_proper_card_is_refused(tmp_path, text, message):
    if text is not None:
        (tmp_path / CARD).write_text(text, encoding="latin-1")
    with pytest.raises(ValueError, match=message):
        read_card(tmp_path)


def test_only_lite_is_shipped():
    with pytest.raises(ValueError, match="only the lite preset is shipped"):
        load_parts(None, "paper")
    with pytest.raises(ValueError, match="unknown preset"):
        load_parts(None, "huge")


def test_a_write_that_stops_half_way_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.safetensors"
    write_tensors(STATE, path)
    before = path.read_bytes()

    def stops(tensors, name, metadata=None):
        with open(name, "wb") as file:
            file.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(store, "save_file", stops)
    with pytest.raises(KeyboardInterrupt):
        write_tensors({"other": torch.zeros(1)}, path)
    assert path.read_bytes() == before


def test_a_fingerprint_changes_with_a_weight_and_with_a_setting():
    net = nn.Linear(2, 3)
    same = store.fingerprint(net, 0.5)
    assert store.fingerprint(net, 0.5) == same != store.fingerprint(net, 0.4)
    with torch.no_grad():
        net.bias[1] += 1
    assert store.fingerprint(net, 0.5) != same


# As the parts come: the autoencoder before what is trained on it.
ORDER = ("autoencoder", "region", "optical", "geometric", "detail")


@pytest.mark.parametrize("part", ["optical", "geometric", "detail"])
def test_parts_that_do_not_belong_together_are_refused(tmp_path, part):
    one, other = tmp_path / "one", tmp_path / "other"
    for seed, folder in enumerate((one, other)):
        torch.manual_seed(seed)
        parts = pipeline.build(TINY)
        for name in ORDER:
            save_part(name, parts[name].state_dict(), TINY, folder, {})
        checksum = read_card(folder)["parts"]["autoencoder"]["sha256"]
        assert read_card(folder)["parts"][part]["built_on"]["autoencoder"] == checksum
        load_parts(folder)
    card = read_card(one)
    card["parts"][part] = read_card(other)["parts"][part]  # file and entry, as a person would copy them
    (one / CARD).write_text(json.dumps(card))
    (one / f"{part}.safetensors").write_bytes((other / f"{part}.safetensors").read_bytes())
    with pytest.raises(ValueError, match=f"do not belong together: '{part}' was trained on another 'autoencoder'"):
        load_parts(one)


def test_a_new_autoencoder_makes_the_old_branches_useless_until_they_are_trained_again(tmp_path):
    torch.manual_seed(0)
    parts = pipeline.build(TINY)
    for name in ORDER:
        save_part(name, parts[name].state_dict(), TINY, tmp_path, {})
    new = {k: v + 0.125 if v.is_floating_point() else v for k, v in parts["autoencoder"].state_dict().items()}
    save_part("autoencoder", new, TINY, tmp_path, {})
    with pytest.raises(ValueError, match="do not belong together"):
        load_parts(tmp_path)
    for name in ("optical", "geometric", "detail"):
        save_part(name, parts[name].state_dict(), TINY, tmp_path, {})
    assert load_parts(tmp_path)[0] == TINY


def test_what_a_part_was_trained_on_travels_with_it(tmp_path):
    for name in ("autoencoder", "optical"):
        save_part(name, STATE, TINY, tmp_path / "a", {})
    other = {"weight": STATE["weight"] + 1, "count": STATE["count"]}
    save_part("autoencoder", other, TINY, tmp_path / "b", {})
    store.copy_part("optical", tmp_path / "a", tmp_path / "b")
    with pytest.raises(ValueError, match="do not belong together"):
        load_part("optical", tmp_path / "b")


def test_parts_saved_at_once_are_all_in_the_card(tmp_path):
    names = [f"part{k}" for k in range(12)]
    with ThreadPoolExecutor(6) as pool:
        list(pool.map(lambda name: save_part(name, STATE, TINY, tmp_path, {}), names))
    assert sorted(read_card(tmp_path)["parts"]) == sorted(names)
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("parts",), None),
        (("parts",), []),
        (("parts", "region"), None),
        (("parts", "region"), "text"),
        (("parts", "region", "sha256"), None),
        (("parts", "region", "sha256"), 7),
        (("parts", "optical", "built_on"), ["autoencoder"]),
        (("config",), None),
        (("config",), "lite"),
        (("config", "unet"), None),
        (("config", "unet"), 3),
        (("config", "unet", "width"), 8.5),
        (("config", "unet", "width"), "8"),
        (("config", "unet", "width"), None),
        (("config", "unet", "width"), True),
        (("config", "unet", "width"), 10**9),
        (("config", "unet", "multipliers"), 4),
        (("config", "unet", "multipliers"), [1, "2"]),
        (("config", "region", "levels"), 12),
        (("config", "region", "levels"), 0),
        (("config", "size"), [64]),
        (("config", "size"), "64"),
        (("config", "sampler", "steps"), 1.5),
        (("config", "schedule", "timesteps"), None),
        (("config", "evidence"), 1),
        (("config", "std", "base"), [0.1]),
        (("config", "wings"), 2),
    ],
    ids=str,
)
def test_a_damaged_card_is_refused_in_one_line(tmp_path, path, value):
    for name in ORDER:
        save_part(name, STATE, TINY, tmp_path, {})
    card = read_card(tmp_path)
    node = card
    for key in path[:-1]:
        node = node[key]
    node[path[-1]] = value
    (tmp_path / CARD).write_text(json.dumps(card))
    with pytest.raises(ValueError) as refusal:
        load_parts(tmp_path)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("wrong", [float("nan"), float("inf"), 1e9])  # 1e9 does not fit into float16
def test_weights_with_nan_are_neither_written_nor_read(tmp_path, wrong):
    bad = {"weight": torch.tensor([1.0, wrong])}
    with pytest.raises(ValueError, match="hold NaN or infinity in weight"):
        save_part("region", bad, TINY, tmp_path, {})
    assert not (tmp_path / "region.safetensors").exists()
    save_part("region", STATE, TINY, tmp_path, {})
    write_tensors({"weight": torch.tensor([1.0, float("nan")])}, tmp_path / "region.safetensors")
    card = read_card(tmp_path)
    card["parts"]["region"]["sha256"] = sha256(tmp_path / "region.safetensors")
    (tmp_path / CARD).write_text(json.dumps(card))
    with pytest.raises(ValueError, match="NaN or infinity"):
        load_part("region", tmp_path)


def test_the_preset_is_checked_against_the_card(tmp_path):
    for name in ORDER:
        save_part(name, STATE, TINY, tmp_path, {})
    assert load_parts(tmp_path)[0] == load_parts(tmp_path, "tiny")[0] == TINY
    with pytest.raises(ValueError, match="only the tiny preset is what .* holds, not 'lite'"):
        load_parts(tmp_path, "lite")


def test_a_card_whose_configuration_cannot_be_is_named(tmp_path):
    save_part("region", {"w": torch.zeros(2)}, preset("tiny"), tmp_path, {})
    card = json.loads((tmp_path / "card.json").read_text())
    for group, key, value in (("unet", "width", "wide"), ("region", "levels", 0)):
        odd = card | {"config": card["config"] | {group: card["config"][group] | {key: value}}}
        (tmp_path / "card.json").write_text(json.dumps(odd))
        with pytest.raises(ValueError, match="card.json is damaged"):
            store.read_config(tmp_path)


def test_weights_may_be_read_by_whoever_may_read_their_card(tmp_path):
    write_tensors({"a": torch.ones(2)}, tmp_path / "a.safetensors")
    (tmp_path / "card.json").write_text("{}")
    assert (tmp_path / "a.safetensors").stat().st_mode == (tmp_path / "card.json").stat().st_mode
