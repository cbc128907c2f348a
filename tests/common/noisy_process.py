"""A process that writes log lines in every possible way; run by test_log."""

from __future__ import annotations

import os
import sys
import threading
import warnings

import numpy as np

from common.log import begin_logging, logger


def fail():
    raise ValueError("in a thread")


if __name__ == "__main__":
    begin_logging("noisy", ["--log-json"])
    log = logger("noisy")
    log.info("numbers", nan=float("nan"), inf=[float("inf")], odd=np.float32(0.5), text='two\nlines "quoted"')
    log.warning("another's", robot="r2")
    os.write(1, b"native on stdout\n")
    os.write(2, b"\xff native on stderr\n\n")
    warnings.warn("a warning", stacklevel=1)
    thread = threading.Thread(target=fail)
    thread.start()
    thread.join()
    print("printed text", flush=True)
    print("from Python to stderr", file=sys.stderr, flush=True)
    raise RuntimeError("uncaught")
