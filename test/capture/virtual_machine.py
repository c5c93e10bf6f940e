#!/usr/bin/env python3
"""Run a command in a small virtual machine whose kernel has virtual video devices (vivid).

    virtual_machine.py [--cache DIR] COMMAND [ARGUMENT ...]
    virtual_machine.py [--cache DIR] --prepare

The machine sees this machine's files, read-only, and is gone afterwards.  Its kernel is Debian's
own package, fetched once with apt and kept in the cache (some 60 MB).  Needs qemu-system-x86_64 and
a static busybox; the exit code is that of the command, 124 after a time-out.

The processor is emulated and its clock counts instructions (-icount), so that a busy host slows
the machine down but makes it lose no frame.
"""

from __future__ import annotations

import argparse
import ctypes
import lzma
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path

CACHE = (
    Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser() / "thermal_stereo_vo/guest-1"
)
TIMEOUT, UNAVAILABLE = 124, 77
PR_SET_PDEATHSIG = 1
FILE_SYSTEM = ("virtio_pci", "9pnet_virtio", "9p")
# Two HDMI inputs, which a scaler brings to any size at exactly 30 Hz, and a television input.
VIVID = "n_devs=3 node_types=0x1,0x1,0x1 num_inputs=1,1,1 input_types=3,3,1 vid_cap_nr=10,11,12"

INIT = f"""#!/bin/busybox sh
/bin/busybox --install -s /bin
mount -t proc proc /proc; mount -t sysfs sys /sys; mount -t devtmpfs dev /dev
while read module; do insmod /modules/$module; done </modules/order
insmod /modules/vivid.ko {VIVID}
mount -t 9p -o ro,trans=virtio,version=9p2000.L,msize=512000,cache=loose host /host \\
    || poweroff -f
for place in proc sys dev; do mount --move /$place /host/$place; done
mkdir -p /host/dev/shm /host/dev/pts
mount -t tmpfs tmpfs /host/dev/shm; mount -t devpts devpts /host/dev/pts
mount -t tmpfs tmpfs /host/run; mkdir -p /host/run/job /host/run/tmp /host/run/home /host/run/lock
mount -t 9p -o trans=virtio,version=9p2000.L,msize=512000,cache=none job /host/run/job
ifconfig lo 127.0.0.1 up
chroot /host /bin/sh /run/job/command >/host/run/job/output 2>&1 </host/dev/null
echo $? >/host/run/job/exit_code
sync; poweroff -f
"""


class UnavailableError(Exception):
    """This machine cannot run the guest; says what is missing."""


def require(*programs: str) -> None:
    """Raise UnavailableError unless these can be run."""
    missing = [program for program in programs if shutil.which(program) is None]
    if missing:
        raise UnavailableError(
            f"{', '.join(missing)} not found: apt install qemu-system-x86 busybox-static"
        )


def static_busybox() -> Path:
    """A busybox that runs without any library."""
    require("busybox")
    path = Path(shutil.which("busybox") or "").resolve()
    if b"ld-linux" in path.read_bytes()[:4096]:
        raise UnavailableError(f"{path} is not static: apt install busybox-static")
    return path


def prepare(cache: Path) -> tuple[Path, Path]:
    """Kernel and an archive of its modules, made if they are not in the cache.

    Raises UnavailableError.
    """
    kernel, modules = cache / "vmlinux", cache / "modules.cpio"
    if kernel.exists() and modules.exists():
        return kernel, modules
    busybox = static_busybox()
    require("apt-get", "apt-cache", "dpkg-deb")
    cache.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=cache) as name:
        folder = Path(name)
        package = fetch_kernel(folder)
        subprocess.run(["dpkg-deb", "-x", package, folder / "unpacked"], check=True)
        image = next((folder / "unpacked/boot").glob("vmlinuz-*"))
        found = {normalised(path): path for path in (folder / "unpacked").rglob("*.ko*")}
        (folder / "vmlinux").write_bytes(kernel_of(image.read_bytes()))
        (folder / "modules").write_bytes(modules_archive(busybox, found))
        (folder / "modules").replace(modules)
        (folder / "vmlinux").replace(kernel)
    return kernel, modules


