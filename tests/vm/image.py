"""The image of the virtual machine: Debian with its stock kernel and golfbench's dependencies, made once.

Everything ends up in one initramfs, the root file system as a compressed image in it: while a guest in
virtual time waits for a disk its clock jumps, and memory never makes it wait. Kept by the digest of all that
goes in, in $GOLFBENCH_VM_CACHE or ~/.cache/golfbench/vm. Needs root and Debian's packages of `PACKAGES`.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from tests.vm.kernel import keep_modules, load_order, unpack_kernel

PROJECT = Path(__file__).parents[2]
GUEST = Path(__file__).with_name("guest")

PACKAGES = {
    "qemu-system-x86_64": "qemu-system-x86",
    "mmdebstrap": "mmdebstrap",
    "mkfs.erofs": "erofs-utils",
    "busybox": "busybox-static",
    "cpio": "cpio",
}
"""Program -> package of Debian that has it."""

SUITE = "bookworm"
_INSTALLED = "systemd,systemd-sysv,dbus,udev,kmod,iproute2,can-utils,python3,procps"
_WHEELS = (
    "annotated-doc",
    "canopen",
    "click",
    "eclipse-zenoh",
    "filterpy",
    "greenlet",
    "jinja2",
    "llvmlite",
    "markdown-it-py",
    "markupsafe",
    "mdurl",
    "numba",
    "numpy",
    "packaging",
    "pyarrow",
    "pydantic",
    "pydantic-core",
    "pygments",
    "python-can",
    "rich",
    "scipy",
    "shellingham",
    "sqlalchemy",
    "threadpoolctl",
    "typer",
    "typing-extensions",
    "typing-inspection",
    "wrapt",
)
"""What daemon, nodes and client import; viewer, reports and exports do not run in the guest."""
_MODULES_AT_START = ("virtio_pci", "9pnet_virtio", "9p", "loop", "crc32c_generic", "erofs", "overlay")
_MODULES = (*_MODULES_AT_START, "sch_netem", "button", "acpiphp_ibm")
_MASKED = (
    "dev-hugepages.mount",
    "dev-mqueue.mount",
    "kmod-static-nodes.service",
    "ldconfig.service",
    "modprobe@drm.service",
    "proc-sys-fs-binfmt_misc.automount",
    "sys-fs-fuse-connections.mount",
    "sys-kernel-config.mount",
    "sys-kernel-debug.mount",
    "sys-kernel-tracing.mount",
    "systemd-ask-password-console.path",
    "systemd-ask-password-wall.path",
    "systemd-binfmt.service",
    "systemd-boot-system-token.service",
    "systemd-firstboot.service",
    "systemd-hwdb-update.service",
    "systemd-journal-flush.service",
    "systemd-journald-audit.socket",
    "systemd-machine-id-commit.service",
    "systemd-pcrphase-sysinit.service",
    "systemd-pcrphase.service",
    "systemd-pstore.service",
    "systemd-random-seed.service",
    "systemd-remount-fs.service",
    "systemd-repart.service",
    "systemd-rfkill.socket",
    "systemd-update-done.service",
    "systemd-update-utmp.service",
)
"""Units that a test's machine has no use for: half of the time that it takes to boot."""

HOME = "opt/golfbench"
SITE = f"{HOME}/lib/python3.11/site-packages"
MACHINE_CODE = "var/cache/golfbench"
PROCESSOR = {"NUMBA_CPU_NAME": "nehalem", "NUMBA_CPU_FEATURES": ""}
"""The guest's processor, so that code compiled outside of it is taken from its cache."""

Say = Callable[[str], None]


class Image(NamedTuple):
    """What QEMU boots, and the same root as a folder."""

    kernel: Path
    initramfs: Path
    root: Path


def cache() -> Path:
    """Return the folder of images."""
    fallback = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser() / "golfbench"
    return Path(os.environ.get("GOLFBENCH_VM_CACHE") or fallback / "vm")


def build_image(say: Say) -> Image:
    """Return the image of today's inputs, made now if there is none."""
    folder = cache() / f"image-{_digest()}"
    image = Image(folder / "vmlinux", folder / "initramfs", folder / "root")
    if not image.initramfs.exists():
        made = folder.with_name(f".{folder.name}-{os.getpid()}")
        made.mkdir(parents=True)
        try:
            _build(Image(made / "vmlinux", made / "initramfs", made / "root"), say)
            made.rename(folder)
        finally:
            shutil.rmtree(made, ignore_errors=True)
    return image


def _digest() -> str:
    """Return the digest of everything that is built into an image."""
    here = [Path(__file__), Path(__file__).with_name("kernel.py"), PROJECT / "constraints.txt"]
    return digest_of([*here, *sorted(path for path in GUEST.iterdir() if path.is_file())])


def digest_of(files: list[Path]) -> str:
    """Return 16 hex digits that identify names and contents of `files`."""
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()[:16]


