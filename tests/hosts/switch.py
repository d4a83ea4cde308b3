"""A network switch in this process: its links are cut, delay frames or lose them, as `tc netem` does.

Kernels without netem are common, and a packet filter cannot delay.
"""

from __future__ import annotations

import fcntl
import heapq
import itertools
import os
import random
import struct
import subprocess
import threading
import time
from dataclasses import dataclass, field
from select import select

_TUNSETIFF = 0x400454CA
"""Request of Linux that gives a descriptor of /dev/net/tun its device (linux/if_tun.h)."""
_TAP_WITHOUT_HEADER = 0x1002
"""A device of whole Ethernet frames (IFF_TAP), each without a header of its own (IFF_NO_PI)."""
_FRAME_BYTES = 65_536
_LOOK_S = 0.05


@dataclass(eq=False)
class Link:
    """A host's cable. It can be changed while frames pass."""

    descriptor: int
    delay_s: float = 0.0
    """Of each frame that enters or leaves the host."""
    lost: float = 0.0
    """Share of these frames."""
    is_cut: bool = False
    frames: int = field(default=0, init=False)

    def passes(self, chance: random.Random) -> bool:
        """Whether a frame comes through."""
        return not self.is_cut and not (self.lost and chance.random() < self.lost)

    def write(self, frame: bytes) -> None:
        """Hand a frame to the host; one that does not fit into its queue is lost, as on a wire."""
        try:
            os.write(self.descriptor, frame)
            self.frames += 1
        except OSError:
            pass


class Switch:
    """Hands frames on by their address, in a thread of its own."""

    def __init__(self) -> None:
        self.links: list[Link] = []
        self._known: dict[bytes, Link] = {}
        self._later: list[tuple[float, int, Link, bytes]] = []
        self._numbers = itertools.count()
        self._chance = random.Random(5)
        self._open = True
        self._thread = threading.Thread(target=self._work, name="switch", daemon=True)
        self._thread.start()

    def plug(self, device: str, namespace: str, address: str) -> Link:
        """A link to a network namespace ("" for that of this process), where it has this name and IPv4 address."""
        descriptor = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
        fcntl.ioctl(descriptor, _TUNSETIFF, struct.pack("16sH22x", device.encode(), _TAP_WITHOUT_HEADER))
        inside = ["ip"]
        if namespace:
            subprocess.run(["ip", "link", "set", device, "netns", namespace], check=True)
            inside += ["-netns", namespace]
            subprocess.run([*inside, "link", "set", "lo", "up"], check=True)
        subprocess.run([*inside, "address", "add", f"{address}/24", "dev", device], check=True)
        subprocess.run([*inside, "link", "set", device, "up"], check=True)
        link = Link(descriptor)
        self.links.append(link)
        return link

    def unplug(self, link: Link) -> None:
        """Take a host from the network; its device goes with it."""
        self.links.remove(link)
        self._known = {place: one for place, one in self._known.items() if one is not link}
        time.sleep(2 * _LOOK_S)  # the thread looks at it no more
        os.close(link.descriptor)

    def close(self) -> None:
        """Take all hosts from the network."""
        self._open = False
        self._thread.join()
        for link in self.links:
            os.close(link.descriptor)

    def _work(self) -> None:
        while self._open:
            links = {link.descriptor: link for link in self.links}
            wait_s = min(_LOOK_S, max(self._later[0][0] - time.monotonic(), 0.0)) if self._later else _LOOK_S
            for descriptor in select(links, [], [], wait_s)[0]:
                try:
                    self._take(links[descriptor], os.read(descriptor, _FRAME_BYTES))
                except OSError:
                    continue
            while self._later and self._later[0][0] <= time.monotonic():
                _, _, link, frame = heapq.heappop(self._later)
                link.write(frame)

    def _take(self, source: Link, frame: bytes) -> None:
        self._known[frame[6:12]] = source
        if not source.passes(self._chance):
            return
        known = self._known.get(frame[:6])
        for target in [known] if known is not None else [link for link in self.links if link is not source]:
            if not target.passes(self._chance):
                continue
            if (delay_s := source.delay_s + target.delay_s) > 0:
                heapq.heappush(self._later, (time.monotonic() + delay_s, next(self._numbers), target, frame))
            else:
                target.write(frame)
