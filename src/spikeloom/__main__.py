"""``python -m spikeloom`` is the ``spikeloom`` command."""

import sys


def main() -> int:
    """Run the command; an interrupt while Python still loads it is reported as any other."""
    try:
        from spikeloom.runtime.cli import main as command
    except KeyboardInterrupt:
        sys.stderr.write("spikeloom: interrupted; nothing was written\n")
        return 2
    return command()


if __name__ == "__main__":
    sys.exit(main())