def fetch_kernel(folder: Path) -> Path:
    """Debian's kernel package, downloaded but not installed."""
    for refresh in (False, True):
        if refresh and os.geteuid() == 0:
            subprocess.run(["apt-get", "update", "-qq"], check=False)
        listed = subprocess.run(
            ["apt-cache", "depends", "linux-image-amd64"],
            capture_output=True,
            text=True,
            check=False,
        ).stdout
        found = re.search(r"Depends: (linux-image-\S+)", listed)
        if found is None:
            continue
        loaded = subprocess.run(
            ["apt-get", "download", "-qq", "-o", "APT::Sandbox::User=root", found[1]],
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
        )
        for package in folder.glob("linux-image-*.deb"):
            return package
        print(loaded.stderr, file=sys.stderr)
    raise UnavailableError(
        "the package linux-image-amd64 cannot be fetched: this needs Debian's package sources "
        "('apt-get update' as root first) and a network"
    )


def kernel_of(image: bytes) -> bytes:
    """The ELF kernel inside a bzImage, so that the guest need not unpack it (Documentation/x86)."""
    if image[0x202:0x206] != b"HdrS":
        raise UnavailableError("the kernel image is no bzImage")
    setup_sectors = image[0x1F1] or 4
    begin = (setup_sectors + 1) * 512 + int.from_bytes(image[0x248:0x24C], "little")
    payload = image[begin : begin + int.from_bytes(image[0x24C:0x250], "little")]
    kernel = decompressed(payload)
    if kernel[:4] != b"\x7fELF":
        raise UnavailableError("the kernel image holds no ELF kernel")
    return kernel


def decompressed(data: bytes) -> bytes:
    """Undo xz, gzip or zstd, told by their first bytes; anything else is returned as it is."""
    if data[:6] == b"\xfd7zXZ\0":
        return lzma.LZMADecompressor(lzma.FORMAT_XZ).decompress(data)
    if data[:2] == b"\x1f\x8b":
        return zlib.decompressobj(31).decompress(data)
    if data[:4] == b"\x28\xb5\x2f\xfd":
        require("zstd")
        run = subprocess.run(["zstd", "-dc"], input=data, stdout=subprocess.PIPE, check=False)
        return run.stdout
    return data


def normalised(module: Path) -> str:
    """The name of a module as dependencies spell it."""
    return module.name.split(".ko")[0].replace("-", "_")


def load_order(names: tuple[str, ...], modules: dict[str, Path]) -> Iterator[tuple[str, bytes]]:
    """Modules with their contents, each after those it depends on."""
    done: set[str] = set()

    def visit(name: str) -> Iterator[tuple[str, bytes]]:
        if name in done:
            return
        done.add(name)
        if name not in modules:
            return  # built into the kernel
        content = decompressed(modules[name].read_bytes())
        found = re.search(rb"\0depends=([^\0]*)\0", content)
        for dependency in (found[1].decode() if found else "").split(","):
            if dependency:
                yield from visit(dependency.replace("-", "_"))
        yield name, content

    for name in names:
        yield from visit(name)


def modules_archive(busybox: Path, modules: dict[str, Path]) -> bytes:
    """The initial file system but for ``init``, a cpio archive (newc)."""
    if "vivid" not in modules:
        raise UnavailableError("this kernel package has no vivid module")
    order, files = [], {}
    for name, content in load_order((*FILE_SYSTEM, "vivid"), modules):
        files[f"modules/{name}.ko"] = content
        order += [f"{name}.ko\n"] if name != "vivid" else []
    files["modules/order"] = "".join(order).encode()
    parts = [entry(name, 0o040755) for name in ("bin", "modules", "proc", "sys", "dev", "host")]
    parts += [entry("dev/console", 0o020600, device=(5, 1))]
    parts += [entry(name, 0o100644, content) for name, content in files.items()]
    parts += [entry("bin/busybox", 0o100755, busybox.read_bytes())]
    return b"".join([*parts, entry("TRAILER!!!", 0)])


def entry(name: str, mode: int, content: bytes = b"", device: tuple[int, int] = (0, 0)) -> bytes:
    """One file of a cpio archive."""
    encoded = name.encode() + b"\0"
    numbers = (0, mode, 0, 0, 1, 0, len(content), 0, 0, *device, len(encoded), 0)
    header = b"070701" + b"".join(b"%08x" % number for number in numbers)
    return padded(header + encoded) + padded(content)


