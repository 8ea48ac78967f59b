import re
from base64 import b64encode
from xml.etree import ElementTree

import numpy as np
import pytest

from sim_twin.benchmark.episodes.scenarios import grid
from sim_twin.benchmark.report.pictures import EpisodePicture
from sim_twin.benchmark.report.plots import mode_keys, plot_mode_bars, plot_rate_bars
from sim_twin.benchmark.report.report import write_report
from sim_twin.benchmark.results.summary import STAGES, summarise

MODES = ("missed", "object knocked", "no IK", "no path", "slipped", "dropped", "table collision", "no candidate")


def make_rows(methods, objects=("bottle", "box", "cylinder"), occlusions=(0.0,)):
    """Return rows whose rates grow with the method's number, with the gaps that real rows have."""
    rng, rows = np.random.default_rng(0), []
    for scenario in grid(objects, occlusions=occlusions):
        for k, method in enumerate(methods):
            success = bool(rng.random() < (k + 1) / (len(methods) + 1))
            rank = int(rng.integers(3))
            mode = "success" if success else MODES[rng.integers(len(MODES))]
            row = {**scenario.columns(), "method": method, "success": success, "mode": mode}
            row |= {"success_top1": success and rank == 0, "n_candidates": 800, "n_free": 300, "n_ranked": 120}
            row |= {"detect_ms": 20.0, "generate_ms": rng.uniform(100.0, 200.0), "rejected_ik": int(rng.integers(9))}
            rows.append(row | ({"rank": rank, "plan_ms": None} if mode != "no candidate" else {"n_free": -1}))
    return rows


def write(path, rows, **more):
    write_report(rows, {"run": {"version": "1.2", "command": {"jobs": 2}}, **summarise(rows)}, path, **more)
    return path.read_text()


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    return write(
        tmp_path_factory.mktemp("report") / "report.html", make_rows(("vanilla", "mvb", "full"), occlusions=(0.0, 0.25))
    )


@pytest.mark.integration
def test_the_page_needs_no_other_file(page):
    assert not re.findall(r"""(?:src|href)\s*=\s*['"](?!data:|#)|@import|url\((?!#)|<script""", page)


@pytest.mark.integration
def test_every_plot_is_well_formed(page):
    plots = re.findall(r"<svg.*?</svg>", page, re.DOTALL)
    assert len(plots) == 5 * 2 + 3 * 2 + 1
    for plot in plots:
        ElementTree.fromstring(plot)


@pytest.mark.integration
def test_the_headline_has_both_readings_and_the_papers(tmp_path):
    rows = make_rows(("vanilla", "mvb", "full"))
    page = write(tmp_path / "report.html", rows)
    for method, paper in (("vanilla", "24.7% of 81"), ("mvb", "59.3% of 81"), ("full", "–")):
        own = [row for row in rows if row["method"] == method]
        rates = [np.mean([row[column] for row in own]) for column in ("success", "success_top1")]
        line = next(line for line in page.split("<tr>") if line.startswith(f"<td>{method}</td><td>81</td>"))
        assert f"<td>{rates[0]:.1%}</td>" in line
        assert f"<td>{rates[1]:.1%}</td>" in line
        assert f"<td>{paper}</td>" in line


@pytest.mark.integration
def test_conditions_stand_in_the_order_people_count_them(page):
    words = re.findall(r"<text[^>]*>([^<]*)</text>", page.replace("\N{MINUS SIGN}", "-"))
    assert words.index("near") < words.index("mid") < words.index("far")
    assert words.index("left") < words.index("centre") < words.index("right")
    assert words.index("-45") < words.index("0") < words.index("45")


@pytest.mark.integration
def test_methods_stand_in_their_order_whatever_the_rows(tmp_path):
    page = write(tmp_path / "report.html", make_rows(("full", "mvb:k=3", "mvb", "vanilla")))
    assert re.findall(r"<tr><td>([^<]*)</td><td>81</td>", page) == ["vanilla", "mvb:k=3", "mvb", "full"]


@pytest.mark.integration
def test_a_count_that_was_never_made_is_no_count(tmp_path):
    rows = [row | {"n_free": -1} for row in make_rows(("mvb",))]
    line = next(
        line for line in write(tmp_path / "r.html", rows).split("<tr>") if line.startswith("<td>mvb</td><td>800")
    )
    assert line.startswith("<td>mvb</td><td>800</td><td>–</td><td>120</td>")


@pytest.mark.integration
def test_one_method_alone_and_names_with_markup_are_shown_too(tmp_path):
    page = write(tmp_path / "report.html", make_rows(("mvb:k=3<b>",), objects=("mug",)))
    assert "nothing to compare" in page
    assert "<b>" not in page
    assert "mvb:k=3&lt;b&gt;" in page


