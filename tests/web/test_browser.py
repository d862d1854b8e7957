"""The pages in Chromium: clicks, keys, updates, a phone, and nothing from elsewhere."""

import json
import shutil
from contextlib import contextmanager

import pytest
from served_fleet import EVIL, NAMED_EVIL, WORN, name_of, served, trips

from suspnet.trains.history import History

selenium = pytest.importorskip("selenium")
from selenium import webdriver  # noqa: E402
from selenium.common.exceptions import StaleElementReferenceException  # noqa: E402
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.common.keys import Keys  # noqa: E402
from selenium.webdriver.support.ui import Select, WebDriverWait  # noqa: E402

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = [
    pytest.mark.skipif(not (CHROMIUM and DRIVER), reason="needs chromium and chromedriver"),
    pytest.mark.timeout(200),
]
WAIT_S = 30
N_MORE = 31
"""Number in the name of a trip that comes later."""


@pytest.fixture(scope="module")
def browser():
    """Chromium that finds no other computer, and tells what it asks for and complains of."""
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for argument in (
        *("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"),
        *("--no-first-run", "--disable-background-networking", "--disable-component-update"),
        "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
    ):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    service = webdriver.ChromeService(executable_path=DRIVER)
    found = webdriver.Chrome(options=options, service=service)
    found.set_page_load_timeout(WAIT_S)
    yield found
    found.quit()


@pytest.fixture(autouse=True)
def clean(browser):
    """Fail if a page complained, or asked another computer for anything."""
    size(browser, 1300)
    browser.get_log("browser"), browser.get_log("performance")
    yield
    assert [one["message"] for one in browser.get_log("browser")] == []
    messages = [json.loads(one["message"])["message"] for one in browser.get_log("performance")]
    asked = [
        one["params"]["request"]["url"]
        for one in messages
        if one["method"] == "Network.requestWillBeSent"
    ]
    assert asked
    foreign = [a for a in asked if not a.startswith(("http://127.0.0.1:", "data:", "blob:"))]
    assert foreign == []


@pytest.fixture(scope="module")
def only_read(browser, filled):
    with looked_at(browser, filled[0]) as found:
        yield *found, filled[0]


@pytest.fixture(scope="module")
def written(browser, filled, tmp_path_factory):
    path = tmp_path_factory.mktemp("written") / "fleet.db"
    path.write_bytes(filled[0].read_bytes())
    with looked_at(browser, path) as found:
        yield *found, path


@pytest.fixture
def site(browser, only_read):
    """Address of the pages, the thread behind them and the store, to which no test writes."""
    yield only_read
    browser.get("about:blank")


@pytest.fixture
def own(browser, written):
    """The same, but each test writes to the store of another suspension."""
    yield written
    browser.get("about:blank")


@contextmanager
def looked_at(browser, path, seconds=WAIT_S):
    """Serve a store once its state is worked out; no page is open when the server ends."""
    with served(path) as (address, refresher):
        wait(refresher, lambda found: found.board.view.is_complete, seconds)
        yield address, refresher
        browser.get("about:blank")


def wait(thing, is_so, seconds=WAIT_S):
    """Wait until something is so, for a while."""
    return WebDriverWait(thing, seconds, poll_frequency=0.1).until(is_so)


def size(browser, width):
    metrics = {"width": width, "height": 844, "deviceScaleFactor": 1, "mobile": width < 600}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)


def page_of(site, place):
    address, refresher, _ = site
    return f"{address}/suspension/{name_of(refresher.board.view, place)}"


def shown(browser):
    """Return the text of the main part, which may be replaced at any time."""
    return browser.execute_script("return document.querySelector('main').innerText")


def has_plots(browser):
    """Return whether all figures are drawn that are not folded, and not below the window."""
    drawn = """return [...document.querySelectorAll('.paper img')]
        .filter(e => e.loading !== 'lazy' && e.offsetParent).map(e => e.naturalWidth > 0)"""
    return all(browser.execute_script(drawn))


def acknowledged(path, place):
    with History(path) as store:
        return [(one.parameter, one.by, one.words) for one in store.acknowledgements("am96", place)]


def focused(browser):
    return browser.switch_to.active_element


def tab_until(browser, is_there, most=80):
    """Press Tab until the focus is where it should be."""
    for _ in range(most):
        focused(browser).send_keys(Keys.TAB)
        if is_there(focused(browser)):
            return focused(browser)
    raise AssertionError("the keyboard does not get there")


