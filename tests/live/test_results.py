"""What the log says of an estimate."""

from suspnet.depot.live.results import summary
from suspnet.depot.live.suspension import SectionEstimate
from suspnet.ground.records import OK, TripResult
from suspnet.trains.fits.worn_parts import WornPart


def test_estimates_worn_parts_and_counts_of_frames_are_on_the_line():
    worn = WornPart(("c_p_axle2_left",), 1e6, 0.629).finding
    result = TripResult(
        "06:20", "", status=OK, vehicle="am96", mileage_km=3e4, estimates={"k_p": 0.9}, worn=worn
    )
    line = summary(SectionEstimate(result, {"taken": 8400, "late": 2}, 84.0))
    assert "k_p 0.9; worn: damper of axle 2, left at 62.9 %" in line
    assert line.endswith("(frames: 8400 taken, 2 late)")
