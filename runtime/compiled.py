"""A compiled network, the recordings that it is asked about, and all that can be asked of it."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.files import write_atomically
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.requests.check import CertifyRequest, ExplainRequest, StressRequest
from spikeloom.runtime.requests.choices import ComparisonChoice, NetworkChoice
from spikeloom.runtime.requests.choose import AnytimeRequest
from spikeloom.runtime.requests.exchange import ExportRequest
from spikeloom.runtime.requests.fields import Request, checked, documented
from spikeloom.runtime.requests.main_job import (
    ENGINES,
    EstimateRequest,
    ReportRequest,
    RunRequest,
    VerifyRequest,
)

if TYPE_CHECKING:
    from spikeloom.compiler.ir import Network
    from spikeloom.compiler.types import JsonObject
    from spikeloom.models.recordings.evtouch import Recordings
    from spikeloom.runtime.commands.exchange.export import Written
    from spikeloom.runtime.commands.main_job.run import Decisions
    from spikeloom.runtime.equivalence.explanation.results import Explained
    from spikeloom.runtime.equivalence.verdict import Verdict
    from spikeloom.runtime.machines.base import Price, Stream
    from spikeloom.runtime.machines.netlist_check import NetlistCheck
    from spikeloom.runtime.page.results import Report
    from spikeloom.runtime.studies.anytime.study import Anytime
    from spikeloom.runtime.studies.robustness.results import Certificates, Stress


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
        Seconds of a time bin, which events are put into and bins of arrays are joined to; 0.02 for events where it
        is not given.

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
        window: str | None = None,
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
        window: str | None = None,
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
        window: str | None = None,
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
        groups: str | Sequence[str] | None = None,
        only: str | Sequence[str] | None = None,
        seeds: int = 5,
        require: str | Sequence[str] = (),
        jobs: int | None = None,
        scheduler: str | None = None,
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
        checkpoint: str | Network | None = None,
        shift: int = 25,
        most: int = 16,
        jobs: int | None = None,
        scheduler: str | None = None,
        picture: str | None = None,
        output: str | None = None,
        certificate: str | None = None,
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

    @documented(ExplainRequest)
    def explain(
        self,
        data: Source | Recordings,
        *,
        split: str = "test",
        limit: int | None = None,
        sample: str | int | None = None,
        top: int = 10,
    ) -> Explained:
        """Say why chip and float model differ on one recording: roots, their causes, and what removes them.

        Raises SpikeloomError as :meth:`verify` does.
        """
        from spikeloom.runtime.commands.check import explain

        result: Explained = explain.run(self._comparison(ExplainRequest, locals())).result
        return result

    @documented(ExportRequest)
    def export(
        self,
        output: str,
        to: str,
        *,
        form: str | None = None,
        data: Source | Recordings | None = None,
        split: str | None = None,
        recording: int | None = None,
        dt: float | None = None,
    ) -> Written:
        """Write the netlist in the format of another program.

        Raises SpikeloomError if that cannot say what the netlist does, or the file cannot be written.
        """
        from spikeloom.runtime.commands.exchange import export

        given = dict(locals())
        given |= {"source": str(self.path)} | recordings_of(given)
        result: Written = export.run(checked(ExportRequest, given)).result
        return result

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the netlist, a ``.loom`` file."""
        require_place(os.fspath(path), "save", kinds=["loom"])
        content = self.path.read_bytes()  # before the place is touched, which may be its own
        with write_atomically(path) as file:
            file.write(content)

    def stream(self) -> Stream:
        """Open a live stream: ``step(events)`` takes one bin (taxels, 2), and gives the votes so far.

        Its ``decision`` ends the grasp, and is that of :meth:`run`; the votes of a step are not final.
        """
        from spikeloom.runtime.machines.backends import machine_for
        from spikeloom.runtime.report.console import tell

        machine = machine_for(self.path)
        if (bins := machine.netlist.bins) > 1:
            tell(f"warning: {self.path.name}: a step is {bins} bins joined; hand in what of them is set")
        return machine.stream()

    def _question(self, kind: type[Request], given: Mapping[str, Any]) -> Any:
        """The request of a method from its keywords."""
        return checked(kind, dict(given) | recordings_of(given) | {"netlist": str(self.path)})

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


def recordings_of(given: Mapping[str, Any], name: str = "data") -> JsonObject:
    """Keywords of a request for the recordings that were given: ``Data`` are read for its network, as by a command."""
    data = given[name]
    if not isinstance(data, Data):
        return {name: data}
    return {name: data.source, "bin": given.get("bin") if data.bin is None else data.bin}
