"""The page as HTML, and in a real browser without a network."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest
from needs import needs_program
from sample_charts import empty, sample_page

from adaptune.report.page import Page, PageSection, page_text, write_page
from adaptune.report.tables import Listing


class Seen(HTMLParser):
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
    assert len(seen.of("script")) == 2  # Vega and ours, and none of a name
    assert "<script>alert(1)</script>" in seen.texts["td"]
    chart = replace(empty(), title="</script><!-- {", key="a")
    text = page_text(Page("A", "", (), (PageSection("A", charts=(chart,)),)))
    assert len(Seen(text).of("script")) == 2


def test_everything_lies_in_the_page(seen):
    for attribute in ("src", "srcset", "href"):
        for tag, attrs in seen.tags:
            if attribute in attrs:
                assert re.match(
                    r"#|data:,$|figures/[a-z-]+\.(png|svg|pdf|csv)$", attrs[attribute]
                ), tag
    (policy,) = [m["content"] for m in seen.of("meta") if "http-equiv" in m]
    assert policy.startswith("default-src 'none'")


def test_anchors_exist_once(seen):
    ids = [attrs["id"] for _, attrs in seen.tags if "id" in attrs]
    assert len(ids) == len(set(ids))
    targets = [a["href"][1:] for a in seen.of("a") if a["href"].startswith("#")]
    assert set(targets) <= set(ids)
    assert len(targets) == 1 + len(sample_page().sections)


def test_cells_are_sorted_by_whole_numbers_and_missing_ones_by_nothing():
    rows = [
        {"a": value, "_file": 1} for value in (0.123456789, 1200, None, float("nan"), float("inf"))
    ]
    seen = Seen(page_text(Page("A", "", (), (PageSection("B", tables=(Listing("C", rows),)),))))
    cells = seen.of("td")
    assert [cell["data-value"] for cell in cells] == ["0.123456789", "1200", "", "", "Infinity"]
    assert {cell["class"] for cell in cells} == {"number"}
    assert seen.texts["td"] == ["0.123", "1200", "-", "-", "inf"]


def test_names_between_backticks_are_code():
    table = Listing("C", [{"one_set": 1.0}], "Of `fixed`.")
    sections = (PageSection("B", ("`a<b` is kept: run `adaptune online`",), (), (table,)),)
    seen = Seen(page_text(Page("A", "", ("`adaptive` has less.",), sections)))
    assert seen.texts["code"] == ["adaptive", "a<b", "adaptune online", "fixed"]


@pytest.mark.services
def test_charts_lie_beside_the_page_as_files(tmp_path):
    charts = tuple(replace(empty(), key=key) for key in ("Straße-errors", "b.c"))
    path = tmp_path / "index.html"
    write_page(path, Page("A", "", (), (PageSection("B", charts=charts),)))
    links = [a["href"] for a in Seen(path.read_text("utf-8")).of("a")]
    files = {str(file.relative_to(tmp_path)) for file in tmp_path.rglob("figures/*")}
    assert files == {link for link in links if link.startswith("figures/")}
    assert len(files) == 4 * len(charts)


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    chromium, told = needs_program("chromium", "browser"), []
    sync_playwright = pytest.importorskip("playwright.sync_api").sync_playwright

    path = tmp_path_factory.mktemp("report") / "index.html"
    path.write_text(page_text(sample_page()), "utf-8")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.on("console", lambda message: told.append(message.text))
        page.on("pageerror", lambda error: told.append(str(error)))
        page.on("request", lambda request: told.append(request.url))
        page.goto(path.as_uri())
        page.wait_for_selector("html[data-drawn]", state="attached", timeout=60_000)
        told.remove(path.as_uri())
        yield page
        assert told == []
        browser.close()


def test_charts_are_drawn_and_say_what_a_point_is(opened):
    assert opened.locator(".drawing svg").count() == 5
    assert opened.locator("#empty text").filter(has_text="no data").count() == 1
    assert opened.evaluate(
        "[...document.querySelectorAll('.drawing')].every(d => d.scrollWidth <= d.clientWidth)"
    )
    opened.locator("#comparison .mark-symbol.role-mark path").first.hover()
    tip = opened.locator("#vg-tooltip-element.visible")
    tip.wait_for()
    assert re.search(r"mean RTE \[%\]\s*1$", tip.inner_text())


def column(page, i):
    return page.locator(f"main tbody td:nth-child({i})").all_inner_texts()


def test_tables_are_sorted_by_clicks_and_by_the_keyboard(opened):
    header = opened.get_by_role("columnheader", name="mean_RTE")
    header.get_by_role("button").click()
    assert header.get_attribute("aria-sort") == "ascending"
    known = ["0.0042", "0.0042", "2.500", "2.500", "9.000", "9.000", "10.2", "10.2"]
    assert column(opened, 3) == [*known, "-", "-", "-", "-"]
    header.get_by_role("button").click()
    assert column(opened, 3) == [*known[::-1], "-", "-", "-", "-"]
    header = opened.get_by_role("columnheader", name="sequence")
    header.get_by_role("button").focus()
    opened.keyboard.press("Enter")
    assert column(opened, 1)[:2] == ["drive_0", "drive_1"]
    assert column(opened, 1)[-1] == "drive_11"  # and not after drive_1


def test_a_telephone_scrolls_tables_and_charts_and_not_the_page(opened):
    opened.set_viewport_size({"width": 390, "height": 844})
    assert opened.evaluate("document.documentElement.scrollWidth") == 390
    assert opened.evaluate("document.querySelector('.box').scrollWidth") > 390
    opened.set_viewport_size({"width": 1280, "height": 900})
