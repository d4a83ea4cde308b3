"""Hosts on this machine: each with its own root, user, folders, processes, name and address."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pytest

import roadscan
from roadscan.compute.kernel_options import _folder_of_source
from roadscan.core.private_folder import cache_place
from tests.conftest import REPOSITORY
from tests.hosts.switch import Link, Switch

USER = 10_001
"""Number of the user as whom everything runs, as in deploy/Containerfile."""
NAMESPACES = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "--uts", "--ipc"]
ENTER = str(Path(__file__).parent / "enter.sh")
NETWORK = f"10.{64 + os.getpid() // 256 % 128}.{os.getpid() % 256}"
"""Beginning of the addresses: two test processes at once have two networks."""
PASSWD = f"root:x:0:0::/root:/bin/sh\nroadscan:x:{USER}:{USER}::/var/lib/roadscan:/bin/sh\n"


def machine_folders() -> str:
    """What a host without an image sees of this machine: programs, Python with its packages, and this checkout."""
    environments = {Path(sys.prefix), Path(sys.base_prefix), Path(sys.prefix).resolve()}
    return " ".join(sorted({"/usr", "/etc/ssl", str(REPOSITORY), *map(str, environments)}))


def copy_of_kernels(copy: Path) -> Path:
    """A copy of this user's cache of compiled kernels, of the hosts' user."""
    sources = Path(roadscan.__file__).parent.rglob("kernels/*.py")
    chosen = {Path(_folder_of_source(str(source))).name for source in sources}
    for folder in cache_place().iterdir():
        if folder.name in chosen or not folder.name.startswith("kernels-"):
            shutil.copytree(folder, copy / folder.name)
    for path in (copy, *copy.rglob("*")):
        os.chown(path, USER, USER)
    return copy


def missing() -> str:
    """Why hosts cannot be made here, empty where they can."""
    if os.geteuid() != 0:
        return "only root may make namespaces"
    for program in ("ip", "unshare", "chroot"):
        if shutil.which(program) is None:
            return f"there is no program {program} (apt-get install iproute2 util-linux)"
    tried = subprocess.run([*NAMESPACES, "mount", "-t", "tmpfs", "tmpfs", "/mnt"], capture_output=True, check=False)
    if tried.returncode:
        return f"namespaces cannot be made: {tried.stderr.decode().strip()}"
    if not os.access("/dev/net/tun", os.W_OK):
        return "there is no /dev/net/tun"
    return ""


@dataclass
class Host:
    """A host. What it writes lies below `folder`, and no other host sees that."""

    name: str
    address: str
    folder: Path
    namespace: str = ""
    """Network namespace; empty: it has no network."""
    link: Link | None = None
    image: Path | None = None
    """Root of a container's image, in place of the folders of this machine."""
    own: dict[str, str] = field(default_factory=dict)
    """Its folders and files, by their path on the host."""
    only_read: set[str] = field(default_factory=set)
    """Those of them that it cannot write to."""

    def __post_init__(self) -> None:
        self.give("/etc/passwd", self.written("passwd", PASSWD))
        self.give("/etc/group", self.written("group", f"root:x:0:\nroadscan:x:{USER}:\n"))
        self.give("/etc/hosts", self.written("hosts", f"127.0.0.1 localhost {self.name}\n"))
        self.give("/var/lib/roadscan", self.made("home", 0o700))
        self.give("/tmp", self.made("tmp", 0o1777))

    def give(self, inside: str, here: Path) -> Path:
        """Show a folder or file of this machine to the host under a path."""
        self.own[inside] = str(here)
        return here

    def made(self, name: str, mode: int = 0o755) -> Path:
        """A folder of the host's user."""
        folder = self.folder / name
        folder.mkdir(parents=True)
        folder.chmod(mode)
        os.chown(folder, USER, USER)
        return folder

    def written(self, name: str, text: str) -> Path:
        """A small file that the host's user can read."""
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / name).write_text(text)
        return self.folder / name

    def copied(self, source: Path, name: str) -> Path:
        """A copy of a folder, of the host's user."""
        shutil.copytree(source, self.folder / name, symlinks=True)
        for path in (self.folder / name, *(self.folder / name).rglob("*")):
            os.chown(path, USER, USER, follow_symlinks=False)
        return self.folder / name

    def give_kernels(self, kernels: Path) -> None:
        """Give the host compiled kernels: links to the files of a folder, which are replaced and never changed."""
        kept = self.made("home/.cache")
        shutil.copytree(kernels, kept / "roadscan", copy_function=os.link)
        for folder, _, _ in os.walk(kept):
            os.chown(folder, USER, USER)

    def command(self, command: Sequence[str], environment: Mapping[str, str]) -> tuple[list[str], dict[str, str]]:
        """The command, entered as the host's user; and the environment of the program that enters."""
        root = self.folder / "root"
        root.mkdir(exist_ok=True)
        entering = {
            "ROOT": str(root),
            "NAME": self.name,
            "OWN": " ".join(f"{here}:{inside}" for inside, here in self.own.items()),
        }
        entering |= {"ONLY_READ": " ".join(sorted(self.only_read))}
        entering |= {"IMAGE": str(self.image)} if self.image else {"SEEN": machine_folders()}
        network = ["ip", "netns", "exec", self.namespace] if self.namespace else []
        inside = ["/usr/bin/env", "-i", *(f"{k}={v}" for k, v in environment.items()), *command]
        return [*network, *NAMESPACES, "sh", ENTER, *inside], entering | {"PATH": os.environ["PATH"]}

    @contextlib.contextmanager
    def running(self, command: Sequence[str], environment: Mapping[str, str], log: str) -> Iterator[Running]:
        """A process of the host, with all that it starts, for as long as the context lasts."""
        entered, entering = self.command(command, environment)
        path = self.folder / f"{log}.log"
        with path.open("wb") as stream:
            process = subprocess.Popen(
                entered, env=entering, stdin=subprocess.DEVNULL, stdout=stream, stderr=subprocess.STDOUT, cwd="/",
                start_new_session=True,
            )  # fmt: skip
        running = Running(process, path)
        try:
            yield running
        finally:
            running.kill()


