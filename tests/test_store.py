import hashlib
import json

import pytest
import torch
from torch import nn

from ditr_lite import store
from ditr_lite.config import override, preset
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
    [(None, "no weights in"), ("{", "is damaged"), ("\xff", "is damaged"), ("[]", "no card"), ("{}", "lacks config")],
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