@pytest.mark.integration
def test_pictures_are_in_the_page(tmp_path):
    page = write(
        tmp_path / "report.html",
        make_rows(("mvb",)),
        pictures=[EpisodePicture(caption="box: missed", jpeg=b"jpeg", recording="recordings/a b.rrd")],
    )
    assert f"data:image/jpeg;base64,{b64encode(b'jpeg').decode()}" in page
    assert "box: missed" in page
    assert 'href="recordings/a%20b.rrd"' in page


def bars_of(svg: str) -> dict[str, tuple[float, float, float]]:
    """Return left edge, width and top of each bar by its hint."""
    found = {}
    for group in ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}g"):
        title, path = (group.find(f"{{http://www.w3.org/2000/svg}}{tag}") for tag in ("title", "path"))
        if title is not None and path is not None:
            numbers = [float(number) for number in re.findall(r"[\d.]+", path.attrib["d"])]
            x, y = numbers[::2], numbers[1::2]
            found[title.text] = (min(x), max(x) - min(x), min(y))
    return found


def test_bars_are_as_long_as_the_rates_and_do_not_overlap():
    plot = plot_rate_bars(["a", "b"], {"x": [(1, 4), (0, 0)], "y": [(4, 4), (2, 4)]}, "caption")
    bars = bars_of(plot.svg)
    assert [hint.partition(",")[0] for hint in bars] == ["x", "y", "y"]
    quarter, whole, half = (width for _, width, _ in bars.values())
    assert (quarter / whole, half / whole) == pytest.approx((0.25, 0.5), abs=1e-4)
    tops = [top for *_, top in bars.values()]
    assert tops == sorted(set(tops))
    assert "x, a: 1 of 4, 25.0% (4.6% to 69.9%)" in bars
    assert "no episodes" in plot.svg


def test_ratios_fill_the_bar_and_the_first_leads():
    modes = {"mvb": {"missed": 1, "success": 3}}
    keys = mode_keys(modes, "success")
    assert [name for name, _ in keys] == ["success", "missed"]
    bars = bars_of(plot_mode_bars(modes, keys, "caption").svg)
    (left, wide, _), (next_left, narrow, _) = bars["mvb: success 3 of 4"], bars["mvb: missed 1 of 4"]
    assert wide == pytest.approx(3 * narrow, rel=1e-4)
    assert next_left == pytest.approx(left + wide, abs=1e-3)


def test_the_same_figures_give_the_same_bytes():
    first, second = (plot_rate_bars(["a"], {"x": [(1, 4)]}, "caption") for _ in range(2))
    assert first == second


@pytest.mark.integration
def test_the_papers_known_figures_are_next_to_ours(page):
    start = page.index("<h2>The paper's tables, and ours</h2>")
    tables = page[start : page.index("<h2>Methods against each other")]
    assert re.findall(r"<h3>(\d)", tables) == ["1", "2", "3", "4", "5"]
    papers = re.findall(r"<tr>(<td></td><td>the paper&#39;s</td>.*?)</tr>", tables)
    assert len(papers) == 3 * 2
    for line, rate in zip(papers, ("24.7%", "59.3%") * 3, strict=True):
        figures = re.findall("<td>(.*?)</td>", line)[2:]
        assert figures[0] == rate
        assert set(figures[1:]) == {"–"}
    assert re.findall("<td>the paper&#39;s</td><td></td>(.*)", tables)[0].count("–") == len(STAGES) + 1 - 3


@pytest.mark.integration
def test_tables_give_the_rate_of_each_condition(tmp_path):
    rows = make_rows(("mvb",))
    page = write(tmp_path / "report.html", rows)
    boxes = [row["success"] for row in rows if row["object"] == "box"]
    (head,) = re.findall(r"<h3>2 By object</h3>.*?<tr>(.*?)</tr>", page, re.DOTALL)
    assert re.findall("<th>(.*?)</th>", head) == ["method", "", "all", "bottle", "box", "cylinder"]
    (line,) = re.findall(r"<h3>2 By object</h3>.*?<tr>.*?</tr>\s*<tr>(.*?)</tr>", page, re.DOTALL)
    assert re.findall("<td>(.*?)</td>", line)[4] == f"{np.mean(boxes):.1%}"


@pytest.mark.integration
def test_retries_neighbours_and_noise_are_shown_where_there_were_any(tmp_path):
    rows = make_rows(("mvb",))
    for k, row in enumerate(rows):
        after = [False, k % 2 == 0, k % 4 != 1]
        row |= {
            "top_k": 3,
            "attempts": 2,
            "success_after": after,
            "clutter": k % 3,
            "neighbours_knocked": int(k % 9 == 1),
        }
    page = write(tmp_path / "report.html", rows)
    assert "<td>mvb</td><td>0.0%</td><td>50.6%</td><td>75.3%</td><td>2.00</td>" in page
    assert "<h2>Neighbours</h2>" in page
    assert "15 mm or 15°: mvb 9 of 54." in page
    plain = write(tmp_path / "plain.html", make_rows(("mvb",)))
    assert not any(words in plain for words in ("Retries", "Neighbours", "Physics noise"))
