import pyarrow.parquet as pq

from hal.base.errors import OutputExistsError
from sim_twin.benchmark.results.store import Store
from tests.support.errors import raises


def rows(scenario, **more):
    return [{"scenario": scenario, "method": m, "success": m == "mvb", **more} for m in ("vanilla", "mvb")]


def test_rows_come_back_sorted_whatever_their_columns(tmp_path):
    store = Store(tmp_path, resume=False)
    store.add(rows("b", slip_m=0.01))
    store.add(rows("a"))
    found = store.rows()
    assert [(r["scenario"], r["method"]) for r in found] == [
        ("a", "mvb"), ("a", "vanilla"), ("b", "mvb"), ("b", "vanilla")
    ]  # fmt: skip
    assert found[0]["slip_m"] is None
    assert found[2]["slip_m"] == 0.01


def test_a_second_run_does_not_mix_with_the_first_by_default(tmp_path):
    Store(tmp_path, resume=False).add(rows("a"))
    with raises(OutputExistsError, "output_exists"):
        Store(tmp_path, resume=False)
    assert Store(tmp_path, resume=True).done() == {("a", "vanilla"), ("a", "mvb")}


def test_what_a_killed_run_left_half_written_is_not_a_row(tmp_path):
    Store(tmp_path, resume=False).add(rows("a"))
    (tmp_path / "episodes" / "b-mvb.partial").write_bytes(b"PAR1 cut off")
    store = Store(tmp_path, resume=True)
    assert {s for s, _ in store.done()} == {"a"}
    assert not list((tmp_path / "episodes").glob("*.partial"))


def test_methods_added_later_join_the_earlier_ones(tmp_path):
    store = Store(tmp_path, resume=False)
    store.add(rows("a"))
    store.add([{"scenario": "a", "method": "mvb:k=3", "success": True}])
    assert len(store.rows()) == 3


def test_some_columns_can_be_had_alone(tmp_path):
    store = Store(tmp_path, resume=False)
    store.add(rows("a", slip_m=0.01))
    assert store.rows(["success"])[0] == {"scenario": "a", "method": "mvb", "success": True}


def test_the_table_holds_every_row(tmp_path):
    store = Store(tmp_path, resume=False)
    store.add(rows("a"))
    store.add(rows("b", faces=[0, 2]))
    assert pq.read_table(store.write_table()).num_rows == 4


def test_lists_that_were_empty_and_lists_that_were_not_make_one_table(tmp_path):
    store = Store(tmp_path, resume=False)
    store.add(rows("a", neighbours=[], modes=["missed"], success_after=[False]))
    store.add(rows("b", neighbours=["box"], modes=["missed", "success"], success_after=[False, True]))
    store.add([{"scenario": "c", "method": "mvb", "success": True}])
    assert [row["neighbours"] for row in store.rows()] == [[], [], ["box"], ["box"], None]
    assert store.write_table().exists()
