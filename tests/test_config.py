import json

import pytest

from ditr_lite import config


@pytest.mark.parametrize("name", config.PRESETS)
def test_presets_survive_json(name):
    preset = config.preset(name)
    again = config.from_dict(json.loads(json.dumps(config.to_dict(preset))))
    assert again == preset
    assert hash(again) == hash(preset)  # tuples came back as tuples, at every depth


@pytest.mark.parametrize("name", config.PRESETS)
def test_sizes_fit_the_networks(name):
    preset = config.preset(name)
    height, width = preset.size
    assert preset.name == name
    assert height % 32 == 0 and width % 32 == 0
    # latents are at stride 4 and halve once per further U-Net level
    levels = len(preset.unet.multipliers)
    assert height % (4 * 2 ** (levels - 1)) == 0 and width % (4 * 2 ** (levels - 1)) == 0
    assert max(preset.unet.attention_levels) < levels
    for level in preset.unet.attention_levels:
        assert preset.unet.width * preset.unet.multipliers[level] % preset.unet.heads == 0
    assert 0 < preset.schedule.beta_start < preset.schedule.beta_end < 1


def test_what_the_paper_states_is_the_default():
    refine = config.RefineConfig()
    assert (refine.median, refine.dilate, refine.iterations) == (7, 5, 3)
    assert len(config.AutoencoderConfig().multipliers) == 2  # sampling scale 4: two halvings
    assert config.ScheduleConfig().timesteps == 1000
    assert config.UNetConfig().multipliers == (1, 2, 4, 8)  # four levels, channels double
    paper = config.preset("paper")
    assert paper.unet.block == "plain" and paper.unet.query == "feature"
    assert paper.sampler.steps == 1000 and not paper.evidence
    assert paper.window == 0 and paper.unet.colour_channels == () and paper.region.colour == "scratch"


def test_unknown_preset_lists_the_known():
    with pytest.raises(ValueError, match="tiny, lite, paper"):
        config.preset("huge")


def test_override_changes_one_setting_and_copies():
    lite = config.preset("lite")
    wider = config.override(lite, **{"unet.width": 48, "evidence": False, "size": (96, 128)})
    assert wider.unet.width == 48 and wider.evidence is False and wider.size == (96, 128)
    assert lite.unet.width == 32 and lite.evidence is True
    assert config.override(lite) == lite


@pytest.mark.parametrize(
    ("key", "text", "value"),
    [
        ("unet.width", "48", 48),
        ("evidence", "false", False),
        ("evidence", "True", True),
        ("schedule.beta_end", "0.02", 0.02),
        ("size", "96,128", (96, 128)),
        ("unet.query", "latent", "latent"),
    ],
)
def test_override_converts_text(key, text, value):
    node = config.override(config.preset("lite"), **{key: text})
    for part in key.split("."):
        node = getattr(node, part)
    assert node == value and type(node) is type(value)


def test_override_empties_a_tuple():
    assert config.override(config.preset("lite"), **{"unet.colour_channels": ""}).unet.colour_channels == ()


def test_override_fills_an_empty_tuple():
    empty = config.preset("tiny")
    assert empty.unet.colour_channels == ()
    for value in ("24,40,112", (24, 40, 112)):
        assert config.override(empty, **{"unet.colour_channels": value}).unet.colour_channels == (24, 40, 112)
    with pytest.raises(ValueError, match="'unet.colour_channels' expects tuple"):
        config.override(empty, **{"unet.colour_channels": "24,a"})


