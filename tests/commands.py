"""The command line in a process of its own."""

import sys

HEARS_INTERRUPTS = (
    "import runpy, signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "runpy.run_module('spikeloom', run_name='__main__', alter_sys=True)"
)
RUNTIME = (sys.executable, "-c", HEARS_INTERRUPTS)
"""As ``python -m runtime``, and interrupts reach it even where a job in the background told it to ignore them."""
