"""Cameras without hardware that speak to the real drivers: for tests, validation and trying things out."""

from __future__ import annotations

import ctypes
import os
import shutil
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray

from mems6dof_ros.errors import InputError, Mems6dofError

_GIGE_PROGRAM = "arv-fake-gv-camera-0.8"
_GVCP_PORT = 3956

#: s; how long the emulator may take to listen.
_START = 5.0


class GigeEmulator:
    """Aravis' GigE Vision camera on the loopback interface: real GVCP and GVSP packets, 2048 x 2048.

    ``lost_per_thousand``: stream packets that it does not send. Its clock is the host's, its frame ids are
    16-bit and begin shortly before they wrap. It stamps a frame before it computes and sends it, without
    any exposure: use timestamp_at: end. Software triggers are taken at its frame rate, so set that by
    features: AcquisitionFrameRate. Raises Mems6dofError where the program is absent or the port is taken.
    """

    def __init__(self, serial: str = "EMULATED", lost_per_thousand: int = 0) -> None:
        if shutil.which(_GIGE_PROGRAM) is None:
            raise Mems6dofError(f"{_GIGE_PROGRAM} is not installed; install it by: apt install aravis-tools")
        self.device = f"Aravis-Fake-{serial}"
        self._command = [_GIGE_PROGRAM, "-i", "127.0.0.1", "-s", serial, "-r", str(lost_per_thousand)]
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Plug in; returns when it listens."""
        if _port_taken():
            raise Mems6dofError(f"UDP port {_GVCP_PORT} of 127.0.0.1 is taken: another emulated camera runs")
        self._process = subprocess.Popen(self._command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        deadline = time.monotonic() + _START
        while not _port_taken():
            if time.monotonic() > deadline:
                raise Mems6dofError(f"{_GIGE_PROGRAM} does not listen")
            time.sleep(0.02)

    def kill(self) -> None:
        """Unplug."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def __enter__(self) -> GigeEmulator:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()


def _port_taken() -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("127.0.0.1", _GVCP_PORT))
        except OSError:
            return True
    return False


class WireCounter:
    """Counts the frames that GigE Vision cameras on the loopback interface begin or end to send.

    It reads the packets below every driver, by a raw socket that passes leaders and trailers only, and so
    is independent of what it checks. Needs the right to open one (root); raises PermissionError otherwise.
    """

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(0x0800))
        # GVSP header behind 20 bytes of IP and 8 of UDP: status, block id, then the packet format in 4 bits.
        program = (
            (0x30, 0, 0, 9),  # A = protocol
            (0x15, 0, 7, 17),  # UDP, else drop
            (0x28, 0, 0, 28),  # A = status
            (0x15, 0, 5, 0),  # success, else drop
            (0x30, 0, 0, 32),  # A = format
            (0x54, 0, 0, 0x0F),
            (0x15, 1, 0, 1),  # leader: keep
            (0x15, 0, 1, 2),  # trailer: keep, else drop
            (0x06, 0, 0, 64),
            (0x06, 0, 0, 0),
        )
        code = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *line) for line in program))
        so_attach_filter, so_rcvbufforce = 26, 33
        filter_ = struct.pack("HL", len(program), ctypes.addressof(code))
        self._socket.setsockopt(socket.SOL_SOCKET, so_attach_filter, filter_)
        self._socket.setsockopt(socket.SOL_SOCKET, so_rcvbufforce, 1 << 26)
        self._socket.bind(("lo", 0x0800))
        self._socket.settimeout(0.1)
        self._ids: list[int] = []
        self._running = True
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    @property
    def produced(self) -> int:
        """Frames seen so far."""
        return len(self._ids)

    def __enter__(self) -> WireCounter:
        return self

    def __exit__(self, *_: object) -> None:
        self._running = False
        self._thread.join()
        self._socket.close()

    def _listen(self) -> None:
        while self._running:
            try:
                packet = self._socket.recv(64)
            except TimeoutError:
                continue
            (port,) = struct.unpack_from("!H", packet, 20)
            (block,) = struct.unpack_from("!H", packet, 30)
            if port != _GVCP_PORT and block not in self._ids[-8:]:
                self._ids.append(block)


@contextmanager
def basler_emulator(folder: Path, images: Sequence[NDArray[np.uint16]]) -> Iterator[dict[str, object]]:
    """Make pylon emulate one camera that shows ``images``, over and over; yields options for `open_source`.

    ``folder`` takes the images as TIFF files. pylon looks at the environment when it first enumerates.
    """
    shape = images[0].shape
    if any(image.shape != shape for image in images):
        raise InputError("images", "different shapes", "one shape")
    for k, image in enumerate(images):
        tifffile.imwrite(folder / f"{k:06d}.tif", image)
    before = os.environ.get("PYLON_CAMEMU")
    os.environ["PYLON_CAMEMU"] = "1"
    try:
        yield {
            "device": "0815-0000",
            "pixel_format": "Mono16",
            "region": (0, 0, shape[1], shape[0]),
            "features": (f"ImageFilename={folder}", "ImageFileMode=On", "TestImageSelector=Off"),
        }
    finally:
        if before is None:
            del os.environ["PYLON_CAMEMU"]
        else:
            os.environ["PYLON_CAMEMU"] = before