def _build(image: Image, say: Say) -> None:
    root = image.root
    say("installing Debian")
    fetch = 'mkdir "$1"/opt/kernel && cd "$1"/opt/kernel && export APT_CONFIG="$MMDEBSTRAP_APT_CONFIG"'
    kernel = "$(apt-cache depends linux-image-amd64 | sed -n 's/ *Depends: \\(linux-image-[0-9].*\\)/\\1/p')"
    subprocess.run(
        [
            "mmdebstrap",
            "--quiet",
            "--mode=root",
            "--variant=minbase",
            f"--include={_INSTALLED}",
            *(f"--dpkgopt=path-exclude=/usr/share/{part}/*" for part in ("doc", "man", "locale")),
            "--dpkgopt=force-unsafe-io",
            '--aptopt=Acquire::Languages "none"',
            f"--customize-hook={fetch} && apt-get -qq download {kernel}",
            SUITE,
            root,
        ],
        check=True,
        stdin=subprocess.DEVNULL,
    )
    say("unpacking the kernel")
    [package] = (root / "opt/kernel").glob("linux-image-*.deb")
    unpacked = package.parent
    subprocess.run(["dpkg", "-x", package, unpacked], check=True)
    [vmlinuz] = (unpacked / "boot").glob("vmlinuz-*")
    unpack_kernel(vmlinuz, image.kernel)
    [modules] = (unpacked / "lib/modules").iterdir()
    modules = Path(shutil.move(modules, root / "usr/lib/modules" / modules.name))
    depmod: list[str | Path] = ["chroot", root, "depmod", modules.name]
    subprocess.run(depmod, check=True)
    keep_modules(modules, _MODULES)
    subprocess.run(depmod, check=True)
    shutil.rmtree(unpacked)
    say("installing Python's packages")
    _install_packages(root)
    _configure(root)
    say("packing")
    _pack(image, modules)


def _install_packages(root: Path) -> None:
    site, home = root / SITE, root / HOME
    platforms = [f"--platform=manylinux_2_{minor}_x86_64" for minor in (36, 34, 28, 27, 24, 17)]
    run_pip(
        "install",
        "--target",
        site,
        "--python-version=3.11",
        "--implementation=cp",
        *platforms,
        "--platform=manylinux2014_x86_64",
        "--only-binary=:all:",
        "--no-deps",
        "--no-compile",
        "-c",
        PROJECT / "constraints.txt",
        *_WHEELS,
    )
    for needless in [*site.rglob("tests"), site / "pyarrow/include", site / "bin"]:
        shutil.rmtree(needless, ignore_errors=True)
    (home / "bin").mkdir()
    (home / "bin/python").symlink_to("/usr/bin/python3.11")
    (home / "pyvenv.cfg").write_text("home = /usr/bin\ninclude-system-site-packages = false\n")
    command = home / "bin/golfbench"
    command.write_text("#!/opt/golfbench/bin/python\nfrom bench.commands.cli import main\n\nmain()\n")
    command.chmod(0o755)
    subprocess.run(
        ["chroot", root, f"/{HOME}/bin/python", "-m", "compileall", "-qq", f"/{SITE}"], check=False
    )


def _configure(root: Path) -> None:
    """Install the guest's own files: its start-up and its programs."""
    etc = root / "etc"
    system = etc / "systemd/system"
    for unit in GUEST.glob("*.*"):
        shutil.copy(unit, system)
    shutil.copy(GUEST / "run", root / HOME)
    for masked in _MASKED:
        (system / masked).symlink_to("/dev/null")
    generators = etc / "systemd/system-generators"
    generators.mkdir(exist_ok=True)
    for generator in (root / "usr/lib/systemd/system-generators").iterdir():
        (generators / generator.name).symlink_to("/dev/null")
    (system / "default.target").symlink_to("vm.target")
    manager = etc / "systemd/system.conf.d"
    manager.mkdir()
    environment = " ".join(f"{name}={value}" for name, value in PROCESSOR.items())
    (manager / "vm.conf").write_text(f"[Manager]\nDefaultEnvironment={environment}\n")
    (etc / "systemd/journald.conf.d").mkdir()
    (etc / "systemd/journald.conf.d/vm.conf").write_text("[Journal]\nStorage=volatile\nRuntimeMaxUse=32M\n")
    (etc / "hostname").write_text("bench\n")
    (etc / "fstab").write_text("")
    (etc / "machine-id").write_text("0123456789abcdef0123456789abcdef\n")
    (root / "host").mkdir()


def _pack(image: Image, modules: Path) -> None:
    """Make the initramfs: busybox, the modules for the start in their order, the root's image."""
    top = image.root.with_name("initramfs-content")
    for name in ("bin", "modules", "proc", "sys", "dev"):
        (top / name).mkdir(parents=True)
    busybox = shutil.which("busybox")
    if busybox is None:
        raise FileNotFoundError("busybox")
    shutil.copy(busybox, top / "bin/busybox")
    for applet in ("sh", "mount", "mkdir", "insmod", "losetup", "switch_root", "cat", "cut", "mv"):
        (top / "bin" / applet).symlink_to("busybox")
    order = load_order(modules, _MODULES_AT_START)
    for path in order:
        shutil.copy(path, top / "modules")
    (top / "order").write_text("".join(f"/modules/{path.name}\n" for path in order))
    shutil.copy(GUEST / "init", top / "init")
    (top / "init").chmod(0o755)
    subprocess.run(
        ["mkfs.erofs", "-zlz4", "--quiet", top / "root.erofs", image.root],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    archive(top, image.initramfs)
    shutil.rmtree(top)


def archive(folder: Path, file: Path) -> None:
    """Write `folder` as the kernel unpacks it into memory; such files may stand one behind the other."""
    names = "\n".join(str(path.relative_to(folder)) for path in [folder, *sorted(folder.rglob("*"))])
    with file.open("wb") as output:
        subprocess.run(
            ["cpio", "--create", "--format=newc", "--quiet", "--owner=+0:+0"],
            cwd=folder,
            input=names.encode(),
            stdout=output,
            check=True,
        )


def run_pip(*arguments: str | Path) -> None:
    """Run pip; CalledProcessError when that fails."""
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", "--quiet"]
    subprocess.run([*pip, *arguments], check=True, stdin=subprocess.DEVNULL)
