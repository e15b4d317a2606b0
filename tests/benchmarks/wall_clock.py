"""A wall clock of the project's own processes that can be set while they run.

A library that the loader puts before the others adds an offset to CLOCK_REALTIME; the offset is in a mapped
file, so that all processes see a change at the same instant. CLOCK_MONOTONIC, waits, and the machine's clock
stay as they are. libfaketime does not do: it also takes over sleeping, and fails at that of a paced loop.
"""

from __future__ import annotations

import mmap
import shutil
import struct
import subprocess
import time
from pathlib import Path

_SOURCE = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static volatile int64_t none, *ahead = &none;               /* ns */
static int (*kernels)(clockid_t, struct timespec *);

__attribute__((constructor)) static void begin(void) {
    const char *path = getenv("GOLFBENCH_WALL_CLOCK");
    int file = path ? open(path, O_RDONLY | O_CLOEXEC) : -1;
    kernels = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
    if (file >= 0) {
        void *at = mmap(0, 8, PROT_READ, MAP_SHARED, file, 0);
        if (at != MAP_FAILED) ahead = at;
        close(file);
    }
}

int clock_gettime(clockid_t clock, struct timespec *time) {
    if (!kernels) begin();
    int answer = kernels(clock, time);
    if (!answer && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) {
        int64_t ns = time->tv_sec * INT64_C(1000000000) + time->tv_nsec + *ahead;
        time->tv_sec = ns / 1000000000;
        time->tv_nsec = ns % 1000000000;
    }
    return answer;
}

int gettimeofday(struct timeval *restrict time, void *restrict zone) {
    struct timespec found;
    clock_gettime(CLOCK_REALTIME, &found);
    time->tv_sec = found.tv_sec;
    time->tv_usec = found.tv_nsec / 1000;
    return 0;
}

time_t time(time_t *into) {
    struct timespec found;
    clock_gettime(CLOCK_REALTIME, &found);
    if (into) *into = found.tv_sec;
    return found.tv_sec;
}
"""


class WallClock:
    """A second clock; processes started with `environment` use it."""

    def __init__(self, folder: Path) -> None:
        """Keep library and offset in `folder`.

        Raises:
            RuntimeError: there is no C compiler, or it fails.
        """
        compiler = shutil.which("cc")
        if compiler is None:
            raise RuntimeError("no cc on the PATH; Debian: apt-get install gcc libc6-dev")
        source, library, offset = (folder / f"wall-clock.{ending}" for ending in ("c", "so", "offset"))
        source.write_text(_SOURCE)
        made = subprocess.run(
            [compiler, "-O2", "-shared", "-fPIC", "-o", library, source, "-ldl"],
            capture_output=True,
            text=True,
            check=False,
        )
        if made.returncode:
            raise RuntimeError(f"{compiler} failed: {made.stderr}")
        offset.write_bytes(bytes(8))
        with offset.open("r+b") as file:
            self._offset = mmap.mmap(file.fileno(), 8)
        self.environment = {"LD_PRELOAD": str(library), "GOLFBENCH_WALL_CLOCK": str(offset)}
        self.ahead = 0.0
        """Offset to the machine's clock, s."""

    def set(self, ahead: float) -> None:
        """Set the clock `ahead` (s) of the machine's, at once."""
        self._offset[:] = struct.pack("=q", round(1e9 * ahead))
        self.ahead = ahead

    def now(self) -> float:
        """Return the clock's time, s since 1970."""
        return time.time() + self.ahead
