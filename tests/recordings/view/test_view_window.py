"""The viewer without a window: screenshots, and where it listens."""

import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from recordings.cli_view import main
from recordings.film.film import STATUS_RGB
from recordings.view.draw import open_scene, save_rrd, screenshot, stream
from recordings.view.layers import TIME
from recordings.view.viewer import LOOPBACK, Viewer, ViewerFailed


@pytest.fixture(scope="module")
def viewer():
    """A viewer without a window; skipped where there is no graphics driver. Idle, it still draws: 40 % of a core."""
    try:
        running = Viewer(headless=True, size=(800, 500)).__enter__()
    except ViewerFailed as missing:
        pytest.skip(str(missing))
    yield running
    running.close()


def test_without_a_graphics_driver_the_message_names_the_packages(monkeypatch):
    monkeypatch.setenv("VK_DRIVER_FILES", "nothing.json")
    monkeypatch.setenv("VK_ICD_FILENAMES", "nothing.json")
    monkeypatch.setenv("WGPU_BACKEND", "vulkan")
    with pytest.raises(ViewerFailed, match=r"apt-get install -y libvulkan1 mesa-vulkan-drivers"), Viewer(headless=True):
        pass


@pytest.fixture
def no_driver(monkeypatch):
    monkeypatch.setenv("VK_DRIVER_FILES", "nothing.json")
    monkeypatch.setenv("VK_ICD_FILENAMES", "nothing.json")


@pytest.mark.usefixtures("no_driver")
def test_without_a_graphics_driver_the_picture_is_drawn_in_software_and_that_is_said(session, tmp_path, capsys):
    assert main([str(session), "--screenshot", str(tmp_path / "s.png")]) == 0
    assert "there is no graphics driver" in (said := capsys.readouterr().out)
    assert "drawn in software" in said
    picture = cv2.imread(str(tmp_path / "s.png"))[..., ::-1]
    assert (picture == np.array(STATUS_RGB["tracked"])).all(axis=-1).sum() > 50  # the truth's outline
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50


@pytest.mark.usefixtures("no_driver")
def test_what_cannot_be_drawn_without_a_driver_is_left_out_and_that_is_said(session, tmp_path, capsys):
    save_rrd(session, tmp_path / "a.rrd")
    (tmp_path / "s.png").write_bytes(b"older")
    assert main([str(tmp_path / "a.rrd"), "--screenshot", str(tmp_path / "s.png")]) == 0
    said = capsys.readouterr().out
    assert "the picture is left out" in said
    assert "wrote" not in said
    assert (tmp_path / "s.png").read_bytes() == b"older"


def test_the_viewer_shows_the_streamed_scene_without_complaint(session, viewer):
    scene = open_scene(session)
    stream(scene, viewer)
    viewer.wait_for(TIME, scene.spans_ns[1][1])
    state = viewer.client.get_state()
    assert {"The table in 3D", "Colour of d455", "Depth"} <= {view.name for view in state.views}
    assert not [report for view in state.views for report in view.reports]
    names = {e.entity_path for e in viewer.client.get_recording_schema(paths_only=True).entities}
    assert "/world/object/truth/shape" in names
    assert not [log.message for log in viewer.client.get_logs() if "invalid" in log.message.lower()]


def test_the_viewer_listens_on_the_loopback_address_only(viewer):
    port = int(viewer.url.split(":")[-1].split("/")[0])
    listening = {
        bytes.fromhex(line.split()[1].split(":")[0])[::-1]
        for name in ("/proc/net/tcp", "/proc/net/tcp6")
        for line in Path(name).read_text().splitlines()[1:]
        if line.split()[3] == "0A" and int(line.split()[1].split(":")[1], 16) == port
    }
    assert listening == {socket.inet_aton(LOOPBACK)}


@pytest.mark.usefixtures("viewer")
def test_a_screenshot_shows_the_scene(session, tmp_path):
    screenshot(session, tmp_path / "s.png", size=(800, 500))
    picture = cv2.imread(str(tmp_path / "s.png"))
    assert picture.shape == (500, 800, 3)
    blue = (np.abs(picture.astype(int) - (200, 90, 40)) < 40).all(axis=2)
    space, image = blue[:, :450], blue[30:200, 480:]
    assert space.sum() > 500  # the cloud
    assert image.sum() > 1000  # the colour image
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 200


def test_a_viewer_that_was_closed_leaves_no_process():
    try:
        with Viewer(headless=True) as running:
            process = running._process
    except ViewerFailed as missing:
        pytest.skip(str(missing))
    assert process.poll() is not None


@pytest.mark.skipif(shutil.which("setpriv") is None, reason="no setpriv: Linux alone ends a program with its parent")
@pytest.mark.usefixtures("viewer")
def test_a_program_that_is_killed_leaves_no_viewer_without_a_window():
    program = """import time
from recordings.view.viewer import Viewer
with Viewer(headless=True, size=(320, 200)) as running:
    print(running._process.pid, flush=True)
    time.sleep(600)"""
    killed = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    process = Path("/proc") / killed.stdout.readline().strip()
    assert (process / "exe").exists()
    killed.kill()
    killed.communicate()
    end_s = time.monotonic() + 60
    while _runs(process) and time.monotonic() < end_s:
        time.sleep(0.1)
    assert not _runs(process)


def _runs(process):
    try:
        return (process / "stat").read_text().rsplit(")")[-1].split()[0] != "Z"
    except OSError:
        return False
