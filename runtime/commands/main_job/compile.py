"""The command ``compile``: a checkpoint or a file of another format becomes a netlist."""

import sys
from typing import Any

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.formats.text import text
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.machines.backends import backend_of, trained_for
from spikeloom.runtime.report.console import Progress, tell
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.requests.main_job import CompileRequest

REQUEST = CompileRequest


def run(request: CompileRequest) -> Outcome:
    """Run the command."""
    require_place(request.output, "-o", request, ["loom"])
    backend = backend_of(request.target)
    names = backend.passes
    if unknown := set(request.dump_after) - set(names):
        raise OptionError(
            f"--dump-after {', '.join(sorted(unknown))}: no such pass; allowed: {', '.join(names)}"
        )
    only = trained_for(request.checkpoint)
    if only is not None and only is not backend:
        path = f"{request.checkpoint} was trained for {only.target.title}"
        raise OptionError(f"--target {request.target}: {path}; give --target {only.name}")
    passes = Progress(len(names))

    def dump(name: str, done: Any) -> None:
        passes(names.index(name) + 1, "compiling")
        if name in request.dump_after:
            sys.stderr.write(text(done.newest))

    lowered = backend.lower(request, dump)
    sha256 = lowered.write(request.output)
    voted = lowered.netlist.readout_class
    if never := [str(each) for each in range(lowered.netlist.classes) if each not in voted]:
        tell(
            f"warning: {request.output}: no neuron votes for class {', '.join(never)}, which is never decided"
        )
    return lowered.report(sha256)