@pytest.mark.slow  # test_pages.py sends the form
def test_alarm_is_acknowledged_by_keys_alone(browser, own):
    address, _, path = own
    browser.get(address)
    first = browser.find_element(By.TAG_NAME, "body")
    first.send_keys(Keys.TAB)
    assert focused(browser).text == "Skip to the content"
    outline = "return getComputedStyle(document.activeElement).outlineStyle"
    assert browser.execute_script(outline) != "none"
    focused(browser).send_keys(Keys.ENTER)
    assert focused(browser).get_attribute("id") == "main"
    link = tab_until(browser, lambda e: str(e.get_attribute("href")).endswith("#alarm-k_p-limit"))
    link.send_keys(Keys.ENTER)
    wait(browser, lambda b: b.find_elements(By.ID, "by-alarm-k_p-limit"))
    name = tab_until(browser, lambda e: e.get_attribute("id") == "by-alarm-k_p-limit")
    name.send_keys("Ada")
    tab_until(browser, lambda e: e.tag_name == "button").send_keys(Keys.ENTER)
    wait(browser, lambda b: "Acknowledged by Ada" in shown(b))
    browser.execute_script("return replace()")
    assert "Acknowledged by Ada" in shown(browser)  # an update leaves what was said
    assert acknowledged(path, NAMED_EVIL) == [("k_p", "Ada", "")]


def half_filled(browser):
    """Fill in a name by half and return its field; None while the page is being replaced."""
    try:
        name = browser.find_element(By.CSS_SELECTOR, "input[name=by]")
        name.clear()  # of whom acknowledged before
        name.send_keys("half a na")
    except StaleElementReferenceException:
        return None
    return name


def test_focus_folds_and_forms_outlast_an_update_and_the_end_of_the_server_is_told(browser, own):
    _, refresher, path = own
    browser.get(page_of(own, WORN))
    wait(browser, has_plots)
    browser.execute_script("window.same = true")
    summary = browser.find_element(By.CSS_SELECTOR, "#fold-trips summary")
    summary.send_keys(Keys.SPACE)
    address = "return document.getElementById('trend-plot').src"
    before = browser.execute_script(address)
    with History(path) as store:
        store.write(trips(WORN, 2, n_trips=1, begin=N_MORE))
    wait(browser, lambda b: "trip_031" in shown(b))  # in the table, which stays unfolded
    assert browser.execute_script("return window.same")  # it is the same page
    assert browser.execute_script(address) != before
    wait(browser, has_plots)
    assert "Without JavaScript" not in shown(browser)
    name = wait(browser, half_filled)
    with History(path) as store:
        store.write(trips(WORN, 2, n_trips=1, begin=N_MORE + 1))
    pulse = browser.find_element(By.ID, "pulse")
    wait(browser, lambda b: "There is an update" in pulse.text)
    assert name.get_attribute("value") == "half a na"
    assert refresher.fault == ""
    browser.execute_script("window.fetch = () => Promise.reject(new Error('gone'))")
    lost = browser.find_element(By.ID, "lost")
    wait(browser, lambda b: "No answer from the server since" in lost.text)


@pytest.mark.parametrize("width", [390, pytest.param(1300, marks=pytest.mark.slow)])
def test_every_page_fits_the_window_shows_names_as_text_and_names_its_parts(browser, site, width):
    size(browser, width)
    small = """const found = document.querySelectorAll('a.tile, .count, button, select, input');
        return [...found].filter(e => e.type !== 'hidden' && e.offsetParent)
        .filter(e => e.getBoundingClientRect().height < 43.5).map(e => e.outerHTML)"""
    for address in (site[0], page_of(site, NAMED_EVIL), f"{site[0]}/plan"):
        browser.get(address)
        if "suspension" in address:
            wait(browser, has_plots)
        # while a page is laid out, the window may be as wide as what does not fit yet
        wait(browser, lambda b: b.execute_script("return innerWidth") == width)
        widths = "return [document.documentElement.scrollWidth, innerWidth]"
        page, window = browser.execute_script(widths)
        assert page <= window == width
        assert browser.execute_script(small) == []
        assert EVIL in shown(browser)
        assert browser.execute_script("return window.evil") is None
        assert_all_parts_have_names(browser)
    browser.get(site[0])
    Select(browser.find_element(By.ID, "train")).select_by_visible_text(EVIL)
    browser.find_element(By.CSS_SELECTOR, ".choose button").click()
    wait(browser, lambda b: "1 suspension:" in shown(b))


def assert_all_parts_have_names(browser):
    """Check headings, tables and fields of a page."""
    assert len(browser.find_elements(By.TAG_NAME, "h1")) == 1
    for landmark in ("header", "nav", "main", "footer"):
        assert len(browser.find_elements(By.CSS_SELECTOR, f"body {landmark}")) == 1
    unnamed = """return [...document.querySelectorAll('input:not([type=hidden]), select')]
        .filter(e => !e.labels.length).length"""
    assert browser.execute_script(unnamed) == 0
    headless = "return [...document.querySelectorAll('th')].filter(e => !e.scope).length"
    assert browser.execute_script(headless) == 0
    twice = """const all = [...document.querySelectorAll('main [id]')].map(e => e.id);
        return all.filter((e, i) => all.indexOf(e) !== i && !e.includes('clip'))"""
    assert browser.execute_script(twice) == []