def test_settings_that_are_right_only_together_are_taken_in_any_order():
    settings = {
        "sampler.prediction": "v",
        "unet.anchor": "false",
        "unet.multipliers": "1,2",
        "unet.attention_levels": "1",
    }
    for pairs in (list(settings.items()), list(settings.items())[::-1]):
        changed = config.override(config.preset("tiny"), **dict(pairs))
        assert (changed.sampler.prediction, changed.unet.anchor, changed.unet.multipliers) == ("v", False, (1, 2))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"unet.depth": 3}, "unknown setting 'unet.depth'"),
        ({"size.height": 3}, "unknown setting"),
        ({"unet": 3}, "is a group"),
        ({"unet.width": "wide"}, "expects int"),
        ({"evidence": "maybe"}, "expects bool"),
        ({"size": "96,a"}, "expects tuple"),
        ({"unet.width": 48.5}, "expects int"),
        ({"size": (96.5, 128)}, "expects tuple"),
        ({"size": "64"}, "size: expected .height, width., both multiples of 32, got .64,."),
        ({"size": "60,90"}, "both multiples of 32"),
        ({"size": "0,64"}, "both multiples of 32"),
        ({"size": "96,96,96"}, "both multiples of 32"),
        ({"size": "96,96", "unet.multipliers": "1,2,4,8,8"}, "both multiples of 64"),
        ({"unet.heads": 0}, "unet: expected at least 1, got heads 0"),
        ({"unet.width": "-8"}, "unet: expected at least 1, got width -8"),
        ({"unet.multipliers": "1,0,4,8"}, "unet.multipliers: expected at least 1, got smallest 0"),
        ({"unet.multipliers": ()}, "unet.multipliers: expected at least 1, got levels 0"),
        ({"autoencoder.width": "-8"}, "autoencoder: expected at least 1, got width -8"),
        ({"autoencoder.multipliers": "1,0"}, "got smallest 0"),
        ({"sampler.prediction": "foo", "unet.anchor": "false"}, "unknown sampler.prediction 'foo'; choose one of x0"),
        ({"sampler.steps": 0}, "sampler: expected at least 1, got steps 0"),
        ({"sampler.prediction": "v"}, "'v' needs unet.anchor=false"),
        ({"std.base": "0.1"}, "each of 2 branches"),
        ({"window": 100}, "window: expected 0 or a multiple of 32, got 100"),
        ({"refine.threshold": 1.0}, "a threshold between 0 and 1"),
        ({"refine.looks": (0.5,)}, "none below 1"),
        ({"refine.looks": ()}, "at least one size"),
        ({"region.colour": "foo"}, "unknown region.colour 'foo'; choose one of pretrained, scratch"),
        ({"refine.temperature": 0.0}, "a temperature above 0"),
        ({"refine.median": 4}, "expected an odd median kernel .or 0 for none., got 4"),
        ({"refine.iterations": -1}, "expected iterations >= 0, got -1"),
        ({"sampler.steps": 2000}, "sampler: expected at most 1000, got steps 2000"),
        ({"unet.colour_channels": "24,40"}, r"expected \(\) or \(24, 40, 112\), got \(24, 40\)"),
    ],
)
def test_override_refuses(settings, message):
    with pytest.raises(ValueError, match=message):
        config.override(config.preset("lite"), **settings)


def test_from_dict_refuses_unknown_keys():
    values = config.to_dict(config.preset("tiny"))
    values["unet"]["depth"] = 3
    with pytest.raises(ValueError, match="UNetConfig has no setting depth"):
        config.from_dict(values)


def test_configurations_cannot_be_changed():
    with pytest.raises(AttributeError):
        config.preset("lite").unet.width = 3


def test_stage_one_is_trained_for_its_first_look():
    assert config.preset("tiny").look() == config.preset("tiny").size
    looks = config.override(config.preset("tiny"), **{"refine.looks": (1.5, 1.0)})
    assert looks.look() == looks.look(1.5) == (96, 144) and looks.look(1.0) == looks.size


def test_a_look_is_of_a_size_that_stage_one_can_halve():
    odd = config.override(config.preset("lite"), **{"refine.looks": (1.1,)})
    with pytest.raises(ValueError, match=r"1.1 times size \(192, 256\) is \(211, 282\): .* sees multiples of 32"):
        odd.look()
    assert config.override(odd, **{"region.colour": "scratch"}).look() == (211, 282)
