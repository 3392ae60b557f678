"""The operator's page in a browser, over a real samsodd: what is drawn, and what its buttons do."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Locator, Page, expect, sync_playwright
from running import DATA, WATCHDOG_S, Samsodd, wait_for

#: Frame 0032: x and y of the origin in mm on the table, height in mm, from the description by which it was rendered.
TRUTH = {
    "star_knob": (-129.7, -231.0, 22.7),
    "sensor_box": (152.5, -80.3, 20.8),
    "flange": (-92.2, -80.9, 27.0),
    "dovetail_plate": (46.8, -47.0, 14.0),
}
#: The robot stands 500 mm left of the middle of the table.
BASE_X_MM = 500.0
JIG = """
[robot]
home = { x_mm = 250.0, y_mm = 330.0, z_mm = 250.0, rx_deg = 180.0, ry_deg = 0.0, rz_deg = 0.0 }
safe_height_mm = 120.0
[jig]
order = [
    { part = "dovetail_plate", x_mm = 300.0, y_mm = 340.0 },
    { part = "sensor_box", x_mm = 410.0, y_mm = 340.0 },
]
"""
NO_ROBOT = '\n[robot]\ncontroller = "none"\n'
CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium") or "/usr/bin/chromium"
#: No sandbox for root; nothing is asked of other hosts.
ARGUMENTS = [
    *(["--no-sandbox"] if os.geteuid() == 0 else []),
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]

#: The box of an element of the drawing in its own units: pixels of the frame.
BOX = "p => { const b = p.getBBox(); return [b.x, b.y, b.width, b.height]; }"
#: Its box on the screen, in pixels of the picture, which fills the middle of its field.
ON_PICTURE = """p => {
    const picture = document.getElementById("frame");
    const [shape, field] = [p, picture].map((e) => e.getBoundingClientRect());
    const scale = Math.min(field.width / picture.width, field.height / picture.height);
    const left = field.x + (field.width - scale * picture.width) / 2;
    const top = field.y + (field.height - scale * picture.height) / 2;
    return [shape.x - left, shape.y - top, shape.width, shape.height].map((length) => length / scale);
}"""

BOTH = f"p => [({BOX})(p), ({ON_PICTURE})(p)]"


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    """A tablet; nothing may go wrong in the page itself, and nothing be asked of another host."""
    expect.set_options(timeout=WATCHDOG_S * 1000)
    context = browser.new_context(viewport={"width": 1024, "height": 768})
    context.set_default_timeout(WATCHDOG_S * 1000)
    page = context.new_page()
    errors: list[str] = []
    hosts: set[str] = set()
    page.on("pageerror", lambda error: errors.append(str(error)))
    # A refused request is told by the console, too, and is what some tests are about.
    page.on("console", lambda message: errors.append(message.text) if "Content Security" in message.text else None)
    page.on("request", lambda request: hosts.add(request.url.split("/")[2].split(":")[0]))
    yield page
    context.close()
    assert errors == []
    assert hosts <= {"127.0.0.1", "", "null"}


@pytest.fixture(scope="module")
def catalogue(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # A copy: what is computed of the parts is kept beside them.
    return Path(shutil.copytree(DATA / "parts", tmp_path_factory.mktemp("page") / "parts"))


def unlock(page: Page, token: str) -> None:
    dialog = page.locator("#token-dialog")
    expect(dialog).to_be_visible()
    dialog.get_by_label("Token").fill(token)
    dialog.get_by_role("button", name="Unlock").click()


def boxes_of(shape: Locator) -> tuple[list[float], list[float]]:
    """The box of a shape in the drawing and on the picture; one that is just being drawn anew has none."""
    boxes = wait_for("a shape", lambda: (both := shape.evaluate(BOTH))[0][2] > 0 and both)
    return boxes[0], boxes[1]


def test_the_parts_of_a_known_scene_are_drawn_where_they_lie(page: Page, catalogue: Path) -> None:
    with Samsodd(NO_ROBOT, catalogue) as samsodd:
        samsodd.publish(DATA / "cell" / "0032.jpg")
        page.goto(samsodd.url)
        for name, (x_mm, y_mm, height_mm) in TRUTH.items():
            part = page.locator(f'.part[data-name="{name}"]')
            expect(part).to_have_count(1)
            # What is drawn, against the camera over the table.
            scale = 1600.0 / (900.0 - height_mm)
            u, v = 541.2 + scale * x_mm, 476.6 - scale * y_mm
            shape = part.locator("path").last
            (left, top, width, height), on_screen = boxes_of(shape)
            assert left < u < left + width, name
            assert top < v < top + height, name
            assert abs(left + width / 2 - u) < 40, name
            assert abs(top + height / 2 - v) < 40, name
            # And on the screen it is over the same pixels of the picture.
            assert on_screen == pytest.approx([left + 0.5, top + 0.5, width, height], abs=8.0), name
            data = part.evaluate("p => ({ ...p.dataset })")
            assert float(data["xMm"]) == pytest.approx(BASE_X_MM + x_mm, abs=3.0)
            assert float(data["yMm"]) == pytest.approx(y_mm, abs=3.0)
        texts = page.locator("#parts text").all_text_contents()
        assert any(text.startswith("sensor_box 1") for text in texts), texts
        # The pixels of the frame are under the drawing.
        colours = page.evaluate(
            "() => new Set(document.getElementById('frame').getContext('2d').getImageData(0, 0, 1078, 958).data).size"
        )
        assert colours > 100
        expect(page.locator("#seen tr")).to_have_count(samsodd.ask("scene")["detection_count"])
        drawn = page.locator("#drawing").evaluate("d => d.dataset.drawnUnixMs - d.dataset.timestampMs")
        print(f"from frame to drawn scene: {drawn:.0f} ms")
        for layer in ["Partitions", "Saliency", "Shadows"]:
            page.get_by_role("button", name=layer).click()
        for layer in ["partition", "saliency", "shadow"]:
            expect(page.locator(f"#layer-{layer}")).to_be_visible()
        page.keyboard.press("2")
        expect(page.locator("#layer-saliency")).to_be_hidden()


def test_hold_from_the_page_stops_the_robot_before_its_next_motion(page: Page, catalogue: Path) -> None:
    with Samsodd(JIG, catalogue) as samsodd:
        samsodd.publish(DATA / "cell" / "0032.jpg")
        page.goto(samsodd.url)
        page.get_by_role("button", name="Unlock").click()
        unlock(page, samsodd.token)
        expect(page.locator("#token-dialog")).to_be_hidden()
        expect(page.locator("#robot")).to_have_attribute("data-state", "moving")
        # A motion of the pick itself, of many that follow.
        expect(page.locator("#robot-step")).to_contain_text("dovetail_plate")
        page.keyboard.press("h")
        expect(page.locator("#robot")).to_have_attribute("data-state", "stands")
        expect(page.locator("#robot-reason")).to_contain_text("hold")
        held = samsodd.ask("status")
        commands = held["robot"]["commands"]
        assert held["robot"]["latched"]
        # Frame after frame shows parts that it could go to.
        seen = held["frames"]["processed"] + 6
        after = wait_for("more frames", lambda: (now := samsodd.ask("status"))["frames"]["processed"] >= seen and now)
        assert after["robot"]["commands"] == commands
        assert after["robot"]["position"] == held["robot"]["position"]
        assert not after["robot"]["moving"]
        expect(page.locator('#jig [data-part="dovetail_plate"]')).not_to_have_class("filled")

        page.get_by_role("button", name="Resume").click()
        dialog = page.locator("#resume-dialog")
        expect(dialog).to_contain_text("goes home first")
        if dialog.get_by_role("checkbox").is_visible():
            dialog.get_by_role("checkbox").check()
        dialog.get_by_role("button", name="Resume").click()
        expect(dialog).to_be_hidden()
        wait_for(
            "the robot at work again", lambda: samsodd.ask("status")["robot"]["commands"]["sent"] > commands["sent"]
        )


def test_a_wrong_token_is_refused_and_the_robot_goes_on(page: Page, catalogue: Path) -> None:
    with Samsodd(JIG, catalogue) as samsodd:
        samsodd.publish(DATA / "cell" / "0032.jpg")
        page.goto(samsodd.url)
        page.get_by_role("button", name="Hold").click()
        unlock(page, "abcde-fghij-klmno-pqrst")
        expect(page.locator("#token-error")).to_have_text("This is not the token.")
        assert not samsodd.ask("status")["robot"]["latched"]
        page.locator("#token-dialog").get_by_role("button", name="Cancel").click()
        assert page.evaluate("sessionStorage.length") == 0
        page.get_by_role("button", name="Hold").click()
        unlock(page, samsodd.token)
        expect(page.locator("#robot")).to_have_attribute("data-state", "stands")
        assert page.evaluate("Object.values(sessionStorage)") == [samsodd.token]
        assert page.evaluate("document.cookie + localStorage.length") == "0"


def test_a_region_drawn_with_the_keyboard_is_stored_and_honoured(page: Page, catalogue: Path) -> None:
    with Samsodd(NO_ROBOT, catalogue) as samsodd:
        samsodd.publish(DATA / "cell" / "0032.jpg")
        page.goto(samsodd.url)
        expect(page.locator('.part[data-name="star_knob"]')).to_have_attribute("data-inside", "true")
        page.get_by_role("tab", name="Set up").click()
        page.get_by_role("button", name="Draw").click()
        # The lower corners go up, above the star knob at the lower border of the picture.
        for corner in (3, 4):
            page.locator(".corner").nth(corner - 1).focus()
            for _ in range(20):
                page.keyboard.press("Shift+ArrowUp")
        page.get_by_role("button", name="Store", exact=True).first.click()
        unlock(page, samsodd.token)
        expect(page.locator("#region-state")).to_have_text("Parts are picked inside 4 corners.")
        assert samsodd.ask("region")["region_of_interest"]["points_px"][2] == [970.0, 662.0]
        expect(page.locator('.part[data-name="star_knob"]')).to_have_attribute("data-inside", "false")
        expect(page.locator('.part[data-name="flange"]')).to_have_attribute("data-inside", "true")
        expect(page.locator(".region-line")).to_have_count(1)
        page.get_by_role("button", name="Whole picture").click()
        expect(page.locator('.part[data-name="star_knob"]')).to_have_attribute("data-inside", "true")
        assert samsodd.ask("region")["region_of_interest"] is None


def test_a_part_is_taught_step_by_step(page: Page, tmp_path: Path) -> None:
    parts = tmp_path / "parts"
    shutil.copytree(DATA / "parts" / "hex_nut", parts / "hex_nut")
    with Samsodd(NO_ROBOT, parts) as samsodd:
        samsodd.publish(DATA / "teach" / "sensor_box.jpg")
        page.goto(samsodd.url)
        page.get_by_role("tab", name="Set up").click()
        # Whichever frame it is: vision is soon farther than the first.
        expect(page.locator("#drawing")).to_have_attribute("data-frame", re.compile(r"\d+"), timeout=WATCHDOG_S * 1000)
        page.get_by_role("button", name="Take the picture").click()
        unlock(page, samsodd.token)
        expect(page.locator(".taught")).to_have_count(1)
        page.get_by_role("button", name="It is right").click()
        form = page.locator("#teach-form")
        form.locator('[name="name"]').fill("hex_nut")
        form.get_by_label("Height, mm").fill("20.8")
        form.get_by_role("button", name="Store").click()
        expect(page.locator("#teach-result")).to_contain_text('has a part "hex_nut" already')
        form.locator('[name="name"]').fill("box")
        form.get_by_role("button", name="Store").click()
        expect(page.locator("#teach-result")).to_contain_text("box is stored: 20.8 mm high")
        assert {path.name for path in (parts / "box").iterdir()} >= {"part.toml", "template.png", "mask.png"}
        assert "height_mm = 20.8" in (parts / "box" / "part.toml").read_text()


def test_a_board_on_the_table_is_measured_in_millimetres(page: Page, tmp_path: Path) -> None:
    # The true camera of the pictures of boards, as tests/data/README.md has it.
    text = (DATA / "cell" / "camera.toml").read_text()
    camera = tmp_path / "camera.toml"
    camera.write_text(text.replace("k1 = 0.0", "k1 = -0.118").replace("k2 = 0.0", "k2 = 0.094"))
    with Samsodd(NO_ROBOT, camera=camera) as samsodd:
        samsodd.publish(DATA / "calib" / "02.jpg")
        page.goto(samsodd.url)
        page.get_by_role("tab", name="Set up").click()
        expect(page.locator("#empty")).to_be_hidden()
        form = page.locator("#calibration-form")
        form.get_by_label("Board thickness, mm").fill("3")
        form.get_by_role("button", name="Measure").click()
        unlock(page, samsodd.token)
        expect(page.locator(".board-corner")).to_have_count(54)
        measured = page.locator(".measure").evaluate("m => ({ ...m.dataset })")
        assert 0 < float(measured["meanMm"]) < 0.1
        assert float(measured["maxMm"]) < 0.3
        expect(page.locator("#calibration-result")).to_contain_text("54 corners")


def test_a_lost_connection_and_frames_that_stop_are_told_plainly(page: Page) -> None:
    with Samsodd(NO_ROBOT) as samsodd:
        client = samsodd.publish(DATA / "cell" / "0032.jpg")
        page.goto(samsodd.url)
        expect(page.locator("#frame-age")).to_have_text("live")
        expect(page.locator("#banner")).to_be_hidden()
        client.end()
        expect(page.locator("#banner")).to_contain_text("No frame for")
        expect(page.locator("#picture")).to_have_class("picture stale")
        samsodd.daemon.end()
        expect(page.locator("#banner")).to_contain_text("No connection to samsodd")
        expect(page.locator("#banner")).to_contain_text("The last frame is")


def test_the_api_is_what_its_description_says(tmp_path: Path) -> None:
    parts = tmp_path / "parts"
    shutil.copytree(DATA / "parts" / "hex_nut", parts / "hex_nut")
    with Samsodd("", parts) as samsodd:
        samsodd.publish(DATA / "cell" / "0032.jpg", rate=10)
        wait_for("a frame", lambda: samsodd.ask("status")["frames"]["processed"] > 0)
        arguments = ["--checks", "all", "--max-examples", "6", "--seed", "7", "--phases", "coverage,fuzzing"]
        # Events have no end; they are what the page lives of. Nothing is asserted of times.
        arguments += ["--exclude-path", "/events", "--request-timeout", "600", "--max-response-time", "600"]
        arguments += ["-H", f"Authorization: Bearer {samsodd.token}", "--no-color"]
        url = f"{samsodd.url}/api/v1/openapi.json"
        settings = Path(__file__).with_name("schemathesis.toml")
        program = str(Path(sys.executable).with_name("schemathesis"))
        command = [program, "--config-file", str(settings), "run", url, *arguments]
        ended = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=600)
        assert ended.returncode == 0, ended.stdout[-8000:] + ended.stderr[-2000:]
        assert samsodd.daemon.child.poll() is None
