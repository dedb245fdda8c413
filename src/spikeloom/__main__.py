"""``python -m spikeloom`` is the ``spikeloom`` command."""

import atexit
import gc
import io
import signal
import sys


def main() -> int:
    """Run the command; a request to end (SIGTERM) interrupts as Ctrl-C does, even while Python still loads it."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    atexit.register(
        gc.freeze
    )  # nobody waits for garbage to be looked for at the end: a fifth of a second with numba
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # help has letters that not every terminal has
    try:
        from spikeloom.runtime.cli import main as command

        return command()
    except KeyboardInterrupt:
        sys.stderr.write("spikeloom: interrupted; nothing was written\n")
        return 2


if __name__ == "__main__":
    sys.exit(main())
