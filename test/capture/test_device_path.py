"""Which node a name means."""

from __future__ import annotations

import pytest

from thermal_stereo_vo.capture import device_path
from thermal_stereo_vo.capture.device_path import resolve_device
from thermal_stereo_vo.core.errors import CaptureError


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """sysfs of two grabbers, the second with two channels; who answers QUERYCAP is given."""
    capture = {}

    def add(number, serial, bus):
        usb = tmp_path / "devices" / f"usb-{serial}"
        usb.mkdir(parents=True, exist_ok=True)
        (usb / "idVendor").write_text("1943\n")
        (usb / "serial").write_text(f"{serial}\n")
        interface = usb / "1.0"
        interface.mkdir(exist_ok=True)
        entry = tmp_path / "class" / f"video{number}"
        entry.mkdir(parents=True)
        (entry / "device").symlink_to(interface)
        capture[f"/dev/video{number}"] = (f"/dev/video{number}", "s2255", bus)

    add(10, "B", "usb-2")
    add(2, "A", "usb-1")
    add(9, "B", "usb-2")
    monkeypatch.setattr(
        device_path, "_capture_capability", lambda path: [capture[path]] if path in capture else []
    )
    return tmp_path / "class"


def test_serial_number_and_channel(machine):
    assert resolve_device("serial:A", machine) == "/dev/video2"
    assert resolve_device("serial:B", machine) == "/dev/video9"
    assert resolve_device("serial:B/1", machine) == "/dev/video10"
    assert resolve_device("bus:usb-1", machine) == "/dev/video2"


@pytest.mark.parametrize("name", ["serial:C", "serial:B/2", "bus:usb-9", "/dev/absent"])
def test_an_unknown_name_is_answered_with_the_known_ones(machine, name):
    with pytest.raises(CaptureError, match=rf"no video device '{name}': .*serial:A or bus:usb-1"):
        resolve_device(name, machine)


def test_numbered_nodes_are_refused(machine):
    with pytest.raises(CaptureError, match=r"/dev/video0 is refused.*other eye.*serial:A"):
        resolve_device("/dev/video0", machine)


def test_nothing_set_and_nothing_there(tmp_path):
    with pytest.raises(CaptureError, match=r"no device is set: .* no video device at all"):
        resolve_device("", tmp_path)


def test_a_link_is_followed_anew_each_time(tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    first.touch()
    second.touch()
    link = tmp_path / "left"
    link.symlink_to(first)
    assert resolve_device(str(link)) == str(link)
    link.unlink()
    with pytest.raises(CaptureError, match="no video device"):
        resolve_device(str(link))
    link.symlink_to(second)
    assert resolve_device(str(link)) == str(link)
