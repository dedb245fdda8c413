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
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.targets import DEFAULT_TARGET
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.report.shown import Shown
from spikeloom.runtime.requests.check import CertifyRequest, StressRequest
from spikeloom.runtime.requests.choices import ComparisonChoice, NetworkChoice
from spikeloom.runtime.requests.choose import AnytimeRequest, ChartRequest, SmallestRequest
from spikeloom.runtime.requests.fields import Request, checked, documented
from spikeloom.runtime.requests.main_job import (
    ENGINES,
    CompileRequest,
    EstimateRequest,
    InspectRequest,
    ReportRequest,
    RunRequest,
    VerifyRequest,
)
from spikeloom.runtime.requests.training import FinetuneRequest, TrainRequest

if TYPE_CHECKING:
    from torch import Tensor, nn

    from spikeloom.compiler.ir import Network
    from spikeloom.compiler.storage import Cheapest, Exact, Fixed
    from spikeloom.models.recordings.evtouch import Recordings
    from spikeloom.runtime.commands.main_job.run import Decisions
    from spikeloom.runtime.equivalence.verdict import Verdict
    from spikeloom.runtime.machines.base import Price, Stream
    from spikeloom.runtime.machines.netlist_check import NetlistCheck
    from spikeloom.runtime.page.results import Report
    from spikeloom.runtime.studies.anytime.study import Anytime
    from spikeloom.runtime.studies.chart.results import Chart
    from spikeloom.runtime.studies.counting import CountersReport
    from spikeloom.runtime.studies.robustness.results import Certificates, Stress
    from spikeloom.runtime.studies.smallest.results import Smallest
    from spikeloom.runtime.studies.training.finetuning import Finetuned
    from spikeloom.runtime.studies.training.results import TrainingReport

Numbers = int | str | Sequence[int]
"""One number for all layers, or one for each."""


@dataclass(frozen=True)
class Data:
    """Recordings of a source by split, read when they are first needed; made by :func:`recordings`."""

    source: str
    bin: float | None

    @cached_property
    def train(self) -> Recordings:
        """The training split."""
        return self.split("train")

    @cached_property
    def test(self) -> Recordings:
        """The test split."""
        return self.split("test")

    def split(self, name: str) -> Recordings:
        """Recordings of a split: ``events`` (samples, taxels, 2, steps) uint8, ``labels``, ``files``.

        Raises DataError if there are none, or they cannot be read.
        """
        from spikeloom.runtime.inputs.recordings import recordings as read

        return read(self.source, name, classes=None, taxels=None, bin_s=self.bin)


Source = Data | str | os.PathLike[str]
"""Where recordings are."""


def recordings(source: str | os.PathLike[str], *, bin: float | None = None) -> Data:
    """Name recordings: a zip, folder or file of them, ``synthetic``, ``objects`` or ``containers``.

    Parameters
    ----------
    source : str or path
        As of ``--data``.
    bin : float, optional
        Seconds of a time bin, for files of single events; 0.02 where it is not given.

    Raises
    ------
    DataError
        If there are none.
    """
    from spikeloom.models.recordings.events import data_splits
    from spikeloom.models.recordings.grasps import SYNTHETIC

    place = os.fspath(source)
    if place != SYNTHETIC:
        data_splits(place)
    return Data(place, bin)


