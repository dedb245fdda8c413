"""The library: what ``import spikeloom`` offers. A function asks one question; the command of its name is its client.

Every function takes the options of its command as keywords, builds its request, and returns the dataclass
that ``--json`` prints. Wrong values are an OptionError that names keyword, value and what is allowed.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.targets import DEFAULT_TARGET
from spikeloom.runtime.compiled import (
    Compiled,
    Data,
    Source,
    certify,
    estimate,
    recordings,
    recordings_of,
    report,
    run,
    stress,
    verify,
)
from spikeloom.runtime.report.shown import Shown
from spikeloom.runtime.requests.choices import NetworkChoice
from spikeloom.runtime.requests.choose import ChartRequest, SmallestRequest
from spikeloom.runtime.requests.fields import checked, documented
from spikeloom.runtime.requests.main_job import (
    CompileRequest,
    InspectRequest,
)
from spikeloom.runtime.requests.training import FinetuneRequest, TrainRequest

if TYPE_CHECKING:
    from torch import Tensor, nn

    from spikeloom.compiler.ir import Network
    from spikeloom.compiler.storage import Cheapest, Exact, Fixed
    from spikeloom.models.recordings.evtouch import Recordings
    from spikeloom.runtime.studies.chart.results import Chart
    from spikeloom.runtime.studies.counting import CountersReport
    from spikeloom.runtime.studies.smallest.results import Smallest
    from spikeloom.runtime.studies.training.finetuning import Finetuned
    from spikeloom.runtime.studies.training.results import TrainingReport

__all__ = [
    "Compiled",
    "Data",
    "certify",
    "chart",
    "compile",
    "estimate",
    "finetune",
    "load",
    "recordings",
    "report",
    "run",
    "smallest",
    "stress",
    "train",
    "verify",
]

Numbers = int | str | Sequence[int]
"""One number for all layers, or one for each."""


@documented(CompileRequest)
def compile(
    network: str | os.PathLike[str] | nn.Module | Network,
    *,
    example: Tensor | None = None,
    calibrate: Source | Recordings | None = None,
    bin: float | None = None,
    target: str = DEFAULT_TARGET,
    storage: Fixed | Cheapest | Exact | None = None,
    weight_bits: Numbers | None = None,
    planes: Numbers | None = None,
    scale_groups: Numbers | None = None,
    spike_exact: bool = False,
    keep: float | None = None,
    keep_all: bool = False,
    prune_unused: bool = False,
    share_lists: bool = False,
    cores_for: str | None = None,
    chips: int = 1,
    free_running: bool = False,
    graph: str | None = None,
    taxels: int | str | None = None,
    edges: str | None = None,
    directed: bool = False,
    run: int = 0,
    weights: str | None = None,
    beta: float | None = None,
    theta: float | None = None,
    polarities: int | None = None,
    polarities_first: bool | None = None,
    dt: float | None = None,
    convention: str | None = None,
) -> Compiled:
    """Compile a network to a netlist within the limits of its chip.

    Parameters
    ----------
    network : str, path or Module
        Checkpoint, ONNX, NIR or netx file, ``pretrained:NAME``, or a torch module of affine stages and
        :class:`spikeloom.LIF` layers.
    example : Tensor, optional
        Input of one step, for a module.
    storage : Fixed, Cheapest or Exact, optional
        How weights are stored, in place of `weight_bits`, `planes`, `scale_groups`, `spike_exact` and
        `keep`.

    Raises
    ------
    SpikeloomError
        If something cannot be used, or the network does not fit; the message says what to do.
    """
    given = dict(locals())
    source = _network("compile", given)
    if storage is not None:
        from spikeloom.runtime.inputs.compilation import options_of

        given |= options_of(storage, given)
    return _compiled(given | recordings_of(given, "calibrate") | {"checkpoint": source})


@documented(NetworkChoice)
def load(
    path: str | os.PathLike[str],
    *,
    network: str | os.PathLike[str] | None = None,
    graph: str | None = None,
    taxels: int | str | None = None,
    edges: str | None = None,
    directed: bool = False,
    run: int = 0,
    weights: str | None = None,
    beta: float | None = None,
    theta: float | None = None,
    polarities: int | None = None,
    polarities_first: bool | None = None,
    dt: float | None = None,
    convention: str | None = None,
) -> Compiled:
    """Read a netlist; `network` is what it was compiled from, for questions that compare, with how that is read.

    Raises SpikeloomError if it is none.
    """
    given = dict(locals())
    from spikeloom.runtime.commands.main_job import inspect
    from spikeloom.runtime.inputs.files import require_netlist

    require_netlist(os.fspath(path))
    facts: Shown = inspect.run(InspectRequest(path=os.fspath(path))).result
    origin = None if network is None else os.fspath(network)
    return Compiled(Path(path), origin, checked(NetworkChoice, given), facts)


@documented(FinetuneRequest)
def finetune(
    network: str | os.PathLike[str] | nn.Module | Network,
    data: Source,
    output: str,
    *,
    example: Tensor | None = None,
    bin: float | None = None,
    target: str = DEFAULT_TARGET,
    weight_bits: Numbers | None = None,
    scale_groups: int | None = None,
    robust: float | None = None,
    epochs: int = 40,
    seed: int = 0,
    resume: bool = False,
    graph: str | None = None,
    taxels: int | str | None = None,
    edges: str | None = None,
    directed: bool = False,
    run: int = 0,
    weights: str | None = None,
    beta: float | None = None,
    theta: float | None = None,
    polarities: int | None = None,
    polarities_first: bool | None = None,
    dt: float | None = None,
    convention: str | None = None,
) -> Compiled:
    """Train a network further on the integers of its chip, and give the netlist of what came of it.

    Of a checkpoint `output` is another one, ``.pt``; of any other network NIR, ``.nir``, its netlist beside
    it.

    Raises
    ------
    SpikeloomError
        As of :func:`compile`, and if the recordings are not the network's.
    """
    given = dict(locals())
    from spikeloom.runtime.commands.training import finetune as command

    given |= _place(data, bin) | {"checkpoint": _network("finetune", given)}
    request = checked(FinetuneRequest, given)
    tuned: Finetuned = command.run(request).result
    if tuned.netlist is None:
        again = {"graph": graph, "taxels": taxels, "edges": edges, "directed": directed}
        return compile(output, **again)  # type: ignore[arg-type]
    return Compiled(
        Path(output).with_name(tuned.netlist), output, NetworkChoice(polarities=polarities), tuned
    )


@documented(TrainRequest)
def train(
    data: Source,
    output: str,
    *,
    bin: float | None = None,
    groups: str | Sequence[str] | None = None,
    system: str | None = None,
    graph: str | None = None,
    taxels: int | str | None = None,
    edges: str | None = None,
    directed: bool = False,
    join: int = 1,
    window: str | None = None,
    padding: str | None = None,
    recipe: str = "released",
    current_decay: str | None = None,
    membrane_decay: str | None = None,
    clocks: int | None = None,
    features: int | None = None,
    hops: int | None = None,
    hidden: Numbers | None = None,
    copies: int | None = None,
    thresholds: Numbers | None = None,
    parts: int | None = None,
    ramp: int | None = None,
    levels: int | None = None,
    weight_bits: int | None = None,
    batch: int | None = None,
    spike_penalty: float | None = None,
    robust: float | None = None,
    epochs: int | None = None,
    decay_epochs: int | None = None,
    seed: int = 0,
    seeds: int = 1,
    resume: bool = False,
    keep: str | Sequence[str] = (),
    picture: str | None = None,
    scheduler: str | None = None,
) -> TrainingReport | CountersReport:
    """Train networks of one system, by the released recipe where nothing else is said, and write them.

    Raises
    ------
    SpikeloomError
        If the recordings cannot be used, or options contradict each other.
    """
    given = dict(locals()) | _place(data, bin)
    from spikeloom.runtime.commands.training import train as command

    result: TrainingReport | CountersReport = command.run(checked(TrainRequest, given)).result
    return result


@documented(SmallestRequest)
def smallest(
    data: Source,
    output: str,
    *,
    bin: float | None = None,
    groups: str | None = None,
    target: str = DEFAULT_TARGET,
    budget: str | Sequence[str] = (),
    levels: int | None = None,
    time: str | None = None,
    store: str | None = None,
    jobs: int | None = None,
    html: str | None = None,
    graph: str | None = None,
    taxels: int | str | None = None,
    edges: str | None = None,
    directed: bool = False,
    scheduler: str | None = None,
) -> Smallest:
    """Choose the cheapest of many networks that is about as accurate as the best, and write it.

    Raises
    ------
    SpikeloomError
        If the recordings cannot be used, or a place cannot be written.
    """
    given = dict(locals()) | _place(data, bin)
    from spikeloom.runtime.commands.choose import smallest as command

    result: Smallest = command.run(checked(SmallestRequest, given)).result
    return result


@documented(ChartRequest)
def chart(
    checkpoints: str | Sequence[str],
    data: Source,
    output: str,
    *,
    bin: float | None = None,
    groups: str | Sequence[str] | None = None,
    grid: str | None = None,
    budget: str | Sequence[str] = (),
    table: str | None = None,
    jobs: int | None = None,
    graph: str | None = None,
    taxels: int | str | None = None,
    edges: str | None = None,
    directed: bool = False,
    run: int = 0,
    weights: str | None = None,
    beta: float | None = None,
    theta: float | None = None,
    scheduler: str | None = None,
) -> Chart:
    """Chart accuracy against energy, time and size for a grid of configurations, and say which to deploy.

    Raises
    ------
    SpikeloomError
        If networks and recordings do not belong together, or the folder cannot be written.
    """
    given = dict(locals()) | _place(data, bin)
    from spikeloom.runtime.commands.choose import chart as command

    result: Chart = command.run(checked(ChartRequest, given)).result
    return result


def _compiled(given: Mapping[str, Any]) -> Compiled:
    """Compile into a folder that goes with the compiled network."""
    from spikeloom.runtime.commands.main_job import compile as command

    folder = tempfile.mkdtemp(prefix="spikeloom-")
    path = Path(folder) / "netlist.loom"
    try:
        request = checked(CompileRequest, {**given, "output": str(path)})
        facts: Shown = command.run(request).result
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    made = Compiled(path, request.checkpoint, NetworkChoice.of(vars(request)), facts)
    weakref.finalize(made, shutil.rmtree, folder, ignore_errors=True)
    return made


def _place(data: Source, bin: float | None) -> dict[str, object]:
    """Where recordings are, and their bins, for questions that read more than one split."""
    if isinstance(data, Data):
        return {"data": data.source, "bin": data.bin if bin is None else bin}
    return {"data": data, "bin": bin}


OF_FILES = ("weights", "beta", "theta", "dt", "convention")
"""Keywords about what a file does not say."""


def _network(what: str, given: Mapping[str, Any]) -> str | Network:
    """File of a network, or what a module means."""
    network, example = given["network"], given["example"]
    if isinstance(network, str | os.PathLike):
        return os.fspath(network)
    from torch import Tensor

    from spikeloom.compiler.ir import Network as FloatNetwork
    from spikeloom.models.networks.module import module_network

    if isinstance(network, FloatNetwork):
        return network
    if not isinstance(example, Tensor):
        raise OptionError(
            f"{what}: a module needs the input of one step; give example=torch.zeros(1, CHANNELS)"
        )
    for name in OF_FILES:
        if given.get(name) is not None:
            raise OptionError(f"{what}: {name} is for files, and a module says it itself; leave it out")
    polarities, polarities_first = given["polarities"], given["polarities_first"]
    return module_network(network, example, polarities=polarities, polarities_first=polarities_first)
