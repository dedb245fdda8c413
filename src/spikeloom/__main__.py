"""``python -m spikeloom`` is the ``spikeloom`` command."""

import atexit
import gc
import sys


def main() -> int:
    """Run the command; an interrupt while Python still loads it is reported as any other."""
    atexit.register(gc.freeze)  # nobody waits for garbage to be looked for at the end: a fifth of a second with numba
    try:
        from spikeloom.runtime.cli import main as command
    except KeyboardInterrupt:
        sys.stderr.write("spikeloom: interrupted; nothing was written\n")
        return 2
    return command()


if __name__ == "__main__":
    sys.exit(main())
