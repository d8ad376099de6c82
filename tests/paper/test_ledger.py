"""The ledger: twenty entries, each with a computation of its own and an honest verdict, and one table."""

from test_notebooks import READING_ORDER

from ditr_lite.paper import ledger


def test_there_are_twenty_entries_each_with_its_own_computation():
    assert [e.number for e in ledger.ENTRIES] == list(range(1, 21))
    assert len({e.measured for e in ledger.ENTRIES}) == 20
    assert all(e.measured.__module__ == ledger.__name__ for e in ledger.ENTRIES)


def test_every_entry_says_where_what_and_how_it_ends():
    for e in ledger.ENTRIES:
        assert all((e.where, e.says, e.ours)) and e.holds in ledger.VERDICTS
        assert e.notebook in READING_ORDER
    assert {e.holds for e in ledger.ENTRIES} == set(ledger.VERDICTS)  # no verdict is idle


def test_the_table_is_markdown_and_computed():
    lines = ledger.table().splitlines()
    assert len(lines) == 22 and {line.replace("\\|", "").count("|") for line in lines} == {8}
    assert all(e.measured().replace("|", "\\|") in line for e, line in zip(ledger.ENTRIES, lines[2:], strict=True))
    few = ledger.table(ledger.ENTRIES[4:6]).splitlines()
    assert [line.split(" | ")[0] for line in few[2:]] == ["| 5", "| 6"]
