"""What a multirun's summary says about methods that were not tuned or tested on equal terms."""

import json

from test_tables import run

from suspnet.runs.sweeps import Table5, Table6

EDGE = "the best C, 100, is on the edge: slow"


def test_note_of_what_is_unequal_ends_the_table(tmp_path):
    Table6("SVR's C is capped.").summarise([run("svr", ("k_p",))], tmp_path)
    assert (tmp_path / "table6.md").read_text().endswith("s\nSVR's C is capped.\n")
    Table6().summarise([run("svr", ("k_p",))], tmp_path)
    assert "capped" not in (tmp_path / "table6.md").read_text()


def test_optimum_left_on_an_edge_is_told(tmp_path):
    searched = [
        run(name, ("k_p",))
        | {"group": "primary"}
        | {"search": {"best": {"C": 100.0}, "rmse": [0.1], "edges": edges}}
        for name, edges in (("svr", {"C": EDGE}), ("msvr", {}))
    ]
    Table5().summarise(searched, tmp_path)
    assert f"# primary, svr: {EDGE}\n" in (tmp_path / "experiment" / "best.yaml").read_text()
    records = json.loads((tmp_path / "table5.json").read_text())
    assert [record["edges"] for record in records] == [[EDGE], []]