def padded(data: bytes) -> bytes:
    """Up to the next multiple of four bytes."""
    return data + bytes(-len(data) % 4)


def run(command: list[str], cache: Path, timeout_s: float, environment: dict[str, str]) -> int:
    """Run ``command`` in the guest from the present folder; its output comes on stdout."""
    require("qemu-system-x86_64")
    kernel, modules = prepare(cache)
    with tempfile.TemporaryDirectory() as name:
        job = Path(name)
        # The kernel unpacks archives that follow each other into one file system.
        init = entry("init", 0o100755, INIT.encode()) + entry("TRAILER!!!", 0)
        initramfs = job / "initramfs"
        initramfs.write_bytes(modules.read_bytes() + init)
        (job / "command").write_text(script(command, environment))
        machine = subprocess.Popen(
            qemu(kernel, initramfs, job),
            stdin=subprocess.DEVNULL,
            stdout=(job / "console").open("wb"),
            stderr=subprocess.STDOUT,
            preexec_fn=die_with_parent,
        )
        try:
            machine.wait(timeout_s)
        except subprocess.TimeoutExpired:
            print(f"the guest was stopped after {timeout_s:g} s", file=sys.stderr)
        finally:
            machine.kill()
            machine.wait()
        if (job / "output").exists():
            print((job / "output").read_text(errors="replace"), end="", flush=True)
        if (job / "exit_code").exists():
            return int((job / "exit_code").read_text())
        print((job / "console").read_text(errors="replace")[-4000:], file=sys.stderr)
        return TIMEOUT


def die_with_parent() -> None:
    """No emulator is left behind when a test run is cut off."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def script(command: list[str], environment: dict[str, str]) -> str:
    """What the guest executes."""
    settings = {
        "PATH": os.environ["PATH"],
        "HOME": "/run/home",
        "TMPDIR": "/run/tmp",
        "LANG": "C.UTF-8",
        "PYTHONDONTWRITEBYTECODE": "1",
        **environment,
    }
    exports = "".join(f"export {key}={shlex.quote(value)}\n" for key, value in settings.items())
    return f"{exports}cd {shlex.quote(str(Path.cwd()))}\nexec {shlex.join(command)}\n"


def qemu(kernel: Path, initramfs: Path, job: Path) -> list[str]:
    """The command line of the emulator.  Never KVM: some hosts offer one that boots nothing."""
    arguments = ["qemu-system-x86_64", "-machine", "pc", "-cpu", "max", "-smp", "1", "-m", "2048"]
    arguments += ["-accel", "tcg,thread=single,tb-size=512", "-icount", "shift=1"]
    arguments += [
        "-nodefaults",
        "-no-user-config",
        "-no-reboot",
        "-display",
        "none",
        "-vga",
        "none",
    ]
    arguments += ["-serial", "stdio", "-kernel", str(kernel), "-initrd", str(initramfs)]
    arguments += ["-append", "console=ttyS0 panic=-1 quiet loglevel=4 mitigations=off nokaslr"]
    for tag, path, options in (("host", "/", ",readonly=on"), ("job", str(job), "")):
        share = f"local,id={tag},path={path},security_model=none,multidevs=remap{options}"
        arguments += ["-fsdev", share]
        arguments += ["-device", f"virtio-9p-pci,fsdev={tag},mount_tag={tag}"]
    return arguments


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").split("\n\n")[0],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--cache", type=Path, default=CACHE, help=f"default: {CACHE}")
    parser.add_argument("--prepare", action="store_true", help="only fill the cache")
    parser.add_argument("--timeout", type=float, default=300.0, metavar="S")
    parser.add_argument("--env", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("command", nargs=argparse.REMAINDER)
    args = parser.parse_args()
    die_with_parent()
    try:
        if args.prepare or not args.command:
            require("qemu-system-x86_64")
            prepare(args.cache)
            return 0
        environment = dict(text.split("=", 1) for text in args.env)
        return run(args.command, args.cache, args.timeout, environment)
    except UnavailableError as error:
        print(error, file=sys.stderr)
        return UNAVAILABLE


if __name__ == "__main__":
    sys.exit(main())
