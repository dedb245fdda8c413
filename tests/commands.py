"""Commands, in this process and in one of their own."""

import contextlib
import io
import json
import sys

from spikeloom.runtime import cli

HEARS_INTERRUPTS = (
    "import runpy, signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "runpy.run_module('spikeloom', run_name='__main__', alter_sys=True)"
)
RUNTIME = (sys.executable, "-c", HEARS_INTERRUPTS)
"""As ``python -m runtime``, and interrupts reach it even where a job in the background told it to ignore them."""


def run(*words) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a command."""
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        code = cli.main([str(word) for word in words])
    return code, out.getvalue(), err.getvalue()


def as_json(*words, codes=(0,)):
    """The one object that a command prints with ``--json``."""
    code, out, err = run(*words, "--json")
    assert code in codes, err
    assert out.count("\n") == 1
    return json.loads(out)


def refusal(*words) -> str:
    """What a command says that must fail, after its warnings."""
    code, out, err = run(*words)
    assert (code, out) == (2, "")
    return err.splitlines()[-1].removeprefix("spikeloom: ")