@dataclass
class Running:
    """A process of a host."""

    process: subprocess.Popen[bytes]
    log: Path

    def said(self) -> str:
        """All that it printed."""
        return self.log.read_text(errors="replace")

    def kill(self) -> None:
        """End it and all its processes at once, as a power cut does: the first of their process namespace ends."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def ended(self, within_s: float) -> int:
        """Its exit code."""
        try:
            return self.process.wait(within_s)
        except subprocess.TimeoutExpired:
            pytest.fail(f"it has not ended after {within_s:g} s:\n{self.said()}")

    def wait_for(self, text: str, within_s: float = 90.0) -> None:
        """Wait until it has printed something."""
        self.wait_until(lambda: text in self.said(), f"it did not say '{text}'", within_s)

    def wait_until(self, look: Callable[[], bool], complaint: str, within_s: float = 90.0) -> None:
        """Wait until something holds, while it runs."""
        end = time.monotonic() + within_s
        while not look():
            if self.process.poll() is not None or time.monotonic() > end:
                if look():
                    return
                pytest.fail(f"{complaint}:\n{self.said()}")
            time.sleep(0.02)


@dataclass
class Network:
    """Hosts with names and addresses on one switch. This process is on it, too."""

    folder: Path
    switch: Switch
    hosts: list[Host] = field(default_factory=list)

    def host(self, name: str, image: Path | None = None) -> Host:
        """A new host."""
        number = len(self.hosts) + 2
        namespace, address = f"roadscan-{os.getpid()}-{number}", f"{NETWORK}.{number}"
        subprocess.run(["ip", "netns", "add", namespace], check=True)
        link = self.switch.plug(f"rs{os.getpid()}-{number}", namespace, address)
        host = Host(name, address, self.folder / name, namespace, link, image)
        self.hosts.append(host)
        for one in self.hosts:
            names = "".join(f"{other.address} {other.name}\n" for other in self.hosts)
            one.written("hosts", f"127.0.0.1 localhost\n{names}")
        return host


@contextlib.contextmanager
def network(folder: Path) -> Iterator[Network]:
    """A network without hosts; all of them end with it."""
    folder.mkdir(exist_ok=True)
    folder.chmod(0o755)
    switch = Switch()
    made = Network(folder, switch)
    try:
        switch.plug(f"rs{os.getpid()}-1", "", f"{NETWORK}.1")
        yield made
    finally:
        switch.close()
        for host in made.hosts:
            subprocess.run(["ip", "netns", "delete", host.namespace], check=False)
