import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from urllib.parse import unquote

import pytest
from sample_charts import empty, sample_page

from adaptune.report.page import Page, PageSection, page_text, write_page
from adaptune.report.tables import Listing


class Seen(HTMLParser):
    """The tags of a page with their attributes, and its texts by the innermost tag."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.texts, self.inside = [], {}, []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self.inside.append(tag)

    def handle_endtag(self, tag):
        if tag in self.inside:
            while self.inside.pop() != tag:
                pass

    def handle_data(self, data):
        if self.inside:
            self.texts.setdefault(self.inside[-1], []).append(data)

    def of(self, tag):
        return [attrs for name, attrs in self.tags if name == tag]


@pytest.fixture(scope="module")
def seen():
    return Seen(page_text(sample_page()))


def test_names_are_escaped_everywhere(seen):
    page = sample_page()
    assert seen.texts["title"] == [page.title]
    assert "".join(seen.texts["h1"]) == page.title
    # The data, plotly.js and ours, and no script of a name.
    assert [attrs.get("type") for attrs in seen.of("script")] == ["application/json", None, None]
    assert "<script>alert(1)</script>" in seen.texts["td"]


def test_data_in_the_page_end_no_script():
    section = PageSection("A", charts=(replace(empty(), title="</script><b>", key="a"),))
    chart = replace(
        section.charts[0],
        panels=(replace(section.charts[0].panels[0], title="</script><!-- {"),),
    )
    text = page_text(Page("A", "", (), (replace(section, charts=(chart,)),)))
    (data,) = re.findall(r'<script type="application/json" id="page-charts">(.*?)</script>', text)
    made = json.loads(data)["a"]
    notes = made["layouts"][0]["layout"]["annotations"]
    assert notes[0]["text"] == "&lt;/script&gt;&lt;!-- &#123;"


def test_everything_lies_in_the_page(seen):
    for attribute in ("src", "srcset", "href"):
        for tag, attrs in seen.tags:
            if attribute in attrs:
                assert re.match(r"#|data:,$|figures/[a-z-]+\.(png|svg)$", attrs[attribute]), tag
    (policy,) = [m["content"] for m in seen.of("meta") if "http-equiv" in m]
    assert policy.startswith("default-src 'none'")


def test_anchors_exist_once(seen):
    ids = [attrs["id"] for _, attrs in seen.tags if "id" in attrs]
    assert len(ids) == len(set(ids))
    targets = [a["href"][1:] for a in seen.of("a") if a["href"].startswith("#")]
    assert set(targets) <= set(ids)
    assert len(targets) == 1 + len(sample_page().sections)


def test_cells_are_sorted_by_whole_numbers_and_missing_ones_by_nothing():
    rows = [{"a": value} for value in (0.123456789, 1200, None, float("nan"), float("inf"))]
    seen = Seen(page_text(Page("A", "", (), (PageSection("B", tables=(Listing("C", rows),)),))))
    cells = seen.of("td")
    assert [cell["data-value"] for cell in cells] == ["0.123456789", "1200", "", "", "Infinity"]
    assert {cell["class"] for cell in cells} == {"number"}
    assert seen.texts["td"] == ["0.123", "1200", "-", "-", "inf"]


def test_keys_for_files_only_are_left_out(seen):
    assert "mean_RTE" in headings(seen)
    assert not any("file" in text for text in headings(seen))


def headings(seen):
    return [attrs["data-heading"].replace("\u200b", "") for attrs in seen.of("th")]


def test_names_between_backticks_are_code():
    table = Listing("C", [{"one_set": 1.0}], "Of `fixed`.")
    sections = (PageSection("B", ("`a<b` is kept.",), ("run `adaptune online`",), (), (table,)),)
    seen = Seen(page_text(Page("A", "", ("`adaptive` has less.",), sections)))
    assert seen.texts["code"] == ["adaptive", "a<b", "adaptune online", "fixed"]
    assert headings(seen) == ["one_set"]
    assert not any("`" in text for tag in ("li", "p") for text in seen.texts[tag])


def test_figures_lie_beside_the_page(tmp_path):
    page = Page("A", "", (), (PageSection("B", charts=(empty(),)),))
    write_page(tmp_path / "report/index.html", page)
    files = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert files == {
        f"report/{n}" for n in ("index.html", "figures/empty.png", "figures/empty.svg")
    }
    text = (tmp_path / "report/index.html").read_text("utf-8")
    write_page(tmp_path / "report/index.html", page)
    assert (tmp_path / "report/index.html").read_text("utf-8") == text


def test_any_key_names_a_file_of_its_own_inside_the_folder(tmp_path):
    keys = ("a/b", "a b", "A_B", "../x", ".a", "会議室 <1>")
    charts = tuple(replace(empty(), key=key) for key in keys)
    path = tmp_path / "index.html"
    write_page(path, Page("A", "", (), (PageSection("B", charts=charts),)))
    seen = Seen(path.read_text("utf-8"))
    links = [unquote(a["href"]) for a in seen.of("a") if a["href"].startswith("figures/")]
    assert len(set(links)) == 2 * len(keys)
    assert {str(file.relative_to(tmp_path)) for file in tmp_path.rglob("*.*g")} == set(links)
    anchors = [figure["id"] for figure in seen.of("figure")]
    assert anchors[:4] == ["a_b", "a_b-2", "A_B-3", "_._x"]
