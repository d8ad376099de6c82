"""The slides in a browser, on a laptop's projector."""

import pytest

NAMES = ("00_start_here", "02_region_refinement")
OWN_WISH = "/favicon.ico"  # the browser asks any server for it once; a deck names none


def show(driver, address):
    """Open a deck on a screen of 1366 x 768."""
    size = {"width": 1366, "height": 768, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    driver.get(address)


@pytest.mark.parametrize("name", NAMES)
def test_a_deck_asks_nobody_else(driver, journal, decks, name):
    journal.complaints(), journal.traffic()
    show(driver, f"{decks}{name}.html")
    foreign, missing = journal.traffic()
    assert foreign == [] and [address for address in missing if not address.endswith(OWN_WISH)] == []
    assert [line for line in journal.complaints() if OWN_WISH not in line] == []
