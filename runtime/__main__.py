"""``python -m runtime`` is the ``spikeloom`` command."""

import sys

from runtime.cli import main

sys.exit(main())
