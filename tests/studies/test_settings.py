import pytest

from ditr_lite.config import override, preset
from ditr_lite.studies import settings as ss
from ditr_lite.studies.experiment import touched

TINY = preset("tiny")


def fake(rmse):
    """Return a stand-in for a comparison that knows its answers: (setting, seed) -> millimetres."""

    def compare(settings, seed, **how):
        values = {"default": rmse["default"][seed], "changed": rmse[settings.get("unet.heads", "1")][seed]}
        sets = {arm: {"optical": [v, None, v + 2], "geometric": [v, v, v]} for arm, v in values.items()}
        return {"seconds": {"default": 0 if seed else 9, "changed": 5}, "rmse_m": sets}

    return compare


@pytest.fixture
def rows(monkeypatch):
    monkeypatch.setattr(ss, "compare", fake({"default": [10, 11], "1": [20, 22], "4": [10.5, 10.5]}))
    saved = []
    found = ss.run({"one head": {"unet.heads": "1"}, "four heads": {"unet.heads": "4"}}, save=lambda r: saved.append(1))
    assert len(saved) == 4
    return found


def test_every_setting_is_tried_with_every_seed_and_the_default_counts_once(rows):
    assert list(rows) == [ss.DEFAULT, "one head", "four heads"]
    assert [len(row["seconds"]) for row in rows.values()] == [2, 2, 2]
    assert ss.errors(rows[ss.DEFAULT]).tolist() == [[10, 12], [11, 13]]  # the second frame holds no such pixel


def test_a_change_must_beat_the_seeds_to_be_clear(rows):
    ten = ss.against_default(rows, "one head")
    assert ten.mean == pytest.approx(10.5) and ten.seeds == pytest.approx(2) and ten.clear
    assert not ss.against_default(rows, "four heads").clear
    assert ss.against_default(rows, "one head", "geometric").mean == pytest.approx(10.5)


@pytest.mark.parametrize("settings", ss.SETTINGS.values(), ids=ss.SETTINGS)
def test_every_setting_is_another_stage_two(settings):
    assert override(TINY, **settings) != TINY
    assert set(touched(TINY, settings)) <= {"optical", "geometric", "detail"}
