"""What is published of an estimate."""

from dataclasses import replace

from suspnet.depot.live.results import estimate_row, summary
from suspnet.depot.live.suspension import SectionEstimate
from suspnet.ground.records import OK, TripResult
from suspnet.trains.fits.worn_parts import WornPart

WORN = WornPart(("c_p_axle2_left",), 1e6, 0.629).finding


def test_worn_parts_are_named_in_the_row_and_on_the_line():
    result = TripResult("2026-03-31 06:20", "", status=OK, vehicle="am96", mileage_km=30800.0)
    result = replace(result, estimates={"c_p_axle2_left": 0.629}, worn=WORN)
    estimate = SectionEstimate(result, {"taken": 8400}, 84.0)
    row = estimate_row("train 1", estimate, 0.9)
    assert (row["suspension"], row["worn"]) == ("train 1", WORN)
    assert row["findings"][0]["values"]["names"] == ["c_p_axle2_left"]
    assert row["worn"] == "damper of axle 2, left at 62.9 % of healthy (odds over 1000 : 1)"
    assert row["estimates"]["c_p_axle2_left"]["value"] == 0.629
    assert summary(estimate).endswith(f"c_p_axle2_left 0.629; worn: {WORN}")
    without = replace(estimate, result=replace(result, worn=""))
    assert estimate_row("train 1", without, 0.9)["worn"] == ""
    assert "worn" not in summary(without)
