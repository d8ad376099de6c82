import numpy as np
import pytest

from ditr_lite.evaluation.own_method import checked, find_method, find_methods

RGB, DEPTH = np.zeros((4, 6, 3), np.uint8), np.full((4, 6), 0.5, np.float32)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "mine_own.py").write_text("def fill(rgb, depth, region):\n    return depth + 0.25\n\n\nnumber = 3\n")
    (tmp_path / "slip.py").write_text("def fill(rgb, depth, region) return depth\n")
    (tmp_path / "broken.py").write_text("from json import absent\n")
    return tmp_path


def test_a_method_is_found_by_its_address(folder):
    name, method = find_method("mine_own:fill", folder)
    assert name == "fill" and np.allclose(method(RGB, DEPTH, None), 0.75)


@pytest.mark.parametrize(
    ("address", "reason"),
    [
        ("mine_own", "named module:function"),
        ("mine_own:", "named module:function"),
        (".mine_own:fill", "named module:function"),
        ("slip:fill", "cannot import 'slip'.*line 1"),
        ("broken:fill", "cannot import 'broken'.*absent"),
        ("nowhere_at_all:fill", "cannot import 'nowhere_at_all'"),
        ("mine_own:number", "no function 'number'"),
        ("mine_own:absent", "no function 'absent'"),
        ("mine_own:harmonic", "name of a baseline"),
        ("mine_own:ditr", "row that every table has"),
        ("mine_own:sensor", "row that every table has"),
    ],
)
def test_a_bad_address_is_refused(folder, address, reason):
    with pytest.raises(ValueError, match=reason):
        find_method(address, folder)


def test_two_methods_of_one_name_are_refused(folder):
    (folder / "mine_too.py").write_text("from mine_own import fill\n\n\ndef other(*frame):\n    return fill(*frame)\n")
    assert list(find_methods(["mine_own:fill", "mine_too:other"], folder)) == ["fill", "other"]
    with pytest.raises(ValueError, match="two methods are called 'fill'"):
        find_methods(["mine_own:fill", "mine_too:fill"], folder)


@pytest.mark.parametrize(
    ("result", "reason"),
    [
        (DEPTH[:2], r"expected \(4, 6\) of floats"),
        ((1000 * DEPTH).astype(int), "of floats, metres"),
        (DEPTH * 0, "some pixels are not positive"),
        (np.where(np.eye(4, 6) > 0, np.nan, DEPTH), "some pixels are not positive"),
    ],
)
def test_a_bad_result_is_refused(result, reason):
    with pytest.raises(ValueError, match=reason):
        checked(lambda rgb, depth, region: result, "mine")(RGB, DEPTH, None)


def test_a_method_cannot_change_what_others_are_given():
    def vandal(rgb, depth, region):
        depth[:] = 9
        return depth

    depth = DEPTH.copy()
    assert checked(vandal, "vandal")(RGB, depth).max() == 9 and (depth == DEPTH).all()