@dataclass(frozen=True, eq=False, repr=False)
class Compiled:
    """A netlist, with the network that it was compiled from; made by :func:`compile`, :func:`finetune`, :func:`load`.

    path: file of the netlist.
    network: what it was compiled from, and how that is read; None if that is not known.
    facts: what the compiler of the chip chose, proved and removed, or what :func:`load` found in the file.
    """

    path: Path
    network: str | Network | None
    reading: NetworkChoice
    facts: Any

    def check(self) -> NetlistCheck:
        """Hold what the netlist stores against lowering its network again, level EN; nothing is simulated.

        Raises SpikeloomError if they do not belong together.
        """
        from spikeloom.runtime.commands.main_job import verify

        result: NetlistCheck = verify.run(self._comparison(VerifyRequest, {"data": None})).result
        return result

    @documented(VerifyRequest)
    def verify(
        self,
        data: Source | Recordings,
        *,
        split: str = "test",
        limit: int | None = None,
        window: str = "100%",
        original: str | None = None,
        engine: str = ENGINES[0],
        min_agreement: float | None = None,
        require: str | None = None,
        spec_samples: int = 3,
    ) -> Verdict:
        """Compare chip and float model, spike for spike.

        Raises SpikeloomError if network, netlist and recordings do not belong together, and ModelError if
        the netlist is so unlike its network that nothing can be compared: :meth:`check` says how.
        """
        from spikeloom.runtime.commands.main_job import verify
        from spikeloom.runtime.equivalence.verdict import Verdict

        result = verify.run(self._comparison(VerifyRequest, locals())).result
        if not isinstance(result, Verdict):
            raise ModelError(f"{self.path.name}: {str(result).splitlines()[0]}; check() lists all")
        return result

    @documented(EstimateRequest)
    def estimate(
        self,
        data: Source | Recordings,
        *,
        split: str = "test",
        limit: int | None = None,
        window: str = "100%",
        detail: str = "counts",
        table: str | None = None,
    ) -> Price:
        """Operations, joules and seconds of an inference, by every table of the chip's prices.

        Raises SpikeloomError if the recordings do not suit the netlist.
        """
        from spikeloom.runtime.commands.main_job.estimate import price

        return price(self._question(EstimateRequest, locals()))[2]

    @documented(RunRequest)
    def run(
        self,
        data: Source | Recordings,
        *,
        split: str = "test",
        limit: int | None = None,
        window: str = "100%",
        spikes: str | None = None,
    ) -> Decisions:
        """Decisions of recordings, bit for bit the chip's.

        Raises SpikeloomError if the recordings do not suit the netlist.
        """
        from spikeloom.runtime.commands.main_job import run

        result: Decisions = run.run(self._question(RunRequest, locals())).result
        return result

    @documented(ReportRequest)
    def report(
        self,
        output: str,
        data: Source | Recordings,
        *,
        split: str = "test",
        limit: int | None = None,
        recording: str | None = None,
        stress: str | None = None,
        spec_samples: int = 3,
    ) -> Report:
        """Write a self-contained page: verdict, accuracy, cores, taxels, spikes, energy, time, provenance.

        Raises SpikeloomError as :meth:`verify` does, or if the page cannot be written.
        """
        from spikeloom.runtime.commands.main_job import report

        result: Report = report.run(self._comparison(ReportRequest, locals())).result
        return result

    @documented(StressRequest)
    def stress(
        self,
        data: Source | Recordings,
        *,
        split: str = "test",
        limit: int | None = None,
        only: str | Sequence[str] | None = None,
        seeds: int = 5,
        require: str | Sequence[str] = (),
        jobs: int | None = None,
        picture: str | None = None,
        output: str | None = None,
    ) -> Stress:
        """Find where float model and chip break under a seeded battery of perturbations.

        Raises SpikeloomError as :meth:`verify` does.
        """
        from spikeloom.runtime.commands.check import stress

        result: Stress = stress.run(self._comparison(StressRequest, locals())).result
        return result

    @documented(CertifyRequest)
    def certify(
        self,
        data: Source | Recordings,
        *,
        split: str = "test",
        limit: int | None = None,
        shift: int = 25,
        most: int = 16,
        jobs: int | None = None,
        picture: str | None = None,
        output: str | None = None,
    ) -> Certificates:
        """Decide for every small change of each recording whether it alters the decision; none is sampled.

        Raises SpikeloomError if the recordings do not suit the netlist.
        """
        from spikeloom.runtime.commands.check import certify

        result: Certificates = certify.run(self._question(CertifyRequest, locals())).result
        return result

    @documented(AnytimeRequest)
    def anytime(
        self,
        data: Source | Recordings,
        *,
        split: str = "test",
        limit: int | None = None,
        calibrate: str | None = None,
        held_out: bool = False,
        differ: float | None = None,
        output: str | None = None,
    ) -> Anytime:
        """Say how early each decision could be taken, and what that saves.

        Raises SpikeloomError if the recordings do not suit the netlist.
        """
        from spikeloom.runtime.commands.choose import anytime

        result: Anytime = anytime.run(self._question(AnytimeRequest, locals())).result
        return result

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the netlist, a ``.loom`` file."""
        require_place(os.fspath(path), "save", kinds=["loom"])
        shutil.copyfile(self.path, path)

    def stream(self) -> Stream:
        """Open a live stream: ``step(events)`` takes one bin (taxels, 2), and gives the votes so far."""
        from spikeloom.runtime.machines.backends import machine_for

        return machine_for(self.path).stream()

    def _question(self, kind: type[Request], given: Mapping[str, Any]) -> Any:
        """The request of a method from its keywords."""
        return checked(kind, dict(given) | {"data": _data(given), "netlist": str(self.path)})

    def _comparison(self, kind: type[ComparisonChoice], given: Mapping[str, Any]) -> Any:
        """The same, where the network is compared with."""
        if self.network is None:
            raise OptionError("of a loaded netlist its network is not known; give load(…, network=…)")
        reading = {each.name: getattr(self.reading, each.name) for each in NetworkChoice.options()}
        return self._question(kind, reading | dict(given) | {"checkpoint": self.network})

    def __str__(self) -> str:
        return str(self.facts)

    def __repr__(self) -> str:
        return repr(self.facts)

    def _repr_html_(self) -> str:
        return str(self.facts._repr_html_())


verify = Compiled.verify
estimate = Compiled.estimate
run = Compiled.run
report = Compiled.report
stress = Compiled.stress
certify = Compiled.certify


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
    """Lower a network to a netlist that obeys every limit of its chip.

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
    source = _network("compile", network, example)
    if storage is not None:
        from spikeloom.runtime.inputs.compilation import options_of

        given |= options_of(storage, given)
    folder = tempfile.mkdtemp(prefix="spikeloom-")
    path = Path(folder) / "netlist.loom"
    from spikeloom.runtime.commands.main_job import compile as command

    try:
        seen = {"calibrate": _data({"data": calibrate}, "train")}
        request = checked(CompileRequest, given | seen | {"checkpoint": source, "output": str(path)})
        facts: Shown = command.run(request).result
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    made = Compiled(path, source, NetworkChoice.of(vars(request)), facts)
    weakref.finalize(made, shutil.rmtree, folder, ignore_errors=True)
    return made


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

    given |= _place(data, bin) | {"checkpoint": _network("finetune", network, example)}
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
    target: str = DEFAULT_TARGET,
    budget: str | Sequence[str] = (),
    levels: int | None = None,
    store: str | None = None,
    jobs: int | None = None,
    html: str | None = None,
    graph: str | None = None,
    taxels: int | str | None = None,
    edges: str | None = None,
    directed: bool = False,
) -> Smallest:
    """Find the cheapest network that does the job, among counting networks and some that are trained; write it.

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


def _data(given: Mapping[str, Any], split: str | None = None) -> Any:
    """Recordings that a request takes: those of a split of ``Data``, or what was given."""
    data = given["data"]
    return data.split(split or given["split"]) if isinstance(data, Data) else data


def _place(data: Source, bin: float | None) -> dict[str, object]:
    """Where recordings are, and their bins, for questions that read more than one split."""
    if isinstance(data, Data):
        return {"data": data.source, "bin": data.bin if bin is None else bin}
    return {"data": data, "bin": bin}


def _network(
    what: str, network: str | os.PathLike[str] | nn.Module | Network, example: Tensor | None
) -> str | Network:
    """File of a network, or what a module means."""
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
    return module_network(network, example)
