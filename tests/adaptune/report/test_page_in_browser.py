"""The page in a real browser, without a network."""

import pytest
from needs import needs_browser
from sample_charts import sample_page, samples

from adaptune.report.page import Page, PageSection, page_text
from adaptune.report.tables import Listing

DRAWN = "html[data-drawn]"


@pytest.fixture(scope="module")
def chromium():
    path = needs_browser()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def said():
    """What the page told the console, and whatever it requested."""
    return []


@pytest.fixture(scope="module")
def opened(chromium, said, tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "index.html"
    path.write_text(page_text(sample_page()), "utf-8")
    page = chromium.new_page(viewport={"width": 1280, "height": 900})
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: said.append(request.url))
    page.goto(path.as_uri())
    page.wait_for_selector(DRAWN, state="attached", timeout=60_000)
    assert said == [path.as_uri()]
    said.clear()
    return page


@pytest.fixture
def page(opened, said):
    """The page as it was opened; a test may leave it narrow."""
    opened.set_viewport_size({"width": 1280, "height": 900})
    yield opened
    assert said == []


def column(page, i):
    return page.locator(f"tbody td:nth-child({i})").all_inner_texts()


def visible_shapes(page, key):
    """How many lines, markers and bars of a chart have an extent."""
    return page.evaluate(
        """key => [...document.querySelectorAll(
            `#${key} .js-line, #${key} .point, #${key} .points path, #${key} .js-fill`
        )].filter(e => { const b = e.getBoundingClientRect(); return b.width + b.height > 1; })
        .length""",
        key,
    )


@pytest.mark.parametrize("chart", samples(), ids=lambda chart: chart.key)
def test_charts_are_drawn_whole(chart, page):
    if chart.key == "empty":
        assert page.locator("#empty .annotation-text").text_content() == "no data"
        return
    assert visible_shapes(page, chart.key) >= len(chart.panels)
    # Nothing that is written reaches beyond the picture.
    beyond = page.evaluate(
        """key => {
            const box = document.querySelector(`#${key} .drawing`).getBoundingClientRect();
            return [...document.querySelectorAll(`#${key} svg text`)].filter(text => {
                const b = text.getBoundingClientRect();
                return b.width && (b.left < box.left - 2 || b.right > box.right + 2
                    || b.top < box.top - 2 || b.bottom > box.bottom + 2);
            }).map(text => text.textContent);
        }""",
        chart.key,
    )
    assert beyond == []


def test_labels_do_not_lie_on_the_legend(page):
    for key in ("over-time", "trials", "comparison", "from-above"):
        legend = page.locator(f"#{key} .legend").bounding_box()
        for title in page.locator(f"#{key} .infolayer .xtitle, #{key} .x4title").all():
            label = title.bounding_box()
            assert label["y"] + label["height"] <= legend["y"] + 1


def test_a_point_tells_what_it_is(page):
    box = page.locator("#comparison .bars .point path").first.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.wait_for_selector("#comparison .hoverlayer .hovertext")
    assert "campus, morning: 1" in page.locator("#comparison .hoverlayer").text_content()
    page.mouse.move(0, 0)


def test_tables_are_sorted_by_clicks(page):
    header = page.get_by_role("columnheader", name="mean_RTE")
    header.get_by_role("button").click()
    assert header.get_attribute("aria-sort") == "ascending"
    known = ["0.0042", "0.0042", "2.500", "2.500", "9.000", "9.000", "10.2", "10.2"]
    assert column(page, 3) == [*known, "-", "-", "-", "-"]
    header.get_by_role("button").click()
    assert header.get_attribute("aria-sort") == "descending"
    assert column(page, 3) == [*known[::-1], "-", "-", "-", "-"]


def test_tables_are_sorted_by_the_keyboard(page):
    header = page.get_by_role("columnheader", name="sequence")
    header.get_by_role("button").focus()
    page.keyboard.press("Enter")
    assert column(page, 1)[:4] == ["drive_0", "drive_1", "drive_2", "drive_3_with_a_long_name"]
    assert column(page, 1)[-1] == "drive_11"  # and not after drive_1
    page.keyboard.press("Space")
    assert column(page, 1)[0] == "drive_11"
    assert header.get_attribute("aria-sort") == "descending"
    others = page.locator('th[aria-sort="ascending"], th[aria-sort="descending"]')
    assert others.count() == 1


def test_a_telephone_scrolls_tables_and_not_the_page(page):
    page.set_viewport_size({"width": 390, "height": 844})
    page.wait_for_function("document.querySelector('.drawing svg').clientWidth < 390")
    page.wait_for_timeout(500)  # for all charts
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    assert page.evaluate("document.querySelector('.box').scrollWidth") > 390
    box = page.locator(".box").first.bounding_box()
    assert box["x"] + box["width"] <= 390
    sizes = page.evaluate(
        """[...document.querySelectorAll('p, li, td, th, figcaption, a, .drawing text')]
        .filter(e => e.textContent.trim() && e.getBoundingClientRect().width)
        .map(e => parseFloat(getComputedStyle(e).fontSize))"""
    )
    assert min(sizes) >= 12
    first, second = (page.locator(f"#trials .{axis}title").bounding_box() for axis in ("x", "x2"))
    assert first["y"] + 200 < second["y"]  # one panel below the other


def test_the_page_is_printed(page):
    page.wait_for_timeout(300)
    drawing = page.locator("#over-time .drawing")
    drawing.evaluate(
        """plot => window.addEventListener("beforeprint", () => {
            plot.dataset.printed = `${plot.layout.width}, ${plot.style.zoom < 1}`;
        })"""
    )
    pdf = page.pdf(format="A4")
    assert pdf.startswith(b"%PDF")
    assert pdf.count(b"/Type /Page\n") > 2
    page.emulate_media(media="print")
    assert not page.locator("nav").is_visible()
    page.emulate_media(media="screen")
    assert page.locator("nav").is_visible()
    # As wide as paper, and not higher than a page; then as on the screen again.
    assert drawing.get_attribute("data-printed") == "680, true"
    assert drawing.evaluate("plot => plot.layout.width") > 800
    assert drawing.evaluate("plot => plot.style.zoom") == "1"


def test_a_section_is_reached_from_the_navigation(page):
    page.get_by_role("link", name="What is missing").click()
    page.wait_for_timeout(600)
    assert page.locator("#page-section-3").bounding_box()["y"] < 900


def test_a_table_of_many_columns_does_not_make_the_printed_page_wider(page):
    rows = [{f"name_{i}": 1.234 * i for i in range(20)}]
    page.set_content(
        page_text(Page("A", "", (), (PageSection("B", tables=(Listing("C", rows),)),)))
    )
    page.set_viewport_size({"width": 688, "height": 900})
    page.emulate_media(media="print")
    assert page.evaluate("document.documentElement.scrollWidth") <= 688


def test_a_click_anywhere_in_a_heading_sorts_and_the_average_stays_last(page):
    rows = [{"sequence": name, "error": error} for name, error in (("a", 2.0), ("b", 1.0))]
    listing = Listing("C", [*rows, {"sequence": "average", "error": 1.5}])
    page.set_content(page_text(Page("A", "", (), (PageSection("B", tables=(listing,)),))))
    for order in (["b", "a", "average"], ["a", "b", "average"]):
        page.locator("th").nth(1).click(position={"x": 2, "y": 2})
        assert page.locator("td:first-child").all_text_contents() == order
