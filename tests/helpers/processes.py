"""Real Python processes on this machine's loopback, with fake CPU devices, and none left behind."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

from helpers.compilation import UNOPTIMISED, as_in_use

TESTS = Path(__file__).parents[1]
PATIENCE_S = 400  # for one process, mostly compilation


class Processes:
    """Starts Python processes with fake CPU devices, and leaves none behind."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._all: list[subprocess.Popen[str]] = []
        # With the emitters that users have. The older ones, of other tests, round by how many
        # scenes a device makes, 1e-6 of the light; of which thresholds make 5e-4 of an event.
        ours = {k: v for k, v in as_in_use().items() if not k.startswith(("SLURM_", "OMPI_"))}
        self._environment = ours | {
            "PYTHONPATH": f"{TESTS.parent}{os.pathsep}{TESTS}", "JAX_PLATFORMS": "cpu",
            UNOPTIMISED: "1",
            "JAX_COMPILATION_CACHE_DIR": str(folder / "compiled")}

    def start(self, *args: object, devices: int = 1, **environment: str) -> subprocess.Popen[str]:
        """python ARGS, its output in the folder."""
        flags = {"XLA_FLAGS": f"{self._environment['XLA_FLAGS']} "
                              f"--xla_force_host_platform_device_count={devices}"}
        with (self.folder / f"output{len(self._all)}.txt").open("w") as output:
            process = subprocess.Popen(
                [sys.executable, *map(str, args)], env=self._environment | flags | environment,
                stdout=output, stderr=subprocess.STDOUT, text=True, cwd=TESTS.parent)
        self._all.append(process)
        return process

    def run(self, *args: object, devices: int = 1) -> None:
        """python ARGS until it ends well."""
        self.end_well(self.start(*args, devices=devices))

    def end_well(self, *processes: subprocess.Popen[str], code: int = 0) -> None:
        for process in processes:
            found = process.wait(PATIENCE_S)
            output = self.folder / f"output{self._all.index(process)}.txt"
            assert found == code, output.read_text()[-3000:]

    def stop(self) -> None:
        for process in self._all:
            process.kill()
            process.wait()


def free_port(low: int, high: int) -> int:
    """The first port from low to high that nobody listens on."""
    for port in range(low, high + 1):
        with socket.socket() as listener:
            try:
                listener.bind(("127.0.0.1", port))
            except OSError:
                continue
            return listener.getsockname()[1]
    raise AssertionError("no free port")
